"""What a sweep returned from each actor, and what it would have returned if nothing else existed."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from sensors.raycast.column import actor_columns, in_prism_frame, profile, rectangle, surface
from sensors.scene import Hit


@njit(cache=True, nogil=True, parallel=True)
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
                        first, s0, s1, last, t, low, high = profile(enter, leave, bottom, top, beams)
                        for r in range(first, last):
                            if taken[r] != column and (
                                within_limit or surface(r, s0, s1, t, low, high, beams) <= limit
                            ):
                                taken[r] = column
                                n_unoccluded[i] += 1
                                n_returns[i] += hit[o, c, r] == Hit.ACTOR + a
    return n_returns, n_unoccluded
