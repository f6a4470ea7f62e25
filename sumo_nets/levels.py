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
        return np.abs(self.z_m[:, 0] - self.z_m[:, 1]) < LEVEL_M


def crossings(lanes: Sequence[Lane]) -> Crossings:
    """The places where lanes of motor vehicles cross, but for those within junctions."""
    row = np.array([k for k, lane in enumerate(lanes) if lane.for_cars and not lane.across], int)
    if not len(row):
        return Crossings(np.zeros((0, 2), int), np.zeros((0, 2)), np.zeros((0, 2)))
    points = [lanes[k].line_m for k in row]
    flat = np.concatenate(points)[:, :2]
    lines = shapely.linestrings(flat, indices=np.repeat(np.arange(len(row)), list(map(len, points))))
    one, other = shapely.STRtree(lines).query(lines, predicate="crosses")
    edge = np.array([lanes[k].edge for k in row])
    kept = (one < other) & (edge[one] != edge[other])
    one, other = one[kept][:_MOST_PAIRS], other[kept][:_MOST_PAIRS]
    place = shapely.point_on_surface(shapely.intersection(lines[one], lines[other]))
    along = [shapely.line_locate_point(lines[rows], place) for rows in (one, other)]
    z_m = np.array([
        [_height_m(points[k], at) for k, at in zip(rows, at_m, strict=True)]
        for rows, at_m in zip((one, other), along, strict=True)
    ]).reshape(2, -1).T  # fmt: skip
    left = [shapely.length(lines[rows]) - at for rows, at in zip((one, other), along, strict=True)]
    near_end = np.minimum.reduce([*along, *left]) < _SHARED_M
    shared = [bool({*lanes[row[a]].ends} & {*lanes[row[b]].ends}) for a, b in zip(one, other, strict=True)]
    real = ~(np.array(shared, bool) & near_end)
    lane = np.column_stack([row[one], row[other]])
    return Crossings(lane[real], shapely.get_coordinates(place)[real], z_m[real])


def is_bridge(lanes: Sequence[Lane], found: Crossings) -> list[Bool[ndarray, "k"]]:
    """Of every segment of every lane, whether it passes over another lane, or belongs to the same bridge."""
    bridge = [np.zeros(len(lane.line_m) - 1, bool) for lane in lanes]
    for pair, xy_m, z_m in zip(found.lane, found.xy_m, found.z_m, strict=True):
        if abs(z_m[0] - z_m[1]) >= LEVEL_M:
            line_m = lanes[pair[int(z_m[1] > z_m[0])]].line_m
            middle = (line_m[1:] + line_m[:-1]) / 2
            half = np.hypot(*np.diff(line_m[:, :2], axis=0).T) / 2
            near = np.hypot(*(middle[:, :2] - xy_m).T) - half < _BRIDGE_M
            bridge[pair[int(z_m[1] > z_m[0])]] |= near & (np.abs(middle[:, 2] - z_m.max()) < LEVEL_M)
    return bridge


def _height_m(line_m: Float[ndarray, "k 3"], at_m: float) -> float:
    length = np.hypot(*np.diff(line_m[:, :2], axis=0).T)
    return float(np.interp(at_m, np.concatenate([[0.0], np.cumsum(length)]), line_m[:, 2]))
