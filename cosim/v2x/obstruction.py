"""Line of sight by buildings: which straight lines between antennas no wall cuts.

A ray is marched through a grid that knows how far the next wall may be, and tested exactly against the walls of
the cells where there are some. The answer for two places never changes, so it can be remembered: `Sight` keeps
what it has seen in a table of fixed size, and a forgotten answer is found again.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numba import njit
from numpy import ndarray
from scipy.ndimage import distance_transform_cdt

from cosim.rng import mix
from cosim.v2x.kernel import inlined, kernel

_SLACK_M = 1e-6
"""Walls are filed under every cell within this distance, so that rounding never loses one."""


class Grid(NamedTuple):
    """Walls by cell."""

    low: Float[ndarray, "2"]
    cell_m: float
    step: Int[ndarray, "nx ny"]  # cells to the nearest one with a wall; 0 where there is one
    ptr: Int[ndarray, "cells+1"]
    wall: Int[ndarray, "m"]
    house_ptr: Int[ndarray, "cells+1"]
    house: Int[ndarray, "k"]
    solid: UInt8[ndarray, "nx ny 2"]  # base and top of the building that fills the cell; base above top if none
    zero_m: float  # height of level 0 of these
    level_m: float


@kernel
def _file(low, cell_m, shape, first, second, fill, ptr, out):
    """List every segment under every cell that it touches (boxes first, then the separating axis)."""
    for w in range(first.shape[0]):
        x0, y0, x1, y1 = first[w, 0], first[w, 1], second[w, 0], second[w, 1]
        i0 = max(int((min(x0, x1) - _SLACK_M - low[0]) / cell_m), 0)
        i1 = min(int((max(x0, x1) + _SLACK_M - low[0]) / cell_m), shape[0] - 1)
        j0 = max(int((min(y0, y1) - _SLACK_M - low[1]) / cell_m), 0)
        j1 = min(int((max(y0, y1) + _SLACK_M - low[1]) / cell_m), shape[1] - 1)
        nx, ny = y0 - y1, x1 - x0
        reach = (0.5 * cell_m + _SLACK_M) * (abs(nx) + abs(ny))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                cx, cy = low[0] + (i + 0.5) * cell_m, low[1] + (j + 0.5) * cell_m
                if abs(nx * (cx - x0) + ny * (cy - y0)) <= reach:
                    cell = i * shape[1] + j
                    if fill:
                        out[ptr[cell]] = w
                    ptr[cell] += 1


def _by_cell(low: ndarray, cell_m: float, shape: tuple[int, int], a: ndarray, b: ndarray) -> tuple[ndarray, ndarray]:
    count = np.zeros(shape[0] * shape[1] + 1, np.int64)
    _file(low, cell_m, shape, a, b, False, count, np.zeros(0, np.int32))
    ptr = np.concatenate([[0], np.cumsum(count[:-1])])
    out = np.empty(ptr[-1], np.int32)
    _file(low, cell_m, shape, a, b, True, ptr.copy(), out)
    return ptr, out


@njit(cache=True)
def _inside(xyz, grid, walls, spans, low_z, high_z):
    """The building around each point, by even-odd over its rings; -1 if none. Any height if z is not a number."""
    out = np.full(xyz.shape[0], -1)
    nx, ny = grid.step.shape
    for p in range(xyz.shape[0]):
        x, y, z = xyz[p]
        i, j = int((x - grid.low[0]) // grid.cell_m), int((y - grid.low[1]) // grid.cell_m)
        if i < 0 or j < 0 or i >= nx or j >= ny:
            continue
        cell = i * ny + j
        for h in range(grid.house_ptr[cell], grid.house_ptr[cell + 1]):
            house = grid.house[h]
            if z < low_z[house] or z > high_z[house]:
                continue
            odd = False
            for w in range(spans[house], spans[house + 1]):
                x0, y0, x1, y1 = walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]
                if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                    odd = not odd
            if odd:
                out[p] = house
                break
    return out


@kernel
def _over_grid(start, delta, high, t, stop):
    """The part of a ray between `t` and `stop` in which one of its coordinates is on the grid."""
    if delta == 0.0:
        return (t, stop) if 0.0 <= start < high else (1.0, 0.0)
    near, far = -start / delta, (high - start) / delta
    return max(t, min(near, far)), min(stop, max(near, far))


@inlined
def _cut(xyz, p, q, grid, walls):
    """Whether a wall cuts the segment between two points outside of all buildings."""
    x, y = xyz[p, 0], xyz[p, 1]
    dx, dy, dz = xyz[q, 0] - x, xyz[q, 1] - y, xyz[q, 2] - xyz[p, 2]
    nx, ny = grid.step.shape
    cell_m = grid.cell_m
    inv = 1.0 / cell_m
    u, v = (x - grid.low[0]) * inv, (y - grid.low[1]) * inv  # in cells
    du, dv = dx * inv, dy * inv
    inv_u = 1.0 / du if du != 0.0 else np.inf
    inv_v = 1.0 / dv if dv != 0.0 else np.inf
    # Only the part of the segment over the grid.
    t, stop = _over_grid(u, du, nx, 0.0, 1.0)
    t, stop = _over_grid(v, dv, ny, t, stop)
    cut = False
    while t < stop and not cut:
        i = min(max(int(u + t * du), 0), nx - 1)
        j = min(max(int(v + t * dv), 0), ny - 1)
        step = grid.step[i, j]
        if step == 0:
            cell = i * ny + j
            for k in range(grid.ptr[cell], grid.ptr[cell + 1]):
                w = grid.wall[k]
                ex, ey = walls[w, 2] - walls[w, 0], walls[w, 3] - walls[w, 1]
                fx, fy = walls[w, 0] - x, walls[w, 1] - y
                det = dx * ey - dy * ex
                s = fx * ey - fy * ex  # along the ray, times det
                r = fx * dy - fy * dx  # along the wall, times det
                if det < 0.0:
                    det, s, r = -det, -s, -r
                if det > 0.0 and 0.0 <= s <= det and 0.0 <= r <= det:
                    z = xyz[p, 2] + s / det * dz
                    if walls[w, 4] <= z <= walls[w, 5]:
                        cut = True
                        break
            step = 1
        # Leave the square of cells of which nothing is closer than `step` cells.
        edge_u = i + step if du > 0.0 else i + 1 - step
        edge_v = j + step if dv > 0.0 else j + 1 - step
        t_u = (edge_u - u) * inv_u if du != 0.0 else np.inf
        t_v = (edge_v - v) * inv_v if dv != 0.0 else np.inf
        t = max(t, min(t_u, t_v)) + 1e-12
    return cut


N_PROBES = 16
N_WAYS = 8
_WAYS = np.uint64(N_WAYS - 1)
_REGION = np.uint64(127)


@inlined
def runs_into_house(xyz, p, q, grid):
    """Whether one of a few points of the segment lies in a cell that a building fills: cheap, and never wrong."""
    inv = 1.0 / grid.cell_m
    u, v = (xyz[p, 0] - grid.low[0]) * inv, (xyz[p, 1] - grid.low[1]) * inv
    du, dv = (xyz[q, 0] - xyz[p, 0]) * inv, (xyz[q, 1] - xyz[p, 1]) * inv
    z, dz = (xyz[p, 2] - grid.zero_m) / grid.level_m, (xyz[q, 2] - xyz[p, 2]) / grid.level_m
    nx, ny = grid.step.shape
    n = min(int((abs(du) + abs(dv)) * 0.5) + 1, N_PROBES)
    t, into = 0.5, False
    for _ in range(n):
        i, j = int(u + t * du), int(v + t * dv)
        if 0 <= i < nx and 0 <= j < ny:
            top = grid.solid[i, j, 1]
            if top > 0 and grid.solid[i, j, 0] <= z + t * dz <= top:
                into = True
                break
        t += 0.6180339887498949  # golden section: any first few are evenly spread
        if t >= 1.0:
            t -= 1.0
    return into


@kernel
def _clear(xyz, indoors, a, b, grid, walls, out):
    for m in range(len(a)):
        p, q = a[m], b[m]
        if indoors[p] or indoors[q] or runs_into_house(xyz, p, q, grid):
            out[m] = False
            continue
        out[m] = not _cut(xyz, p, q, grid, walls)


@kernel
def _clear_remembered(xyz, indoors, place, a, b, grid, walls, memo, out):
    mask, one = np.uint64(memo.shape[0] - 1), np.uint64(1)
    for m in range(len(a)):
        p, q = a[m], b[m]
        if indoors[p] or indoors[q] or runs_into_house(xyz, p, q, grid):
            out[m] = False
            continue
        region = mix(place[p], one) & mask & ~_REGION  # pairs of one radio lie close together in memory
        if place[p] > place[q]:
            p, q = q, p
        h = mix(place[p], place[q])
        tag = mix(h, place[p]) | one  # 63 bits of another hash name the pair, the last bit answers
        first = np.int64(region | (h & _REGION & ~_WAYS))
        way = 0
        while way < N_WAYS and memo[first + way] | one != tag:
            way += 1
        if way < N_WAYS:
            out[m] = memo[first + way] & one
            continue
        out[m] = not _cut(xyz, p, q, grid, walls)
        for k in range(N_WAYS - 1, 0, -1):  # the oldest is forgotten
            memo[first + k] = memo[first + k - 1]
        memo[first] = tag if out[m] else tag ^ one


@dataclass(frozen=True, slots=True)
class Walls:
    """The buildings of a city as walls in a grid. Made by `Walls.of`."""

    grid: Grid
    walls: Float[ndarray, "w 6"]
    """x, y of both ends, base and top [m]."""
    spans: Int[ndarray, "h+1"]
    """Where each building's walls begin."""
    base_m: Float[ndarray, "h"]
    top_m: Float[ndarray, "h"]

    @staticmethod
    def of(buildings: list[tuple[ndarray, list[ndarray], float, float]], cell_m: float = 4.0) -> "Walls":
        """Index buildings given as (outer ring, holes, base z, top z); rings (k, 2), closed or not."""
        if not cell_m > 0:
            raise ValueError(f"cell_m = {cell_m} m must be positive.")
        parts: list[ndarray] = []
        sizes = np.zeros(len(buildings), np.int64)
        for h, (outer, holes, base, top) in enumerate(buildings):
            if not top > base:
                raise ValueError(f"buildings[{h}]: top_z = {top} m is not above base_z = {base} m.")
            for ring in (outer, *holes):
                ring = np.asarray(ring, float)
                if ring.ndim != 2 or ring.shape[1] != 2 or len(ring) < 3 or not np.all(np.isfinite(ring)):
                    raise ValueError(f"buildings[{h}]: a ring must be (k, 2) finite numbers with k >= 3.")
                ends = np.roll(ring, -1, axis=0)
                walls = np.column_stack([ring, ends, np.full(len(ring), base), np.full(len(ring), top)])
                walls = walls[np.any(ring != ends, axis=1)]
                parts.append(walls)
                sizes[h] += len(walls)
        walls = np.concatenate(parts) if parts else np.zeros((0, 6))
        spans = np.concatenate([[0], np.cumsum(sizes)])
        ends = walls[:, :4].reshape(-1, 2)
        low = ends.min(0) - cell_m if len(ends) else np.zeros(2)
        high = ends.max(0) + cell_m if len(ends) else np.ones(2)
        nx, ny = (int(k) for k in np.ceil((high - low) / cell_m))
        ptr, wall = _by_cell(low, cell_m, (nx, ny), walls[:, :2], walls[:, 2:4])
        house_ptr, house = _houses(low, cell_m, (nx, ny), walls, spans)
        empty = (np.diff(ptr) == 0).reshape(nx, ny)
        step = np.full((nx, ny), 255)
        if not empty.all():
            step = np.minimum(distance_transform_cdt(empty, "chessboard"), 255)
        base_m, top_m = (np.array([b[k] for b in buildings], float) for k in (2, 3))
        zero_m = float(base_m.min(initial=0.0))
        level_m = float(max(top_m.max(initial=1.0) - zero_m, 1.0)) / 254
        solid = np.tile(np.array([1, 0], np.uint8), (nx, ny, 1))
        grid = Grid(low, float(cell_m), step.astype(np.uint8), ptr, wall, house_ptr, house, solid, zero_m, level_m)
        i, j = np.nonzero(empty)
        middle = np.column_stack([low[0] + (i + 0.5) * cell_m, low[1] + (j + 0.5) * cell_m, np.full(len(i), np.nan)])
        owner = _inside(middle, grid, walls, spans, base_m, top_m)
        i, j, owner = i[owner >= 0], j[owner >= 0], owner[owner >= 0]
        solid[i, j, 0] = np.ceil((base_m[owner] - zero_m) / level_m - 1e-9)  # rounded inwards: a bit less is filled
        solid[i, j, 1] = np.floor((top_m[owner] - zero_m) / level_m + 1e-9)
        return Walls(grid, walls, spans, base_m, top_m)

    def indoors(self, xyz_m: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Which points are inside a building: no line of sight leaves it."""
        xyz_m = np.ascontiguousarray(xyz_m, float)
        return _inside(xyz_m, self.grid, self.walls, self.spans, self.base_m, self.top_m) >= 0

    def clear(self, xyz_m: Float[ndarray, "n 3"], a: Int[ndarray, "m"], b: Int[ndarray, "m"]) -> Bool[ndarray, "m"]:
        """Which of the lines between antennas `a` and `b` (rows) no building cuts; exact."""
        xyz_m = np.ascontiguousarray(xyz_m, float)
        out = np.empty(len(a), np.bool_)
        _clear(xyz_m, self.indoors(xyz_m), a, b, self.grid, self.walls, out)
        return out


def _houses(
    low: ndarray, cell_m: float, shape: tuple[int, int], walls: ndarray, spans: ndarray
) -> tuple[ndarray, ndarray]:
    """Buildings by the cells that their bounding box touches."""
    cells, ids = [], []
    for h in range(len(spans) - 1):
        ends = walls[spans[h] : spans[h + 1], :4].reshape(-1, 2)
        if len(ends) == 0:
            continue
        i0, j0 = ((ends.min(0) - low) // cell_m).astype(int)
        i1, j1 = ((ends.max(0) - low) // cell_m).astype(int)
        i, j = np.meshgrid(np.arange(i0, i1 + 1), np.arange(j0, j1 + 1), indexing="ij")
        cells.append((i * shape[1] + j).ravel())
        ids.append(np.full(i.size, h))
    cell = np.concatenate([*cells, np.zeros(0, np.int64)])
    order = np.argsort(cell, kind="stable")
    ptr = np.searchsorted(cell[order], np.arange(shape[0] * shape[1] + 1))
    return ptr.astype(np.int64), np.concatenate([*ids, np.zeros(0, np.int64)])[order].astype(np.int32)


@dataclass(frozen=True, slots=True)
class Sight:
    """Walls with a memory: lines of sight between places, antennas moved to the nearest point of a fine grid.

    The answer depends on the two places only, not on what was asked before.
    """

    walls: Walls
    snap_m: float
    """Width of a place [m]; heights are rounded to the same."""
    memo: ndarray

    @staticmethod
    def of(walls: Walls, snap_m: float = 0.5, n_remembered: int = 1 << 21) -> "Sight":
        """A memory for at least `n_remembered` pairs."""
        if not snap_m > 0:
            raise ValueError(f"snap_m = {snap_m} m must be positive.")
        return Sight(walls, snap_m, np.zeros(1 << max(n_remembered - 1, 255).bit_length(), np.uint64))

    def snap(self, xyz_m: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """The places of these antennas."""
        return self._cell(xyz_m) * self.snap_m + self._low

    def clear(self, xyz_m: Float[ndarray, "n 3"], a: Int[ndarray, "m"], b: Int[ndarray, "m"]) -> Bool[ndarray, "m"]:
        """Which of the lines between the places of antennas `a` and `b` (rows) no building cuts."""
        cell = self._cell(xyz_m)
        xyz = cell * self.snap_m + self._low
        out = np.empty(len(a), np.bool_)
        _clear_remembered(
            xyz, self.walls.indoors(xyz), _place(cell), a, b, self.walls.grid, self.walls.walls, self.memo, out
        )
        return out

    @property
    def _low(self) -> ndarray:
        return np.array([*self.walls.grid.low, 0.0])

    def _cell(self, xyz_m: ndarray) -> ndarray:
        cell = np.rint((np.asarray(xyz_m, float) - self._low) / self.snap_m)
        if not np.all(np.abs(cell) < 1 << 24):
            raise ValueError("an antenna lies too far from the buildings to be told apart. Check the coordinates.")
        return cell.astype(np.int64)


def _place(cell: Int[ndarray, "n 3"]) -> ndarray:
    """63-bit name of a place: 25 bits each of x and y, 13 of height."""
    x, y, z = (cell[:, k].astype(np.uint64) & np.uint64((1 << bits) - 1) for k, bits in ((0, 25), (1, 25), (2, 13)))
    return (x << np.uint64(38)) | (y << np.uint64(13)) | z
