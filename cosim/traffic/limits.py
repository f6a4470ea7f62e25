"""Speed limits of the roads, as a digital map has them: by place, on a grid."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.ragged import rows_of
from sumo_nets.network import Lane

_CELL_M = 5.0
_FASTEST_MPS = 100.0
"""A limit above this says nothing: some maps mark roads without a limit by such a number."""
_LONGEST_M = 100_000.0
"""No lane is longer; a map with a wrong number would fill the memory with cells."""
_NEAR = np.indices((3, 3)).reshape(2, 9).T - 1


@dataclass(frozen=True, slots=True)
class SpeedLimits:
    """Speed limits in the cells that a lane for motor vehicles with a limit crosses, and in the cells around them."""

    cell: Int[ndarray, "k"]
    """Number of each cell, ascending."""
    limit_mps: Float[ndarray, "k"]
    """Largest limit of the lanes there."""

    @staticmethod
    def of(lanes: Iterable[Lane], origin_m: tuple[float, float]) -> SpeedLimits:
        """The limits of these lanes; the world's origin is at `origin_m` in their coordinates."""
        cells, limits = [np.zeros(0, np.int64)], [np.zeros(0)]
        for lane in lanes:
            line_m = lane.line_m[:, :2] - origin_m
            is_road = np.hypot(*np.diff(line_m, axis=0).T).sum() <= _LONGEST_M
            if is_road and lane.for_cars and 0 < lane.limit_mps <= _FASTEST_MPS:
                points = _dense(line_m)
                around = _cells(points)[:, None] + _NEAR
                cells.append(np.unique(_number(around.reshape(-1, 2))))
                limits.append(np.full(len(cells[-1]), lane.limit_mps))
        number, limit = np.concatenate(cells), np.concatenate(limits)
        order = np.lexsort((-limit, number))
        cell, first = np.unique(number[order], return_index=True)
        return SpeedLimits(cell, limit[order][first])

    def at(self, xy_m: Float[ndarray, "n 2"]) -> Float[ndarray, "n"]:
        """Limit at each place of the world [m/s]; NaN without a lane within 14 m, a number with one within 4.8 m."""
        row, is_road = rows_of(_number(_cells(xy_m)), self.cell)
        limit_mps = np.full(len(xy_m), np.nan)
        limit_mps[is_road] = self.limit_mps[row[is_road]]
        return limit_mps


NO_LIMITS = SpeedLimits(np.zeros(0, np.int64), np.zeros(0))
"""Of a world without a map."""


def _dense(line_m: Float[ndarray, "k 2"]) -> Float[ndarray, "m 2"]:
    """Points along a line, half a cell apart at most. The line may have no length."""
    step_m = np.hypot(*np.diff(line_m, axis=0).T)
    vertex_m = np.append(0.0, np.cumsum(step_m))
    n = 2 + int(2 * vertex_m[-1] / _CELL_M)
    at_m = np.linspace(0.0, vertex_m[-1], n)
    x, y = line_m.T
    return np.column_stack([np.interp(at_m, vertex_m, x), np.interp(at_m, vertex_m, y)])


def _cells(xy_m: Float[ndarray, "n 2"]) -> Int[ndarray, "n 2"]:
    return np.floor(xy_m / _CELL_M).astype(np.int64)


def _number(cells: Int[ndarray, "n 2"]) -> Int[ndarray, "n"]:
    """One number per cell, not negative within 5,000 km of the origin."""
    return (cells[:, 0] + 1_000_000 << 32) + cells[:, 1] + 1_000_000
