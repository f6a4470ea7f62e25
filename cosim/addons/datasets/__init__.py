"""Readers of recorded data sets: annotations and detections in their published layouts."""
