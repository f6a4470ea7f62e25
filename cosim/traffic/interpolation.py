"""The timesteps of a trace at any times: its own, and between them if steps are shorter or a timestep is missing."""

from collections.abc import Iterator, Sequence
from math import ceil
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.traffic.fcd import Timestep
from cosim.traffic.frame import TrafficError

LONGEST_S = 2.0
"""Longest interval of a trace that is interpolated [s]. A car at 50 km/h travels 28 m in it."""
_SPARE_M, _SPARE_FACTOR = 2.0, 1.5
"""An actor that moves farther than its speed allows, by more than this, has been put elsewhere by the simulator."""
_TOLERANCE = 1e-3
"""Part of a step by which a timestep may miss it."""
_LONG = 1.5
"""Two timesteps that are farther apart than this number of intervals have lost those between them."""
_GOES_ON_P = 0.5
"""If this share of the actors is there before and after a time without a timestep, the road was not empty."""


def interval_s(times_s: Float[ndarray, "n"]) -> float | None:
    """The interval of timesteps, of which one may be missing; None for fewer than two.

    It is rounded to two digits if the timesteps are not regular.
    """
    if len(times_s) < 2:
        return None
    took_s = np.diff(times_s)
    median_s = float(np.median(took_s))
    near_s = took_s[np.abs(took_s - median_s) < 0.5 * median_s]
    mean_s = float(near_s.mean())
    is_regular = np.ptp(near_s) < 1e-6 * median_s + 1e-9
    return round(mean_s, 6) if is_regular else float(f"{mean_s:.2g}")


class Timeline:
    """The actors of a trace at any times, which are asked for in ascending order.

    At the time of a timestep, these are its actors. At another time, an actor is on the road if it is there at the
    timesteps before and after, and if it can have driven from one place to the other. It then moves on a curve that has
    the actor's headings and speeds at both ends. Heading and speed change linearly.

    A time without a timestep was an empty road if the actors before it do not come back after it, because SUMO writes
    no rows for an empty road. Otherwise the recording has lost the timestep. In a trace of recorded positions, nobody
    was seen then.

    Parameters
    ----------
    source
        Name of the trace for error messages.
    timesteps
        Timesteps in the order of time.
    every_s
        Interval of the trace [s].
    step_s
        Interval of the times that are asked for [s].
    is_complete
        Whether no timestep is lost.
    """

    def __init__(
        self, source: str, timesteps: Iterator[Timestep], every_s: float, step_s: float, is_complete: bool = False
    ) -> None:
        self._source, self._timesteps, self._every_s = source, timesteps, every_s
        self._tolerance_s = _TOLERANCE * min(every_s, step_s)
        self._is_complete = is_complete
        self._longest_s = max(_LONG * every_s, 0.0 if is_complete else LONGEST_S + self._tolerance_s)
        steps = step_s / every_s
        off = abs(steps - round(steps))
        self.is_between = off > 0.01 * max(1.0, steps) or steps < 0.5
        """Whether steps fall between timesteps by themselves."""
        self._before: Timestep | None = None
        self._after = next(timesteps, None)
        self._way: _Way | None = None
        self._n_lost, self._first_lost_s = 0, 0.0

    def at(self, time_s: float) -> Timestep | None:
        """The actors at a time; None after the end of the trace. A TrafficError is raised in a gap of the recording."""
        while self._after is not None and self._after.time_s <= time_s + self._tolerance_s:
            self._before, self._after, self._way = self._after, next(self._timesteps, None), None
        if self._before is not None and self._before.time_s >= time_s - self._tolerance_s:
            return self._before
        if self._after is None:
            return None
        if self._before is None:
            return _nobody(time_s)
        if self._way is None:
            self._way = _Way(self._before, self._after)
            self._check_gap(self._before, self._after, self._way)
        took_s = self._after.time_s - self._before.time_s
        if took_s > self._longest_s:
            return _nobody(time_s)
        if took_s > _LONG * self._every_s and len(self._way):
            self._first_lost_s = self._first_lost_s if self._n_lost else time_s
            self._n_lost += 1
        return self._way.at((time_s - self._before.time_s) / took_s)

    def n_empty(self, time_s: float, step_s: float) -> int:
        """Number of steps of an empty road after this time, the last one asked for, up to the next timestep."""
        if self._before is None or self._after is None:
            return 0
        if self._after.time_s - self._before.time_s <= self._longest_s:
            return 0
        return ceil((self._after.time_s - self._tolerance_s - time_s) / step_s) - 1

    @property
    def last_s(self) -> float:
        """Time of the latest timestep that was reached."""
        return np.nan if self._before is None else self._before.time_s

    def report(self) -> dict[str, Any]:
        """The interval if the trace is interpolated by intent, and how many steps its lost timesteps concern."""
        report: dict[str, Any] = {"trace_interpolated_s": self._every_s} if self.is_between else {}
        if self._n_lost:
            report["trace_lost"] = {"steps": self._n_lost, "first_s": round(self._first_lost_s, 6)}
        return report

    def _check_gap(self, before: Timestep, after: Timestep, way: "_Way") -> None:
        n = len(before.names)
        is_long = after.time_s - before.time_s > self._longest_s
        goes_on = n > 0 and len(way) >= _GOES_ON_P * n
        if is_long and goes_on and not self._is_complete:
            raise TrafficError(
                f"{self._source}: no timestep between {before.time_s:g} s and {after.time_s:g} s, "
                f"although {len(way)} of {n} actors are there before and after: the recording has a gap, "
                f"or its interval of {self._every_s:g} s changes there. "
                "Record it again, or cut it into two traces at the gap."
            )


def _nobody(time_s: float) -> Timestep:
    none = np.zeros(0)
    return Timestep(time_s, [], [], none.reshape(0, 3), none, none, none.astype(bool))


class _Way:
    """The actors that drive from one timestep to the next one. All times between share their lists of names."""

    def __init__(self, first: Timestep, second: Timestep) -> None:
        before, after = rows_in_both(_keys(first), _keys(second))
        self._first_s, self._took_s = first.time_s, second.time_s - first.time_s
        stays = _can_drive(first, second, before, after, self._took_s)
        before, after = before[stays], after[stays]
        rows = before.tolist()
        self._names = [first.names[row] for row in rows]
        self._types = [first.types[row] for row in rows]
        self._is_person = first.is_person[before]
        self._vclasses = None if first.vclasses is None else [first.vclasses[row] for row in rows]
        self._lwh_m = None if first.lwh_m is None else first.lwh_m[before]
        self._begin_m, self._end_m = first.front_m[before], second.front_m[after]
        begin_deg = first.compass_deg[before]
        turn_deg = (second.compass_deg[after] - begin_deg + 180.0) % 360.0 - 180.0
        self._begin_deg, self._turn_deg = _as_carrier(self._begin_m, self._end_m, begin_deg, turn_deg)
        self._begin_mps, self._end_mps = first.speed_mps[before], second.speed_mps[after]

    def __len__(self) -> int:
        return len(self._names)

    def at(self, part: float) -> Timestep:
        """The actors at a part of the way, from 0 to 1."""
        headings_deg = self._begin_deg, self._begin_deg + self._turn_deg
        lengths_m = self._begin_mps * self._took_s, self._end_mps * self._took_s
        return Timestep(
            self._first_s + part * self._took_s,
            self._names,
            self._types,
            curve(self._begin_m, self._end_m, headings_deg, lengths_m, part),
            (self._begin_deg + part * self._turn_deg) % 360.0,
            self._begin_mps + part * (self._end_mps - self._begin_mps),
            self._is_person,
            self._vclasses,
            self._lwh_m,
        )


def curve(
    begin_m: Float[ndarray, "n 3"],
    end_m: Float[ndarray, "n 3"],
    headings_deg: tuple[Float[ndarray, "n"], Float[ndarray, "n"]],
    lengths_m: tuple[Float[ndarray, "n"], Float[ndarray, "n"]],
    part: float,
) -> Float[ndarray, "n 3"]:
    """Positions on cubic Hermite curves between two poses.

    Parameters
    ----------
    begin_m, end_m
        Both ends [m].
    headings_deg
        Headings at the begin and at the end, clockwise from north [degrees].
    lengths_m
        Lengths of the tangents at the begin and at the end: speed times duration [m]. They are limited to three times
        the chord, so that no actor moves backwards on a straight line (Fritsch and Carlson, SIAM J. Numer. Anal. 17,
        1980).
    part
        Position on the curve, from 0 to 1.

    Returns
    -------
    The points [m]. Heights, and positions of actors whose headings differ from the chord by 90 degrees or more, are
    interpolated linearly.
    """
    chord_m = end_m - begin_m
    points = begin_m + part * chord_m
    most_m = 3.0 * np.hypot(chord_m[:, 0], chord_m[:, 1])
    curved = np.zeros((len(points), 2))
    forward = np.ones(len(points), bool)
    of_begin = part * (1 - part) ** 2
    of_end = -(part**2) * (1 - part)
    for weight, heading_deg, length_m in zip((of_begin, of_end), headings_deg, lengths_m, strict=True):
        heading_rad = np.deg2rad(heading_deg)
        heading = np.column_stack([np.sin(heading_rad), np.cos(heading_rad)])
        forward &= (heading * chord_m[:, :2]).sum(axis=1) > 0
        tangent_m = heading * np.clip(length_m, 0.0, most_m)[:, None]
        curved += weight * (tangent_m - chord_m[:, :2])
    points[:, :2] += np.where(forward[:, None], curved, 0.0)
    return points


def _keys(timestep: Timestep) -> list[tuple[str, bool]]:
    """Name of each actor, and whether it is a person."""
    return list(zip(timestep.names, timestep.is_person.tolist(), strict=True))


def rows_in_both(
    first: Sequence[object],
    second: Sequence[object],
) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    """Rows of the keys that both have, in the order of the first. Of equal keys in the second, the last one counts."""
    row_of = {key: row for row, key in enumerate(second)}
    after = np.array([row_of.get(key, -1) for key in first], np.int64)
    before = np.flatnonzero(after >= 0)
    return before, after[before]


def _as_carrier(
    begin_m: Float[ndarray, "n 3"],
    end_m: Float[ndarray, "n 3"],
    begin_deg: Float[ndarray, "n"],
    turn_deg: Float[ndarray, "n"],
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Headings, where actors at the same position at both ends have those of the first of them.

    A person in a vehicle is recognised by its position, which must therefore be the vehicle's at all times.
    """
    ways = np.column_stack([begin_m, end_m])
    _, first, same = np.unique(ways, axis=0, return_index=True, return_inverse=True)
    row = first[same.reshape(-1)]
    return begin_deg[row], turn_deg[row]


def _can_drive(
    first: Timestep, second: Timestep, before: ndarray, after: ndarray, seconds: float
) -> Bool[ndarray, "n"]:
    """Whether each actor's distance between two timesteps agrees with its speeds."""
    dx_m, dy_m, _ = (second.front_m[after] - first.front_m[before]).T
    way_m = np.hypot(dx_m, dy_m)
    before_mps = np.abs(first.speed_mps[before])
    after_mps = np.abs(second.speed_mps[after])
    fastest_mps = np.maximum(before_mps, after_mps)
    return way_m <= _SPARE_FACTOR * fastest_mps * seconds + _SPARE_M
