"""Families of distributions of durations, by their survival functions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import special, stats

Free = Float[ndarray, "k"]
"""Parameters without bounds, in which the likelihood is maximised and intervals are symmetric."""

Values = Float[ndarray, "n"]
"""Durations [s], or probabilities."""

_LARGEST_LOG = 300.0
"""Largest logarithm of a ratio of means. Beyond it, products of means and of durations overflow."""


@dataclass(frozen=True, slots=True)
class Family:
    """A family of distributions on the positive numbers.

    `log_sf(x, free)` is the logarithm of the survival function, -inf where nothing lasts so long.
    """

    label: str
    parameters: tuple[str, ...]
    """Names, with units as suffix; in the order of the free parameters, one to one and increasing in each."""
    log_sf: Callable[[Values, Free], Values]
    natural: Callable[[Free], Float[ndarray, "k"]]
    """Parameters in their own units from the free ones, each from the one in its place."""
    starts: Callable[[float, float], list[Free]]
    """Where to begin, from the median and the mean of durations."""
    draw: Callable[[Free, Values], Values]
    """Durations at these survival probabilities (inverse of the survival function)."""


def _exponential() -> Family:
    return Family(
        "exponential",
        ("mean_s",),
        lambda x, free: -x / np.exp(free[0]),
        np.exp,
        lambda median_s, mean_s: [np.log([mean_s])],
        lambda free, p: stats.expon.isf(p, scale=np.exp(free[0])),
    )


def _weibull() -> Family:
    return Family(
        "Weibull",
        ("shape", "scale_s"),
        lambda x, free: -((x / np.exp(free[1])) ** np.exp(free[0])),
        np.exp,
        lambda median_s, mean_s: [
            np.array([0.0, np.log(mean_s)]),
            np.array([-0.5, np.log(median_s)]),
        ],
        lambda free, p: stats.weibull_min.isf(
            p,
            np.exp(free[0]),
            scale=np.exp(free[1]),
        ),
    )


def _log_normal() -> Family:
    def log_sf(x: Float[ndarray, "n"], free: Free) -> Float[ndarray, "n"]:
        log_x = np.log(np.maximum(x, 1e-300))
        return special.log_ndtr((free[0] - log_x) / np.exp(free[1]))

    return Family(
        "log-normal",
        ("median_s", "sigma"),
        log_sf,
        np.exp,
        lambda median_s, mean_s: [np.array([np.log(median_s), 0.0])],
        lambda free, p: stats.lognorm.isf(
            p,
            np.exp(free[1]),
            scale=np.exp(free[0]),
        ),
    )


def _generalised_pareto() -> Family:
    def log_sf(x: Float[ndarray, "n"], free: Free) -> Float[ndarray, "n"]:
        ratio = x / np.exp(free[1])
        if abs(free[0]) < 1e-9:
            return -ratio
        with np.errstate(divide="ignore"):
            scaled = np.maximum(free[0] * ratio, -1.0)
            return -np.log1p(scaled) / free[0]

    return Family(
        "generalised Pareto",
        ("shape", "scale_s"),
        log_sf,
        lambda free: np.array([free[0], np.exp(free[1])]),
        lambda median_s, mean_s: [
            np.array([0.1, np.log(mean_s)]),
            np.array([0.6, np.log(median_s)]),
        ],
        lambda free, p: stats.genpareto.isf(p, free[0], scale=np.exp(free[1])),
    )


def _hyper_exponential() -> Family:
    """A share of short ones and a rest of long ones, both exponential; the second mean is the larger one."""

    def natural(free: Free) -> Float[ndarray, "3"]:
        ratio = np.exp(np.minimum(free[2], _LARGEST_LOG))  # a search may try means that no number can hold
        short_share, short_s = special.expit(free[0]), np.exp(free[1])
        return np.array([short_share, short_s, 1 + ratio])

    def log_sf(x: Float[ndarray, "n"], free: Free) -> Float[ndarray, "n"]:
        _, short_s, ratio = natural(free)
        with np.errstate(invalid="ignore"):
            short = -x / short_s + special.log_expit(free[0])
            long = -x / (short_s * ratio) + special.log_expit(-free[0])
            return np.where(np.isinf(x), -np.inf, np.logaddexp(short, long))

    def draw(free: Free, p: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
        _, short_s, ratio = natural(free)
        low = np.zeros(len(p))
        high = np.full(len(p), short_s * ratio * 800.0)
        for _ in range(80):
            middle = (low + high) / 2
            above = np.exp(log_sf(middle, free)) > p
            low = np.where(above, middle, low)
            high = np.where(above, high, middle)
        return (low + high) / 2

    def starts(median_s: float, mean_s: float) -> list[Free]:
        tried = (
            (0.0, median_s / 2, 4.0),
            (1.0, mean_s / 2, 5.0),
            (-1.0, median_s / 4, 8.0),
        )
        found = []
        for share, short_s, ratio in tried:
            found.append(np.array([share, np.log(short_s), np.log(ratio)]))
        return found

    return Family(
        "hyper-exponential",
        ("short_share", "short_mean_s", "ratio_of_means"),
        log_sf,
        natural,
        starts,
        draw,
    )


FAMILIES: Mapping[str, Family] = {
    "exponential": _exponential(),
    "weibull": _weibull(),
    "log_normal": _log_normal(),
    "generalised_pareto": _generalised_pareto(),
    "hyper_exponential": _hyper_exponential(),
}
"""The families that are fitted, by name."""
