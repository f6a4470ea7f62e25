"""What a sweep returned from each actor, and what it would have returned if nothing else existed."""

from __future__ import annotations

import numpy as np

from cosim.base.kernel import compiled, kernel
from sensors.raycast.column import (
    actor_columns,
    columns_of,
    in_prism_frame,
    profile,
    rectangle,
    rectangle_columns,
    slopes_of,
    surface,
)
from sensors.scene import Hit


@compiled
def unoccluded_returns(hit, origin, yaw, beams, limit, xyz, radius, height, ptr, row, own, bodies):
    """Per candidate (observer, actor): returns in the sweep, and returns if nothing else existed."""
    n_returns = np.zeros(len(row), np.int32)
    n_unoccluded = np.zeros(len(row), np.int32)
    most = 0
    for a in range(len(bodies.ptr) - 1):
        most = max(most, bodies.ptr[a + 1] - bodies.ptr[a])
    for o in range(len(own)):
        place = origin[o]
        cos = np.cos(yaw[o])
        sin = np.sin(yaw[o])
        pose = place[0], place[1], place[2], cos, sin
        taken = np.zeros(len(beams.tan_el), np.int32)  # the last column (of all) in which a row was counted
        frame = np.empty((most, 8))
        window = np.empty((most, 4), np.int64)
        room = taken, frame, window
        columns, slopes = columns_of(beams), slopes_of(beams)
        hits, n_columns = hit[o], np.int64(0)
        for i in range(ptr[o], ptr[o + 1]):
            a = row[i]
            if a != own[o]:
                n_returns[i], n_unoccluded[i], n_columns = _of_actor(
                    hits, pose, beams, columns, slopes, limit, a, xyz, radius[a], height[a], bodies, room, n_columns
                )
    return n_returns, n_unoccluded


@kernel
def _of_actor(hits, pose, beams, columns, slopes, limit, a, xyz, radius, height, bodies, room, n_columns):
    """Returns of one sweep from an actor, and those without anything else; columns looked at so far."""
    x, y, z, cos, sin = pose
    taken, frame, window = room
    n_returned = n_rays = 0
    dx = xyz[a, 0] - x
    dy = xyz[a, 1] - y
    per_rad = bodies.speed_mps[a] * beams.s_per_rad  # how far the actor moves while the sensor turns by one radian
    farthest = 0.5 * beams.fov_rad * abs(per_rad)
    radius += farthest
    a0, a1, b0, b1 = actor_columns(dx, dy, radius, cos, sin, columns)
    if a1 <= a0 and b1 <= b0:
        return 0, 0, n_columns
    away = np.hypot(dx, dy) + radius
    apart_z = abs(xyz[a, 2] - z) + 0.5 * height
    within_limit = np.hypot(away, apart_z) < limit
    n = _seen_from(frame, window, bodies, a, farthest, x, y, z, cos, sin, columns)
    code = Hit.ACTOR + a
    for turn in range(2):
        c0, c1 = (a0, a1) if turn == 0 else (b0, b1)
        for c in range(c0, c1):
            n_columns += 1
            ca, sa = beams.cos_az[c], beams.sin_az[c]
            low, high, one_by_one = 0, 0, not within_limit  # rows that are counted at once
            for k in range(n):
                in_one = window[k, 0] <= c < window[k, 1]
                in_other = window[k, 2] <= c < window[k, 3]
                if not (in_one or in_other):
                    continue
                row = frame[k]
                p = row[0] - per_rad * beams.azimuth_rad[c]
                u, v = row[2], row[3]
                along = u * ca - v * sa
                across = v * ca + u * sa
                enter, leave = rectangle(p, row[1], along, across, row[4], row[5])
                if leave <= max(enter, 0.0):
                    continue
                first, s0, s1, last, t, bottom, top = profile(enter, leave, row[6], row[7], slopes)
                one_by_one |= low < high and (last < low or high < first)  # a gap between two prisms
                if not one_by_one:
                    is_first = low >= high
                    low = first if is_first else min(low, first)
                    high = last if is_first else max(high, last)
                    continue
                for r in range(np.uint64(first), np.uint64(last)):
                    if (
                        taken[r] != n_columns
                        and not low <= r < high
                        and (within_limit or surface(r, s0, s1, t, bottom, top, beams.cos_el, beams.sin_el) <= limit)
                    ):
                        taken[r] = n_columns
                        n_rays += 1
                        n_returned += hits[np.uint64(c), r] == code
            n_rays += high - low
            for r in range(np.uint64(low), np.uint64(high)):
                n_returned += hits[np.uint64(c), r] == code
    return n_returned, n_rays, n_columns


@kernel
def _seen_from(frame, window, bodies, a, farthest, x, y, z, cos, sin, columns):
    """Number of an actor's prisms; of each, the sensor in its frame, its size, and the columns that may cross it.

    During the sweep, the actor moves by at most `farthest` along its heading.
    """
    first, end = bodies.ptr[a], bodies.ptr[a + 1]
    for k in range(first, end):
        p, q, u, v = in_prism_frame(bodies, k, x, y, cos, sin)
        half_l, half_w = bodies.half_l_m[k], bodies.half_w_m[k]
        row = frame[k - first]
        row[0], row[1] = p, q
        row[2], row[3] = u, v
        row[4], row[5] = half_l, half_w
        row[6] = bodies.bottom_m[k] - z
        row[7] = bodies.top_m[k] - z
        reach = half_l + farthest
        ahead = -p * u - q * v
        left = p * v - q * u
        a0, a1, b0, b1 = rectangle_columns(ahead, left, u, -v, reach, half_w, columns)
        crossed = window[k - first]
        crossed[0], crossed[1] = a0, a1
        crossed[2], crossed[3] = b0, b1
    return end - first
