"""The prisms as triangle meshes, and sweeps by any engine that returns the first triangle on a ray.

Such engines compute in single precision, so the city is cut into tiles and each tile is cast around its own centre.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray

from cosim.base.plane import turned_by
from cosim.base.ragged import owner_of_rows
from sensors.boxes import Boxes
from sensors.neighbours import Neighbours
from sensors.range_noise import RangeNoise, add_noise
from sensors.range_steps import count_steps
from sensors.scene import Hit, Prisms, Scene, roof_triangles

TILE_M = 256.0
STEP_M = 1e-4  # how far behind a face of one's own body a ray starts again

_Vectors = Float[ndarray, "r 3"]
_Met = tuple[Float[ndarray, "r"], Int[ndarray, "r"]]
Tracer = Callable[[_Vectors, _Vectors], _Met]
"""Origins and unit directions to distance and number of the first triangle; -1 is none."""


class _Tile(NamedTuple):
    """The triangles near one tile of the city, in a frame with its origin in the tile's centre."""

    centre_m: Float[ndarray, "3"]
    trace: Tracer | None
    """None where there are no triangles."""
    code: Int[ndarray, "t"]
    """What each triangle belongs to, as a `Hit` code."""


def cast(
    tracer_of: Callable[[ndarray], Tracer],
    sweeps,
    boxes: Boxes,
    bodies: Prisms,
    scene: Scene,
    noise: RangeNoise,
    _near: Neighbours,
) -> None:
    """Cast the rays of all observers.

    Parameters
    ----------
    tracer_of
        Makes an engine from triangles (t, 3, 3).
    sweeps, boxes, bodies, scene, noise
        As for `sensors.raycast.columnar.cast`.
    """
    origin_m, hit, max_range_m = sweeps.poses.origin_m, sweeps.hit, sweeps.max_range_m
    ranges = sweeps.unrounded_m if len(sweeps.unrounded_m) else np.empty(hit.shape, np.float32)
    city = city_triangles(scene)
    body, actor = _bodies(bodies, boxes, scene)
    mesh = np.concatenate([city, body])
    of_city = np.full(len(city), Hit.BUILDING)
    code = np.concatenate([of_city, Hit.ACTOR + actor]).astype(np.int32)
    low = mesh[:, :, :2].min(axis=1)
    high = mesh[:, :, :2].max(axis=1)

    corners = np.floor(origin_m[:, :2] / TILE_M).astype(np.int64)
    for corner in np.unique(corners, axis=0):
        here = np.flatnonzero((corners == corner).all(axis=1))
        height_m = np.mean(origin_m[here, 2])
        centre = np.append((corner + 0.5) * TILE_M, height_m)
        limit_m = 0.5 * TILE_M + max_range_m
        is_above_low = high > centre[:2] - limit_m
        is_below_high = low < centre[:2] + limit_m
        close = (is_above_low & is_below_high).all(axis=1)
        trace = tracer_of((mesh[close] - centre).astype(np.float32)) if close.any() else None
        tile = _Tile(centre, trace, code[close])
        for o in here.tolist():
            _sweep(sweeps, o, tile, ranges[o])
    per_metre = np.float32(1.0 / sweeps.step_m)
    for o in range(len(hit)):
        add_noise(ranges[o], hit[o], noise.key[o], noise)
        count_steps(ranges[o], sweeps.range_steps[o], per_metre)


def _sweep(sweeps, o: int, tile: _Tile, range_m: Float32[ndarray, "a e"]) -> None:
    """Fill the ranges and hits of observer `o`, without noise."""
    beams = sweeps.beams
    origin = sweeps.poses.origin_m[o] - tile.centre_m
    ground = sweeps.ground_m[o] - tile.centre_m[2]
    own = Hit.ACTOR + sweeps.observers[o]
    direction = directions(sweeps.poses.yaw_rad[o], beams)
    n_rays = len(direction)
    distance = np.full(n_rays, np.inf)
    what = np.full(n_rays, Hit.NOTHING, np.int32)
    behind = np.zeros(n_rays)  # distance already covered, behind faces of the observer's own body
    left = np.arange(n_rays)
    while tile.trace is not None and len(left):
        start = origin + behind[left, None] * direction[left]
        onward = direction[left].astype(np.float32)
        ahead, triangle = tile.trace(start.astype(np.float32), onward)
        met = triangle >= 0
        far = behind[left] + ahead
        who = np.where(met, tile.code[np.maximum(triangle, 0)], Hit.NOTHING)
        mine = met & (who == own)
        distance[left] = np.where(met & ~mine, far, np.inf)
        what[left] = np.where(mine, Hit.NOTHING, who)
        behind[left[mine]] = far[mine] + STEP_M
        left = left[mine]
    rise = ground - origin[2]
    upward = np.broadcast_to(beams.sin_el, range_m.shape).ravel()
    with np.errstate(divide="ignore"):
        road = np.where(rise * upward > 0.0, rise / upward, np.inf)
    what = np.where(road < distance, Hit.GROUND, what)
    distance = np.minimum(road, distance)
    beyond = distance > sweeps.max_range_m
    range_m[:] = np.where(beyond, np.inf, distance).reshape(range_m.shape)
    hit = sweeps.hit[o]
    hit[:] = np.where(beyond, Hit.NOTHING, what).reshape(hit.shape)


def directions(yaw: float, beams) -> Float[ndarray, "r 3"]:
    """Unit vectors of all rays of a sensor.

    Parameters
    ----------
    yaw
        Heading of the sensor, world frame [rad].
    beams
        `sensors.lidar.Beams`.

    Returns
    -------
    World directions, column by column of azimuth, each from the lowest beam up.
    """
    azimuth = beams.azimuth_rad + yaw
    out = np.empty((len(azimuth), len(beams.cos_el), 3))
    out[..., 0] = np.cos(azimuth)[:, None] * beams.cos_el
    out[..., 1] = np.sin(azimuth)[:, None] * beams.cos_el
    out[..., 2] = beams.sin_el
    return out.reshape(-1, 3)


def city_triangles(scene: Scene) -> Float[ndarray, "t 3 3"]:
    """Triangles of the static city.

    Returns
    -------
    Corners in the world frame [m]: walls, undersides and roofs of all buildings, then trees and meshes of the scene.
    """
    city = scene.buildings
    building = owner_of_rows(np.diff(city.ptr))
    base, top = city.base_m[building], city.top_m[building]
    a_base = np.column_stack([city.ax_m, city.ay_m, base])
    b_base = np.column_stack([city.bx_m, city.by_m, base])
    b_top = np.column_stack([city.bx_m, city.by_m, top])
    a_top = np.column_stack([city.ax_m, city.ay_m, top])
    lower = np.stack([a_base, b_base, b_top], axis=1)
    upper = np.stack([a_base, b_top, a_top], axis=1)
    parts = [lower, upper]
    flat, owner = roof_triangles(scene)
    for height_m in (city.base_m, city.top_m):
        z = np.broadcast_to(height_m[owner, None, None], (len(flat), 3, 1))
        parts.append(np.concatenate([flat, z], axis=2))
    parts.append(body_triangles(scene.trees))
    if scene.triangles_m is not None:
        parts.append(scene.triangles_m)
    return np.concatenate(parts)


def _bodies(
    bodies: Prisms,
    boxes: Boxes,
    scene: Scene,
) -> tuple[Float[ndarray, "t 3 3"], Int[ndarray, "t"]]:
    """Triangles of all actors, and the actor of each: meshes of the scene where their shape has one, else prisms."""
    is_mesh = np.isin(bodies.shape, list(scene.bodies_m))
    owner = np.repeat(owner_of_rows(np.diff(bodies.ptr)), 12)
    upright = ~is_mesh[owner]
    parts = [body_triangles(bodies)[upright]]
    actors = [owner[upright]]
    for shape, unit in scene.bodies_m.items():
        rows = np.flatnonzero(bodies.shape == shape)
        local = unit * boxes.lwh_m[rows, None, None, :]
        local[..., :2] = turned_by(boxes.yaw_rad[rows, None, None], local)
        placed = local + boxes.xyz_m[rows, None, None, :]
        parts.append(placed.reshape(-1, 3, 3))
        actors.append(np.repeat(rows, len(unit)))
    return np.concatenate(parts), np.concatenate(actors)


_FACES = np.array(
    [
        (0, 1, 5),
        (0, 5, 4),
        (1, 2, 6),
        (1, 6, 5),
        (2, 3, 7),
        (2, 7, 6),
        (3, 0, 4),
        (3, 4, 7),
        (0, 2, 1),
        (0, 3, 2),
        (4, 5, 6),
        (4, 6, 7),
    ]
)
"""Corners of the triangles of a prism, two for each side; corners 0 to 3 are below 4 to 7."""


def body_triangles(bodies: Prisms) -> Float[ndarray, "t 3 3"]:
    """Triangles of the bodies of actors.

    Returns
    -------
    Corners in the world frame [m], twelve triangles per prism, in the order of the prisms.
    """
    corner = np.empty((len(bodies.x_m), 8, 3))
    sides = ((-1, -1), (1, -1), (1, 1), (-1, 1))  # of half the length and half the width
    for c, (l_side, w_side) in enumerate(sides):
        along = l_side * bodies.half_l_m
        aside = w_side * bodies.half_w_m
        x = bodies.x_m + bodies.cos * along - bodies.sin * aside
        y = bodies.y_m + bodies.sin * along + bodies.cos * aside
        corner[:, c] = np.column_stack([x, y, bodies.bottom_m])
        corner[:, c + 4] = np.column_stack([x, y, bodies.top_m])
    return corner[:, _FACES].reshape(-1, 3, 3)
