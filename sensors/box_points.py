"""How many returns of a sweep lie in a box: single-precision bounds first, the exact test where they do not decide.

A ray crosses an upright box where its horizontal length lies in an interval (one per column of azimuth) and its height
in another (one per box). Both are widened and narrowed by more than single precision can err; returns between the two
are tested in double precision, so that the counts are those of the exact test of every return. Stretches of rows whose
returns are all nearer than the box, or all farther, are not looked at.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from sensors.kernel import adding, compiled, dividing, inlined, kernel, parallel
from sensors.pairs import in_sensor_frame
from sensors.range_steps import NO_RETURN
from sensors.raycast.column import below, columns_of, rectangle_columns, slopes_of

BLOCK = 16
"""Rows that are compared at once; the rows behind the last whole block are tested one by one."""

STRETCH = 32
"""Rows whose nearest and farthest return are looked up first; whole blocks."""

_GRAZING = 1e-7
"""Sine of the angle between a column and a side of the box below which their crossing is not computed."""

_FEW = 16
"""Boxes of one sweep for which it does not pay to look at the whole sweep first."""

_NO_RETURN, _ZERO = np.uint16(NO_RETURN), np.uint16(0)

_REACH_M = 0.01
"""How far behind the farthest return of a sweep boxes are looked at: more than lengths are rounded by."""

_WIDE = 4096
"""More than the rows of a column; a sum of float32 that counts two things is exact up to 2^24."""


@inlined
def in_box(x, y, z, cx, cy, cz, cos, sin, half_l, half_w, half_h):
    """Whether a point lies strictly inside an upright box."""
    dx, dy, dz = x - cx, y - cy, z - cz
    return (abs(cos * dx + sin * dy) < half_l) & (abs(cos * dy - sin * dx) < half_w) & (abs(dz) < half_h)


@dividing
def _crossings(cos_az, sin_az, p, q, cos, sin, half_l, half_w, near, far):
    """Horizontal lengths at which columns enter and leave a box; nan where one runs along a side of it.

    (p, q) is the sensor in the frame of the box, whose heading is (cos, sin) in the frame of the sensor.
    """
    for i in range(len(cos_az)):
        ca, sa = cos_az[i], sin_az[i]
        u, v = cos * ca + sin * sa, cos * sa - sin * ca
        along, across = 1.0 / u, 1.0 / v
        s, t = (-half_l - p) * along, (half_l - p) * along
        enter, leave = min(s, t), max(s, t)
        s, t = (-half_w - q) * across, (half_w - q) * across
        near[i] = np.nan if min(abs(u), abs(v)) < _GRAZING else max(enter, min(s, t))
        far[i] = min(leave, max(s, t))


@adding
def _tally(steps, c, r0, r1, cos_el, sin_el, middle, half, height, half_h, error):
    """Returns of a column that are inside for certain, times `_WIDE`, and those that may be; rows in whole blocks.

    `cos_el` and `sin_el` are lengths per step. The box ends before `NO_RETURN` steps: it is not told from a range.
    Only whole numbers are added, so that the order of the additions does not matter.
    """
    count = np.float32(0.0)
    both, one, none = np.float32(_WIDE + 1), np.float32(1.0), np.float32(0.0)
    column = np.uint64(c)
    for row in range(np.uint64(r0), np.uint64(r1), np.uint64(BLOCK)):
        for i in range(BLOCK):
            r = row + np.uint64(i)
            d = np.float32(steps[column, r])
            outside = max(abs(d * cos_el[r] - middle) - half, abs(d * sin_el[r] - height) - half_h)
            count += both if outside < -error else (one if outside < error else none)
    return int(count)


@kernel
def _nearest_and_farthest(steps, c, r0, r1):
    """The nearest and farthest return of a column in rows r0 to r1: `NO_RETURN` and 0 if there are none."""
    nearest, farthest = _NO_RETURN, _ZERO
    column = np.uint64(c)
    for r in range(np.uint64(r0), np.uint64(r1)):
        d = steps[column, r]
        nearest, farthest = min(nearest, d), max(farthest, d if d < _NO_RETURN else _ZERO)
    return nearest, farthest


@compiled
def _bounds(steps, flat, nearest, farthest):
    """Horizontal lengths between which the returns of a sweep lie, by stretch and column; the most steps of all.

    `flat` are the least and largest horizontal length of a step in each stretch.
    """
    n, m = steps.shape
    for c in range(n):
        for b in range(m // STRETCH):
            nearest[b, c], farthest[b, c] = _nearest_and_farthest(steps, c, STRETCH * b, STRETCH * b + STRETCH)
        if m % STRETCH > 0:
            nearest[-1, c], farthest[-1, c] = _nearest_and_farthest(steps, c, m // STRETCH * STRETCH, m)
    most = np.float32(0.0)
    for b in range(len(flat)):
        for c in range(n):
            most = max(most, farthest[b, c])
        for c in range(n):
            nearest[b, c] *= flat[b, 0]
            farthest[b, c] *= flat[b, 1]
    return most


@kernel
def _any_between(nearest, farthest, a0, a1, b0, b1, enter, leave):
    """Whether a stretch of these columns may have a return of a length between two."""
    found = np.int32(0)
    for b in range(b0, b1):
        near, far = nearest[b, a0:a1], farthest[b, a0:a1]
        for i in range(len(near)):
            found |= np.int32((far[i] >= enter) & (near[i] <= leave))
    return found > 0


@kernel
def _stretches_between(nearest, farthest, a0, a1, b0, b1, enter, leave, error, first, last):
    """First and last stretch of each column that may have a return between two lengths of its own; b1, b0 if none."""
    first[: a1 - a0], last[: a1 - a0] = b1, b0
    for b in range(b1 - 1, b0 - 1, -1):
        near, far, here = nearest[b, a0:a1], farthest[b, a0:a1], np.int32(b)
        for i in range(len(near)):
            found = (far[i] >= enter[i] - error) & (near[i] <= leave[i] + error)
            first[i] = here if found else first[i]
            last[i] = max(last[i], here + np.int32(1)) if found else last[i]


@kernel
def _count(
    steps, step_m, beams, cos_el, sin_el, a0, a1, r0, r1, x, y, z, cos, sin, half_l, half_w, half_h, bounds, scratch
):
    """Returns in columns a0 to a1 and rows r0 to r1 that lie inside a box."""
    m = len(cos_el)
    nearest, farthest = bounds
    near, far, first, until = scratch
    error = 2e-5 + 2e-6 * (abs(x) + abs(y) + abs(z) + half_l + half_w + half_h)
    b0, b1 = r0 // STRETCH, (r1 + STRETCH - 1) // STRETCH
    low, high = r0 // BLOCK * BLOCK, min((r1 + BLOCK - 1) // BLOCK, m // BLOCK) * BLOCK  # whole blocks
    radius, distance = np.sqrt(half_l * half_l + half_w * half_w), np.sqrt(x * x + y * y)
    least, most = np.float32(distance - radius - 3.0 * error), np.float32(distance + radius + 3.0 * error)
    if not _any_between(nearest, farthest, a0, a1, b0, b1, least, most):
        return 0
    exactly = np.hypot(distance + radius, abs(z) + half_h) + error >= NO_RETURN * step_m
    p, q = -(cos * x + sin * y), -(cos * y - sin * x)
    _crossings(beams.cos_az[a0:a1], beams.sin_az[a0:a1], p, q, cos, sin, half_l, half_w, near, far)
    _stretches_between(nearest, farthest, a0, a1, b0, b1, near, far, np.float32(3.0 * error), first, until)
    total = 0
    for c in range(a0, a1):
        enter, leave = float(near[c - a0]), float(far[c - a0])
        tested, end = r0, r1  # rows that are tested exactly
        if enter == enter:
            if enter - error >= leave + error or leave + error <= 0.0:
                continue
            enter = max(enter, -1.0)  # a long interval behind the sensor would cost precision
            if first[c - a0] >= until[c - a0]:
                continue
            some, last = max(low, STRETCH * first[c - a0]), STRETCH * until[c - a0]
            whole = some if exactly else min(high, last)
            counted = _tally(
                steps, c, some, whole, cos_el, sin_el, np.float32(0.5 * (enter + leave)),
                np.float32(0.5 * (leave - enter)), np.float32(z), np.float32(half_h), np.float32(error),
            )  # fmt: skip
            if counted // _WIDE == counted % _WIDE:
                total += counted // _WIDE
                some = whole
            tested, end = max(r0, some), min(r1, last)
        ca, sa = beams.cos_az[c], beams.sin_az[c]
        for r in range(tested, end):
            d = steps[c, r] * step_m
            away, up = d * beams.cos_el[r], d * beams.sin_el[r]
            inside = in_box(away * ca, away * sa, up, x, y, z, cos, sin, half_l, half_w, half_h)
            total += inside & (steps[c, r] != _NO_RETURN)
    return total


@parallel
def points_in_boxes(range_steps, step_m, beams, pairs, run):
    """Returns of the pair's sweep strictly inside its box, of every pair; `run` as `Pairs.runs`.

    `range_steps` and `step_m` as `sensors.lidar.RangeImages`; a step is a power of two, so that single precision holds
    every range, and lengths per step are exactly as precise as lengths per metre.
    """
    out = np.zeros(len(pairs.o), np.int32)
    n, m = range_steps.shape[1], len(beams.tan_el)
    cos_el, sin_el = (step_m * beams.cos_el).astype(np.float32), (step_m * beams.sin_el).astype(np.float32)
    edge_cos, edge_sin = np.cos(0.5 * beams.fov_rad), np.sin(0.5 * beams.fov_rad)
    flat = np.empty(((m + STRETCH - 1) // STRETCH, 2), np.float32)
    flat[:, 0], flat[:, 1] = np.inf, -np.inf
    for r in range(m):
        b = r // STRETCH
        flat[b, 0], flat[b, 1] = min(flat[b, 0], cos_el[r]), max(flat[b, 1], cos_el[r])
    for i in prange(len(run) - 1):
        steps, columns, slopes = range_steps[pairs.o[run[i]]], columns_of(beams), slopes_of(beams)
        lengths = np.empty((2, len(flat), n), np.float32)
        bounds = lengths[0], lengths[1]
        if run[i + 1] - run[i] > _FEW:
            farthest = _bounds(steps, flat, bounds[0], bounds[1]) * step_m + _REACH_M
        else:
            bounds[0][:], bounds[1][:], farthest = 0.0, np.inf, np.inf
        scratch = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.int32), np.empty(n, np.int32)
        for k in range(run[i], run[i + 1]):
            x, y, z, length, width, height, yaw = in_sensor_frame(pairs, k)
            half_l, half_w, half_h = 0.5 * length, 0.5 * width, 0.5 * height
            radius, distance = np.sqrt(half_l * half_l + half_w * half_w), np.sqrt(x * x + y * y)
            close = distance - radius
            if abs(y) * edge_cos - x * edge_sin > radius or close > farthest:
                continue  # beside the field of view, or behind all returns
            cos, sin = np.cos(yaw), np.sin(yaw)
            a0, a1, b0, b1 = rectangle_columns(x, y, cos, sin, half_l, half_w, columns)
            r0, r1 = 0, m
            if close > 1e-6:
                low, high = z - half_h, z + half_h
                r0 = max(0, below(slopes, low / (close if low < 0.0 else distance + radius)) - 1)
                r1 = min(m, below(slopes, high / (close if high > 0.0 else distance + radius)) + 1)
            for turn in range(2):
                c0, c1 = (a0, a1) if turn == 0 else (b0, b1)
                if c1 > c0:
                    out[k] += _count(
                        steps, step_m, beams, cos_el, sin_el, c0, c1, r0, r1, x, y, z, cos, sin, half_l, half_w, half_h,
                        bounds, scratch,
                    )  # fmt: skip
    return out
