"""Trackers from step to step: they take arrays and return rows of the run's tables. The cycle does not read them."""
