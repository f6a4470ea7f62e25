"""Whether a straight line between two places meets a surface."""

from __future__ import annotations

import numpy as np
from numba import njit

from sensors.raycast.columnar import contains, rectangle
from sensors.scene import GRID_CELL_M


@njit(cache=True)
def blocked(start, end, a, b, place, ptr, row, bodies, city):
    """Per line from start to end: does it cross a wall, a roof or a body other than actors a and b?

    `ptr`, `row` list, per place, the actors that may stand in the way of lines from there; `place` is each line's.
    """
    out = np.zeros(len(start), np.bool_)
    for i in range(len(start)):
        x0, y0, z0 = start[i, 0], start[i, 1], start[i, 2]
        dx, dy, dz = end[i, 0] - x0, end[i, 1] - y0, end[i, 2] - z0
        out[i] = _by_actor(x0, y0, z0, dx, dy, dz, a[i], b[i], row[ptr[place[i]] : ptr[place[i] + 1]], bodies)
        if not out[i]:
            out[i] = _by_building(x0, y0, z0, dx, dy, dz, city)
    return out


@njit(cache=True)
def _by_actor(x0, y0, z0, dx, dy, dz, a, b, row, bodies):
    for actor in row:
        if actor == a or actor == b:
            continue
        for k in range(bodies.ptr[actor], bodies.ptr[actor + 1]):
            px, py = x0 - bodies.x_m[k], y0 - bodies.y_m[k]
            enter, leave = rectangle(
                bodies.cos[k] * px + bodies.sin[k] * py, bodies.cos[k] * py - bodies.sin[k] * px,
                bodies.cos[k] * dx + bodies.sin[k] * dy, bodies.cos[k] * dy - bodies.sin[k] * dx,
                bodies.half_l_m[k], bodies.half_w_m[k],
            )  # fmt: skip
            enter, leave = max(enter, 0.0), min(leave, 1.0)
            if enter < leave:
                low, high = z0 + enter * dz, z0 + leave * dz
                if max(low, high) > bodies.bottom_m[k] and min(low, high) < bodies.top_m[k]:
                    return True
    return False


@njit(cache=True)
def _by_building(x0, y0, z0, dx, dy, dz, city):
    gx, gy = city.grid_xy_m
    left, right = min(x0, x0 + dx), max(x0, x0 + dx)
    south, north = min(y0, y0 + dy), max(y0, y0 + dy)
    qx0, qx1 = max(0, int(np.floor((left - gx) / GRID_CELL_M))), int(np.floor((right - gx) / GRID_CELL_M))
    qy0, qy1 = max(0, int(np.floor((south - gy) / GRID_CELL_M))), int(np.floor((north - gy) / GRID_CELL_M))
    for cy in range(qy0, min(qy1, city.grid_shape[1] - 1) + 1):
        for cx in range(qx0, min(qx1, city.grid_shape[0] - 1) + 1):
            cell = cy * city.grid_shape[0] + cx
            for item in range(city.grid_ptr[cell], city.grid_ptr[cell + 1]):
                k = city.grid_item[item]
                west, low, east, high = city.bounds_m[k]
                if west > right or east < left or low > north or high < south:
                    continue
                if max(z0, z0 + dz) < city.base_m[k] or min(z0, z0 + dz) > city.top_m[k]:
                    continue
                enter, leave = rectangle(
                    x0 - 0.5 * (west + east), y0 - 0.5 * (low + high), dx, dy, 0.5 * (east - west), 0.5 * (high - low)
                )
                if max(enter, 0.0) > min(leave, 1.0):
                    continue
                for z in (city.base_m[k], city.top_m[k]):
                    if (z0 - z) * (z0 + dz - z) < 0.0:
                        t = (z - z0) / dz
                        if contains(city, k, x0 + t * dx, y0 + t * dy) == 1:
                            return True
                for e in range(city.ptr[k], city.ptr[k + 1]):
                    ax, ay = city.ax_m[e] - x0, city.ay_m[e] - y0
                    bx, by = city.bx_m[e] - x0, city.by_m[e] - y0
                    s, t = dx * ay - dy * ax, dx * by - dy * bx     # sides of the line that the wall's ends are on
                    if (s > 0.0) != (t > 0.0):
                        cross = (bx - ax) * dy - (by - ay) * dx
                        at = (ay * (bx - ax) - ax * (by - ay)) / cross
                        if 0.0 <= at <= 1.0 and city.base_m[k] <= z0 + at * dz <= city.top_m[k]:
                            return True
    return False
