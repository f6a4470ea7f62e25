"""The archive: what a run leaves on disk, the figures drawn from it and the numbers read off it."""
