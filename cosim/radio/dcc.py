"""Reactive decentralised congestion control: least time between two frames of a station.

References
----------
.. [1] ETSI TS 102 687 V1.2.1, "Decentralized congestion control mechanisms for ITS operating in the 5 GHz range".
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, Int, UInt64
from numpy import ndarray

STATES = ("relaxed", "active 1", "active 2", "active 3", "restrictive")


@dataclass(frozen=True, kw_only=True, slots=True)
class DccParams:
    """Reactive congestion control on the channel busy ratio."""

    enabled: bool = True
    """Whether congestion control is active."""
    cbr_bounds: tuple[float, float, float, float] = (0.30, 0.40, 0.50, 0.65)
    """Busy ratios from which the states active 1, 2, 3 and restrictive begin."""
    t_off_s: tuple[float, float, float, float, float] = (0.05, 0.1, 0.2, 0.25, 1.0)
    """Least time between two frames in the states relaxed to restrictive [s]."""
    smoothing: Annotated[float, Gt(0), Le(1)] = 0.5
    """Weight of the newest busy ratio in the running mean."""
    period_s: Annotated[float, Ge(0.001), Le(60)] = 0.1
    """Time over which the busy ratio is measured; the state moves one step in each [s]."""

    def __post_init__(self) -> None:
        bounds, gaps = self.cbr_bounds, self.t_off_s
        if len(bounds) != 4 or list(bounds) != sorted(set(bounds)) or not 0 < bounds[0] <= bounds[-1] <= 1:
            raise ValueError(f"radio.dcc.cbr_bounds = {bounds} must be four increasing busy ratios in (0, 1].")
        if len(gaps) != 5 or list(gaps) != sorted(gaps) or gaps[0] < 0 or gaps[-1] > 60:
            raise ValueError(f"radio.dcc.t_off_s = {gaps} must be five times [s] from 0 to 60 that do not decrease.")


@dataclass(frozen=True, slots=True)
class DccState:
    """State of congestion control of N stations."""

    key: UInt64[ndarray, "n"]
    cbr: Float[ndarray, "n"]
    """Busy ratio, smoothed."""
    level: Int[ndarray, "n"]
    """Row of `STATES`."""

    @staticmethod
    def start() -> "DccState":
        """No stations yet."""
        return DccState(np.zeros(0, np.uint64), np.zeros(0), np.zeros(0, np.int8))

    def of(self, key: UInt64[ndarray, "n"]) -> "DccState":
        """The state of these stations (each once), in this order. New ones start relaxed, on an idle channel."""
        if np.array_equal(self.key, key):
            return self
        _, was, now = np.intersect1d(self.key, key, assume_unique=True, return_indices=True)
        cbr, level = np.zeros(len(key)), np.zeros(len(key), np.int8)
        cbr[now], level[now] = self.cbr[was], self.level[was]
        return DccState(key, cbr, level)


def update(state: DccState, key: UInt64[ndarray, "n"], busy: Float[ndarray, "n"], params: DccParams) -> DccState:
    """The state of stations after one more period.

    Parameters
    ----------
    key
        Stations, each once. Stations of the state that are not among them are dropped; new ones start relaxed.
    busy
        Busy ratio that each station measured in the period, in [0, 1].

    Raises
    ------
    ValueError
        If a busy ratio is outside 0 to 1.

    Notes
    -----
    The state moves one step towards the state of the smoothed busy ratio.   Deviations from [1]_: one step per period,
    both upwards and downwards; no control of power, rate or sensitivity.
    """
    if not ((busy >= 0) & (busy <= 1 + 1e-9)).all():
        raise ValueError("busy ratios must lie in 0 ... 1.")
    now = state.of(key)
    cbr = (1 - params.smoothing) * now.cbr + params.smoothing * busy
    wanted = np.searchsorted(params.cbr_bounds, cbr, side="right")
    level = (now.level + np.sign(wanted - now.level)).astype(np.int8)
    return DccState(key, cbr, level)


def gap_ns(state: DccState, key: UInt64[ndarray, "n"], params: DccParams) -> Int[ndarray, "n"]:
    """Least time between two frames of each of these stations (each once) [ns]; 0 if control is off."""
    if not params.enabled:
        return np.zeros(len(key), np.int64)
    gaps = np.rint(np.array(params.t_off_s) * 1e9).astype(np.int64)
    return gaps[state.of(key).level]
