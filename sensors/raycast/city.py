"""Buildings in a sweep: the walls that close a column, and the walls, roofs and undersides that only take some rows."""

from __future__ import annotations

import numpy as np

from cosim.base.kernel import kernel
from sensors.raycast.column import below


@kernel
def contains(city, k, x, y):
    """Whether a point lies in a footprint: the parity of walls crossed to the east."""
    odd = 0
    for e in range(city.ptr[k], city.ptr[k + 1]):
        ay = city.ay_m[e] - y
        by = city.by_m[e] - y
        if (ay > 0.0) != (by > 0.0):
            ax = city.ax_m[e] - x
            bx = city.bx_m[e] - x
            if (ax * by - bx * ay) / (by - ay) > 0.0:
                odd ^= 1
    return odd


@kernel
def column_bound(x, y, columns):
    """First column at or counter-clockwise of a point, in [0, n]."""
    n = columns.n
    if x <= 0.0 and columns.fov_rad < np.pi:
        return 0 if y < 0.0 else n  # behind the sensor: the angle is not needed
    columns_per_rad = n / columns.fov_rad
    place = (np.arctan2(y, x) - columns.first_rad) * columns_per_rad
    return min(n, max(0, int(np.ceil(place))))


@kernel
def wall(ax, ay, bx, by, cos, sin, columns):
    """A wall from (ax, ay) to (bx, by), relative to a sensor looking along (cos, sin): (p0, p1, q0, q1, u, v).

    It fills columns [p0, p1) and [q0, q1); there 1 / distance = u cos(azimuth) + v sin(azimuth). Neighbouring walls
    share the column bound of their common corner, so that there is no gap between them.
    """
    a_ahead = cos * ax + sin * ay
    a_left = cos * ay - sin * ax
    b_ahead = cos * bx + sin * by
    b_left = cos * by - sin * bx
    cross = a_ahead * b_left - a_left * b_ahead
    if cross == 0.0:
        return 0, 0, 0, 0, 0.0, 0.0
    u = (b_left - a_left) / cross
    v = (a_ahead - b_ahead) / cross
    ka = column_bound(a_ahead, a_left, columns)
    kb = column_bound(b_ahead, b_left, columns)
    if cross < 0.0:
        ka, kb = kb, ka
        a_left, b_left = b_left, a_left
    if a_left >= 0.0 and b_left < 0.0:  # counter-clockwise across the rear
        return ka, columns.n, 0, kb, u, v
    return ka, max(ka, kb), 0, 0, u, v


@kernel
def close_columns(found, x, y, z, ground, cos, sin, city, beams, columns, nearest, open_wall, flat):
    """Raise `nearest` (1 / distance per column) to the nearest wall that closes the column; list what does not.

    A wall closes a column if it stands on the ground and reaches over the highest beam.

    Returns
    -------
    How many walls were written to `open_wall` (columns of `wall`, bottom, top, largest 1 / distance that is open) and
    how many buildings to `flat` (building, whether the sensor is over or under it).
    """
    n_open = n_flat = 0
    road = ground - z
    for k in found:
        bottom = city.base_m[k] - z
        top = city.top_m[k] - z
        if top <= road:
            continue
        west, south, east, north = city.bounds_m[k]
        in_bounds = west <= x <= east and south <= y <= north
        inside = in_bounds and contains(city, k, x, y) == 1
        within = inside and bottom < 0.0 and top > 0.0
        if top < 0.0 or bottom > 0.0 or within:
            flat[n_flat, 0] = k
            flat[n_flat, 1] = inside
            n_flat += 1
        closing = np.inf
        if bottom <= road and top > 0.0:
            closing = max(beams.tan_el[-1], 0.0) / top
        for e in range(city.ptr[k], city.ptr[k + 1]):
            ax = city.ax_m[e] - x
            ay = city.ay_m[e] - y
            bx = city.bx_m[e] - x
            by = city.by_m[e] - y
            if not (ax * by < ay * bx or within):
                continue  # the back of a wall is visible only from inside
            p0, p1, q0, q1, u, v = wall(ax, ay, bx, by, cos, sin, columns)
            is_open = False
            for turn in range(2):
                c0, c1 = (p0, p1) if turn == 0 else (q0, q1)
                if c1 <= c0:
                    continue
                of_first = u * beams.cos_az[c0] + v * beams.sin_az[c0]
                of_last = u * beams.cos_az[c1 - 1] + v * beams.sin_az[c1 - 1]
                if min(of_first, of_last) >= closing:
                    for c in range(c0, c1):
                        w = u * beams.cos_az[c] + v * beams.sin_az[c]
                        nearest[c] = max(nearest[c], w)
                    continue
                for c in range(c0, c1):
                    w = u * beams.cos_az[c] + v * beams.sin_az[c]
                    nearest[c] = max(nearest[c], w if w >= closing else 0.0)
                    is_open |= nearest[c] < w < closing
            if is_open:
                entry = open_wall[n_open]
                entry[0], entry[1] = p0, p1
                entry[2], entry[3] = q0, q1
                entry[4], entry[5] = u, v
                entry[6] = max(bottom, road)
                entry[7] = top
                entry[8] = closing
                n_open += 1
    return n_open, n_flat


@kernel
def toggle_levels(toggled, city, k, height, x, y, cos, sin, beams, columns, slopes):
    """Mark, per column, the rows from which on a beam's point on a level lies beyond one more wall.

    The point where a beam meets a level moves monotonically along the column with the beam's elevation; if the number
    of walls before it is odd, it lies on the footprint.
    """
    toggled[:] = 0
    for e in range(city.ptr[k], city.ptr[k + 1]):
        ax = city.ax_m[e] - x
        ay = city.ay_m[e] - y
        bx = city.bx_m[e] - x
        by = city.by_m[e] - y
        p0, p1, q0, q1, u, v = wall(ax, ay, bx, by, cos, sin, columns)
        for turn in range(2):
            c0, c1 = (p0, p1) if turn == 0 else (q0, q1)
            for c in range(c0, c1):
                w = u * beams.cos_az[c] + v * beams.sin_az[c]
                toggled[c, below(slopes, height * w)] ^= 1
