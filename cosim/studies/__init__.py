"""Studies: many runs from one file, planned so that nothing is computed twice, on one machine or many."""
