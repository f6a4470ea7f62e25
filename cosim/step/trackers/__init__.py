"""What is followed from step to step beside the cycle: plain arrays in, rows of the run's tables out."""
