"""Copies of every fourth column and every second row of sweeps, next to each other in memory.

These rays suffice to compute shares of the returns. The ray caster copies them while the sweep is in the processor's
cache. Selecting them later would read the whole sweep from memory again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int, UInt16
from numpy import ndarray

from sensors.kernel import kernel

COLUMN_STEP, ROW_STEP = 4, 2


class Thinned(NamedTuple):
    """The selected rays of M sweeps."""

    range_steps: UInt16[ndarray, "m a/4 e/2"]
    hit: Int[ndarray, "m a/4 e/2"]


def thinned_size(size: tuple[int, int, int]) -> tuple[int, int, int]:
    """Size of the selection from the size (sweeps, columns, rows) of whole sweeps."""
    m, a, e = size
    return m, -(-a // COLUMN_STEP), -(-e // ROW_STEP)


@kernel
def thin(steps, hits, some_steps, some_hits):
    """Copy the selected rays of one sweep."""
    step, skip = np.uint64(COLUMN_STEP), np.uint64(ROW_STEP)
    for c in range(np.uint64(some_hits.shape[0])):
        for r in range(np.uint64(some_hits.shape[1])):
            some_steps[c, r] = steps[c * step, r * skip]
        for r in range(np.uint64(some_hits.shape[1])):
            some_hits[c, r] = hits[c * step, r * skip]
