"""Intervals of ratios and means over units that are independent of each other: vehicles, not messages."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

LEVEL = 0.95
FEW = 10
"""Fewer units than this are too few for a figure: a result then says so."""
_DRAWS = 1000
_FEWEST = 3


class Estimate(NamedTuple):
    """A share or mean with its interval."""

    value: float
    low: float
    """NaN, as `high`, where there are fewer than three units."""
    high: float
    n_units: int
    """Units with something to count."""


def ratio(top: Float[ndarray, "u"], bottom: Float[ndarray, "u"], level: float = LEVEL) -> Estimate:
    """Sum over sum, with a percentile interval of the cluster bootstrap [1]_: whole units are drawn again.

    Parameters
    ----------
    top, bottom
        Per unit; a unit whose bottom is 0 does not count. With bottom the number of values and top their sum, the
        ratio is the mean over all values, of units with many as of units with few.

    Notes
    -----
    1,000 draws of a fixed seed: the same table gives the same interval. Percentile intervals are too narrow for few
    units; below `FEW` the value is to be read as an example.

    References
    ----------
    .. [1] Field, Welsh, "Bootstrapping clustered data", J. R. Statist. Soc. B 69(3), 2007.
    """
    some = bottom > 0
    top, bottom = np.asarray(top, float)[some], np.asarray(bottom, float)[some]
    n = len(bottom)
    if not n:
        return Estimate(float("nan"), float("nan"), float("nan"), 0)
    value = float(top.sum() / bottom.sum())
    if n < _FEWEST:
        return Estimate(value, float("nan"), float("nan"), n)
    drawn = _drawn(n)
    low, high = np.quantile((drawn @ top) / (drawn @ bottom), [(1 - level) / 2, (1 + level) / 2])
    return Estimate(value, float(low), float(high), n)


@lru_cache(maxsize=8)
def _drawn(n: int) -> Int[ndarray, "draws n"]:
    """How often each of `n` units is drawn, in every draw; metrics of one run ask for the same few `n` again."""
    return np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), size=_DRAWS)
