"""Geometry of one azimuth column: a vertical plane in which beams are lines and prisms are rectangles.

These functions are called for every actor or wall and column. They take what they need of a sweep's beams and no more:
each array that is handed over costs time, and all of `Beams` more than the work.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.base.kernel import compiled, inlined, kernel

MARGIN_RAD = 1e-9
"""Rounding of a window's limits."""

CELLS_PER_BEAM = 4
"""Cells into which the slopes of the beams are cut, per beam: most hold none or one."""


class Columns(NamedTuple):
    """The azimuths of a sweep: evenly spaced, counter-clockwise."""

    n: int
    first_rad: float
    step_rad: float
    fov_rad: float


class Slopes(NamedTuple):
    """The slopes of a sweep's beams, and equal cells of slope, in which `below` finds a row."""

    tan_el: ndarray
    """float64 [e], ascending."""
    cells_per_slope: float
    first_row: ndarray
    """int64 [cells]: how many beams lie in the cells before each."""
    most_in_cell: int
    """Beams in the fullest cell."""


def cells_of_slopes(tan_el: Float[ndarray, "e"]) -> Slopes:
    """Equal cells of slope from the lowest beam to the highest.

    Parameters
    ----------
    tan_el
        Tangent of the elevation of each beam, ascending.
    """
    extent = max(tan_el[-1] - tan_el[0], 1e-9)
    per_slope = float(CELLS_PER_BEAM * len(tan_el) / extent)
    cell = ((tan_el - tan_el[0]) * per_slope).astype(np.int64)
    cells = np.arange(cell[-1] + 1)
    first_row = np.searchsorted(cell, cells).astype(np.int64)
    most_in_cell = int(np.bincount(cell).max())
    return Slopes(tan_el, per_slope, first_row, most_in_cell)


@kernel
def columns_of(beams):
    """The azimuths of `Beams`. Once per sweep: Numba hands no tuples within tuples to the threads of a loop."""
    n = len(beams.azimuth_rad)
    return Columns(n, beams.azimuth_rad[0], beams.fov_rad / n, beams.fov_rad)


@compiled
def slopes_of(beams):
    """The slopes of `Beams`, once per sweep."""
    return Slopes(beams.tan_el, beams.cells_per_slope, beams.first_row, beams.most_in_cell)


@kernel
def below(slopes, slope):
    """How many beams are lower than a slope: the first row at or above it."""
    tan_el = slopes.tan_el
    lowest, m = tan_el[0], len(tan_el)
    if not slope > lowest:
        return 0
    if slope > tan_el[m - 1]:
        return m
    # A slope's cell grows with it, also when rounded: beams of cells before are lower, those of cells behind are not.
    row = slopes.first_row[np.uint64((slope - lowest) * slopes.cells_per_slope)]
    for _ in range(slopes.most_in_cell):
        row += tan_el[np.uint64(row)] < slope
    return row


@kernel
def spans(angle, half, columns):
    """Columns within `half` of an azimuth, as two index ranges (the second one for arcs across the rear)."""
    n, first, step = columns.n, columns.first_rad, columns.step_rad
    if half >= np.pi:
        return 0, n, 0, 0
    low = (angle - half - first) / step
    high = (angle + half - first) / step
    turn = -2.0 * np.pi / step
    if angle < 0.0:
        turn = 2.0 * np.pi / step
    a0 = max(0, int(np.ceil(low)))
    a1 = min(n, int(np.floor(high)) + 1)
    b0 = max(0, int(np.ceil(low + turn)))
    b1 = min(n, int(np.floor(high + turn)) + 1)
    return a0, max(a0, a1), b0, max(b0, b1)


@kernel
def actor_columns(dx, dy, radius, cos, sin, columns):
    """Columns that may cross a circle of radius `radius` at (dx, dy), for a sensor looking along (cos, sin)."""
    distance = np.hypot(dx, dy)
    half = np.arcsin(radius / distance) if distance > radius else np.pi
    ahead = cos * dx + sin * dy
    left = cos * dy - sin * dx
    return spans(np.arctan2(left, ahead), half, columns)


@kernel
def rectangle_columns(x, y, cos, sin, half_l, half_w, columns):
    """Columns that may cross a rectangle at (x, y) of heading (cos, sin), all in the frame of the sensor.

    Seen along its centre, no corner lies farther aside, and none nearer, than half the extents of the rectangle in
    these directions.
    """
    along = abs(cos * x + sin * y)
    across = abs(cos * y - sin * x)
    aside = half_l * across + half_w * along
    near = x * x + y * y - half_l * along - half_w * across
    half = np.arctan(aside / near) + MARGIN_RAD if near > 0.0 else np.pi
    return spans(np.arctan2(y, x), half, columns)


@kernel
def in_prism_frame(bodies, k, x, y, cos, sin):
    """A point, and a heading (cos, sin), in the frame of prism k."""
    dx = x - bodies.x_m[k]
    dy = y - bodies.y_m[k]
    u, v = bodies.cos[k], bodies.sin[k]
    p = u * dx + v * dy
    q = u * dy - v * dx
    along = cos * u + sin * v
    across = sin * u - cos * v
    return p, q, along, across


@kernel
def rectangle(p, q, u, v, half_l, half_w):
    """Where a ray from (p, q) along (u, v) enters and leaves a centred rectangle; enter > leave if it misses."""
    enter, leave = -np.inf, np.inf
    if u != 0.0:
        s = (-half_l - p) / u
        t = (half_l - p) / u
        enter, leave = min(s, t), max(s, t)
    elif abs(p) > half_l:
        enter = np.inf
    if v != 0.0:
        s = (-half_w - q) / v
        t = (half_w - q) / v
        enter = max(enter, min(s, t))
        leave = min(leave, max(s, t))
    elif abs(q) > half_w:
        enter = np.inf
    return enter, leave


@inlined
def profile(enter, leave, bottom, top, slopes):
    """Rows of one column that a prism covers: (a, s0, s1, b, t, low, high).

    Rows [a, s0) meet the level `low`, rows [s0, s1) the wall at distance t, rows [s1, b) the level `high`.
    Heights are relative to the sensor. From within, these are the inner faces.
    """
    if enter > 0.0:
        s0 = below(slopes, bottom / enter)
        s1 = below(slopes, top / enter)
        a = below(slopes, bottom / leave) if bottom > 0.0 else s0
        b = below(slopes, top / leave) if top < 0.0 else s1
        return a, s0, s1, b, enter, bottom, top
    if top <= 0.0:
        s = below(slopes, top / leave)
        return 0, s, s, s, leave, top, top
    if bottom >= 0.0:
        s = below(slopes, bottom / leave)
        return s, s, s, len(slopes.tan_el), leave, bottom, bottom
    s0 = below(slopes, bottom / leave)
    s1 = below(slopes, top / leave)
    return 0, s0, s1, len(slopes.tan_el), leave, bottom, top


@kernel
def surface(r, s0, s1, t, low, high, cos_el, sin_el):
    """Range of row r to the face that `profile` gives it."""
    if r < s0:
        return np.float32(low / sin_el[r])
    if r < s1:
        return np.float32(t / cos_el[r])
    return np.float32(high / sin_el[r])
