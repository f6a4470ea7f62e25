"""Range noise and dropouts of a sweep, each a function of (key of the sweep, ray)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float32, UInt64
from numpy import ndarray

from cosim.base.hash_rng import GOLDEN, splitmix64
from cosim.base.kernel import compiled
from sensors.scene import Hit

_SECOND = np.uint64(2 * int(GOLDEN) % 2**64)
_LANES, _ONE = np.uint64(4), np.uint64(1)
_S4, _S11 = np.uint16(4), np.uint64(11)


class RangeNoise(NamedTuple):
    """Noise along the ray: normal, in 4,096 equiprobable levels."""

    key: UInt64[ndarray, "m"]
    """Of each sweep."""
    sigma_m: np.float32
    dropout_p: float
    level: Float32[ndarray, "4096"]
    """Standard normal quantiles in the middle of equally probable bins, at unit variance."""

    @staticmethod
    def of(keys: UInt64[ndarray, "m"], sigma_m: float, dropout_p: float) -> RangeNoise:
        """Noise of some sweeps.

        Parameters
        ----------
        keys
            Key of each sweep.
        sigma_m
            Standard deviation of a range.
        dropout_p
            Probability that a return is lost.
        """
        return RangeNoise(np.asarray(keys, np.uint64), np.float32(sigma_m), float(dropout_p), _levels())


@lru_cache(maxsize=1)
def _levels() -> Float32[ndarray, "k"]:
    z = scipy.special.ndtri((np.arange(4096) + 0.5) / 4096)
    return (z / z.std()).astype(np.float32)


@compiled
def add_noise(ranges, hits, key, noise):
    """Range noise and dropouts of one sweep, in place."""
    if noise.sigma_m > 0.0:
        _displace(ranges, splitmix64(key + GOLDEN), noise)
    if noise.dropout_p > 0.0:
        _drop(ranges, hits, splitmix64(key + _SECOND), noise)


@compiled
def _displace(ranges, seed, noise):
    """Range noise: one hash gives four rays of a column 16 bits each, of which the highest 12 number a level."""
    n = np.uint64(ranges.shape[0])
    m = np.uint64(ranges.shape[1])
    zero = np.float32(0.0)
    level_m = noise.sigma_m * noise.level
    off_m = np.empty(m, np.float32)
    n_words = (m + _LANES - _ONE) // _LANES
    words = np.empty(n_words, np.uint64)
    drawn = words.view(np.uint16)
    for c in range(n):  # looking up is a loop of its own, because it is not vectorised
        for w in range(n_words):
            words[w] = splitmix64(seed + (c * n_words + w) * GOLDEN)
        for r in range(m):
            off_m[r] = level_m[drawn[r] >> _S4]
        for r in range(m):
            d = ranges[c, r] + off_m[r]
            ranges[c, r] = d if d > zero else zero


@compiled
def _drop(ranges, hits, seed, noise):
    """Dropouts of one sweep: a hash per ray, independent of those of the noise."""
    n = np.uint64(ranges.shape[0])
    m = np.uint64(ranges.shape[1])
    lost_below = np.uint64(noise.dropout_p * 2.0**53)
    for c in range(n):
        for r in range(m):
            drawn = splitmix64(seed + (c * m + r) * GOLDEN)
            if drawn >> _S11 < lost_below:
                ranges[c, r] = np.inf
                hits[c, r] = Hit.NOTHING
