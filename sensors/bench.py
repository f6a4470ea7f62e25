"""How fast the sensors are on this machine: the median CPU time of several runs on one core, engines side by side."""

from __future__ import annotations

from collections.abc import Callable
from time import process_time

import numba
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from sensors.boxes import Boxes, overlapping_pairs
from sensors.evidence import line_of_sight, plausible, points_in_boxes, sightings
from sensors.lidar import LidarParams, scan
from sensors.near import near
from sensors.scene import LABEL_OF_SHAPE, Scene

_SIZE_M = np.array(
    [
        (4.4, 1.8, 1.5), (5.2, 2.0, 2.2), (9.0, 2.5, 3.5), (12.0, 2.55, 3.2),
        (2.2, 0.8, 1.6), (1.8, 0.6, 1.7), (0.6, 0.6, 1.75),
    ]
)  # fmt: skip


def town(n_actors: int = 600, n_blocks: int = 20, pitch_m: float = 60.0) -> tuple[Scene, Boxes, UInt8[ndarray, "n"]]:
    """A grid of streets between L-shaped blocks and the traffic in it, always the same."""
    rng = np.random.default_rng(0)
    corner = np.array([(8, 8), (52, 8), (52, 30), (40, 30), (40, 52), (8, 52)]) / 60.0 * pitch_m
    rings = [[corner + pitch_m * np.array([i, j])] for i in range(n_blocks) for j in range(n_blocks)]
    scene = Scene.from_footprints(rings, np.zeros(len(rings)), rng.uniform(4, 25, len(rings)))
    shape = rng.choice([0, 0, 0, 0, 1, 2, 3, 5, 6, 6], n_actors).astype(np.uint8)
    lwh = _SIZE_M[shape] * rng.uniform(0.95, 1.05, (n_actors, 3))
    street, along = rng.integers(0, n_blocks, n_actors) * pitch_m, rng.uniform(0, n_blocks * pitch_m, n_actors)
    lane, east = rng.choice([-4.5, -1.7, 1.7, 4.5], n_actors), rng.random(n_actors) < 0.5
    x, y = np.where(east, along, street + lane), np.where(east, street + lane, along)
    yaw = np.where(east, 0.0, np.pi / 2) + np.where(lane > 0, np.pi, 0.0)
    return scene, Boxes(np.column_stack([x, y, lwh[:, 2] / 2]), lwh, yaw), shape


def bench(
    world: tuple[Scene, Boxes, UInt8[ndarray, "n"]] | None = None, n_observers: int = 100, runs: int = 5
) -> list[dict[str, str | float]]:
    """Rows of (what, value, unit) on a given world, or on a synthetic town of 600 actors."""
    scene, boxes, shape = town() if world is None else world
    cars = np.flatnonzero(LABEL_OF_SHAPE[shape] == 0)[:n_observers]
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        return _measure(scene, boxes, shape, cars, runs)
    finally:
        numba.set_num_threads(threads)


def _median_s(work: Callable[[], object], runs: int) -> float:
    work()  # compiled, and its memory touched
    seconds = []
    for _ in range(runs):
        start = process_time()
        work()
        seconds.append(process_time() - start)
    return float(np.median(seconds))


def _measure(scene, boxes, shape, observers, runs) -> list[dict[str, str | float]]:
    keys = np.arange(len(observers), dtype=np.uint64)
    clean = LidarParams(range_sigma_m=0.0)
    sweeps = scan(boxes, shape, observers, scene, clean, keys)
    rays = sweeps.range_m.size
    columnar = _median_s(lambda: scan(boxes, shape, observers, scene, clean, keys, sweeps), runs)
    noisy = _median_s(lambda: scan(boxes, shape, observers, scene, LidarParams(), keys, sweeps), runs)
    judged = LidarParams(range_sigma_m=0.0, engine="embree")
    embree = _median_s(lambda: scan(boxes, shape, observers, scene, judged, keys, sweeps), 1)
    scan(boxes, shape, observers, scene, LidarParams(), keys, sweeps)

    ptr, row = near(sweeps.poses.origin_m, boxes, 70.0)
    o = np.repeat(np.arange(len(observers)), np.diff(ptr))
    other = row != observers[o]
    o, row = o[other], row[other]
    asked = boxes.take(row)
    crowd = Boxes(asked.xyz_m + np.random.default_rng(1).normal(0, 0.2, asked.xyz_m.shape), asked.lwh_m, asked.yaw_rad)
    label = LABEL_OF_SHAPE[shape][row]
    n_pairs = len(overlapping_pairs(crowd, label, o)[0])

    figures = [
        ("columnar, one core", rays / columnar / 1e6, "M rays/s"),
        ("columnar, one sweep", columnar / len(observers) * 1e6, "us"),
        ("columnar with range noise, one core", rays / noisy / 1e6, "M rays/s"),
        ("embree, one core", rays / embree / 1e6, "M rays/s"),
        ("columnar / embree", embree / columnar, "times"),
        (
            "sightings",
            _median_s(lambda: sightings(sweeps, boxes, shape), runs) / len(observers) * 1e6,
            "us per observer",
        ),
        ("points in boxes", _median_s(lambda: points_in_boxes(sweeps, o, asked), runs) / len(o) * 1e6, "us per box"),
        ("plausibility", _median_s(lambda: plausible(sweeps, o, asked), runs) / len(o) * 1e6, "us per box"),
        (
            "sight lines",
            _median_s(lambda: line_of_sight(scene, boxes, shape, observers[o], row), runs) / len(o) * 1e6,
            "us per pair",
        ),
        ("overlapping pairs", n_pairs / _median_s(lambda: overlapping_pairs(crowd, label, o), runs) / 1e6, "M pairs/s"),
    ]
    return [{"what": what, "value": value, "unit": unit} for what, value, unit in figures]
