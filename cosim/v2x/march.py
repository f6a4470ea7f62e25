"""Straight lines marched through a grid of walls: the kernels of `obstruction`.

A cell knows how many cells away the next wall may be, so that a ray crosses empty streets in a few steps, and is
tested exactly against the walls of the cells where there are some.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import njit
from numpy import ndarray

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


class Filled(NamedTuple):
    """Cells that a building fills at every height where an antenna is."""

    bits: UInt8[ndarray, "k"]  # eight cells each; that of the first corner is empty
    nx: int
    ny: int


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


def by_cell(low: ndarray, cell_m: float, shape: tuple[int, int], a: ndarray, b: ndarray) -> tuple[ndarray, ndarray]:
    count = np.zeros(shape[0] * shape[1] + 1, np.int64)
    _file(low, cell_m, shape, a, b, False, count, np.zeros(0, np.int32))
    ptr = np.concatenate([[0], np.cumsum(count[:-1])])
    out = np.empty(ptr[-1], np.int32)
    _file(low, cell_m, shape, a, b, True, ptr.copy(), out)
    return ptr, out


@njit(cache=True)
def inside(xyz, grid, walls, spans, low_z, high_z):
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


@kernel
def through(xyz, a, b, grid, walls, n_walls, inside):
    """Count the walls that each segment crosses, and add up where it leaves houses less where it enters them."""
    nx, ny = grid.step.shape
    inv = 1.0 / grid.cell_m
    for m in range(len(a)):
        p, q = a[m], b[m]
        x, y = xyz[p, 0], xyz[p, 1]
        dx, dy, dz = xyz[q, 0] - x, xyz[q, 1] - y, xyz[q, 2] - xyz[p, 2]
        u, v, du, dv = (x - grid.low[0]) * inv, (y - grid.low[1]) * inv, dx * inv, dy * inv
        t, stop = _over_grid(u, du, nx, 0.0, 1.0)
        t, stop = _over_grid(v, dv, ny, t, stop)
        while t < stop:
            i = min(max(int(u + t * du), 0), nx - 1)
            j = min(max(int(v + t * dv), 0), ny - 1)
            step = max(np.int64(grid.step[i, j]), 1)
            edge_u = i + step if du > 0.0 else i + 1 - step
            edge_v = j + step if dv > 0.0 else j + 1 - step
            t_u = (edge_u - u) / du if du != 0.0 else np.inf
            t_v = (edge_v - v) / dv if dv != 0.0 else np.inf
            leave = max(t, min(t_u, t_v)) + 1e-12
            cell = i * ny + j
            for k in range(grid.ptr[cell], grid.ptr[cell + 1]):
                w = grid.wall[k]
                ex, ey = walls[w, 2] - walls[w, 0], walls[w, 3] - walls[w, 1]
                fx, fy = walls[w, 0] - x, walls[w, 1] - y
                det = dx * ey - dy * ex  # positive where the ray leaves: the house is on the wall's left
                if det == 0.0:
                    continue
                s, r = (fx * ey - fy * ex) / det, (fx * dy - fy * dx) / det
                # A wall may be filed under several cells: it counts in the one where it is crossed.
                if t <= s < min(leave, stop) and 0.0 <= r < 1.0 and walls[w, 4] <= xyz[p, 2] + s * dz <= walls[w, 5]:
                    n_walls[m] += 1
                    inside[m] += s if det > 0.0 else -s
            t = leave


N_PROBES = 12
_PROBES = (0.5 + 0.6180339887498949 * np.arange(N_PROBES)) % 1.0  # golden section: any first few are evenly spread
_AT_ONCE = 3
N_WAYS = 8
_WAYS = np.uint64(N_WAYS - 1)
_REGION = np.uint64(127)


@inlined
def runs_into_house(cells, p, q, filled):
    """Whether one of a few points of the segment lies in a cell that a building fills: cheap, and never wrong."""
    u, v = cells[p, 0], cells[p, 1]
    du, dv = cells[q, 0] - u, cells[q, 1] - v
    n = min(int((abs(du) + abs(dv)) * 0.5) + 1, N_PROBES)
    first, into = 0, False
    while first < n and not into:
        for k in range(first, first + _AT_ONCE):  # without asking in between: guessing wrong costs more than looking
            i, j = int(u + _PROBES[k] * du), int(v + _PROBES[k] * dv)
            cell = i * filled.ny + j if (i >= 0) & (i < filled.nx) & (j >= 0) & (j < filled.ny) else 0
            into |= (filled.bits[cell >> 3] >> (cell & 7)) & 1 != 0
        first += _AT_ONCE
    return into


@kernel
def probe(cells, a, b, filled, hidden):
    """Lines that are seen at once to run into a house."""
    for m in range(len(a)):
        hidden[m] = runs_into_house(cells, a[m], b[m], filled)


@kernel
def clear(xyz, indoors, a, b, hidden, grid, walls, out):
    for m in range(len(a)):
        p, q = a[m], b[m]
        if hidden[m] or indoors[p] or indoors[q]:
            out[m] = False
            continue
        out[m] = not _cut(xyz, p, q, grid, walls)


@kernel
def clear_remembered(xyz, indoors, place, a, b, hidden, grid, walls, memo, out):
    mask, one = np.uint64(memo.shape[0] - 1), np.uint64(1)
    for m in range(len(a)):
        p, q = a[m], b[m]
        if hidden[m] or indoors[p] or indoors[q]:
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
