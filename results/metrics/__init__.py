"""Figures of merit, each a function from a run to a small tidy DataFrame."""
