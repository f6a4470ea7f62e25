"""Streets that pass over one another: places where lanes of motor vehicles cross outside junctions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from sumo_nets.network import Lane

LEVEL_M = 2.0
"""Lanes that are less apart in height are on one level: a car on the lower one would hit a car on the upper one [m]."""
_SHARED_M = 50.0
"""Lanes that begin or end at the same junction may cross this near to their ends, because of how they are drawn [m]."""
_BRIDGE_M = 150.0
"""A lane that passes over another one is a bridge up to this distance from there, where it is as high [m]."""


_MOST_PAIRS = 200_000
"""More pairs of lanes than any network has; a file with more is not looked through to its end."""


class Crossings(NamedTuple):
    """Places where two lanes cross, each pair of lanes once; network coordinates."""

    lane: Int[ndarray, "k 2"]
    """Rows of the two lanes."""
    xy_m: Float[ndarray, "k 2"]
    z_m: Float[ndarray, "k 2"]
    """Heights of the two lanes."""

    @property
    def on_one_level(self) -> Bool[ndarray, "k"]:
        """Where vehicles would drive through one another."""
        z_m, other_z_m = self.z_m.T
        return np.abs(z_m - other_z_m) < LEVEL_M


def crossings(lanes: Sequence[Lane]) -> Crossings:
    """The places where lanes of motor vehicles cross, but for those within junctions."""
    of_motors = [k for k, lane in enumerate(lanes) if lane.for_cars and not lane.across]
    row = np.array(of_motors, int)
    if not len(row):
        nothing = np.zeros((0, 2))
        return Crossings(nothing.astype(int), nothing, nothing)
    points = [lanes[k].line_m for k in row]
    flat = np.concatenate(points)[:, :2]
    of_point = np.repeat(np.arange(len(row)), [len(line_m) for line_m in points])
    lines = shapely.linestrings(flat, indices=of_point)
    one, other = shapely.STRtree(lines).query(lines, predicate="crosses")
    edge = np.array([lanes[k].edge for k in row])
    kept = (one < other) & (edge[one] != edge[other])
    one = one[kept][:_MOST_PAIRS]
    other = other[kept][:_MOST_PAIRS]
    place = shapely.point_on_surface(shapely.intersection(lines[one], lines[other]))
    z_m = np.zeros((len(place), 2))
    to_end_m = np.full(len(place), np.inf)
    for column, rows in enumerate((one, other)):
        at_m = shapely.line_locate_point(lines[rows], place)
        of_pair = [points[k] for k in rows]
        z_m[:, column] = list(map(_height_m, of_pair, at_m))
        left_m = shapely.length(lines[rows]) - at_m
        to_end_m = np.minimum.reduce([to_end_m, at_m, left_m])
    ends = [set(lanes[k].ends) for k in row]
    pairs = zip(one, other, strict=True)
    shared = [not ends[a].isdisjoint(ends[b]) for a, b in pairs]
    real = ~(np.array(shared, bool) & (to_end_m < _SHARED_M))
    lane = np.column_stack([row[one], row[other]])
    return Crossings(lane[real], shapely.get_coordinates(place)[real], z_m[real])


def is_bridge(lanes: Sequence[Lane], found: Crossings) -> list[Bool[ndarray, "k"]]:
    """Of every segment of every lane, whether it passes over another lane, or belongs to the same bridge."""
    bridge = [np.zeros(len(lane.line_m) - 1, bool) for lane in lanes]
    for pair, xy_m, z_m in zip(found.lane, found.xy_m, found.z_m, strict=True):
        if abs(z_m[0] - z_m[1]) >= LEVEL_M:
            upper = pair[int(z_m[1] > z_m[0])]
            line_m = lanes[upper].line_m
            middle = (line_m[1:] + line_m[:-1]) / 2
            away_m = np.hypot(*(middle[:, :2] - xy_m).T)
            near = away_m - _lengths_m(line_m) / 2 < _BRIDGE_M
            as_high = np.abs(middle[:, 2] - z_m.max()) < LEVEL_M
            bridge[upper] |= near & as_high
    return bridge


def _height_m(line_m: Float[ndarray, "k 3"], at_m: float) -> float:
    along_m = np.concatenate([[0.0], np.cumsum(_lengths_m(line_m))])
    return float(np.interp(at_m, along_m, line_m[:, 2]))


def _lengths_m(line_m: Float[ndarray, "k 3"]) -> Float[ndarray, "s"]:
    """Length of every segment, seen from above."""
    return np.hypot(*np.diff(line_m[:, :2], axis=0).T)
