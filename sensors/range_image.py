"""Kernels that search a window of a range image instead of a whole point cloud.

The test of a single point is exact, so a window may be too large but never changes a result. Rows are taken as slices
from 0: an index that might be negative prevents vectorisation.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numba import njit, prange
from numpy import ndarray

from sensors.raycast.column import actor_columns, below, in_prism_frame, profile, rectangle, spans, surface
from sensors.scene import Hit

MARGIN_RAD = 1e-9  # rounding of a window's limits


@njit(cache=True, inline="always")
def in_box(x, y, z, cx, cy, cz, cos, sin, half_l, half_w, half_h):
    """Whether a point lies strictly inside an upright box."""
    dx, dy, dz = x - cx, y - cy, z - cz
    return (abs(cos * dx + sin * dy) < half_l) & (abs(cos * dy - sin * dx) < half_w) & (abs(dz) < half_h)


@njit(cache=True, parallel=True)
def points_in_boxes(range_m, beams, o, xyz, lwh, yaw):
    """Returns of sweep o[k] strictly inside box k (sensor frame)."""
    out = np.zeros(len(o), np.int32)
    m = len(beams.tan_el)
    for k in prange(len(o)):
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
        cos_el, sin_el = beams.cos_el[r0:r1], beams.sin_el[r0:r1]
        count = 0
        for turn in range(2):
            for c in range(a0 if turn == 0 else b0, a1 if turn == 0 else b1):
                ranges, ca, sa = range_m[o[k], c, r0:r1], beams.cos_az[c], beams.sin_az[c]
                for r in range(len(ranges)):
                    d = np.float64(ranges[r])
                    flat = d * cos_el[r]
                    count += in_box(flat * ca, flat * sa, d * sin_el[r], x, y, z, cos, sin, half_l, half_w, half_h)
        out[k] = count
    return out


def frustum(
    xyz: Float[ndarray, "n 3"], lwh: Float[ndarray, "n 3"]
) -> tuple[Float[ndarray, "n 4 3"], Float[ndarray, "n"], Float[ndarray, "n 4"]]:
    """The pyramid from the sensor through a small square in the middle of each box (sensor frame).

    Parameters
    ----------
    xyz, lwh
        Boxes whose bottom lies below the sensor, but not straight below.

    Returns
    -------
    planes (a point p is inside iff p . plane < 0 for all four), the distance of the bottom centre, and the window that
    holds the pyramid: azimuth of its middle, half its width, lowest and highest slope.
    """
    bottom = xyz - np.array([0.0, 0.0, 0.5]) * lwh[:, 2:]
    x, y, z = bottom.T
    distance = np.sqrt(x * x + y * y + z * z)
    down = np.column_stack([x, y, (x * x + y * y) / z])
    down /= np.sqrt((down * down).sum(axis=1))[:, None]
    right = np.cross(down, bottom / distance[:, None])
    s = (np.minimum(lwh[:, 0], lwh[:, 1]) / 4.0)[:, None]
    tl, tr = xyz - s * down - s * right, xyz - s * down + s * right
    bl, br = xyz + s * down - s * right, xyz + s * down + s * right
    planes = np.stack([np.cross(tr, tl), -np.cross(br, bl), -np.cross(tr, br), np.cross(tl, bl)], axis=1)

    corner = np.stack([tl, tr, bl, br], axis=1)
    middle = np.arctan2(xyz[:, 1], xyz[:, 0])
    off = np.arctan2(corner[:, :, 1], corner[:, :, 0]) - middle[:, None]
    half = np.abs(off - 2.0 * np.pi * np.round(off / (2.0 * np.pi))).max(axis=1)
    slope = corner[:, :, 2] / np.hypot(corner[:, :, 0], corner[:, :, 1])
    low, high = slope.min(axis=1), slope.max(axis=1)
    # Beside a large box the planes may bound no pyramid through the corners: then every ray is tested.
    sound = ((np.einsum("nck,npk->ncp", corner, planes) < 0.0) | _ON_PLANE).all(axis=(1, 2)) & (half < 1.5)
    # The side of a pyramid between two corners is a great circle: its slope is larger by 1 / cos of half its arc.
    bulge = 1.0 / np.cos(np.where(sound, half, 0.0))
    low = np.where(sound, np.where(low < 0.0, low * bulge, low / bulge), -np.inf)
    high = np.where(sound, np.where(high > 0.0, high * bulge, high / bulge), np.inf)
    return planes, distance, np.column_stack([middle, np.where(sound, half + MARGIN_RAD, np.pi), low, high])


_ON_PLANE = np.array([[1, 0, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1], [0, 1, 1, 0]], bool)
"""Which of its planes (top, bottom, right, left) each corner of the pyramid lies on."""


@njit(cache=True, inline="always")
def in_frustum(x, y, z, plane):
    """Whether a point lies strictly inside the pyramid."""
    return (
        (x * plane[0, 0] + y * plane[0, 1] + z * plane[0, 2] < 0.0)
        & (x * plane[1, 0] + y * plane[1, 1] + z * plane[1, 2] < 0.0)
        & (x * plane[2, 0] + y * plane[2, 1] + z * plane[2, 2] < 0.0)
        & (x * plane[3, 0] + y * plane[3, 1] + z * plane[3, 2] < 0.0)
    )


@njit(cache=True, parallel=True)
def free_space(range_m, beams, o, planes, distance, window, margin_m):
    """Returns of sweep o[k] in the pyramid through box k, and how many of them are nearer than the box."""
    seen, closer = np.zeros(len(o), np.int32), np.zeros(len(o), np.int32)
    for k in prange(len(o)):
        plane, limit = planes[k], distance[k] + margin_m
        a0, a1, b0, b1 = spans(window[k, 0], window[k, 1], beams)
        r0 = max(0, below(beams.tan_el, window[k, 2]) - 1)
        r1 = min(len(beams.tan_el), below(beams.tan_el, window[k, 3]) + 1)
        cos_el, sin_el = beams.cos_el[r0:r1], beams.sin_el[r0:r1]
        n_seen = n_closer = 0
        for turn in range(2):
            for c in range(a0 if turn == 0 else b0, a1 if turn == 0 else b1):
                ranges, ca, sa = range_m[o[k], c, r0:r1], beams.cos_az[c], beams.sin_az[c]
                for r in range(len(ranges)):
                    d = np.float64(ranges[r])
                    flat = d * cos_el[r]
                    x, y, z = flat * ca, flat * sa, d * sin_el[r]
                    inside = in_frustum(x, y, z, plane) & (d < np.inf)
                    n_seen += inside
                    n_closer += inside & (np.sqrt(x * x + y * y + z * z) < limit)
        seen[k], closer[k] = n_seen, n_closer
    return seen, closer


@njit(cache=True, parallel=True)
def unoccluded_returns(hit, origin, yaw, beams, limit, xyz, radius, height, ptr, row, own, bodies):
    """Per candidate (observer, actor): returns in the sweep, and returns if nothing else existed."""
    n_returns, n_unoccluded = np.zeros(len(row), np.int32), np.zeros(len(row), np.int32)
    for o in prange(len(own)):
        taken = np.zeros(len(beams.tan_el), np.int64)  # the last column (of all) in which a row was counted
        column = 0
        x, y, z, cos, sin = origin[o, 0], origin[o, 1], origin[o, 2], np.cos(yaw[o]), np.sin(yaw[o])
        for i in range(ptr[o], ptr[o + 1]):
            a = row[i]
            if a == own[o]:
                continue
            dx, dy = xyz[a, 0] - x, xyz[a, 1] - y
            a0, a1, b0, b1 = actor_columns(dx, dy, radius[a], cos, sin, beams)
            within_limit = np.hypot(np.hypot(dx, dy) + radius[a], abs(xyz[a, 2] - z) + 0.5 * height[a]) < limit
            for turn in range(2):
                for c in range(a0 if turn == 0 else b0, a1 if turn == 0 else b1):
                    column += 1
                    ca, sa = beams.cos_az[c], beams.sin_az[c]
                    for k in range(bodies.ptr[a], bodies.ptr[a + 1]):
                        p, q, u, v = in_prism_frame(bodies, k, x, y, cos, sin)
                        enter, leave = rectangle(
                            p, q, u * ca - v * sa, v * ca + u * sa, bodies.half_l_m[k], bodies.half_w_m[k]
                        )
                        if leave <= max(enter, 0.0):
                            continue
                        bottom, top = bodies.bottom_m[k] - z, bodies.top_m[k] - z
                        first, s0, s1, last, t, low, high = profile(enter, leave, bottom, top, beams.tan_el)
                        for r in range(first, last):
                            if taken[r] != column and (
                                within_limit or surface(r, s0, s1, t, low, high, beams) <= limit
                            ):
                                taken[r] = column
                                n_unoccluded[i] += 1
                                n_returns[i] += hit[o, c, r] == Hit.ACTOR + a
    return n_returns, n_unoccluded
