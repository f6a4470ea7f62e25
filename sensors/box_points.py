"""How many returns of a sweep lie in a box: single-precision bounds first, the exact test where they do not decide.

A ray crosses an upright box where its horizontal length lies in an interval (one per column of azimuth) and its height
in another (one per box). Both are widened and narrowed by more than single precision can err; returns between the two
are tested in double precision, so that the counts are those of the exact test of every return. Tiles of the range image
whose returns are all nearer than the box, or all farther, are not looked at.
"""

from __future__ import annotations

import math

import numpy as np

from cosim.base.kernel import compiled, dividing, inlined, kernel
from cosim.base.threads import in_ranges
from sensors.lanes import LANES, TILE, near_box, nearest_and_farthest
from sensors.pairs import in_sensor_frame
from sensors.range_steps import NO_RETURN
from sensors.raycast.column import below, columns_of, rectangle_columns, slopes_of

_GRAZING = 1e-7
"""Sine of the angle between a column and a side of the box below which their crossing is not computed."""

_FEW = 16
"""Boxes of one sweep for which it does not pay to look at the whole sweep first."""

_NO_RETURN = np.uint16(NO_RETURN)

_REACH_M = 0.01
"""How far behind the farthest return of a sweep boxes are looked at: more than lengths are rounded by."""


@inlined
def in_box(x, y, z, cx, cy, cz, cos, sin, half_l, half_w, half_h):
    """Whether a point lies strictly inside an upright box."""
    dx, dy = x - cx, y - cy
    along = cos * dx + sin * dy
    across = cos * dy - sin * dx
    is_within = (abs(along) < half_l) & (abs(across) < half_w)
    return is_within & (abs(z - cz) < half_h)


@dividing
def _crossings(cos_az, sin_az, p, q, cos, sin, half_l, half_w, middle, half):
    """The horizontal lengths between which each column of a sweep lies in a box.

    (p, q) is the sensor in the frame of the box, whose heading is (cos, sin) in the frame of the sensor. `middle` and
    `half` are written: the middle of the interval and half its length, which is negative where a column misses the box.
    Both are NaN where a column runs along a side of the box.

    Returns
    -------
    Number of columns that run along a side.
    """
    n = 0
    for i in range(len(cos_az)):
        ca, sa = cos_az[i], sin_az[i]
        u = cos * ca + sin * sa
        v = cos * sa - sin * ca
        along, across = 1.0 / u, 1.0 / v
        s = (-half_l - p) * along
        t = (half_l - p) * along
        enter, leave = min(s, t), max(s, t)
        s = (-half_w - q) * across
        t = (half_w - q) * across
        enter = max(enter, min(s, t), -1.0)  # long intervals behind would cost precision
        leave = min(leave, max(s, t))
        grazing = min(abs(u), abs(v)) < _GRAZING
        n += grazing
        middle[i] = np.nan if grazing else 0.5 * (enter + leave)
        half[i] = np.nan if grazing else 0.5 * (leave - enter)
    return n


@kernel
def _bounds(steps, flat, nearest, farthest):
    """Horizontal lengths between which the returns of a sweep lie, by tile; the most steps of all.

    `flat` are the least and largest horizontal length of a step in each block of rows. The last block and the last tile
    begin earlier where they are not whole.
    """
    n, m = steps.shape
    most = 0
    for t in range(nearest.shape[1]):
        column = np.uint64(min(TILE * t, n - TILE))
        for b in range(len(flat)):
            row = np.uint64(min(LANES * b, m - LANES))
            least, largest = nearest_and_farthest(steps, column, row)
            nearest[b, t] = least * flat[b, 0]
            farthest[b, t] = largest * flat[b, 1]
            most = max(most, largest)
    return most


@kernel
def _count(steps, step_m, beams, cos_el, sin_el, a0, a1, r0, r1, box, bounds, scratch):
    """Returns in columns a0 to a1 and rows r0 to r1 that lie inside a box."""
    m = steps.shape[1]
    x, y, z, cos, sin, half_l, half_w, half_h = box
    nearest, farthest = bounds
    middle, half = scratch
    lengths = abs(x) + abs(y) + abs(z) + half_l + half_w + half_h
    error = 2e-5 + 2e-6 * lengths
    b0 = r0 // LANES
    b1 = (r1 + LANES - 1) // LANES
    t0 = a0 // TILE
    t1 = (a1 + TILE - 1) // TILE
    radius = np.sqrt(half_l * half_l + half_w * half_w)
    distance = np.sqrt(x * x + y * y)
    least = np.float32(distance - radius - 3.0 * error)
    most = np.float32(distance + radius + 3.0 * error)
    p = -(cos * x + sin * y)
    q = -(cos * y - sin * x)
    b1 = min(b1, m // LANES)  # whole blocks
    if distance + radius + abs(z) + half_h + error >= NO_RETURN * step_m:
        b1 = b0  # no return is not told from a range there
    n_grazing = -1  # until a tile needs to know
    height, half_height = np.float32(z), np.float32(half_h)
    margin = np.float32(error)
    total = 0
    for b in range(np.uint64(b0), np.uint64(b1)):
        row = b * np.uint64(LANES)
        for t in range(np.uint64(t0), np.uint64(t1)):
            if farthest[b, t] >= least and nearest[b, t] <= most:
                if n_grazing < 0:
                    ca = beams.cos_az[a0:a1]
                    sa = beams.sin_az[a0:a1]
                    n_grazing = _crossings(ca, sa, p, q, cos, sin, half_l, half_w, middle, half)
                first = t * np.uint64(TILE)
                end = first + np.uint64(TILE)
                for c in range(max(first, np.uint64(a0)), min(end, np.uint64(a1))):
                    i = c - np.uint64(a0)
                    limits = middle[i], half[i], height, half_height, margin
                    count, undecided = near_box(steps, c, row, cos_el, sin_el, limits)
                    total += count
                    for k in range(LANES if undecided else 0):
                        if undecided >> k & 1:
                            total += _is_inside(steps, step_m, beams, c, row + np.uint64(k), box)
    rest = max(r0, b1 * LANES)
    if n_grazing > 0 or rest < r1:
        for column in range(a0, a1):
            is_grazing = n_grazing > 0 and np.isnan(half[column - a0])
            for r in range(r0 if is_grazing else rest, r1):
                total += _is_inside(steps, step_m, beams, column, r, box)
    return total


@inlined
def _is_inside(steps, step_m, beams, c, r, box):
    """Whether this ray returned from within a box."""
    x, y, z, cos, sin, half_l, half_w, half_h = box
    d = steps[c, r] * step_m
    away = d * beams.cos_el[r]
    ahead = away * beams.cos_az[c]
    left = away * beams.sin_az[c]
    up = d * beams.sin_el[r]
    is_inside = in_box(ahead, left, up, x, y, z, cos, sin, half_l, half_w, half_h)
    return is_inside & (steps[c, r] != _NO_RETURN)


@kernel
def _unbounded(nearest, farthest):
    """Bounds where a sweep is not looked at as a whole."""
    for b in range(nearest.shape[0]):
        for t in range(nearest.shape[1]):
            nearest[b, t], farthest[b, t] = 0.0, np.inf


def points_in_boxes(range_steps, step_m, beams, pairs, run):
    """Number of returns of the pair's sweep strictly inside its box, for each pair.

    `run` is `Pairs.runs`; its runs are divided among threads. `range_steps` and `step_m` are those of
    `sensors.lidar.RangeImages`. A step is a power of two: single precision holds every range, and lengths per step are
    exactly as precise as lengths per metre.
    """
    cos_el = (step_m * beams.cos_el).astype(np.float32)
    sin_el = (step_m * beams.sin_el).astype(np.float32)
    m = len(cos_el)
    flat = []
    for end in range(LANES, m + LANES, LANES):
        begin = max(0, min(end, m) - LANES)
        block = cos_el[begin:end]
        flat.append((block.min(), block.max()))
    half_fov_rad = 0.5 * beams.fov_rad
    edge = math.cos(half_fov_rad), math.sin(half_fov_rad)
    bounds = np.array(flat, np.float32)
    given = range_steps, step_m, beams, cos_el, sin_el, bounds, edge, pairs, run
    out = np.zeros(len(pairs.o), np.int32)

    def add(begin: int, end: int) -> None:
        _add_points(out, begin, end, given)

    in_ranges(add, len(run) - 1)
    return out


@compiled
def _add_points(out, begin, end, given):
    """As `points_in_boxes`, added to `out`, for the runs `begin` to `end`.

    `flat` is the least and largest length per step of each block of rows, `edge` the cosine and sine of half the field
    of view.
    """
    range_steps, step_m, beams, cos_el, sin_el, flat, edge, pairs, run = given
    n, m = range_steps.shape[1], len(cos_el)
    columns, slopes = columns_of(beams), slopes_of(beams)
    n_tiles = (n + TILE - 1) // TILE
    lengths = np.empty((2, len(flat), n_tiles), np.float32)
    bounds = lengths[0], lengths[1]
    scratch = np.empty(n, np.float32), np.empty(n, np.float32)
    for i in range(begin, end):
        steps = range_steps[pairs.o[run[i]]]
        n_boxes = run[i + 1] - run[i]
        if n_boxes > _FEW and n >= TILE and m >= LANES:
            farthest = _bounds(steps, flat, bounds[0], bounds[1]) * step_m + _REACH_M
        else:
            _unbounded(bounds[0], bounds[1])
            farthest = np.inf
        for k in range(run[i], run[i + 1]):
            x, y, z, length, width, height, yaw = in_sensor_frame(pairs, k)
            half_l, half_w, half_h = 0.5 * length, 0.5 * width, 0.5 * height
            radius = np.sqrt(half_l * half_l + half_w * half_w)
            distance = np.sqrt(x * x + y * y)
            close, far = distance - radius, distance + radius
            aside = abs(y) * edge[0] - x * edge[1]
            if aside > radius or close > farthest:
                continue  # beside the field of view, or behind all returns
            cos, sin = np.cos(yaw), np.sin(yaw)
            a0, a1, b0, b1 = rectangle_columns(x, y, cos, sin, half_l, half_w, columns)
            r0, r1 = 0, m
            if close > 1e-6:
                low, high = z - half_h, z + half_h
                lowest = low / (close if low < 0.0 else far)
                highest = high / (close if high > 0.0 else far)
                r0 = max(0, below(slopes, lowest) - 1)
                r1 = min(m, below(slopes, highest) + 1)
            box = x, y, z, cos, sin, half_l, half_w, half_h
            for turn in range(2):
                c0, c1 = (a0, a1) if turn == 0 else (b0, b1)
                if c1 > c0:
                    out[k] += _count(steps, step_m, beams, cos_el, sin_el, c0, c1, r0, r1, box, bounds, scratch)
