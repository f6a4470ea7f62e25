"""Measures the speed of the sensors and ray casters: the least processor time of several runs on one core."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from cosim.base.codes import ObjectClass
from cosim.base.threads import n_threads, use_threads
from sensors.boxes import Boxes, overlapping_pairs
from sensors.evidence import observability, plausible, points_in_boxes
from sensors.false_positives import false_positives
from sensors.lidar import LidarParams, beams, mount, scan
from sensors.line_of_sight import WallIndex, los_between_actors
from sensors.neighbours import neighbours
from sensors.raycast import embree, mesh, open3d
from sensors.reports import DetectorDraws
from sensors.scene import LABEL_OF_SHAPE, Scene, Shape, prisms
from sensors.statistical_detector import DetectorParams, resolved
from sensors.tracking.params import TrackingParams
from sensors.tracking.track import track
from sensors.tracking.tracks import Found, Observers, TrackMemory
from tests.bench.timing import least_s
from tests.sensors.town import in_lanes, sizes


def town(n_actors: int = 600, n_blocks: int = 20, pitch_m: float = 60.0) -> tuple[Scene, Boxes, UInt8[ndarray, "n"]]:
    """A grid of streets between L-shaped blocks and the traffic in it, always the same.

    Returns
    -------
    The blocks, and box and `Shape` of each actor.
    """
    rng = np.random.default_rng(0)
    corner = np.array([(8, 8), (52, 8), (52, 30), (40, 30), (40, 52), (8, 52)]) / 60.0 * pitch_m
    rings = [[corner + pitch_m * np.array([i, j])] for i in range(n_blocks) for j in range(n_blocks)]
    scene = Scene.from_footprints(rings, np.zeros(len(rings)), rng.uniform(4, 25, len(rings)))
    others = [Shape.VAN, Shape.TRUCK, Shape.BUS, Shape.BICYCLE, Shape.PEDESTRIAN, Shape.PEDESTRIAN]
    shape = rng.choice([Shape.CAR] * 4 + others, n_actors).astype(np.uint8)
    lwh = sizes(rng, shape)
    xyz, yaw = in_lanes(rng, lwh, n_blocks, pitch_m)
    return scene, Boxes(xyz, lwh, yaw), shape


def bench(
    world: tuple[Scene, Boxes, UInt8[ndarray, "n"]] | None = None, n_observers: int = 100, runs: int = 5
) -> list[tuple[str, float, str]]:
    """Measure the sensors.

    Parameters
    ----------
    world
        Buildings, boxes and `Shape` of the actors. None: the `town` of 600 actors.
    n_observers
        Largest number of observers. They are the first cars of the world.
    runs
        Number of repetitions, at most 3 for the reference ray casters. The shortest time counts.

    Returns
    -------
    Rows of (what, figure, unit).
    """
    scene, boxes, shape = town() if world is None else world
    cars = np.flatnonzero(LABEL_OF_SHAPE[shape] == ObjectClass.CAR)[:n_observers]
    threads = n_threads()
    use_threads(1)
    try:
        return _measure(scene, boxes, shape, cars, runs)
    finally:
        use_threads(threads)


def _rays_alone(boxes, shape, observers, scene, tracer_of) -> Callable[[], object]:
    """The ray queries of an engine alone. The scene and the rays are made before the measurement."""
    poses, grid = mount(boxes, observers, LidarParams()), beams(LidarParams())
    centre = poses.origin_m.mean(axis=0)
    triangles = np.concatenate([mesh.city_triangles(scene), mesh.body_triangles(prisms(shape, boxes))]) - centre
    trace = tracer_of(triangles.astype(np.float32))
    rays = [mesh.directions(yaw, grid).astype(np.float32) for yaw in poses.yaw_rad]
    starts = [np.broadcast_to((p - centre).astype(np.float32), rays[0].shape).copy() for p in poses.origin_m]
    return lambda: [trace(start, ray) for start, ray in zip(starts, rays, strict=True)]


def street_of_tracks(n_vehicles: int, n_seen: int = 15) -> tuple[TrackMemory, Observers, Found]:
    """Vehicles that have sensed five times at 1 Hz, and what they see next; always the same.

    Each sees cars in rows, 3 m from lane to lane and 8 m from car to car, and pedestrians between them. It misses one
    object in five.

    Parameters
    ----------
    n_vehicles
        Number of vehicles that sense.
    n_seen
        Number of objects around each.

    Returns
    -------
    Their tracks, the vehicles at the next second, and their detections.
    """
    rng, params = np.random.default_rng(0), TrackingParams(model="constant_velocity")
    owner, k = np.divmod(np.arange(n_vehicles * n_seen), n_seen)
    label = np.where(k % 5 == 4, ObjectClass.PEDESTRIAN, ObjectClass.CAR).astype(np.uint8)
    speed_mps = np.where(label == ObjectClass.CAR, np.array([8.0, 0.0, -8.0])[k % 3], 1.3)
    xy_m = np.column_stack([8.0 * (k // 3), 3.0 * (k % 3) + 1.5 * (k % 5 == 4)]) + rng.normal(0, 0.5, (len(k), 2))
    yaw_rad = np.where(speed_mps < 0, np.pi, 0.0)
    memory = TrackMemory()
    for second in range(6):
        seen = np.flatnonzero(rng.random(len(k)) < 0.8)
        at_m = xy_m[seen] + np.column_stack([second * speed_mps[seen], np.zeros(len(seen))])
        noisy_m = at_m + rng.normal(0, 0.1, at_m.shape)
        limit = np.full(len(seen), 14.0)
        score = rng.uniform(0.2, 1.0, len(seen))
        found = Found(owner[seen], label[seen], noisy_m, yaw_rad[seen], score, limit, np.zeros(len(seen)))
        observers = Observers(np.arange(n_vehicles), np.full(n_vehicles, float(second)), np.full(n_vehicles, 8.0))
        if second < 5:
            memory, _ = track(memory, observers, found, params)
    return memory, observers, found


def _measure(scene, boxes, shape, observers, runs) -> list[tuple[str, float, str]]:
    keys = np.arange(len(observers), dtype=np.uint64)
    clean = LidarParams(range_sigma_m=0.0)
    sweeps = scan(boxes, shape, observers, scene, clean, keys)
    rays = sweeps.hit.size
    columnar = least_s(lambda: scan(boxes, shape, observers, scene, clean, keys, sweeps), runs)
    noisy = least_s(lambda: scan(boxes, shape, observers, scene, LidarParams(), keys, sweeps), runs)
    references = {}
    for name, tracer_of in (("embree", embree.tracer_of), ("open3d", open3d.tracer_of)):
        if not find_spec({"embree": "embreex"}.get(name, name)):
            continue
        reference = LidarParams(range_sigma_m=0.0, engine=name)  # type: ignore[arg-type]
        references[name] = least_s(partial(scan, boxes, shape, observers, scene, reference, keys, sweeps), min(runs, 3))
        references[f"{name}, rays alone"] = least_s(
            _rays_alone(boxes, shape, observers, scene, tracer_of), min(runs, 3)
        )
    scan(boxes, shape, observers, scene, LidarParams(), keys, sweeps)

    ptr, row = neighbours(sweeps.poses.origin_m, boxes, 70.0)
    o = np.repeat(np.arange(len(observers)), np.diff(ptr))
    other = row != observers[o]
    o, row = o[other], row[other]
    asked = boxes.take(row)
    crowd = Boxes(asked.xyz_m + np.random.default_rng(1).normal(0, 0.2, asked.xyz_m.shape), asked.lwh_m, asked.yaw_rad)
    label = LABEL_OF_SHAPE[shape][row]
    n_pairs, walls = len(overlapping_pairs(crowd, label, o)[0]), WallIndex.of(scene.buildings)
    seen, model = observability(sweeps, boxes, shape), resolved(DetectorParams())
    fresh, actors = keys + np.uint64(10_000), np.arange(len(boxes), dtype=np.uint64)
    draws = DetectorDraws(0.0, actors, fresh, keys, np.uint64(1), fresh, keys)
    n_tracking = 10 * len(observers)
    tracks = (*street_of_tracks(n_tracking), TrackingParams(model="constant_velocity"))

    return [
        ("columnar, one core", rays / columnar / 1e6, "M rays/s"),
        ("columnar, one sweep", columnar / len(observers) * 1e6, "us"),
        ("columnar with range noise, one core", rays / noisy / 1e6, "M rays/s"),
        *((f"{name}, one core", rays / seconds / 1e6, "M rays/s") for name, seconds in references.items()),
        *((f"columnar / {name}", seconds / columnar, "times") for name, seconds in references.items()),
        (
            "observability",
            least_s(lambda: observability(sweeps, boxes, shape), runs) / len(observers) * 1e6,
            "us per observer",
        ),
        (
            "false positives",
            least_s(lambda: false_positives(sweeps, seen, draws, model), runs) / len(observers) * 1e6,
            "us per observer",
        ),
        ("points in boxes", least_s(lambda: points_in_boxes(sweeps, o, asked), runs) / len(o) * 1e6, "us per box"),
        ("plausibility", least_s(lambda: plausible(sweeps, o, asked), runs) / len(o) * 1e6, "us per box"),
        (
            "lines of sight",
            least_s(lambda: los_between_actors(walls, boxes, shape, observers[o], row), runs) / len(o) * 1e6,
            "us per pair",
        ),
        ("tracks", least_s(lambda: track(*tracks), runs) / n_tracking * 1e6, "us per vehicle and sweep"),
        ("overlapping pairs", n_pairs / least_s(lambda: overlapping_pairs(crowd, label, o), runs) / 1e6, "M pairs/s"),
    ]
