"""Cells: parts of the city whose vehicles sense in worker processes."""
