"""Trees: a trunk and a crown each, upright prisms that stand still. They hide what is behind them, and return light."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy
from jaxtyping import Float
from numpy import ndarray

from sensors.neighbours import Neighbours, neighbours_in
from sensors.scene import Prisms, Scene, Shape


def tree_prisms(
    foot_m: Float[ndarray, "t 3"], trunk_m: float, crown_base_m: float, crown_m: float, height_m: float
) -> Prisms:
    """Trees of one size.

    Parameters
    ----------
    foot_m
        Where each tree stands on the ground, world frame [m].
    trunk_m, crown_m
        Widths of the trunk and the crown [m].
    crown_base_m, height_m
        Lower and upper end of the crown above the ground [m].

    Returns
    -------
    Two square prisms per tree, the trunk first. Light does not pass through a crown. `shape` has no meaning.
    """
    n = len(foot_m)
    x, y, z = np.repeat(foot_m, 2, axis=0).T
    part = np.tile([0, 1], n)
    half = 0.5 * np.where(part == 0, trunk_m, crown_m)
    return Prisms(
        ptr=2 * np.arange(n + 1),
        x_m=x.copy(),
        y_m=y.copy(),
        cos=np.ones(2 * n),
        sin=np.zeros(2 * n),
        half_l_m=half,
        half_w_m=half.copy(),
        bottom_m=z + np.where(part == 0, 0.0, crown_base_m),
        top_m=z + np.where(part == 0, crown_base_m, height_m),
        shape=np.full(n, Shape.CAR, np.uint8),
        speed_mps=np.zeros(n),
    )


def radius_m(trees: Prisms) -> float:
    """Radius of the circle around the widest tree [m]; 0 without trees."""
    return float(np.hypot(trees.half_l_m, trees.half_w_m).max(initial=0.0))


def trees_near(points_m: Float[ndarray, "m d"], scene: Scene, range_m: float) -> Neighbours:
    """Trees of a scene that may come within a horizontal range of each point.

    Parameters
    ----------
    points_m
        Points in the world frame [m]; only x and y count.
    range_m
        Horizontal range [m].

    Returns
    -------
    Numbers of the trees, by point.
    """
    return neighbours_in(_index(scene), points_m, range_m + radius_m(scene.trees))


@lru_cache(maxsize=4)
def _index(scene: Scene) -> scipy.spatial.cKDTree:
    first = scene.trees.ptr[:-1]
    xy_m = np.column_stack([scene.trees.x_m[first], scene.trees.y_m[first]])
    return scipy.spatial.cKDTree(xy_m)
