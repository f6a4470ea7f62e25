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
        ay, by = city.ay_m[e] - y, city.by_m[e] - y
        if (ay > 0.0) != (by > 0.0):
            ax, bx = city.ax_m[e] - x, city.bx_m[e] - x
            if (ax * by - bx * ay) / (by - ay) > 0.0:
                odd ^= 1
    return odd


@kernel
def column_bound(x, y, columns):
    """First column at or counter-clockwise of a point, in [0, n]."""
    n = columns.n
    if x <= 0.0 and columns.fov_rad < np.pi:
        return 0 if y < 0.0 else n  # behind the sensor: the angle is not needed
    return min(n, max(0, int(np.ceil((np.arctan2(y, x) - columns.first_rad) * (n / columns.fov_rad)))))


@kernel
def wall(ax, ay, bx, by, cos, sin, columns):
    """A wall from (ax, ay) to (bx, by), relative to a sensor looking along (cos, sin): (p0, p1, q0, q1, u, v).

    It fills columns [p0, p1) and [q0, q1); there 1 / distance = u cos(azimuth) + v sin(azimuth). Neighbouring walls
    share the column bound of their common corner, so that there is no gap between them.
    """
    ax, ay = cos * ax + sin * ay, cos * ay - sin * ax
    bx, by = cos * bx + sin * by, cos * by - sin * bx
    cross = ax * by - ay * bx
    if cross == 0.0:
        return 0, 0, 0, 0, 0.0, 0.0
    u, v = (by - ay) / cross, (ax - bx) / cross
    ka, kb = column_bound(ax, ay, columns), column_bound(bx, by, columns)
    if cross < 0.0:
        ka, kb, ay, by = kb, ka, by, ay
    if ay >= 0.0 and by < 0.0:  # counter-clockwise across the rear
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
    for k in found:
        bottom, top = city.base_m[k] - z, city.top_m[k] - z
        if top <= ground - z:
            continue
        bounds = city.bounds_m[k]
        inside = bounds[0] <= x <= bounds[2] and bounds[1] <= y <= bounds[3] and contains(city, k, x, y) == 1
        within = inside and bottom < 0.0 and top > 0.0
        if top < 0.0 or bottom > 0.0 or within:
            flat[n_flat, 0], flat[n_flat, 1] = k, inside
            n_flat += 1
        closing = max(beams.tan_el[-1], 0.0) / top if bottom <= ground - z and top > 0.0 else np.inf
        for e in range(city.ptr[k], city.ptr[k + 1]):
            ax, ay = city.ax_m[e] - x, city.ay_m[e] - y
            bx, by = city.bx_m[e] - x, city.by_m[e] - y
            if not (ax * by < ay * bx or within):
                continue  # the back of a wall is visible only from inside
            p0, p1, q0, q1, u, v = wall(ax, ay, bx, by, cos, sin, columns)
            is_open = False
            for turn in range(2):
                c0, c1 = (p0, p1) if turn == 0 else (q0, q1)
                if c1 <= c0:
                    continue
                w = u * beams.cos_az[c0] + v * beams.sin_az[c0]
                if min(w, u * beams.cos_az[c1 - 1] + v * beams.sin_az[c1 - 1]) >= closing:
                    for c in range(c0, c1):
                        nearest[c] = max(nearest[c], u * beams.cos_az[c] + v * beams.sin_az[c])
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
                entry[6] = max(bottom, ground - z)
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
        ax, ay = city.ax_m[e] - x, city.ay_m[e] - y
        bx, by = city.bx_m[e] - x, city.by_m[e] - y
        p0, p1, q0, q1, u, v = wall(ax, ay, bx, by, cos, sin, columns)
        for turn in range(2):
            for c in range(p0 if turn == 0 else q0, p1 if turn == 0 else q1):
                w = u * beams.cos_az[c] + v * beams.sin_az[c]
                toggled[c, below(slopes, height * w)] ^= 1
