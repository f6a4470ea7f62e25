"""Hashes for draws that a kernel makes itself: chance comes in as a key, and a draw is a function of it.

The mixer is that of SplitMix64 [1]_.

References
----------
.. [1] G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014.
"""

from __future__ import annotations

import numpy as np
from numba import njit

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_A, _B = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11, _ONE = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11), np.uint64(1)
_TO_UNIT = 2.0**-53


@njit(cache=True, inline="always")
def scrambled(x):
    """A 64-bit hash of a 64-bit number."""
    x = (x ^ (x >> _S30)) * _A
    x = (x ^ (x >> _S27)) * _B
    return x ^ (x >> _S31)


@njit(cache=True, inline="always")
def joined(h, x):
    """Hash of what `h` (uint64) stands for, followed by the whole number `x`."""
    return scrambled(h + (np.uint64(x) + _ONE) * GOLDEN)


@njit(cache=True, inline="always")
def unit(h):
    """Uniform in [0, 1) with 53 bits from a hash (uint64)."""
    return (h >> _S11) * _TO_UNIT
