"""Timesteps between those of a trace, for traffic steps that are shorter than the trace's."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from cosim.mobility.fcd import Timestep

LONGEST_S = 2.0
"""Longest interval of a trace that is interpolated [s]. A car at 50 km/h travels 28 m in it."""
_SPARE_M, _SPARE_FACTOR = 2.0, 1.5
"""An actor that moves farther than its speed allows, by more than this, has been put elsewhere by the simulator."""


def interpolated(timesteps: Iterator[Timestep], every_s: float, n: int) -> Iterator[Timestep]:
    """Yield the timesteps of a trace, and n - 1 between any two that are one interval apart.

    An actor is on the road between two timesteps if it is there at both, and if it can have driven from one place to
    the other. It then moves on a curve that has the actor's headings and speeds at both ends. Heading and speed change
    linearly.

    All timesteps of one interval share their lists of names and types.

    Parameters
    ----------
    every_s
        Interval of the trace [s].
    n
        Number of steps per interval.
    """
    last = None
    for first, second in pairwise(timesteps):
        yield first
        last = second
        if abs(second.time_s - first.time_s - every_s) > 1e-3 * every_s:
            continue  # the road was empty in between
        row_of = {key: row for row, key in enumerate(zip(second.names, second.types, strict=True))}
        keys = list(zip(first.names, first.types, strict=True))
        after = np.fromiter((row_of.get(key, -1) for key in keys), np.int64, len(keys))
        before = np.flatnonzero(after >= 0)
        after = after[before]
        stays = _can_drive(first, second, before, after, every_s)
        before, after = before[stays], after[stays]
        names = [first.names[row] for row in before.tolist()]
        types = [first.types[row] for row in before.tolist()]
        begin_m, end_m = first.front_m[before], second.front_m[after]
        begin_deg = first.compass_deg[before]
        turn_deg = (second.compass_deg[after] - begin_deg + 180.0) % 360.0 - 180.0
        begin_deg, turn_deg = _as_carrier(begin_m, end_m, begin_deg, turn_deg)
        begin_mps, end_mps = first.speed_mps[before], second.speed_mps[after]
        for step in range(1, n):
            part = step / n
            yield Timestep(
                first.time_s + part * (second.time_s - first.time_s),
                names,
                types,
                curve(
                    begin_m, end_m, (begin_deg, begin_deg + turn_deg), (begin_mps * every_s, end_mps * every_s), part
                ),
                (begin_deg + part * turn_deg) % 360.0,
                begin_mps + part * (end_mps - begin_mps),
            )
    if last is not None:
        yield last


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
    weights = part * (1 - part) ** 2, -(part**2) * (1 - part)
    for weight, heading_deg, length_m in zip(weights, headings_deg, lengths_m, strict=True):
        heading = np.column_stack([np.sin(np.deg2rad(heading_deg)), np.cos(np.deg2rad(heading_deg))])
        forward &= (heading * chord_m[:, :2]).sum(axis=1) > 0
        curved += weight * (heading * np.clip(length_m, 0.0, most_m)[:, None] - chord_m[:, :2])
    points[:, :2] += np.where(forward[:, None], curved, 0.0)
    return points


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
    way_m = np.hypot(*(second.front_m[after] - first.front_m[before])[:, :2].T)
    fastest_mps = np.maximum(np.abs(first.speed_mps[before]), np.abs(second.speed_mps[after]))
    return way_m <= _SPARE_FACTOR * fastest_mps * seconds + _SPARE_M
