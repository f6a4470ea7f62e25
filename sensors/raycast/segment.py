"""Whether a straight line between two points meets a surface."""

from __future__ import annotations

import numpy as np
from numba import njit

from sensors.raycast.city import contains, gather
from sensors.raycast.column import in_prism_frame, rectangle


@njit(cache=True)
def blocked(start, end, a, b, origin, ptr, row, bodies, city):
    """Per line from start to end: does it cross a wall, a roof or a body other than actors a and b?

    `ptr`, `row` list, per origin, the actors that may block lines from there; `origin` is that of each line.
    """
    out = np.zeros(len(start), np.bool_)
    for i in range(len(start)):
        x0, y0, z0 = start[i, 0], start[i, 1], start[i, 2]
        dx, dy, dz = end[i, 0] - x0, end[i, 1] - y0, end[i, 2] - z0
        out[i] = _by_actor(x0, y0, z0, dx, dy, dz, a[i], b[i], row[ptr[origin[i]] : ptr[origin[i] + 1]], bodies)
        if not out[i]:
            out[i] = _by_building(x0, y0, z0, dx, dy, dz, city)
    return out


@njit(cache=True)
def _by_actor(x, y, z, dx, dy, dz, a, b, row, bodies):
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


@njit(cache=True)
def _by_building(x, y, z, dx, dy, dz, city):
    low, high = min(z, z + dz), max(z, z + dz)
    for k in gather(city, min(x, x + dx), min(y, y + dy), max(x, x + dx), max(y, y + dy)):
        base, top = city.base_m[k], city.top_m[k]
        if high < base or low > top:
            continue
        bounds = city.bounds_m[k]
        west, south, east, north = bounds[0], bounds[1], bounds[2], bounds[3]
        enter, leave = rectangle(
            x - 0.5 * (west + east), y - 0.5 * (south + north), dx, dy, 0.5 * (east - west), 0.5 * (north - south)
        )
        if max(enter, 0.0) > min(leave, 1.0):
            continue
        for level in (base, top):
            if low < level < high:
                t = (level - z) / dz
                if contains(city, k, x + t * dx, y + t * dy) == 1:
                    return True
        for e in range(city.ptr[k], city.ptr[k + 1]):
            ax, ay = city.ax_m[e] - x, city.ay_m[e] - y
            bx, by = city.bx_m[e] - x, city.by_m[e] - y
            if (dx * ay - dy * ax > 0.0) != (dx * by - dy * bx > 0.0):  # its ends lie on either side of the line
                t = (ay * (bx - ax) - ax * (by - ay)) / ((bx - ax) * dy - (by - ay) * dx)
                if 0.0 <= t <= 1.0 and base <= z + t * dz <= top:
                    return True
    return False
