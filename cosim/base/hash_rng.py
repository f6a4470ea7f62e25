"""Counter-based random numbers. A draw is a hash of a key, so it does not depend on order or threads.

The mixer is that of SplitMix64 [1]_.

References
----------
.. [1] G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014.
"""

from __future__ import annotations

import numpy as np
import scipy
from jaxtyping import Float, UInt64
from numpy import ndarray

from cosim.base.kernel import compiled, inlined

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_A, _B = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)
_S11, _ONE = np.uint64(11), np.uint64(1)
_TO_UNIT = 2.0**-53


@inlined
def splitmix64(x):
    """A 64-bit hash of a 64-bit number."""
    x = (x ^ (x >> _S30)) * _A
    x = (x ^ (x >> _S27)) * _B
    return x ^ (x >> _S31)


@inlined
def mix(h, x):
    """Hash of the prefix `h` (uint64) extended by the integer `x`."""
    return splitmix64(h + (np.uint64(x) + _ONE) * GOLDEN)


@inlined
def unit(h):
    """Uniform in [0, 1) with 53 bits from a hash (uint64)."""
    return (h >> _S11) * _TO_UNIT


def mix_rows(
    keys: UInt64[ndarray, "k"],
    ids: UInt64[ndarray, "k"],
) -> UInt64[ndarray, "k"]:
    """New keys: each key extended by the identifier in the same row, as `mix` does for one."""
    return splitmix64.py_func(keys + (ids + _ONE) * GOLDEN)


@compiled
def uniforms(keys: UInt64[ndarray, "k"], n: int) -> Float[ndarray, "k n"]:
    """`n` uniforms in [0, 1) of each key."""
    out = np.empty((len(keys), n))
    for row in range(len(keys)):
        for column in range(n):
            out[row, column] = unit(mix(keys[row], column))
    return out


def normals(keys: UInt64[ndarray, "k"], n: int) -> Float[ndarray, "k n"]:
    """`n` standard normals of each key.

    Returns
    -------
    Row i depends on key i alone, and the first columns do not depend on `n`.
    """
    return scipy.special.ndtri(np.maximum(uniforms(keys, n), _TO_UNIT))


def persistent_normals(keys: UInt64[ndarray, "k"], n: int, time_s: float, memory_s: float) -> Float[ndarray, "k n"]:
    """`n` standard normals of each key that change slowly with time.

    Parameters
    ----------
    keys
        Keys that are the same at all times.
    n
        Number of normals per key.
    time_s
        The present time.
    memory_s
        Time after which the draws of a key are replaced.

    Returns
    -------
    Row i depends on key i and the times alone, and the first columns do not depend on `n`.

    Notes
    -----
    Each key has independent normals every `memory_s` seconds, at a random phase. Between two of them, a and b, the
    value is (1 - w) a + w b, scaled to unit variance. The correlation is 0.72 after half of `memory_s`, 0.28 after
    `memory_s`, and 0 after twice `memory_s` or more.
    """
    phase = uniforms(keys, 1)[:, 0]
    cell, w = np.divmod(time_s / memory_s + phase, 1.0)
    before = normals(mix_rows(keys, (cell + 1.0).astype(np.uint64)), n)
    after = normals(mix_rows(keys, (cell + 2.0).astype(np.uint64)), n)
    w = w[:, None]
    mean = (1.0 - w) * before + w * after
    return mean / np.sqrt((1.0 - w) ** 2 + w**2)
