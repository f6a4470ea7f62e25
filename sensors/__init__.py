"""Sensors: what the LiDAR of each equipped vehicle returns, and what a detector reports."""
