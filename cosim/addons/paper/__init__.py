"""Reproduction of the paper: its scenarios and experiments, with its results beside the obtained ones."""
