"""Blockage of links by the bodies of vehicles that are there.

A grid of cells holds the vehicles of traffic. The cells along the line between two antennas name the vehicles that may
cross it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.kernel import kernel
from cosim.base.ragged import counting_order, expand, ptr_of

CELL_M = 10.0
_BELOW_M = 3.0
"""A body whose top is farther below the line than this is on a street below [m]."""


@dataclass(frozen=True, slots=True)
class Bodies:
    """B upright boxes of road users, world frame, whether equipped or not."""

    xyz_m: Float[ndarray, "b 3"]
    """Centres."""
    lwh_m: Float[ndarray, "b 3"]
    """Length along the heading, width, height."""
    yaw_rad: Float[ndarray, "b"]
    own: Int[ndarray, "n"]
    """Row of each station's own body; -1 if it has none."""

    def equals(self, other: "Bodies | None") -> bool:
        """Whether these are the same bodies at the same places."""
        return other is not None and all(
            np.array_equal(getattr(self, name), getattr(other, name)) for name in ("xyz_m", "lwh_m", "yaw_rad", "own")
        )

    def copy(self) -> "Bodies":
        """These bodies in arrays of their own."""
        columns = self.xyz_m, self.lwh_m, self.yaw_rad, self.own
        return Bodies(*(column.copy() for column in columns))


def tallest_blocker_m(
    xyz_m: Float[ndarray, "n 3"],
    a: Int[ndarray, "m"],
    b: Int[ndarray, "m"],
    bodies: Bodies,
) -> Float[ndarray, "m"]:
    """Height of the tallest body whose footprint the line between two antennas crosses, above its street [m].

    Parameters
    ----------
    xyz_m
        Antennas of the N stations.
    a, b
        Rows of the two ends of each link.
    bodies
        Road users. The bodies of the two ends do not block.

    Returns
    -------
    Height per link; 0 where no body is in the way.

    Notes
    -----
    A body blocks by its footprint, whatever the height of the line above it: TR 37.885 compares heights of antennas and
    blocker. A body that is wholly above the line, or more than 3 m below it, is on another street.
    """
    out = np.zeros(len(a))
    if not len(a) or not len(bodies.xyz_m):
        return out
    antenna_m, centre_m = xyz_m[:, :2], bodies.xyz_m[:, :2]
    low = np.minimum(antenna_m.min(0), centre_m.min(0)) - CELL_M
    span = np.maximum(antenna_m.max(0), centre_m.max(0)) - low
    side_m = max(CELL_M, float(span.max()) / 4000)
    shape = (span / side_m).astype(np.int64) + 2
    # Each body is listed under all cells that the square around its circle touches.
    length_m, width_m, _ = bodies.lwh_m.T
    radius_m = (np.hypot(length_m, width_m) / 2)[:, None]
    first = ((centre_m - low - radius_m) / side_m).astype(np.int64)
    last = ((centre_m - low + radius_m) / side_m).astype(np.int64)
    first = first.clip(0, shape - 1)
    last = last.clip(0, shape - 1)
    count = last - first + 1
    n_cells = count.prod(axis=1)
    k, body = expand(np.zeros_like(n_cells), n_cells)
    n_rows = count[body, 1]
    cx = first[body, 0] + k // n_rows
    cy = first[body, 1] + k % n_rows
    cell = cx * shape[1] + cy
    order = counting_order(cell, int(shape.prod()))
    ptr = ptr_of(cell[order], int(shape.prod()))
    ends = np.ascontiguousarray(xyz_m, np.float64), a, b
    cosine, sine = np.cos(bodies.yaw_rad), np.sin(bodies.yaw_rad)
    shapes = bodies.own, bodies.xyz_m, bodies.lwh_m, cosine, sine
    _tallest(*ends, *shapes, ptr, body[order], low, side_m, shape, out)
    return out


@kernel
def _tallest(xyz, a, b, own, centre, lwh, cosine, sine, ptr, body, low, side_m, shape, out):
    """Walk the cells of each line, and test the bodies there."""
    for m in range(len(a)):
        i, j = a[m], b[m]
        # In cells, from the corner of the grid.
        x0 = (xyz[i, 0] - low[0]) / side_m
        y0 = (xyz[i, 1] - low[1]) / side_m
        dx = (xyz[j, 0] - low[0]) / side_m - x0
        dy = (xyz[j, 1] - low[1]) / side_m - y0
        cx, cy = np.int64(x0), np.int64(y0)
        step_x = 1 if dx > 0 else -1
        step_y = 1 if dy > 0 else -1
        # Shares of the line at which it enters the next column and the next row of cells, and from one to the next.
        per_x = 1.0 / max(abs(dx), 1e-12)
        per_y = 1.0 / max(abs(dy), 1e-12)
        next_x = ((cx + 1 - x0) if dx > 0 else (x0 - cx)) * per_x
        next_y = ((cy + 1 - y0) if dy > 0 else (y0 - cy)) * per_y
        tallest = 0.0
        while True:
            c = cx * shape[1] + cy
            for k in range(ptr[c], ptr[c + 1]):
                e = body[k]
                height = lwh[e, 2]
                if height <= tallest or e == own[i] or e == own[j]:
                    continue
                if _crosses(xyz, i, j, centre, lwh, cosine, sine, e):
                    tallest = height
            if next_x < next_y:
                if next_x > 1.0:
                    break
                cx += step_x
                next_x += per_x
            else:
                if next_y > 1.0:
                    break
                cy += step_y
                next_y += per_y
            is_column = 0 <= cx < shape[0]
            if not is_column or cy < 0 or cy >= shape[1]:
                break
        out[m] = tallest


@kernel
def _crosses(xyz, i, j, centre, lwh, cosine, sine, e):
    """Whether the line between two antennas crosses the footprint of a body on the same street."""
    # Both ends along and across the body, from its centre.
    cos, sin = cosine[e], sine[e]
    ax = xyz[i, 0] - centre[e, 0]
    ay = xyz[i, 1] - centre[e, 1]
    bx = xyz[j, 0] - centre[e, 0]
    by = xyz[j, 1] - centre[e, 1]
    u0 = cos * ax + sin * ay
    v0 = cos * ay - sin * ax
    u1 = cos * bx + sin * by
    v1 = cos * by - sin * bx
    near, far = 0.0, 1.0
    for axis in range(2):
        p, q = (u0, u1) if axis == 0 else (v0, v1)
        d = q - p
        half = lwh[e, axis] / 2
        if abs(d) < 1e-12:
            if abs(p) > half:
                return False
        else:
            t0 = (-half - p) / d
            t1 = (half - p) / d
            near = max(near, min(t0, t1))
            far = min(far, max(t0, t1))
    if near > far:
        return False
    t = (near + far) / 2
    za, zb = xyz[i, 2], xyz[j, 2]
    z = za + t * (zb - za)
    half = lwh[e, 2] / 2
    bottom = centre[e, 2] - half
    top = centre[e, 2] + half
    return bottom <= z <= top + _BELOW_M
