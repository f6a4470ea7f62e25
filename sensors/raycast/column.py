"""Geometry of one azimuth column: a vertical plane in which beams are lines and prisms are rectangles."""

from __future__ import annotations

import numpy as np
from numba import njit

from sensors.kernel import kernel


@njit(cache=True, inline="always")
def below(tan_el, slope):
    """How many beams are lower than a slope: the first row at or above it."""
    count = 0
    for r in range(len(tan_el)):
        count += tan_el[r] < slope
    return count


@kernel
def spans(angle, half, beams):
    """Columns within `half` of an azimuth, as two index ranges (the second one for arcs across the rear)."""
    n = len(beams.azimuth_rad)
    if half >= np.pi:
        return 0, n, 0, 0
    step = beams.fov_rad / n
    low, high = (angle - half - beams.azimuth_rad[0]) / step, (angle + half - beams.azimuth_rad[0]) / step
    turn = 2.0 * np.pi / step if angle < 0.0 else -2.0 * np.pi / step
    a0, a1 = max(0, int(np.ceil(low))), min(n, int(np.floor(high)) + 1)
    b0, b1 = max(0, int(np.ceil(low + turn))), min(n, int(np.floor(high + turn)) + 1)
    return a0, max(a0, a1), b0, max(b0, b1)


@kernel
def actor_columns(dx, dy, radius, cos, sin, beams):
    """Columns that may cross a circle of radius `radius` at (dx, dy), for a sensor looking along (cos, sin)."""
    distance = np.hypot(dx, dy)
    half = np.arcsin(radius / distance) if distance > radius else np.pi
    return spans(np.arctan2(cos * dy - sin * dx, cos * dx + sin * dy), half, beams)


@kernel
def in_prism_frame(bodies, k, x, y, cos, sin):
    """A point, and a heading (cos, sin), in the frame of prism k."""
    dx, dy = x - bodies.x_m[k], y - bodies.y_m[k]
    u, v = bodies.cos[k], bodies.sin[k]
    return u * dx + v * dy, u * dy - v * dx, cos * u + sin * v, sin * u - cos * v


@kernel
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


@kernel
def profile(enter, leave, bottom, top, tan_el):
    """Rows of one column that a prism covers: (a, s0, s1, b, t, low, high).

    Rows [a, s0) meet the level `low`, rows [s0, s1) the wall at distance t, rows [s1, b) the level `high`.
    Heights are relative to the sensor. From within, these are the inner faces.
    """
    if enter > 0.0:
        s0, s1 = below(tan_el, bottom / enter), below(tan_el, top / enter)
        a = below(tan_el, bottom / leave) if bottom > 0.0 else s0
        b = below(tan_el, top / leave) if top < 0.0 else s1
        return a, s0, s1, b, enter, bottom, top
    if top <= 0.0:
        s = below(tan_el, top / leave)
        return 0, s, s, s, leave, top, top
    if bottom >= 0.0:
        s = below(tan_el, bottom / leave)
        return s, s, s, len(tan_el), leave, bottom, bottom
    return 0, below(tan_el, bottom / leave), below(tan_el, top / leave), len(tan_el), leave, bottom, top


@kernel
def surface(r, s0, s1, t, low, high, beams):
    """Range of row r to the face that `profile` gives it."""
    if r < s0:
        return np.float32(low / beams.sin_el[r])
    if r < s1:
        return np.float32(t / beams.cos_el[r])
    return np.float32(high / beams.sin_el[r])
