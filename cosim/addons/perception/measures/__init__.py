"""Measures of perception that stand beside published ones in `cosim compare`."""
