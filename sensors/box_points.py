"""How many returns of a sweep lie in a box: single-precision bounds first, the exact test where they do not decide.

A ray crosses an upright box where its horizontal length lies in an interval (one per column of azimuth) and its height
in another (one per box). Both are widened and narrowed by more than single precision can err; returns between the two
are tested in double precision, so that the counts are those of the exact test of every return.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from sensors.raycast.column import below, spans

MARGIN_RAD = 1e-9
"""Rounding of a window's limits."""

BLOCK = 16
"""Rows that are compared at once; the rows behind the last whole block are tested one by one."""

_GRAZING = 1e-7
"""Sine of the angle between a column and a side of the box below which their crossing is not computed."""

_WIDE = 4096
"""More than the rows of a column; a sum of float32 that counts two things is exact up to 2^24."""


@njit(cache=True, inline="always")
def in_box(x, y, z, cx, cy, cz, cos, sin, half_l, half_w, half_h):
    """Whether a point lies strictly inside an upright box."""
    dx, dy, dz = x - cx, y - cy, z - cz
    return (abs(cos * dx + sin * dy) < half_l) & (abs(cos * dy - sin * dx) < half_w) & (abs(dz) < half_h)


@njit(cache=True, error_model="numpy")
def _crossings(beams, a0, a1, p, q, cos, sin, half_l, half_w, near, far):
    """Horizontal lengths at which columns a0 to a1 enter and leave a box; nan where one runs along a side of it.

    (p, q) is the sensor in the frame of the box, whose heading is (cos, sin) in the frame of the sensor.
    """
    for i in range(a1 - a0):
        ca, sa = beams.cos_az[a0 + i], beams.sin_az[a0 + i]
        u, v = cos * ca + sin * sa, cos * sa - sin * ca
        s, t = (-half_l - p) / u, (half_l - p) / u
        enter, leave = min(s, t), max(s, t)
        s, t = (-half_w - q) / v, (half_w - q) / v
        near[i] = np.nan if min(abs(u), abs(v)) < _GRAZING else max(enter, min(s, t))
        far[i] = min(leave, max(s, t))


@njit(cache=True, fastmath={"reassoc", "nsz"})
def _tally(ranges, c, r0, r1, cos_el, sin_el, middle, half, height, half_h, error):
    """Returns of a column that are inside for certain, times `_WIDE`, and those that may be; rows in whole blocks.

    Only whole numbers are added, so that the order of the additions does not matter.
    """
    count = np.float32(0.0)
    both, one, none = np.float32(_WIDE + 1), np.float32(1.0), np.float32(0.0)
    column = np.uint64(c)
    for row in range(np.uint64(r0), np.uint64(r1), np.uint64(BLOCK)):
        for i in range(BLOCK):
            r = row + np.uint64(i)
            d = ranges[column, r]
            outside = max(abs(d * cos_el[r] - middle) - half, abs(d * sin_el[r] - height) - half_h)
            count += both if outside < -error else (one if outside < error else none)
    return int(count)


@njit(cache=True)
def _count(ranges, beams, cos_el, sin_el, a0, a1, r0, r1, x, y, z, cos, sin, half_l, half_w, half_h, near, far):
    """Returns in columns a0 to a1 and rows r0 to r1 that lie inside a box."""
    m = len(cos_el)
    first, last = r0 // BLOCK * BLOCK, min((r1 + BLOCK - 1) // BLOCK, m // BLOCK) * BLOCK
    p, q = -(cos * x + sin * y), -(cos * y - sin * x)
    _crossings(beams, a0, a1, p, q, cos, sin, half_l, half_w, near, far)
    error = 2e-5 + 2e-6 * (abs(x) + abs(y) + abs(z) + half_l + half_w + half_h)
    total = 0
    for c in range(a0, a1):
        enter, leave = near[c - a0], far[c - a0]
        tested = r0  # first row that is tested exactly
        if enter == enter:
            if enter - error >= leave + error or leave + error <= 0.0:
                continue
            enter = max(enter, -1.0)  # a long interval behind the sensor would cost precision
            counted = _tally(
                ranges, c, first, last, cos_el, sin_el, np.float32(0.5 * (enter + leave)),
                np.float32(0.5 * (leave - enter)), np.float32(z), np.float32(half_h), np.float32(error),
            )  # fmt: skip
            if counted // _WIDE == counted % _WIDE:
                total += counted // _WIDE
                tested = max(r0, last)
        ca, sa = beams.cos_az[c], beams.sin_az[c]
        for r in range(tested, r1):
            d = np.float64(ranges[c, r])
            flat = d * beams.cos_el[r]
            total += in_box(flat * ca, flat * sa, d * beams.sin_el[r], x, y, z, cos, sin, half_l, half_w, half_h)
    return total


@njit(cache=True, parallel=True)
def points_in_boxes(range_m, beams, o, run, xyz, lwh, yaw):
    """Returns of sweep o[k] strictly inside box k (sensor frame); `run` says where another sweep follows."""
    out = np.zeros(len(o), np.int32)
    n, m = range_m.shape[1], len(beams.tan_el)
    cos_el, sin_el = beams.cos_el.astype(np.float32), beams.sin_el.astype(np.float32)
    for i in prange(len(run) - 1):
        near, far = np.empty(n), np.empty(n)
        for k in range(run[i], run[i + 1]):
            x, y, z = xyz[k, 0], xyz[k, 1], xyz[k, 2]
            half_l, half_w, half_h = 0.5 * lwh[k, 0], 0.5 * lwh[k, 1], 0.5 * lwh[k, 2]
            cos, sin = np.cos(yaw[k]), np.sin(yaw[k])
            radius, distance = np.hypot(half_l, half_w), np.hypot(x, y)
            close = distance - radius
            half = np.arcsin(radius / distance) + MARGIN_RAD if close > 0.0 else np.pi
            a0, a1, b0, b1 = spans(np.arctan2(y, x), half, beams)
            r0, r1 = 0, m
            if close > 1e-6:
                low, high = z - half_h, z + half_h
                r0 = max(0, below(beams.tan_el, low / (close if low < 0.0 else distance + radius)) - 1)
                r1 = min(m, below(beams.tan_el, high / (close if high > 0.0 else distance + radius)) + 1)
            for turn in range(2):
                c0, c1 = (a0, a1) if turn == 0 else (b0, b1)
                if c1 > c0:
                    out[k] += _count(
                        range_m[o[k]], beams, cos_el, sin_el, c0, c1, r0, r1, x, y, z, cos, sin, half_l, half_w,
                        half_h, near, far,
                    )  # fmt: skip
    return out
