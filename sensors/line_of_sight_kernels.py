"""Straight lines through a grid of walls and past the bodies of actors: the kernels of `line_of_sight`.

Each cell stores the distance in cells to the nearest cell that contains a wall, so that a line crosses empty streets
in few steps and is tested exactly only against the walls of occupied cells.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.base.kernel import compiled, inlined, kernel
from sensors.raycast.column import in_prism_frame, rectangle

_SLACK_M = 1e-6
"""A wall is listed under every cell within this distance, so that rounding never omits one."""


_BASE, _TOP = 4, 5
"""Columns of `Walls.segment`."""

BUILDING_CELLS = 4
"""Width of the squares in which buildings are listed [cells]: a city has tens of millions of cells."""


class Grid(NamedTuple):
    """Walls and buildings by cell."""

    low: Float[ndarray, "2"]
    cell_m: float
    step: Int[ndarray, "nx ny"]  # cells to the nearest one with a wall; 0 where there is one
    ptr: Int[ndarray, "cells+1"]
    wall: Int[ndarray, "m"]
    building_ptr: Int[ndarray, "squares+1"]  # of squares of cells, `BUILDING_CELLS` wide
    building: Int[ndarray, "k"]


class Walls(NamedTuple):
    """W walls, by building."""

    segment: Float[ndarray, "w 6"]  # x, y of both ends, base and top [m]; see `_BASE`, `_TOP`
    ptr: Int[ndarray, "b+1"]  # where each building's walls begin
    base_m: Float[ndarray, "b"]
    top_m: Float[ndarray, "b"]


class FilledCells(NamedTuple):
    """Cells that one building fills at every height at which an end of a line is."""

    bits: UInt8[ndarray, "k"]  # eight cells each; the cell of the first corner is empty
    nx: int
    ny: int


@inlined
def _cells_between(start, end, low, cell_m, n):
    """The first and the last of `n` cells along one axis that lie between two coordinates."""
    first = int((min(start, end) - _SLACK_M - low) / cell_m)
    last = int((max(start, end) + _SLACK_M - low) / cell_m)
    return max(first, 0), min(last, n - 1)


@kernel
def _list_segments(low, cell_m, shape, first, second, fill, ptr, out):
    """List every segment under every cell that it touches (bounding boxes first, then the separating axis)."""
    for w in range(first.shape[0]):
        x0, y0 = first[w]
        x1, y1 = second[w]
        i0, i1 = _cells_between(x0, x1, low[0], cell_m, shape[0])
        j0, j1 = _cells_between(y0, y1, low[1], cell_m, shape[1])
        nx, ny = y0 - y1, x1 - x0
        extent = (0.5 * cell_m + _SLACK_M) * (abs(nx) + abs(ny))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                dx = low[0] + (i + 0.5) * cell_m - x0
                dy = low[1] + (j + 0.5) * cell_m - y0
                if abs(nx * dx + ny * dy) <= extent:
                    cell = i * shape[1] + j
                    if fill:
                        out[ptr[cell]] = w
                    ptr[cell] += 1


def by_cell(
    low: ndarray,
    cell_m: float,
    shape: tuple[int, int],
    a: ndarray,
    b: ndarray,
) -> tuple[ndarray, ndarray]:
    """List the segments under every cell that they touch.

    Parameters
    ----------
    low, cell_m, shape
        Lower corner of the grid, width of a cell, and number of cells in x and in y.
    a, b
        x and y of the two ends of each segment.

    Returns
    -------
    The segments of cell i * shape[1] + j (i in x, j in y), as compressed rows: where each cell begins, and numbers of
    segments, ascending in a cell. Both are 32-bit, because a city has tens of millions of cells.
    """
    count = np.zeros(shape[0] * shape[1] + 1, np.int64)
    _list_segments(low, cell_m, shape, a, b, False, count, np.zeros(0, np.int32))
    ptr = np.concatenate([[0], np.cumsum(count[:-1])])
    out = np.empty(ptr[-1], np.int32)
    _list_segments(low, cell_m, shape, a, b, True, ptr.copy(), out)
    return ptr.astype(np.int32), out


@compiled
def building_at(xyz, grid, walls):
    """The building that contains each point, by even-odd over its rings; -1 if none. Any height where z is NaN."""
    out = np.full(xyz.shape[0], -1)
    nx, ny = grid.step.shape
    for p in range(xyz.shape[0]):
        x, y, z = xyz[p]
        i = int((x - grid.low[0]) // grid.cell_m)
        j = int((y - grid.low[1]) // grid.cell_m)
        if i < 0 or j < 0 or i >= nx or j >= ny:
            continue
        squares_per_row = (ny + BUILDING_CELLS - 1) // BUILDING_CELLS
        square = i // BUILDING_CELLS * squares_per_row + j // BUILDING_CELLS
        for h in range(grid.building_ptr[square], grid.building_ptr[square + 1]):
            building = grid.building[h]
            if z < walls.base_m[building] or z > walls.top_m[building]:
                continue
            odd = False
            for w in range(walls.ptr[building], walls.ptr[building + 1]):
                wall = walls.segment[w]
                x0, y0 = wall[0], wall[1]
                x1, y1 = wall[2], wall[3]
                if (y0 > y) != (y1 > y):
                    x_of_wall = x0 + (y - y0) / (y1 - y0) * (x1 - x0)
                    if x < x_of_wall:
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
def _from_to(xyz, p, q):
    """From point p to point q."""
    dx = xyz[q, 0] - xyz[p, 0]
    dy = xyz[q, 1] - xyz[p, 1]
    dz = xyz[q, 2] - xyz[p, 2]
    return dx, dy, dz


@inlined
def _crossing(x, y, dx, dy, wall):
    """Where the line from (x, y) along (dx, dy) crosses a wall: a determinant; times it, shares of line and of wall."""
    ex = wall[2] - wall[0]
    ey = wall[3] - wall[1]
    fx, fy = wall[0] - x, wall[1] - y
    det = dx * ey - dy * ex
    of_line = fx * ey - fy * ex
    of_wall = fx * dy - fy * dx
    return det, of_line, of_wall


@kernel
def walls_crossed(xyz, a, b, grid, walls, n_walls, inside):
    """Count the walls that each line crosses, and find the part of the line that lies inside buildings.

    `inside` gets the sum of the parameters (0 to 1 along the line) where the line leaves buildings, less those where it
    enters.
    """
    nx, ny = grid.step.shape
    inv = 1.0 / grid.cell_m
    for m in range(len(a)):
        p, q = a[m], b[m]
        x, y = xyz[p, 0], xyz[p, 1]
        dx, dy, dz = _from_to(xyz, p, q)
        # In cells, from the corner of the grid.
        u = (x - grid.low[0]) * inv
        v = (y - grid.low[1]) * inv
        du, dv = dx * inv, dy * inv
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
                wall = walls[grid.wall[k]]
                # `det` is positive where the line leaves: the building is on the wall's left.
                det, s, r = _crossing(x, y, dx, dy, wall)
                if det == 0.0:
                    continue
                s, r = s / det, r / det
                # A wall may be listed under several cells: it counts in the one where it is crossed.
                is_here = t <= s < min(leave, stop) and 0.0 <= r < 1.0
                height = xyz[p, 2] + s * dz
                if is_here and wall[_BASE] <= height <= wall[_TOP]:
                    n_walls[m] += 1
                    inside[m] += s if det > 0.0 else -s
            t = leave


N_PROBES = 12
_PROBES = (0.5 + 0.6180339887498949 * np.arange(N_PROBES)) % 1.0  # golden section: any first few are evenly spread
_AT_ONCE = 3
_CHUNK = 512
"""Lines that one thread follows at once."""


@inlined
def crosses_filled_cell(cells, p, q, filled):
    """Whether one of a few points of the line lies in a cell that a building fills: sufficient for no line of sight."""
    u, v = cells[p, 0], cells[p, 1]
    du = cells[q, 0] - u
    dv = cells[q, 1] - v
    n = min(int((abs(du) + abs(dv)) * 0.5) + 1, N_PROBES)
    first, found = 0, False
    while first < n and not found:
        for k in range(first, first + _AT_ONCE):  # without a branch in between: mispredicting costs more than testing
            i = int(u + _PROBES[k] * du)
            j = int(v + _PROBES[k] * dv)
            on_grid = (i >= 0) & (i < filled.nx) & (j >= 0) & (j < filled.ny)
            cell = i * filled.ny + j if on_grid else 0
            found |= (filled.bits[cell >> 3] >> (cell & 7)) & 1 != 0
        first += _AT_ONCE
    return found


@kernel
def probe(cells, a, b, filled, blocked):
    """Lines that cross a filled cell."""
    for m in range(len(a)):
        blocked[m] = crosses_filled_cell(cells, a[m], b[m], filled)


@kernel
def _cut(xyz, p, q, listed, walls):
    """Whether one of the walls that are listed cuts the line between two points."""
    x, y = xyz[p, 0], xyz[p, 1]
    dx, dy, dz = _from_to(xyz, p, q)
    for w in listed:
        wall = walls[w]
        det, s, r = _crossing(x, y, dx, dy, wall)
        if det < 0.0:
            det, s, r = -det, -s, -r
        if det > 0.0 and 0.0 <= s <= det and 0.0 <= r <= det:
            height = xyz[p, 2] + s / det * dz
            if wall[_BASE] <= height <= wall[_TOP]:
                return True
    return False


_U, _V, _DU, _DV, _PER_U, _PER_V = range(6)
_T, _STOP, _SIGN_U, _EDGE_U, _SIGN_V, _EDGE_V = range(6, 12)
"""Columns of a line on its way: start, extent and inverse extent along x and y, in cells; the parameter now and at the
end; by axis +1 or -1, and 0 or 1: on which side a line of its direction leaves a cell."""


@inlined
def _by_rank(a, b, rank):
    """Both ends, that of lower rank first; `a` first where they are equal."""
    return (b, a) if rank[a] > rank[b] else (a, b)


@kernel
def _follow(begin, end, xyz, indoors, rank, a, b, blocked, grid, walls, line, active, course, out):
    """Lines from `begin` to before `end`, all of them a step at a time: their steps do not wait for each other.

    `line` and `active` have room for a number per line: which line a row of `course` is of, and which rows go on.
    """
    nx, ny = grid.step.shape
    inv = 1.0 / grid.cell_m
    n = 0
    for m in range(begin, end):
        p, q = _by_rank(a[m], b[m], rank)
        out[m] = not (blocked[m] or indoors[p] or indoors[q])
        if not out[m]:
            continue
        dx, dy, _ = _from_to(xyz, p, q)
        # In cells, from the corner of the grid.
        u = (xyz[p, 0] - grid.low[0]) * inv
        v = (xyz[p, 1] - grid.low[1]) * inv
        du, dv = dx * inv, dy * inv
        t, stop = _over_grid(u, du, nx, 0.0, 1.0)  # only the part over the grid
        t, stop = _over_grid(v, dv, ny, t, stop)
        line[n], active[n], row = m, n, course[n]
        row[_U], row[_DU] = u, du
        row[_V], row[_DV] = v, dv
        row[_PER_U] = 1.0 / du if du != 0.0 else np.inf
        row[_PER_V] = 1.0 / dv if dv != 0.0 else np.inf
        row[_T], row[_STOP] = t, stop
        row[_SIGN_U] = 1.0 if du >= 0.0 else -1.0
        row[_SIGN_V] = 1.0 if dv >= 0.0 else -1.0
        row[_EDGE_U] = 0.0 if du >= 0.0 else 1.0
        row[_EDGE_V] = 0.0 if dv >= 0.0 else 1.0
        n += t < stop
    while n > 0:
        left = 0
        for k in range(n):
            r = np.uint64(active[k])  # signed numbers of rows would be tested for being negative
            row = course[r]
            t, u, v = row[_T], row[_U], row[_V]
            u_now = u + t * row[_DU]
            v_now = v + t * row[_DV]
            i = min(max(int(u_now), 0), nx - 1)
            j = min(max(int(v_now), 0), ny - 1)
            step = grid.step[np.uint64(i), np.uint64(j)]
            cut = False
            if step == 0:
                m = line[r]
                p, q = _by_rank(a[m], b[m], rank)
                cell = i * ny + j
                listed = grid.wall[grid.ptr[cell] : grid.ptr[cell + 1]]
                cut = _cut(xyz, p, q, listed, walls)
                out[m] = not cut
                step = 1
            # Leave the square of cells of which nothing is closer than `step` cells.
            edge_u = i + row[_SIGN_U] * step + row[_EDGE_U]
            edge_v = j + row[_SIGN_V] * step + row[_EDGE_V]
            t_u = (edge_u - u) * row[_PER_U]
            t_v = (edge_v - v) * row[_PER_V]
            t = max(t, min(t_u, t_v)) + 1e-12
            row[_T] = t
            active[left] = r
            left += (t < row[_STOP]) & (not cut)
        n = left


def n_chunks(n_lines: int) -> int:
    """Number of the chunks in which `has_los` follows lines."""
    return (n_lines + _CHUNK - 1) // _CHUNK


@compiled
def has_los(begin, end, xyz, indoors, rank, a, b, blocked, grid, walls, out):
    """Which lines of the chunks from `begin` to `end` no wall cuts. There are `n_chunks`.

    Lines in `blocked` are known to be cut. A line with an end in `indoors` has no line of sight. A line is followed
    from its end of lower `rank`, from `a` where both ranks are equal.
    """
    line = np.empty(_CHUNK, np.int64)
    active = np.empty(_CHUNK, np.int64)
    course = np.empty((_CHUNK, 12))
    for chunk in range(begin, end):
        first = chunk * _CHUNK
        stop = min(first + _CHUNK, len(a))
        _follow(first, stop, xyz, indoors, rank, a, b, blocked, grid, walls, line, active, course, out)


@compiled
def cut_by_body(start, end, a, b, place, ptr, row, bodies):
    """Whether each line from start to end crosses the body of an actor other than a and b.

    `place` is the place from which a line starts. `ptr` and `row` list, for each place, the actors whose bodies can cut
    lines from there.
    """
    out = np.zeros(len(start), np.bool_)
    for i in range(len(start)):
        from_here = place[i]
        listed = row[ptr[from_here] : ptr[from_here + 1]]
        out[i] = _meets_body(start[i], end[i], a[i], b[i], listed, bodies)
    return out


@kernel
def _meets_body(start, end, a, b, listed, bodies):
    """Whether the line crosses the body of one of the listed actors, other than a and b."""
    x, y, z = start
    dx = end[0] - x
    dy = end[1] - y
    dz = end[2] - z
    for actor in listed:
        if actor in (a, b):
            continue
        for k in range(bodies.ptr[actor], bodies.ptr[actor + 1]):
            p, q, u, v = in_prism_frame(bodies, k, x, y, dx, dy)
            half_l, half_w = bodies.half_l_m[k], bodies.half_w_m[k]
            enter, leave = rectangle(p, q, u, v, half_l, half_w)
            enter, leave = max(enter, 0.0), min(leave, 1.0)
            if enter < leave:
                z0, z1 = z + enter * dz, z + leave * dz
                low, high = min(z0, z1), max(z0, z1)
                if high > bodies.bottom_m[k] and low < bodies.top_m[k]:
                    return True
    return False
