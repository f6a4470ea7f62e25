"""The columnar caster: a scene of upright prisms, cast column by column of azimuth, each a problem in the plane.

In a column of azimuth φ a wall stands at one horizontal distance t, a prism between two, and a beam of elevation α
climbs to t tan α. With the beams sorted by tan α, what a prism covers is an index range: its side the rows with
tan α in [bottom / t, top / t), its roof (seen from above) the rows up to top / t_out. Work is proportional to what is
hit. Along a straight wall w = 1 / t is a linear function of (cos φ, sin φ), so that the nearest of the walls that
close a column up to the highest beam is a running maximum; everything else is drawn over it, and the
nearer surface is kept. Seen from inside, a prism shows its inner faces, as a closed mesh would.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from cosim.base.kernel import compiled, inlined, kernel
from sensors.boxes import Boxes
from sensors.neighbours import Neighbours, buildings_near
from sensors.range_noise import RangeNoise, add_noise
from sensors.range_steps import count_steps
from sensors.raycast.city import close_columns, toggle_levels
from sensors.raycast.column import (
    actor_columns,
    below,
    columns_of,
    in_prism_frame,
    profile,
    rectangle,
    rectangle_columns,
    slopes_of,
)
from sensors.scene import Buildings, Hit, Prisms, Scene
from sensors.trees import radius_m, trees_near


def cast(sweeps, boxes: Boxes, bodies: Prisms, scene: Scene, noise: RangeNoise, near: Neighbours) -> None:
    """Cast the rays of all observers.

    Parameters
    ----------
    sweeps
        `sensors.lidar.Sweeps`: sensors and beams. Its arrays `range_steps` and `hit` are filled, and
        `unrounded_m` where it has rows.
    boxes, bodies
        All actors and their prisms, world frame.
    scene
        Buildings and trees.
    noise
        Range noise and dropouts, with one key per observer.
    near
        The actors near each sensor.

    Raises
    ------
    ValueError
        If the scene has meshes, which this caster cannot cast.
    """
    if scene.triangles_m is not None or scene.bodies_m:
        n_triangles = sum(map(len, scene.bodies_m.values()))
        if scene.triangles_m is not None:
            n_triangles += len(scene.triangles_m)
        raise ValueError(
            f'lidar.engine = "columnar" casts upright prisms, and the scene has a mesh of {n_triangles} '
            'triangles. Set lidar.engine to "embree" or "open3d".'
        )
    origin_m, limit_m = sweeps.poses.origin_m, float(sweeps.max_range_m)
    sensors = _Sensors(
        origin_m,
        sweeps.poses.yaw_rad,
        sweeps.ground_m,
        sweeps.observers,
        near,
        buildings_near(origin_m, scene, limit_m),
        trees_near(origin_m, scene, limit_m),
    )
    still = _Still(scene.buildings, scene.trees, radius_m(scene.trees))
    out = _Swept(sweeps.range_steps, np.float32(1.0 / sweeps.step_m), sweeps.hit, sweeps.unrounded_m)
    _cast(sensors, sweeps.beams, limit_m, boxes.xyz_m, boxes.circumradius_m, bodies, still, noise, out)


class _Sensors(NamedTuple):
    """Poses of M sensors, the height of the road under each, who carries it, and what is near."""

    origin_m: ndarray
    yaw_rad: ndarray
    ground_m: ndarray
    own: ndarray
    actors: Neighbours
    buildings: Neighbours
    trees: Neighbours


class _Still(NamedTuple):
    """What never moves."""

    buildings: Buildings
    trees: Prisms
    tree_radius_m: float


class _Swept(NamedTuple):
    """Arrays that a cast fills, as in `sensors.lidar.Sweeps`; `per_metre` range steps make a metre."""

    range_steps: ndarray
    per_metre: np.float32
    hit: ndarray
    unrounded_m: ndarray


@compiled
def _cast(sensors, beams, limit, xyz, radius, bodies, still, noise, out):
    """Sweep by sweep, so that each is finished while it is in the cache of its core."""
    origin, near = sensors.origin_m, sensors.actors
    standing, wood = sensors.buildings, sensors.trees
    for o in range(len(origin)):
        hits = out.hit[o]
        view = beams, columns_of(beams), slopes_of(beams), limit
        x, y, z = origin[o]
        yaw = sensors.yaw_rad[o]
        pose = x, y, z, np.cos(yaw), np.sin(yaw)
        ranges = np.empty(hits.shape, np.float32)
        nearest = np.full(len(beams.azimuth_rad), 1.0 / limit)
        found = standing.row[standing.ptr[o] : standing.ptr[o + 1]]
        _city(ranges, hits, pose, sensors.ground_m[o], view, nearest, still.buildings, found)
        for a in near.row[near.ptr[o] : near.ptr[o + 1]]:
            if a != sensors.own[o]:
                at = xyz[a, 0], xyz[a, 1]
                _body(ranges, hits, a, Hit.ACTOR + a, at, radius[a], pose, view, nearest, bodies)
        trees = still.trees
        for k in wood.row[wood.ptr[o] : wood.ptr[o + 1]]:
            first = trees.ptr[k]
            at = trees.x_m[first], trees.y_m[first]
            code = np.int64(Hit.BUILDING)
            _body(ranges, hits, k, code, at, still.tree_radius_m, pose, view, nearest, trees)
        add_noise(ranges, hits, noise.key[o], noise)
        count_steps(ranges, out.range_steps[o], out.per_metre)
        if o < len(out.unrounded_m):  # in loops: Numba compiles the words of an error, for 3 s, to assign arrays
            for c in range(len(ranges)):
                for r in range(ranges.shape[1]):
                    out.unrounded_m[o, c, r] = ranges[c, r]


@inlined
def _paint(ranges, hits, c, r, d, limit, code):
    """Keep the nearer of two surfaces; the lower code where they touch, independent of order.

    Column and row are unsigned: an index that might be negative costs a comparison.
    """
    if d <= limit:
        before = ranges[c, r]
        if d < before or (d == before and code < hits[c, r]):
            ranges[c, r] = d
            hits[c, r] = code


@compiled
def _city(ranges, hits, pose, ground, view, nearest, city, found):
    """Ground and buildings of one sweep; leaves the nearest closing wall per column in `nearest`."""
    x, y, z, cos, sin = pose
    beams, columns, slopes, limit = view
    n, m = ranges.shape
    n_walls = 0
    for k in found:
        n_walls += city.ptr[k + 1] - city.ptr[k]
    open_wall = np.empty((n_walls, 9))
    flat = np.empty((len(found), 2), np.int64)
    n_open, n_flat = close_columns(found, x, y, z, ground, cos, sin, city, beams, columns, nearest, open_wall, flat)

    # The road, and the walls that close a column: below, up to the highest beam.
    road = np.full(m, np.inf, np.float32)
    on_road = np.full(m, Hit.NOTHING, hits.dtype)
    for r in range(m):
        if (ground - z) * beams.tan_el[r] > 0.0:
            d = np.float32((ground - z) / beams.sin_el[r])
            if d <= limit:
                road[r], on_road[r] = d, Hit.GROUND
    inv_cos = 1.0 / beams.cos_el
    for c in range(np.uint64(n)):
        for r in range(np.uint64(m)):
            ranges[c, r] = road[r]
        for r in range(np.uint64(m)):
            hits[c, r] = on_road[r]
        if nearest[c] > 1.0 / limit:
            foot = below(slopes, (ground - z) * nearest[c])
            t = 1.0 / nearest[c]
            for r in range(np.uint64(foot), np.uint64(m)):
                d = np.float32(t * inv_cos[r])
                ranges[c, r] = d if d <= limit else np.inf
                hits[c, r] = Hit.BUILDING if d <= limit else Hit.NOTHING

    # Walls that a beam may pass above or below.
    for i in range(n_open):
        wall = open_wall[i]
        u, v = wall[4], wall[5]
        bottom, top = wall[6], wall[7]
        for turn in range(2):
            c0 = int(wall[2 * turn])
            c1 = int(wall[2 * turn + 1])
            for c in range(c0, c1):
                w = u * beams.cos_az[c] + v * beams.sin_az[c]
                if nearest[c] < w < wall[8]:
                    t = 1.0 / w
                    first = below(slopes, bottom * w)
                    last = below(slopes, top * w)
                    for r in range(np.uint64(first), np.uint64(last)):
                        d = np.float32(t * inv_cos[r])
                        _paint(ranges, hits, np.uint64(c), r, d, limit, Hit.BUILDING)
    # Roofs and undersides.
    toggled = np.empty((n if n_flat > 0 else 0, m + 1), np.uint8)
    for i in range(n_flat):
        k, inside = flat[i, 0], flat[i, 1]
        bottom = city.base_m[k] - z
        top = city.top_m[k] - z
        within = inside == 1 and bottom < 0.0 and top > 0.0
        roof = top, top < 0.0 or within
        underside = bottom, bottom > 0.0 or within
        for height, is_seen in (roof, underside):
            if is_seen:
                toggle_levels(toggled, city, k, height, x, y, cos, sin, beams, columns, slopes)
                _level(ranges, hits, height, inside, beams, limit, toggled)


@kernel
def _level(ranges, hits, height, inside, beams, limit, toggled):
    """Paint one roof or underside: where the number of walls before a beam's point is odd."""
    n, m = ranges.shape
    for c in range(n):
        odd = inside
        if height < 0.0:
            for r in range(m):  # rows ascend: points on a level below recede
                odd ^= toggled[c, r]
                if beams.tan_el[r] >= 0.0:
                    break
                if odd:
                    d = np.float32(height / beams.sin_el[r])
                    _paint(ranges, hits, c, r, d, limit, Hit.BUILDING)
        else:
            for r in range(m - 1, -1, -1):
                odd ^= toggled[c, r + 1]
                if beams.tan_el[r] <= 0.0:
                    break
                if odd:
                    d = np.float32(height / beams.sin_el[r])
                    _paint(ranges, hits, c, r, d, limit, Hit.BUILDING)


@kernel
def _body(ranges, hits, a, code, at, radius, pose, view, nearest, bodies):
    """Paint the prisms of body a over the city; an actor is at `at` when the sensor looks straight ahead."""
    x, y, z, cos, sin = pose
    beams, columns, slopes, limit = view
    dx = at[0] - x
    dy = at[1] - y
    per_rad = bodies.speed_mps[a] * beams.s_per_rad  # how far the actor moves while the sensor turns by one radian
    farthest = 0.5 * beams.fov_rad * abs(per_rad)
    radius += farthest
    a0, a1, b0, b1 = actor_columns(dx, dy, radius, cos, sin, columns)
    if a1 <= a0 and b1 <= b0:
        return
    clear = np.hypot(dx, dy) - radius
    for k in range(bodies.ptr[a], bodies.ptr[a + 1]):
        p, q, u, v = in_prism_frame(bodies, k, x, y, cos, sin)
        bottom = bodies.bottom_m[k] - z
        top = bodies.top_m[k] - z
        half_l, half_w = bodies.half_l_m[k], bodies.half_w_m[k]
        reach = half_l + farthest
        ahead = -p * u - q * v
        left = p * v - q * u
        a0, a1, b0, b1 = rectangle_columns(ahead, left, u, -v, reach, half_w, columns)
        for turn in range(2):
            c0, c1 = (a0, a1) if turn == 0 else (b0, b1)
            for c in range(c0, c1):
                if clear * nearest[c] >= 1.0:
                    continue
                ca, sa = beams.cos_az[c], beams.sin_az[c]
                behind = p - per_rad * beams.azimuth_rad[c]
                along = u * ca - v * sa
                across = v * ca + u * sa
                enter, leave = rectangle(behind, q, along, across, half_l, half_w)
                if leave <= max(enter, 0.0) or enter * nearest[c] >= 1.0:
                    continue
                first, s0, s1, last, t, low, high = profile(enter, leave, bottom, top, slopes)
                column = np.uint64(c)
                for r in range(np.uint64(first), np.uint64(s0)):
                    d = np.float32(low / beams.sin_el[r])
                    _paint(ranges, hits, column, r, d, limit, code)
                for r in range(np.uint64(s0), np.uint64(s1)):
                    d = np.float32(t / beams.cos_el[r])
                    _paint(ranges, hits, column, r, d, limit, code)
                for r in range(np.uint64(s1), np.uint64(last)):
                    d = np.float32(high / beams.sin_el[r])
                    _paint(ranges, hits, column, r, d, limit, code)
