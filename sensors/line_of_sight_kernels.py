"""Straight lines through a grid of walls and past the bodies of actors: the kernels of `line_of_sight`.

Each cell stores the distance in cells to the nearest cell that contains a wall, so that a line crosses empty streets
in few steps and is tested exactly only against the walls of occupied cells.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import njit, prange
from numpy import ndarray

from sensors.hash_rng import mix
from sensors.kernel import inlined, kernel
from sensors.raycast.column import in_prism_frame, rectangle

_SLACK_M = 1e-6
"""A wall is listed under every cell within this distance, so that rounding never omits one."""


class Grid(NamedTuple):
    """Walls and buildings by cell."""

    low: Float[ndarray, "2"]
    cell_m: float
    step: Int[ndarray, "nx ny"]  # cells to the nearest one with a wall; 0 where there is one
    ptr: Int[ndarray, "cells+1"]
    wall: Int[ndarray, "m"]
    building_ptr: Int[ndarray, "cells+1"]
    building: Int[ndarray, "k"]


class Walls(NamedTuple):
    """W walls, by building."""

    segment: Float[ndarray, "w 6"]  # x, y of both ends, base and top [m]
    ptr: Int[ndarray, "b+1"]  # where each building's walls begin
    base_m: Float[ndarray, "b"]
    top_m: Float[ndarray, "b"]


class FilledCells(NamedTuple):
    """Cells that one building fills at every height at which an end of a line is."""

    bits: UInt8[ndarray, "k"]  # eight cells each; the cell of the first corner is empty
    nx: int
    ny: int


@kernel
def _list_segments(low, cell_m, shape, first, second, fill, ptr, out):
    """List every segment under every cell that it touches (bounding boxes first, then the separating axis)."""
    for w in range(first.shape[0]):
        x0, y0, x1, y1 = first[w, 0], first[w, 1], second[w, 0], second[w, 1]
        i0 = max(int((min(x0, x1) - _SLACK_M - low[0]) / cell_m), 0)
        i1 = min(int((max(x0, x1) + _SLACK_M - low[0]) / cell_m), shape[0] - 1)
        j0 = max(int((min(y0, y1) - _SLACK_M - low[1]) / cell_m), 0)
        j1 = min(int((max(y0, y1) + _SLACK_M - low[1]) / cell_m), shape[1] - 1)
        nx, ny = y0 - y1, x1 - x0
        extent = (0.5 * cell_m + _SLACK_M) * (abs(nx) + abs(ny))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                cx, cy = low[0] + (i + 0.5) * cell_m, low[1] + (j + 0.5) * cell_m
                if abs(nx * (cx - x0) + ny * (cy - y0)) <= extent:
                    cell = i * shape[1] + j
                    if fill:
                        out[ptr[cell]] = w
                    ptr[cell] += 1


def by_cell(low: ndarray, cell_m: float, shape: tuple[int, int], a: ndarray, b: ndarray) -> tuple[ndarray, ndarray]:
    """Segments from a to b by cell, compressed rows; a city has tens of millions of cells."""
    count = np.zeros(shape[0] * shape[1] + 1, np.int64)
    _list_segments(low, cell_m, shape, a, b, False, count, np.zeros(0, np.int32))
    ptr = np.concatenate([[0], np.cumsum(count[:-1])])
    out = np.empty(ptr[-1], np.int32)
    _list_segments(low, cell_m, shape, a, b, True, ptr.copy(), out)
    return ptr.astype(np.int32), out


@njit(cache=True)
def building_at(xyz, grid, walls):
    """The building that contains each point, by even-odd over its rings; -1 if none. Any height where z is NaN."""
    out = np.full(xyz.shape[0], -1)
    nx, ny = grid.step.shape
    for p in range(xyz.shape[0]):
        x, y, z = xyz[p]
        i, j = int((x - grid.low[0]) // grid.cell_m), int((y - grid.low[1]) // grid.cell_m)
        if i < 0 or j < 0 or i >= nx or j >= ny:
            continue
        cell = i * ny + j
        for h in range(grid.building_ptr[cell], grid.building_ptr[cell + 1]):
            building = grid.building[h]
            if z < walls.base_m[building] or z > walls.top_m[building]:
                continue
            odd = False
            for w in range(walls.ptr[building], walls.ptr[building + 1]):
                wall = walls.segment[w]
                x0, y0, x1, y1 = wall[0], wall[1], wall[2], wall[3]
                if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                    odd = not odd
            if odd:
                out[p] = building
                break
    return out


@kernel
def _over_grid(start, delta, high, t, stop):
    """The part of a line between `t` and `stop` in which one of its coordinates lies on the grid."""
    if delta == 0.0:
        return (t, stop) if 0.0 <= start < high else (1.0, 0.0)
    near, far = -start / delta, (high - start) / delta
    return max(t, min(near, far)), min(stop, max(near, far))


@inlined
def _is_cut(xyz, p, q, grid, walls):
    """Whether a wall cuts the line between two points outside all buildings; `walls` are segments."""
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
                s = fx * ey - fy * ex  # along the line, times det
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
def walls_crossed(xyz, a, b, grid, walls, n_walls, inside):
    """Count the walls that each line crosses; add up the parameters where it leaves buildings less where it enters."""
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
                det = dx * ey - dy * ex  # positive where the line leaves: the building is on the wall's left
                if det == 0.0:
                    continue
                s, r = (fx * ey - fy * ex) / det, (fx * dy - fy * dx) / det
                # A wall may be listed under several cells: it counts in the one where it is crossed.
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
_CHUNK = 1024
"""Lines that one thread follows at once."""


@inlined
def crosses_filled_cell(cells, p, q, filled):
    """Whether one of a few points of the line lies in a cell that a building fills: sufficient for no line of sight."""
    u, v = cells[p, 0], cells[p, 1]
    du, dv = cells[q, 0] - u, cells[q, 1] - v
    n = min(int((abs(du) + abs(dv)) * 0.5) + 1, N_PROBES)
    first, found = 0, False
    while first < n and not found:
        for k in range(first, first + _AT_ONCE):  # without a branch in between: mispredicting costs more than testing
            i, j = int(u + _PROBES[k] * du), int(v + _PROBES[k] * dv)
            cell = i * filled.ny + j if (i >= 0) & (i < filled.nx) & (j >= 0) & (j < filled.ny) else 0
            found |= (filled.bits[cell >> 3] >> (cell & 7)) & 1 != 0
        first += _AT_ONCE
    return found


@kernel
def probe(cells, a, b, filled, blocked):
    """Lines that cross a filled cell."""
    for m in range(len(a)):
        blocked[m] = crosses_filled_cell(cells, a[m], b[m], filled)


@kernel
def has_los(xyz, indoors, a, b, blocked, grid, walls, out):
    """Which lines no wall cuts; `blocked` are known to be cut, `indoors` ends have no line of sight."""
    for m in range(len(a)):
        p, q = a[m], b[m]
        if blocked[m] or indoors[p] or indoors[q]:
            out[m] = False
            continue
        out[m] = not _is_cut(xyz, p, q, grid, walls)


@inlined
def _entry(place, p, q, mask):
    """Where the answer of a pair of places is kept, and the tag that it has there."""
    one = np.uint64(1)
    region = mix(place[p], one) & mask & ~_REGION  # pairs of one end lie close together in memory
    low, high = (place[q], place[p]) if place[p] > place[q] else (place[p], place[q])
    h = mix(low, high)
    return np.int64(region | (h & _REGION & ~_WAYS)), mix(h, low) | one


@njit(cache=True, nogil=True, parallel=True)
def has_los_cached(xyz, indoors, place, a, b, blocked, grid, walls, memo, out, is_new):
    """The same, with the answers in `memo` by the places of both ends; `is_new` are those that it lacks."""
    n = len(a)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        first, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)
        _has_los_cached(first, end, xyz, indoors, place, a, b, blocked, grid, walls, memo, out, is_new)


@kernel
def _has_los_cached(begin, end, xyz, indoors, place, a, b, blocked, grid, walls, memo, out, is_new):
    """Of the lines from `begin` to before `end`."""
    mask, one = np.uint64(memo.shape[0] - 1), np.uint64(1)
    for m in range(begin, end):
        p, q = a[m], b[m]
        out[m], is_new[m] = False, False
        if blocked[m] or indoors[p] or indoors[q]:
            continue
        first, tag = _entry(place, p, q, mask)
        way = 0
        while way < N_WAYS and memo[first + way] | one != tag:
            way += 1
        if way < N_WAYS:
            out[m] = memo[first + way] & one
            continue
        if place[p] > place[q]:
            p, q = q, p
        is_new[m] = True
        out[m] = not _is_cut(xyz, p, q, grid, walls)


@kernel
def remember(place, a, b, los, is_new, memo):
    """Keep new answers."""
    mask, one = np.uint64(memo.shape[0] - 1), np.uint64(1)
    for m in range(len(a)):
        if is_new[m]:
            first, tag = _entry(place, a[m], b[m], mask)
            for k in range(N_WAYS - 1, 0, -1):  # the oldest is evicted
                memo[first + k] = memo[first + k - 1]
            memo[first] = tag if los[m] else tag ^ one


@njit(cache=True)
def cut_by_body(start, end, a, b, place, ptr, row, bodies):
    """Per line from start to end: does it cross a body of an actor other than a and b?

    `ptr`, `row` list, per place, the actors whose bodies can cut lines from there; `place` is each line's.
    """
    out = np.zeros(len(start), np.bool_)
    for i in range(len(start)):
        x, y, z = start[i, 0], start[i, 1], start[i, 2]
        dx, dy, dz = end[i, 0] - x, end[i, 1] - y, end[i, 2] - z
        out[i] = _meets_body(x, y, z, dx, dy, dz, a[i], b[i], row[ptr[place[i]] : ptr[place[i] + 1]], bodies)
    return out


@njit(cache=True)
def _meets_body(x, y, z, dx, dy, dz, a, b, row, bodies):
    for actor in row:
        if actor in (a, b):
            continue
        for k in range(bodies.ptr[actor], bodies.ptr[actor + 1]):
            p, q, u, v = in_prism_frame(bodies, k, x, y, dx, dy)
            enter, leave = rectangle(p, q, u, v, bodies.half_l_m[k], bodies.half_w_m[k])
            enter, leave = max(enter, 0.0), min(leave, 1.0)
            if enter < leave:
                low, high = z + enter * dz, z + leave * dz
                if max(low, high) > bodies.bottom_m[k] and min(low, high) < bodies.top_m[k]:
                    return True
    return False
