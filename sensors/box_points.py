"""How many returns of a sweep lie in a box: single-precision bounds first, the exact test where they do not decide.

A ray crosses an upright box where its horizontal length lies in an interval (one per column of azimuth) and its height
in another (one per box). Both are widened and narrowed by more than single precision can err. A column with a return
between the two is tested in double precision, so that the counts are those of the exact test of every return.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from sensors.kernel import dividing, inlined, kernel, parallel
from sensors.pairs import in_sensor_frame
from sensors.range_steps import NO_RETURN
from sensors.raycast.column import below, columns_of, rectangle_columns, slopes_of

_GRAZING = 1e-7
"""Sine of the angle between a column and a side of the box below which their crossing is not computed."""

_NO_RETURN = np.uint16(NO_RETURN)


@inlined
def in_box(x, y, z, cx, cy, cz, cos, sin, half_l, half_w, half_h):
    """Whether a point lies strictly inside an upright box."""
    dx, dy, dz = x - cx, y - cy, z - cz
    return (abs(cos * dx + sin * dy) < half_l) & (abs(cos * dy - sin * dx) < half_w) & (abs(dz) < half_h)


@dividing
def _crossings(cos_az, sin_az, p, q, cos, sin, half_l, half_w, middle, half):
    """The horizontal lengths between which columns are in a box: the middle of the interval, and half its length, which
    is negative where a column misses the box. Both nan where one runs along a side of it.

    (p, q) is the sensor in the frame of the box, whose heading is (cos, sin) in the frame of the sensor.
    """
    for i in range(len(cos_az)):
        ca, sa = cos_az[i], sin_az[i]
        u, v = cos * ca + sin * sa, cos * sa - sin * ca
        along, across = 1.0 / u, 1.0 / v
        s, t = (-half_l - p) * along, (half_l - p) * along
        enter, leave = min(s, t), max(s, t)
        s, t = (-half_w - q) * across, (half_w - q) * across
        enter, leave = max(enter, min(s, t), -1.0), min(leave, max(s, t))  # long intervals behind would cost precision
        grazing = min(abs(u), abs(v)) < _GRAZING
        middle[i] = np.nan if grazing else 0.5 * (enter + leave)
        half[i] = np.nan if grazing else 0.5 * (leave - enter)


@inlined
def _near_box(steps, cos_el, sin_el, middle, half, height, half_h, error):
    """Of the ranges of some rows of a column: how many end in a box, and how many may.

    `cos_el` and `sin_el` are lengths per step. A ray ends in the box where its horizontal length is within `half` of
    `middle` and its height within `half_h` of `height`, all float32. It is counted where it does so by `error`; it may
    do so where it would with `error` to spare.
    """
    count = possible = np.int32(0)
    for k in range(len(steps)):
        far = np.float32(steps[k])
        beside, above = abs(far * cos_el[k] - middle) - half, abs(far * sin_el[k] - height) - half_h
        count += np.int32((beside < -error) & (above < -error))
        possible += np.int32((beside < error) & (above < error))
    return count, possible


@kernel
def _count(steps, step_m, beams, cos_el, sin_el, a0, a1, r0, r1, box, scratch):
    """Returns in columns a0 to a1 and rows r0 to r1 that lie inside a box."""
    x, y, z, cos, sin, half_l, half_w, half_h = box
    middle, half = scratch
    error = 2e-5 + 2e-6 * (abs(x) + abs(y) + abs(z) + half_l + half_w + half_h)
    p, q = -(cos * x + sin * y), -(cos * y - sin * x)
    _crossings(beams.cos_az[a0:a1], beams.sin_az[a0:a1], p, q, cos, sin, half_l, half_w, middle, half)
    beyond = np.hypot(np.hypot(x, y) + np.hypot(half_l, half_w), abs(z) + half_h) + error >= NO_RETURN * step_m
    height, half_height, margin, total = np.float32(z), np.float32(half_h), np.float32(error), 0
    cos_rows, sin_rows = cos_el[r0:r1], sin_el[r0:r1]
    for i in range(a1 - a0):
        column = a0 + i
        if half[i] < -margin:
            continue
        count, possible = _near_box(
            steps[column, r0:r1], cos_rows, sin_rows, middle[i], half[i], height, half_height, margin
        )
        if count == possible and not (beyond or np.isnan(half[i])):
            total += count
        else:  # no return is not told from a range, the column runs along a side, or single precision does not decide
            for r in range(r0, r1):
                total += _is_inside(steps, step_m, beams, column, r, box)
    return total


@inlined
def _is_inside(steps, step_m, beams, c, r, box):
    """Whether this ray returned from within a box."""
    x, y, z, cos, sin, half_l, half_w, half_h = box
    d = steps[c, r] * step_m
    away, up = d * beams.cos_el[r], d * beams.sin_el[r]
    inside = in_box(away * beams.cos_az[c], away * beams.sin_az[c], up, x, y, z, cos, sin, half_l, half_w, half_h)
    return inside & (steps[c, r] != _NO_RETURN)


def points_in_boxes(range_steps, step_m, beams, pairs, run, n_chunks):
    """Returns of the pair's sweep strictly inside its box, of every pair; `run` as `Pairs.runs`, which threads share
    in `n_chunks`.

    `range_steps` and `step_m` as `sensors.lidar.RangeImages`; a step is a power of two, so that single precision holds
    every range, and lengths per step are exactly as precise as lengths per metre.
    """
    # In a parallel kernel every expression of arrays would be compiled as a loop over threads.
    cos_el, sin_el = (step_m * beams.cos_el).astype(np.float32), (step_m * beams.sin_el).astype(np.float32)
    out = np.zeros(len(pairs.o), np.int32)
    edge = math.cos(0.5 * beams.fov_rad), math.sin(0.5 * beams.fov_rad)
    _add_points(out, range_steps, step_m, beams, cos_el, sin_el, edge, pairs, run, n_chunks)
    return out


@parallel
def _add_points(out, range_steps, step_m, beams, cos_el, sin_el, edge, pairs, run, n_chunks):
    """As `points_in_boxes`; `edge` is the cosine and sine of half the field of view."""
    n, m = range_steps.shape[1], len(cos_el)
    for chunk in prange(n_chunks):
        columns, slopes = columns_of(beams), slopes_of(beams)
        scratch = np.empty(n, np.float32), np.empty(n, np.float32)
        for i in range(np.int64(chunk), len(run) - 1, n_chunks):  # neighbours in a city have as many boxes to look at
            steps = range_steps[pairs.o[run[i]]]
            for k in range(run[i], run[i + 1]):
                x, y, z, length, width, height, yaw = in_sensor_frame(pairs, k)
                half_l, half_w, half_h = 0.5 * length, 0.5 * width, 0.5 * height
                radius, distance = np.sqrt(half_l * half_l + half_w * half_w), np.sqrt(x * x + y * y)
                close = distance - radius
                if abs(y) * edge[0] - x * edge[1] > radius:
                    continue  # beside the field of view
                cos, sin = np.cos(yaw), np.sin(yaw)
                a0, a1, b0, b1 = rectangle_columns(x, y, cos, sin, half_l, half_w, columns)
                r0, r1 = 0, m
                if close > 1e-6:
                    low, high = z - half_h, z + half_h
                    r0 = max(0, below(slopes, low / (close if low < 0.0 else distance + radius)) - 1)
                    r1 = min(m, below(slopes, high / (close if high > 0.0 else distance + radius)) + 1)
                box = x, y, z, cos, sin, half_l, half_w, half_h
                for turn in range(2):
                    c0, c1 = (a0, a1) if turn == 0 else (b0, b1)
                    if c1 > c0:
                        out[k] += _count(steps, step_m, beams, cos_el, sin_el, c0, c1, r0, r1, box, scratch)
