"""Positions of objects on the lane paths of vehicles."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.world import LanePaths

_SAMPLES = np.array(
    [
        [0, 0],
        [1, 1],
        [1, 0],
        [1, -1],
        [0, 1],
        [0, -1],
        [-1, 1],
        [-1, 0],
        [-1, -1],
    ],
    float,
)
"""Points of a footprint that are tested: the centre, the corners and the middles of the sides, in half extents."""


def ahead_on_path(
    paths: LanePaths,
    path: Int[ndarray, "n"],
    xy_m: Float[ndarray, "n 2"],
    lw_m: Float[ndarray, "n 2"],
    yaw_rad: Float[ndarray, "n"],
    look_m: Float[ndarray, "n"],
    half_width_m: float,
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Distance along a vehicle's lane path to each object, and the path's heading there.

    Parameters
    ----------
    path
        Row of `paths` for each object.
    xy_m, lw_m, yaw_rad
        Footprint of the object: centre, length and width, heading.
    look_m
        Distance ahead of the front bumper up to which objects are searched for.
    half_width_m
        An object is on the path if its centre, a corner or the middle of a side is within this distance of the path.

    Returns
    -------
    Gap from the front bumper to the nearest such point along the path [m], and heading of the path there [rad]. The gap
    is 0 if the object is beside the vehicle, and infinite if it is not on the path or its centre is not ahead.
    """
    line, front_m = paths.line[path], paths.front_m[path]
    lines = paths.ptr, paths.xy_m, paths.along_m
    return _ahead(*lines, line, front_m, xy_m, lw_m, yaw_rad, look_m, half_width_m, _SAMPLES)


@compiled
def _ahead(ptr, line_xy, along, line, front, xy, lw, yaw, look, half_width, samples):
    n = xy.shape[0]
    gap, heading = np.full(n, np.inf), np.zeros(n)
    for i in range(n):
        first = ptr[line[i]]
        last = ptr[line[i] + 1]
        begin, end = front[i], front[i] + look[i]
        cos = np.cos(yaw[i])
        sin = np.sin(yaw[i])
        centre_ahead = False
        for k in range(samples.shape[0]):
            forward = samples[k, 0] * lw[i, 0] / 2
            left = samples[k, 1] * lw[i, 1] / 2
            x = xy[i, 0] + cos * forward - sin * left
            y = xy[i, 1] + sin * forward + cos * left
            best, at, direction = np.inf, 0.0, 0.0
            for v in range(first, last - 1):
                length = along[v + 1] - along[v]
                if along[v] > end:
                    break
                if length <= 0.0 or along[v + 1] < begin:
                    continue
                vx, vy = line_xy[v]
                ux = (line_xy[v + 1, 0] - vx) / length
                uy = (line_xy[v + 1, 1] - vy) / length
                t = (x - vx) * ux + (y - vy) * uy
                lowest = max(0.0, begin - along[v])
                highest = min(length, end - along[v])
                t = min(max(t, lowest), highest)
                away = np.hypot(x - vx - t * ux, y - vy - t * uy)
                if away < best:
                    best = away
                    at = along[v] + t
                    direction = np.arctan2(uy, ux)
            if k == 0:
                centre_ahead = at > begin + 1e-9
                half_diagonal = np.hypot(lw[i, 0], lw[i, 1]) / 2
                if not centre_ahead or best > half_width + half_diagonal + 1e-6:
                    break  # no point of the footprint is on the path
            if best <= half_width and at - begin < gap[i]:
                gap[i], heading[i] = at - begin, direction
        if not centre_ahead:
            gap[i] = np.inf
    return gap, heading
