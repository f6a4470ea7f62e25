"""Ranges as a LiDAR reports them: whole numbers of steps, in 16 bits."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt16
from numpy import ndarray

from cosim.base.kernel import kernel

NO_RETURN = 65_535
"""Code of a ray without a return."""

FINEST_M = 2.0**-9
"""The step of 2 mm in which HDL-64E reports ranges (Velodyne HDL-64E S2 manual), rounded to a power of two: single
precision holds every multiple of it."""

_HALF = np.float32(0.5)
_MOST = np.float32(NO_RETURN)


def step_m(max_range_m: float, range_sigma_m: float) -> float:
    """Finest step for which 16 bits hold all ranges with noise: 1.95 mm up to 127 m, twice that up to 254 m."""
    step = FINEST_M
    while max_range_m + 4.0 * range_sigma_m > (NO_RETURN - 1) * step:
        step *= 2.0
    return step


@kernel
def count_steps(ranges, steps, per_metre):
    """The ranges of one sweep in steps, to the nearest; `per_metre` of them make a metre."""
    n = np.uint64(ranges.shape[0])
    m = np.uint64(ranges.shape[1])
    for c in range(n):
        for r in range(m):
            rounded = ranges[c, r] * per_metre + _HALF
            steps[c, r] = np.int32(min(rounded, _MOST))


def metres(range_steps: UInt16[ndarray, "*n"], step: float) -> Float32[ndarray, "*n"]:
    """Ranges in metres.

    Parameters
    ----------
    range_steps
        Ranges in steps, or `NO_RETURN`.
    step
        Length of a step [m].

    Returns
    -------
    Ranges [m]; inf for rays without a return.
    """
    range_m = range_steps * np.float32(step)
    return np.where(range_steps == NO_RETURN, np.float32(np.inf), range_m)
