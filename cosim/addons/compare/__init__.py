"""Comparison of what cosim computes with published and measured values: `cosim validate`."""
