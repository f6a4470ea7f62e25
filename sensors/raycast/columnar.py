"""The columnar caster: a street is upright prisms, a sweep is columns, and each column is a problem in the plane.

In a column of azimuth φ a wall stands at one horizontal distance t, a prism between two, and a beam of elevation α
climbs to t tan α. With the beams sorted by tan α, what a prism covers is an index range: its side the rows with
tan α in [bottom / t, top / t), its roof (seen from above) the rows up to top / t_out. Work is proportional to what is
hit. Along a straight wall w = 1 / t is a linear function of (cos φ, sin φ), so that the nearest of the walls that
close a column up to the highest beam is a running maximum; everything else is painted over it, nearest first wins.
Seen from inside, a prism shows its inner faces, as a closed mesh would.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from sensors.boxes import Boxes
from sensors.near import near
from sensors.scene import GRID_CELL_M, Prisms, Scene

GROUND, BUILDING, ACTOR = 1, 2, 3


def cast(range_m, hit, poses, ground_m, observers, beams, max_range_m, boxes: Boxes, bodies: Prisms, scene: Scene):
    """Fill `range_m` and `hit` of every observer; see `sensors.lidar.scan`."""
    ptr, row = near(poses.origin_m, boxes, max_range_m)
    _cast(
        range_m, hit, poses.origin_m, poses.yaw_rad, ground_m, observers, beams, float(max_range_m),
        boxes.xyz_m, 0.5 * np.hypot(boxes.lwh_m[:, 0], boxes.lwh_m[:, 1]), ptr, row, bodies, scene.buildings,
    )  # fmt: skip


@njit(cache=True, inline="always")
def below(tan_el, slope):
    """How many beams are lower than a slope: the first row at or above it."""
    count = 0
    for r in range(len(tan_el)):
        count += tan_el[r] < slope
    return count


@njit(cache=True)
def spans(angle, half, first, step, n):
    """Columns within `half` of an angle, as two index ranges (the second one is for arcs across the rear)."""
    if half >= np.pi:
        return 0, n, 0, 0
    low, high = (angle - half - first) / step, (angle + half - first) / step
    turn = 2.0 * np.pi / step
    a0, a1 = max(0, int(np.ceil(low))), min(n, int(np.floor(high)) + 1)
    shift = turn if angle < 0.0 else -turn
    b0, b1 = max(0, int(np.ceil(low + shift))), min(n, int(np.floor(high + shift)) + 1)
    return a0, max(a0, a1), b0, max(b0, b1)


@njit(cache=True)
def rectangle(p, q, u, v, half_l, half_w):
    """Where a ray from (p, q) along (u, v) enters and leaves a centred rectangle; enter > leave if it misses."""
    enter, leave = -np.inf, np.inf
    if u != 0.0:
        s, t = (-half_l - p) / u, (half_l - p) / u
        enter, leave = min(s, t), max(s, t)
    elif abs(p) > half_l:
        enter = np.inf
    if v != 0.0:
        s, t = (-half_w - q) / v, (half_w - q) / v
        enter, leave = max(enter, min(s, t)), min(leave, max(s, t))
    elif abs(q) > half_w:
        enter = np.inf
    return enter, leave


@njit(cache=True)
def profile(enter, leave, bottom, top, tan_el):
    """Rows of one column that a prism covers: (a, s0, s1, b, t, low, high).

    Rows [a, s0) meet the level `low`, rows [s0, s1) the wall at distance t, rows [s1, b) the level `high`.
    Heights are relative to the sensor.
    """
    if enter > 0.0:
        s0, s1 = below(tan_el, bottom / enter), below(tan_el, top / enter)
        a = below(tan_el, bottom / leave) if bottom > 0.0 else s0
        b = below(tan_el, top / leave) if top < 0.0 else s1
        return a, s0, s1, b, enter, bottom, top
    n = len(tan_el)
    if top <= 0.0:
        s = below(tan_el, top / leave)
        return 0, s, s, s, leave, top, top
    if bottom >= 0.0:
        s = below(tan_el, bottom / leave)
        return s, s, s, n, leave, bottom, bottom
    return 0, below(tan_el, bottom / leave), below(tan_el, top / leave), n, leave, bottom, top


@njit(cache=True, inline="always")
def paint(ranges, hits, r, d, limit, code):
    """Keep the nearer of two surfaces; the lower code where they touch, so that no order matters."""
    if d <= limit and (d < ranges[r] or (d == ranges[r] and code < hits[r])):
        ranges[r] = d
        hits[r] = code


@njit(cache=True)
def wall_columns(ax, ay, bx, by, ka, kb, n):
    """Columns of the wall from a to b (as seen from the sensor) whose ends have column bounds ka and kb."""
    if ax * by - ay * bx < 0.0:
        ax, ay, bx, by, ka, kb = bx, by, ax, ay, kb, ka
    if ay >= 0.0 and by < 0.0:      # counter-clockwise across the rear
        return ka, n, 0, kb
    return ka, max(ka, kb), 0, 0


@njit(cache=True)
def column_bound(x, y, first, step, n, cos_half, narrow):
    """First column at or counter-clockwise of a place, in [0, n]."""
    if narrow and (x <= 0.0 or x * x < cos_half * (x * x + y * y)):
        return 0 if y < 0.0 else n      # outside the field of view: no need to know the angle
    return min(n, max(0, int(np.ceil((np.arctan2(y, x) - first) / step))))


@njit(cache=True)
def level(ranges, hits, city, k, z, x0, y0, cos, sin, beams, first, step, inside, limit, flips):
    """Paint the roof or underside of one building: the places of its level where a wall has been crossed oddly often."""
    n, m = ranges.shape
    flips[:] = 0
    for e in range(city.ptr[k], city.ptr[k + 1]):
        dx, dy = city.ax_m[e] - x0, city.ay_m[e] - y0
        ax, ay = cos * dx + sin * dy, cos * dy - sin * dx
        dx, dy = city.bx_m[e] - x0, city.by_m[e] - y0
        bx, by = cos * dx + sin * dy, cos * dy - sin * dx
        cross = ax * by - ay * bx
        if cross == 0.0:
            continue
        ka = column_bound(ax, ay, first, step, n, 0.0, False)
        kb = column_bound(bx, by, first, step, n, 0.0, False)
        p0, p1, q0, q1 = wall_columns(ax, ay, bx, by, ka, kb, n)
        u, v = (by - ay) / cross, (ax - bx) / cross
        for half in range(2):
            for c in range(p0 if half == 0 else q0, p1 if half == 0 else q1):
                w = u * beams.cos_az[c] + v * beams.sin_az[c]
                flips[c, below(beams.tan_el, z * w)] ^= 1
    for c in range(n):
        odd = inside
        if z < 0.0:     # the higher the beam, the farther the place on the level
            for r in range(m):
                odd ^= flips[c, r]
                if beams.tan_el[r] >= 0.0:
                    break
                if odd:
                    paint(ranges[c], hits[c], r, np.float32(z / beams.sin_el[r]), limit, BUILDING)
        else:
            for r in range(m - 1, -1, -1):
                odd ^= flips[c, r + 1]
                if beams.tan_el[r] <= 0.0:
                    break
                if odd:
                    paint(ranges[c], hits[c], r, np.float32(z / beams.sin_el[r]), limit, BUILDING)


@njit(cache=True)
def contains(city, k, x, y):
    """Whether a place lies in a footprint: the parity of walls crossed to the east."""
    odd = 0
    for e in range(city.ptr[k], city.ptr[k + 1]):
        ay, by = city.ay_m[e] - y, city.by_m[e] - y
        if (ay > 0.0) != (by > 0.0):
            ax, bx = city.ax_m[e] - x, city.bx_m[e] - x
            if (ax * by - bx * ay) / (by - ay) > 0.0:
                odd ^= 1
    return odd


@njit(cache=True)
def city_walls(x0, y0, z0, ground, cos, sin, city, beams, limit, nearest, open_wall, flat):
    """Nearest closing wall per column (as 1 / distance), and lists of the walls and levels to be painted over it.

    Returns
    -------
    How many walls and levels were listed.
    """
    n = len(nearest)
    first, step = beams.azimuth_rad[0], beams.fov_rad / n
    narrow = beams.fov_rad < np.pi
    cos_half = np.cos(min(0.5 * beams.fov_rad + 1e-6, 0.5 * np.pi)) ** 2
    tan_top = beams.tan_el[-1]
    n_open = n_flat = 0
    qx0 = int(np.floor((x0 - limit - city.grid_xy_m[0]) / GRID_CELL_M))
    qx1 = int(np.floor((x0 + limit - city.grid_xy_m[0]) / GRID_CELL_M))
    qy0 = int(np.floor((y0 - limit - city.grid_xy_m[1]) / GRID_CELL_M))
    qy1 = int(np.floor((y0 + limit - city.grid_xy_m[1]) / GRID_CELL_M))
    qx0, qy0 = max(qx0, 0), max(qy0, 0)
    qx1, qy1 = min(qx1, city.grid_shape[0] - 1), min(qy1, city.grid_shape[1] - 1)
    for cy in range(qy0, qy1 + 1):
        for cx in range(qx0, qx1 + 1):
            cell = cy * city.grid_shape[0] + cx
            for item in range(city.grid_ptr[cell], city.grid_ptr[cell + 1]):
                k = city.grid_item[item]
                bounds = city.bounds_m[k]
                # A building touches several cells; it is met in the first of them that is looked at.
                if cx != max(qx0, int(np.floor((bounds[0] - city.grid_xy_m[0]) / GRID_CELL_M))):
                    continue
                if cy != max(qy0, int(np.floor((bounds[1] - city.grid_xy_m[1]) / GRID_CELL_M))):
                    continue
                dx = max(bounds[0] - x0, 0.0, x0 - bounds[2])
                dy = max(bounds[1] - y0, 0.0, y0 - bounds[3])
                if dx * dx + dy * dy > limit * limit:
                    continue
                inside = dx == 0.0 and dy == 0.0 and contains(city, k, x0, y0) == 1
                bottom, top = city.base_m[k] - z0, city.top_m[k] - z0
                if top < ground - z0:
                    continue
                within = inside and bottom < 0.0 and top > 0.0
                if top < 0.0 or bottom > 0.0 or within:
                    flat[n_flat, 0], flat[n_flat, 1] = k, 1 if inside else 0
                    n_flat += 1
                # A wall nearer than 1 / closing hides everything that it crosses the line of sight to.
                closing = np.inf
                if bottom <= ground - z0 and top > 0.0:
                    closing = max(tan_top, 0.0) / top
                for e in range(city.ptr[k], city.ptr[k + 1]):
                    dx, dy = city.ax_m[e] - x0, city.ay_m[e] - y0
                    ex, ey = city.bx_m[e] - x0, city.by_m[e] - y0
                    cross = dx * ey - dy * ex
                    if cross == 0.0 or (cross > 0.0 and not within):
                        continue    # the back of a wall is only seen from within
                    ax, ay = cos * dx + sin * dy, cos * dy - sin * dx
                    bx, by = cos * ex + sin * ey, cos * ey - sin * ex
                    ka = column_bound(ax, ay, first, step, n, cos_half, narrow)
                    kb = column_bound(bx, by, first, step, n, cos_half, narrow)
                    p0, p1, q0, q1 = wall_columns(ax, ay, bx, by, ka, kb, n)
                    cross = ax * by - ay * bx
                    u, v = (by - ay) / cross, (ax - bx) / cross
                    listed = False
                    for half in range(2):
                        c0, c1 = (p0, p1) if half == 0 else (q0, q1)
                        if c1 <= c0:
                            continue
                        ends = min(
                            u * beams.cos_az[c0] + v * beams.sin_az[c0], u * beams.cos_az[c1 - 1] + v * beams.sin_az[c1 - 1]
                        )
                        if ends >= closing:
                            for c in range(c0, c1):
                                nearest[c] = max(nearest[c], u * beams.cos_az[c] + v * beams.sin_az[c])
                            continue
                        for c in range(c0, c1):
                            w = u * beams.cos_az[c] + v * beams.sin_az[c]
                            nearest[c] = max(nearest[c], w if w >= closing else 0.0)
                            listed |= w < closing and w > nearest[c]
                    if listed:
                        open_wall[n_open, 0], open_wall[n_open, 1] = u, v
                        open_wall[n_open, 2], open_wall[n_open, 3] = max(bottom, ground - z0), top
                        open_wall[n_open, 4], open_wall[n_open, 5] = p0, p1
                        open_wall[n_open, 6], open_wall[n_open, 7] = q0, q1
                        open_wall[n_open, 8] = closing
                        n_open += 1
    return n_open, n_flat


@njit(cache=True)
def city_size(x0, y0, city, limit):
    """How many walls and buildings the sensor may meet at most."""
    walls = buildings = 0
    gx, gy = city.grid_xy_m
    for cy in range(max(0, int((y0 - limit - gy) // GRID_CELL_M)), min(city.grid_shape[1], int((y0 + limit - gy) // GRID_CELL_M) + 1)):
        for cx in range(max(0, int((x0 - limit - gx) // GRID_CELL_M)), min(city.grid_shape[0], int((x0 + limit - gx) // GRID_CELL_M) + 1)):
            cell = cy * city.grid_shape[0] + cx
            for item in range(city.grid_ptr[cell], city.grid_ptr[cell + 1]):
                k = city.grid_item[item]
                walls += city.ptr[k + 1] - city.ptr[k]
                buildings += 1
    return walls, buildings


@njit(cache=True)
def one_sweep(ranges, hits, x0, y0, z0, yaw, ground, own, beams, limit, xyz, reach, near_row, bodies, city):
    """One observer's range image."""
    n, m = ranges.shape
    tan_el = beams.tan_el
    cos, sin = np.cos(yaw), np.sin(yaw)
    first, step = beams.azimuth_rad[0], beams.fov_rad / n

    nearest = np.full(n, 1.0 / limit)
    walls, buildings = city_size(x0, y0, city, limit)
    open_wall, flat = np.empty((walls, 9)), np.empty((buildings, 2), np.int64)
    n_open, n_flat = city_walls(x0, y0, z0, ground, cos, sin, city, beams, limit, nearest, open_wall, flat)

    inv_cos = 1.0 / beams.cos_el
    road = np.full(m, np.inf, np.float32)
    for r in range(m):
        if (ground - z0) * tan_el[r] > 0.0:
            d = np.float32((ground - z0) / beams.sin_el[r])
            if d <= limit:
                road[r] = d
    for c in range(n):
        w = nearest[c]
        stands = w > 1.0 / limit
        foot = below(tan_el, (ground - z0) * w) if stands else m
        for r in range(foot):
            ranges[c, r] = road[r]
            hits[c, r] = GROUND if road[r] < np.inf else 0
        for r in range(foot, m):
            d = np.float32(inv_cos[r] / w)
            ranges[c, r] = d if d <= limit else np.inf
            hits[c, r] = BUILDING if d <= limit else 0

    for i in range(n_open):
        u, v, bottom, top = open_wall[i, 0], open_wall[i, 1], open_wall[i, 2], open_wall[i, 3]
        for half in range(2):
            for c in range(int(open_wall[i, 4 + 2 * half]), int(open_wall[i, 5 + 2 * half])):
                w = u * beams.cos_az[c] + v * beams.sin_az[c]
                if w <= nearest[c] or w >= open_wall[i, 8]:
                    continue
                for r in range(below(tan_el, bottom * w), below(tan_el, top * w)):
                    paint(ranges[c], hits[c], r, np.float32(inv_cos[r] / w), limit, BUILDING)
    if n_flat > 0:
        flips = np.empty((n, m + 1), np.uint8)
        for i in range(n_flat):
            k, inside = flat[i, 0], flat[i, 1]
            bottom, top = city.base_m[k] - z0, city.top_m[k] - z0
            if top < 0.0 or (inside and bottom < 0.0):
                level(ranges, hits, city, k, top, x0, y0, cos, sin, beams, first, step, inside, limit, flips)
            if bottom > 0.0 or (inside and top > 0.0):
                level(ranges, hits, city, k, bottom, x0, y0, cos, sin, beams, first, step, inside, limit, flips)

    for a in near_row:
        if a == own:
            continue
        dx, dy = xyz[a, 0] - x0, xyz[a, 1] - y0
        distance = np.hypot(dx, dy)
        half = np.arcsin(reach[a] / distance) if distance > reach[a] else np.pi
        a0, a1, b0, b1 = spans(np.arctan2(cos * dy - sin * dx, cos * dx + sin * dy), half, first, step, n)
        if a1 <= a0 and b1 <= b0:
            continue
        for k in range(bodies.ptr[a], bodies.ptr[a + 1]):
            bottom, top = bodies.bottom_m[k] - z0, bodies.top_m[k] - z0
            # the sensor and its axes in the prism's frame
            dx, dy = x0 - bodies.x_m[k], y0 - bodies.y_m[k]
            p = bodies.cos[k] * dx + bodies.sin[k] * dy
            q = bodies.cos[k] * dy - bodies.sin[k] * dx
            turn_cos = cos * bodies.cos[k] + sin * bodies.sin[k]
            turn_sin = sin * bodies.cos[k] - cos * bodies.sin[k]
            for half_turn in range(2):
                for c in range(a0 if half_turn == 0 else b0, a1 if half_turn == 0 else b1):
                    if (distance - reach[a]) * nearest[c] >= 1.0:
                        continue
                    ca, sa = beams.cos_az[c], beams.sin_az[c]
                    enter, leave = rectangle(
                        p, q, turn_cos * ca - turn_sin * sa, turn_sin * ca + turn_cos * sa,
                        bodies.half_l_m[k], bodies.half_w_m[k],
                    )  # fmt: skip
                    if leave <= max(enter, 0.0) or enter * nearest[c] >= 1.0:
                        continue
                    lo, s0, s1, hi, t, low, high = profile(enter, leave, bottom, top, tan_el)
                    for r in range(lo, s0):
                        paint(ranges[c], hits[c], r, np.float32(low / beams.sin_el[r]), limit, ACTOR + a)
                    for r in range(s0, s1):
                        paint(ranges[c], hits[c], r, np.float32(t * inv_cos[r]), limit, ACTOR + a)
                    for r in range(s1, hi):
                        paint(ranges[c], hits[c], r, np.float32(high / beams.sin_el[r]), limit, ACTOR + a)


@njit(cache=True, parallel=True)
def _cast(range_m, hit, origin, yaw, ground, own, beams, limit, xyz, reach, ptr, row, bodies, city):
    for o in prange(len(origin)):
        one_sweep(
            range_m[o], hit[o], origin[o, 0], origin[o, 1], origin[o, 2], yaw[o], ground[o], own[o], beams, limit,
            xyz, reach, row[ptr[o] : ptr[o + 1]], bodies, city,
        )  # fmt: skip
