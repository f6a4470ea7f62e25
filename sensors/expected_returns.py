"""Expected returns from the bodies around a sensor, by a few lines to each body instead of a whole sweep.

It needs poses alone: where bodies and buildings stand, and the beams of the sensor. Nothing is cast and nothing is
drawn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled, inlined, kernel
from cosim.base.ragged import owner_of_rows
from sensors.boxes import Boxes
from sensors.lidar import Beams
from sensors.line_of_sight import WallIndex
from sensors.neighbours import Neighbours
from sensors.pairs import Poses
from sensors.scene import Prisms

N_LINES = 5
"""Lines to each body, evenly spaced over its width as the sensor sees it."""


class ExpectedReturns(NamedTuple):
    """Expected returns of sensor o from body b, one row per pair of the `Neighbours` that were given."""

    n: Float[ndarray, "k"]
    """With everything that stands in front; may be below 1."""
    n_unoccluded: Float[ndarray, "k"]
    """If nothing stood in front."""

    @property
    def seen_p(self) -> Float[ndarray, "k"]:
        """Probability of at least one return, for rays whose place relative to the body is uniformly distributed."""
        return np.minimum(self.n, 1.0)

    @property
    def occlusion(self) -> Float[ndarray, "k"]:
        """Share of the unoccluded returns that are missing, in [0, 1]; 0 where there are none."""
        share = np.ones_like(self.n)
        np.divide(self.n, self.n_unoccluded, out=share, where=self.n_unoccluded > 0)
        return 1.0 - share


def expected_returns(
    poses: Poses,
    own: Int[ndarray, "m"],
    beams: Beams,
    near: Neighbours,
    boxes: Boxes,
    bodies: Prisms,
    walls: WallIndex,
    range_m: float,
) -> ExpectedReturns:
    """Expected returns of every sensor from every body near it.

    Parameters
    ----------
    poses
        Of the sensors.
    own
        Row of the body that carries each sensor; it neither blocks nor is seen.
    beams
        Rays of the sensors.
    near
        Bodies near each sensor, by sensor.
    boxes, bodies
        Boxes and bodies, by row; world frame.
    walls
        Buildings.
    range_m
        Farthest return.

    Returns
    -------
    One row per row of `near`.

    Notes
    -----
    A body fills an interval of azimuth. Each of `N_LINES` lines, in the middle of equal parts of the interval, stands
    for the columns of its part. On a line, the body fills an interval of slopes, from the road side of its nearest edge
    to its highest edge. The nearer bodies on the line hide the slopes below their own highest edge, because bodies
    stand on the road. A building between the sensor and the body hides all of it. What remains are the rows of beams
    between two slopes.   Deviations from a sweep: no gap under a trailer, no range noise, no dropouts; the road hides
    nothing.
    """
    line = np.empty((len(near.row), N_LINES, 2))  # of each pair and line: expected returns, unoccluded
    ends = np.empty((len(near.row), N_LINES, 3))
    columns_per_rad = len(beams.azimuth_rad) / beams.fov_rad
    _lines(
        poses.origin_m,
        poses.yaw_rad,
        own,
        near.ptr,
        near.row,
        boxes.xyz_m,
        boxes.circumradius_m,
        bodies,
        beams.tan_el,
        beams.fov_rad,
        columns_per_rad,
        range_m,
        line,
        ends,
    )
    o = owner_of_rows(np.diff(near.ptr))
    pair, number = np.nonzero(line[:, :, 0] > 0)
    points = np.concatenate([poses.origin_m, ends[pair, number]])
    end = len(poses.origin_m) + np.arange(len(pair))
    hidden = ~walls.has_los(points, o[pair], end)
    line[pair[hidden], number[hidden], 0] = 0.0
    n = line[:, :, 0].sum(axis=1)
    n_unoccluded = line[:, :, 1].sum(axis=1)
    return ExpectedReturns(n, n_unoccluded)


@kernel
def _crossed(bodies, k, x, y, cos, sin):
    """Distances at which a horizontal line from (x, y) enters and leaves prism k; the second is not above the first
    where it misses."""
    c, s = bodies.cos[k], bodies.sin[k]
    dx = x - bodies.x_m[k]
    dy = y - bodies.y_m[k]
    p = c * dx + s * dy
    q = c * dy - s * dx
    u = c * cos + s * sin
    v = c * sin - s * cos
    enter, leave = -np.inf, np.inf
    half_l, half_w = bodies.half_l_m[k], bodies.half_w_m[k]
    for at, along, half in ((p, u, half_l), (q, v, half_w)):
        if abs(along) < 1e-12:
            if abs(at) > half:
                return 1.0, 0.0
        else:
            one = (-half - at) / along
            other = (half - at) / along
            enter = max(enter, min(one, other))
            leave = min(leave, max(one, other))
    return max(enter, 0.0), leave


@kernel
def _width(bodies, j, x, y, middle):
    """Least and greatest bearing of the corners of body j from (x, y), relative to the bearing `middle`."""
    low, high = np.inf, -np.inf
    for k in range(bodies.ptr[j], bodies.ptr[j + 1]):
        for a in (-1.0, 1.0):
            for b in (-1.0, 1.0):
                along = a * bodies.half_l_m[k]
                across = b * bodies.half_w_m[k]
                east = bodies.cos[k] * along - bodies.sin[k] * across
                north = bodies.sin[k] * along + bodies.cos[k] * across
                dx = bodies.x_m[k] + east - x
                dy = bodies.y_m[k] + north - y
                turn = _wrapped(np.arctan2(dy, dx) - middle)
                low, high = min(low, turn), max(high, turn)
    return low, high


@inlined
def _wrapped(angle):
    """An angle in [-pi, pi]."""
    return angle - 2 * np.pi * np.rint(angle / (2 * np.pi))


@kernel
def _rows_between(slopes, low, high):
    """Number of ascending slopes in [low, high)."""
    n = 0
    for slope in slopes:
        if low <= slope < high:
            n += 1
    return n


@kernel
def _on_line(bodies, j, x, y, z, cos, sin, range_m):
    """Distance at which a line meets body j, and the slopes of its lower and upper end; not finite where it misses."""
    first, bottom, top = np.inf, np.inf, -np.inf
    for k in range(bodies.ptr[j], bodies.ptr[j + 1]):
        enter, leave = _crossed(bodies, k, x, y, cos, sin)
        if enter < leave and enter <= range_m:
            near = max(enter, 0.01)
            first = min(first, near)
            low = bodies.bottom_m[k] - z
            high = bodies.top_m[k] - z
            bottom = min(bottom, low / near, low / leave)
            top = max(top, high / near, high / leave)
    return first, bottom, top


@kernel
def _hidden_by(bodies, b, x, y, z, cos, sin, first):
    """Slope below which body b hides what is `first` away on a line; not finite where it hides nothing."""
    hidden = -np.inf
    for k in range(bodies.ptr[b], bodies.ptr[b + 1]):
        enter, leave = _crossed(bodies, k, x, y, cos, sin)
        if enter < leave and enter < first:
            near = max(enter, 0.01)
            high = bodies.top_m[k] - z
            hidden = max(hidden, high / near, high / leave)
    return hidden


@compiled
def _lines(origin, yaw, own, ptr, row, xyz, radius, bodies, slopes, fov_rad, columns_per_rad, range_m, line, ends):
    """Write the expected returns of each line, and where it meets the body."""
    n_lines = line.shape[1]
    for o in range(len(origin)):
        x, y, z = origin[o]
        for pair in range(ptr[o], ptr[o + 1]):
            j = row[pair]
            line[pair] = 0.0
            ends[pair] = 0.0
            dx = xyz[j, 0] - x
            dy = xyz[j, 1] - y
            nearest = np.hypot(dx, dy) - radius[j]
            if j == own[o] or nearest > range_m:
                continue
            middle = np.arctan2(dy, dx)
            low, high = _width(bodies, j, x, y, middle)
            n_columns = (high - low) * columns_per_rad / n_lines
            for i in range(n_lines):
                bearing = middle + low + (i + 0.5) * (high - low) / n_lines
                if abs(_wrapped(bearing - yaw[o])) > 0.5 * fov_rad:
                    continue
                cos, sin = np.cos(bearing), np.sin(bearing)
                first, bottom, top = _on_line(bodies, j, x, y, z, cos, sin, range_m)
                if not first < np.inf:
                    continue
                line[pair, i, 1] = n_columns * _rows_between(slopes, bottom, top)
                hidden = bottom
                for other in range(ptr[o], ptr[o + 1]):
                    b = row[other]
                    if b == j or b == own[o]:
                        continue
                    # Bodies away from the line, or behind the body, hide nothing.
                    dx = xyz[b, 0] - x
                    dy = xyz[b, 1] - y
                    ahead = cos * dx + sin * dy
                    aside = cos * dy - sin * dx
                    if abs(aside) <= radius[b] and ahead - radius[b] <= first:
                        hidden = max(hidden, _hidden_by(bodies, b, x, y, z, cos, sin, first))
                line[pair, i, 0] = n_columns * _rows_between(slopes, hidden, top)
                ends[pair, i, 0] = x + first * cos
                ends[pair, i, 1] = y + first * sin
                slope = 0.5 * (max(hidden, bottom) + top)
                ends[pair, i, 2] = max(z + slope * first, 0.1)
