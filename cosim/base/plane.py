"""Angles and vectors of the ground plane."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def wrapped(angle_rad: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Angles turned into (-pi, pi]."""
    return np.pi - np.mod(np.pi - angle_rad, 2.0 * np.pi)


def ahead_of(yaw_rad: Float[ndarray, "n"]) -> Float[ndarray, "n 2"]:
    """Unit vectors along headings."""
    return np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad)])


def crossed(
    a: Float[ndarray, "... 2"],
    b: Float[ndarray, "... 2"],
) -> Float[ndarray, "..."]:
    """Areas that pairs of vectors span, positive where b is to the left of a."""
    towards_left = a[..., 0] * b[..., 1]
    return towards_left - a[..., 1] * b[..., 0]


def turned_by(
    angle_rad: Float[ndarray, "..."] | float,
    xy: Float[ndarray, "... 2"],
) -> Float[ndarray, "... 2"]:
    """Vectors of the plane, turned counter-clockwise.

    Parameters
    ----------
    angle_rad
        One angle for each vector. The heading of a body turns from its own frame (x forward, y left) into the frame of
        the heading; its negative turns the other way, with the same rounding.
    xy
        The vectors. Further columns are left out.
    """
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    x, y = xy[..., 0], xy[..., 1]
    turned_x = cos * x - sin * y
    turned_y = sin * x + cos * y
    return np.stack([turned_x, turned_y], axis=-1)
