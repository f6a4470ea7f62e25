"""Decentralised congestion control, reactive or adaptive (LIMERIC): least time between two frames of a station.

References
----------
.. [1] ETSI TS 102 687 V1.2.1, "Decentralized congestion control mechanisms for ITS operating in the 5 GHz range":
   clauses 5.3 (reactive) and 5.4 (adaptive).
.. [2] G. Bansal, J. B. Kenney, C. E. Rohrs, "LIMERIC: a linear adaptive message rate algorithm for DSRC congestion
   control", IEEE TVT 62(9), 2013.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Float, Int, UInt64
from numpy import ndarray

from cosim.base.bounds import PositiveShare

STATES = ("relaxed", "active 1", "active 2", "active 3", "restrictive")


@dataclass(frozen=True, kw_only=True, slots=True)
class DccParams:
    """Congestion control on the channel busy ratio."""

    enabled: bool = True
    """Whether congestion control is active."""
    algorithm: Literal["reactive", "adaptive"] = "reactive"
    """`reactive`: five states, each with a least time between frames. `adaptive`: LIMERIC, each station adapts its
    share of the time on air until the busy ratio is at `target_cbr`."""
    cbr_bounds: tuple[float, float, float, float] = (0.30, 0.40, 0.50, 0.65)
    """Busy ratios from which the states active 1, 2, 3 and restrictive begin."""
    t_off_s: tuple[float, float, float, float, float] = (0.05, 0.1, 0.2, 0.25, 1.0)
    """Least time between two frames in the states relaxed to restrictive [s]."""
    smoothing: PositiveShare = 0.5
    """Weight of the newest busy ratio in the running mean."""
    period_s: Annotated[float, Ge(0.001), Le(60)] = 0.1
    """Time over which the busy ratio is measured; the state moves one step in each [s]."""

    target_cbr: PositiveShare = 0.68
    """With `adaptive`: busy ratio that all stations together approach."""

    def __post_init__(self) -> None:
        bounds, gaps = self.cbr_bounds, self.t_off_s
        increases = list(bounds) == sorted(set(bounds))
        in_range = all(0 < bound <= 1 for bound in bounds)
        if len(bounds) != 4 or not increases or not in_range:
            raise ValueError(f"radio.dcc.cbr_bounds = {bounds} must be four increasing busy ratios in (0, 1].")
        in_range = all(0 <= gap <= 60 for gap in gaps)
        if len(gaps) != 5 or list(gaps) != sorted(gaps) or not in_range:
            raise ValueError(f"radio.dcc.t_off_s = {gaps} must be five times [s] from 0 to 60 that do not decrease.")


ALPHA, BETA = 0.016, 0.0012
"""Weights of the own share and of the distance to the target: table 3 of [1]_."""
SHARE_MIN, SHARE_MAX = 0.0006, 0.03
"""Least and largest share of the time that a station may be on air: table 3 of [1]_."""
STEP_MIN, STEP_MAX = -0.00025, 0.0005
"""Least and largest change towards the target: table 3 of [1]_."""
GAP_MIN_S, GAP_MAX_S = 0.025, 1.0
"""Bounds of the time between two frames with `adaptive` [s]."""


@dataclass(frozen=True, slots=True)
class DccState:
    """State of congestion control of N stations."""

    key: UInt64[ndarray, "n"]
    cbr: Float[ndarray, "n"]
    """Busy ratio, smoothed."""
    level: Int[ndarray, "n"]
    """With `reactive`: row of `STATES`."""
    share: Float[ndarray, "n"]
    """With `adaptive`: share of the time that the station may be on air."""
    before: Float[ndarray, "n"]
    """With `adaptive`: busy ratio of the period before."""
    airtime_ns: Int[ndarray, "n"]
    """Time on air of the longest frame of the last message; 0 before the first one."""
    n_periods: int = 0
    """Periods so far; the share changes every second one."""

    @staticmethod
    def start() -> "DccState":
        """No stations yet."""
        none = np.zeros(0)
        return DccState(
            key=np.zeros(0, np.uint64),
            cbr=none,
            level=np.zeros(0, np.int8),
            share=none,
            before=none,
            airtime_ns=np.zeros(0, np.int64),
        )

    def of(self, key: UInt64[ndarray, "n"]) -> "DccState":
        """The state of these stations (each once), in this order. New ones start relaxed, on an idle channel."""
        if np.array_equal(self.key, key):
            return self
        _, was, now = np.intersect1d(self.key, key, assume_unique=True, return_indices=True)
        cbr = np.zeros(len(key))
        level = np.zeros(len(key), np.int8)
        share = np.full(len(key), SHARE_MAX)
        before = np.zeros(len(key))
        airtime_ns = np.zeros(len(key), np.int64)
        cbr[now] = self.cbr[was]
        level[now] = self.level[was]
        share[now] = self.share[was]
        before[now] = self.before[was]
        airtime_ns[now] = self.airtime_ns[was]
        return DccState(key, cbr, level, share, before, airtime_ns, self.n_periods)

    def after_messages(self, airtime_ns: Int[ndarray, "n"]) -> "DccState":
        """The state after messages with these times on air; 0 where a station sends none."""
        return replace(self, airtime_ns=np.where(airtime_ns > 0, airtime_ns, self.airtime_ns))


@dataclass(frozen=True, slots=True)
class BusyMeasurement:
    """The busy time of stations since congestion control was last updated. It goes on from round to round."""

    key: UInt64[ndarray, "n"]
    busy_ns: Float[ndarray, "n"]
    span_ns: float

    @staticmethod
    def start() -> "BusyMeasurement":
        """Nothing is measured yet."""
        return BusyMeasurement(np.zeros(0, np.uint64), np.zeros(0), 0.0)

    def of(self, key: UInt64[ndarray, "n"]) -> "BusyMeasurement":
        """The measurement of these stations (each once), in this order. New stations have sensed nothing so far."""
        if np.array_equal(self.key, key):
            return self
        _, was, now = np.intersect1d(self.key, key, assume_unique=True, return_indices=True)
        busy_ns = np.zeros(len(key))
        busy_ns[now] = self.busy_ns[was]
        return BusyMeasurement(key, busy_ns, self.span_ns)

    def after(self, busy: Float[ndarray, "n"], span_ns: int) -> "BusyMeasurement":
        """After `span_ns` more, of which each station sensed this share as busy."""
        return BusyMeasurement(self.key, self.busy_ns + busy * span_ns, self.span_ns + span_ns)

    def updated(self, state: DccState, params: DccParams) -> tuple[DccState, "BusyMeasurement"]:
        """Congestion control after all periods that are complete, and what is left of the measurement."""
        busy_ns, span_ns, period_ns = self.busy_ns, self.span_ns, params.period_s * 1e9
        while span_ns >= period_ns - 1:
            state = update(state, self.key, np.minimum(busy_ns / span_ns, 1.0), params)
            busy_ns = busy_ns * max(0.0, 1 - period_ns / span_ns)
            span_ns -= round(period_ns)
        return state, BusyMeasurement(self.key, busy_ns, span_ns)


def update(state: DccState, key: UInt64[ndarray, "n"], busy: Float[ndarray, "n"], params: DccParams) -> DccState:
    """The state of stations after one more period.

    Parameters
    ----------
    key
        Stations, each once. Stations of the state that are not among them are dropped; new ones start relaxed.
    busy
        Busy ratio that each station measured in the period, in [0, 1].

    Notes
    -----
    Reactive: the state moves one step towards the state of the smoothed busy ratio.   Deviations from [1]_: one step
    per period, both upwards and downwards; no control of power, rate or sensitivity.

    Adaptive, every second period: with C = C/2 + (c1 + c2)/4 of the last two busy ratios, the share d becomes
    (1 - alpha) d + beta (target - C), the last term within its bounds, and then the share within its own.
    Deviations from [1]_: a station begins with the largest share.
    """
    assert ((busy >= 0) & (busy <= 1 + 1e-9)).all(), "busy ratios are shares"
    now, n = state.of(key), state.n_periods + 1
    if params.algorithm == "reactive":
        cbr = (1 - params.smoothing) * now.cbr + params.smoothing * busy
        wanted = np.searchsorted(params.cbr_bounds, cbr, side="right")
        level = (now.level + np.sign(wanted - now.level)).astype(np.int8)
        return DccState(key, cbr, level, now.share, busy, now.airtime_ns, n)
    if n % 2:
        return DccState(key, now.cbr, now.level, now.share, busy, now.airtime_ns, n)
    cbr = 0.5 * now.cbr + 0.25 * (now.before + busy)
    step = np.clip(BETA * (params.target_cbr - cbr), STEP_MIN, STEP_MAX)
    share = np.clip((1 - ALPHA) * now.share + step, SHARE_MIN, SHARE_MAX)
    return DccState(key, cbr, now.level, share, busy, now.airtime_ns, n)


def gap_ns(
    state: DccState, key: UInt64[ndarray, "n"], params: DccParams, airtime_ns: Int[ndarray, "n"]
) -> Int[ndarray, "n"]:
    """Least time between two frames of each of these stations (each once) [ns]; 0 if control is off.

    Parameters
    ----------
    airtime_ns
        Time on air of the frames of each station. With `adaptive`, the gap is that over the station's share, within
        `GAP_MIN_S` and `GAP_MAX_S`.
    """
    if not params.enabled:
        return np.zeros(len(key), np.int64)
    now = state.of(key)
    if params.algorithm == "adaptive":
        gap_ns = np.clip(airtime_ns / now.share, GAP_MIN_S * 1e9, GAP_MAX_S * 1e9)
        return np.rint(gap_ns).astype(np.int64)
    gaps = np.rint(np.array(params.t_off_s) * 1e9).astype(np.int64)
    return gaps[now.level]
