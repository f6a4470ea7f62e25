"""Small synthetic worlds and the reference vectors, for the tests of this room."""

import gzip
import json

import numpy as np
import pytest
import shapely

from sensors.boxes import Boxes
from sensors.lidar import LidarParams, scan
from sensors.reports import DetectorDraws
from sensors.scene import Scene
from tests import SHARED

REFERENCE = SHARED / "reference" / "trupercept"
SIZE_M = np.array(
    [
        (4.4, 1.8, 1.5), (5.2, 2.0, 2.2), (9.0, 2.5, 3.5), (12.0, 2.55, 3.2),
        (2.2, 0.8, 1.6), (1.8, 0.6, 1.7), (0.6, 0.6, 1.75),
    ]
)  # fmt: skip


def lines_between(xyz, a, b):
    """Straight lines on the map from places `a` to places `b`, as Shapely geometries."""
    return shapely.linestrings(np.stack([xyz[a, :2], xyz[b, :2]], axis=1))


def cases(name: str) -> list[dict]:
    """The cases of one reference file; skips where the folder is absent."""
    path = REFERENCE / f"{name}.json.gz"
    if not path.exists():
        pytest.skip(f"reference data absent: {path}")
    return json.loads(gzip.decompress(path.read_bytes()))["cases"]


def from_camera(t, h, w, length, ry, dtype=float) -> Boxes:
    """KITTI boxes (camera frame: x right, y down, z forward; t = bottom centre) in the sensor frame."""
    t, h, w, length, ry = (np.array(np.array(v, dtype), float) for v in (t, h, w, length, ry))
    xyz = np.column_stack([t[:, 2], -t[:, 0], -t[:, 1] + h / 2])
    return Boxes(xyz, np.column_stack([length, w, h]), -ry - np.pi / 2)


def labelled(boxes: list[dict], dtype=float) -> Boxes:
    """The boxes of reference cases in the sensor frame."""
    t, h, w, length, ry = zip(*((b["t"], b["h"], b["w"], b["l"], b["ry"]) for b in boxes), strict=True)
    return from_camera(t, h, w, length, ry, dtype)


def cloud(name: str) -> np.ndarray:
    """A reference cloud in the sensor frame."""
    xyz = np.fromfile(REFERENCE / name, "<f4").reshape(-1, 3).astype(float)
    return np.column_stack([xyz[:, 2], -xyz[:, 0], -xyz[:, 1]])


def random_boxes(rng, n, spread=15.0) -> tuple[Boxes, np.ndarray]:
    """Boxes of all sizes at all heights, overlapping, one in another."""
    xyz = np.column_stack([rng.uniform(-spread, spread, (n, 2)), rng.uniform(0, 3, n)])
    boxes = Boxes(xyz, rng.uniform(0.5, 8.0, (n, 3)), rng.uniform(-np.pi, np.pi, n))
    return boxes, rng.integers(0, 7, n).astype(np.uint8)


def random_scene(rng, n=12, spread=40.0) -> Scene:
    """Crooked buildings: on the ground, sunk into it, and floating as passages do; some low, some overlapping."""
    rings, base, top = [], [], []
    for _ in range(n):
        angle, radius = np.sort(rng.uniform(0, 2 * np.pi, 7)), rng.uniform(2, 9, 7)
        corner = rng.uniform(-spread, spread, 2) + np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        rings.append([corner])
        base.append(rng.choice([-5.0, 0.0, 2.5, 4.0]))
        top.append(base[-1] + rng.uniform(1, 9))
    return Scene.from_footprints(rings, base, top)


SQUARE_BLOCK = np.array([(8, 8), (52, 8), (52, 52), (8, 52)])
COURTYARD = np.array([(20, 20), (40, 20), (40, 40), (20, 40)])
L_BLOCK = np.array([(8, 8), (52, 8), (52, 30), (40, 30), (40, 52), (8, 52)])


def blocks(rng, n=6, pitch=60.0) -> Scene:
    """City blocks: L-shaped buildings and ones with a courtyard, most tall, a few lower than a sensor."""
    rings, base, top = [], [], []
    for i in range(n):
        for j in range(n):
            x, y = i * pitch, j * pitch
            corner = np.array([x, y])
            if rng.random() < 0.3:
                rings.append([corner + SQUARE_BLOCK, corner + COURTYARD])
            else:
                rings.append([corner + L_BLOCK])
            base.append(0.0)
            top.append(rng.uniform(8, 25) if rng.random() < 0.85 else rng.uniform(0.5, 3))
    return Scene.from_footprints(rings, base, top)


def sizes(rng, shape) -> np.ndarray:
    """Usual sizes, no two alike: faces of two bodies that coincide have no nearer one."""
    return SIZE_M[shape] * rng.uniform(0.95, 1.05, (len(shape), 3))


def traffic(rng, n) -> tuple[Boxes, np.ndarray]:
    """Actors in the lanes between the blocks."""
    shape = rng.choice([0, 0, 0, 1, 2, 3, 5, 6], n).astype(np.uint8)
    lwh = sizes(rng, shape)
    xyz, yaw = in_lanes(rng, lwh, 6, 60.0)
    return Boxes(xyz, lwh, yaw + rng.normal(0, 0.05, n)), shape


def in_lanes(rng, lwh, n_streets, pitch):
    """Places and headings of actors of these sizes in the four lanes of a grid of streets."""
    n = len(lwh)
    street, along = rng.integers(0, n_streets, n) * pitch, rng.uniform(0, n_streets * pitch, n)
    lane, east = rng.choice([-4.5, -1.7, 1.7, 4.5], n), rng.random(n) < 0.5
    x, y = np.where(east, along, street + lane), np.where(east, street + lane, along)
    return np.column_stack([x, y, lwh[:, 2] / 2]), np.where(east, 0.0, np.pi / 2) + np.where(lane > 0, np.pi, 0.0)


def boxes_at(xyz_m, lwh_m=(1.0, 1.0, 1.0), yaw_rad=0.0) -> Boxes:
    """Boxes at one or more places, of one size and heading unless each has its own."""
    xyz_m = np.array(xyz_m, float).reshape(-1, 3)
    return Boxes(xyz_m, np.broadcast_to(lwh_m, xyz_m.shape).astype(float), np.full(len(xyz_m), yaw_rad, float))


def car(x, y, yaw=0.0, z=0.75) -> Boxes:
    """One car of 4.4 x 1.8 x 1.5 m standing at (x, y)."""
    return Boxes(np.array([[x, y, z]]), SIZE_M[:1], np.array([yaw]))


def exact(boxes, shape, observers, scene=None, **params):
    """A sweep without noise, with ranges before rounding."""
    keys = np.arange(len(observers), dtype=np.uint64)
    scene = Scene.empty() if scene is None else scene
    clean = LidarParams(range_sigma_m=0.0, **params)
    return scan(boxes, np.asarray(shape, np.uint8), np.asarray(observers), scene, clean, keys, unrounded=True)


def to_scene(polygons, base_m, top_m, turn=0.0, shift=(0.0, 0.0)) -> Scene:
    """A scene of Shapely polygons, turned about the origin and moved."""
    cos, sin = np.cos(turn), np.sin(turn)
    turned = [
        [np.array(ring.coords) @ np.array([[cos, sin], [-sin, cos]]) + shift for ring in (p.exterior, *p.interiors)]
        for p in polygons
    ]
    return Scene.from_footprints(turned, base_m, top_m)


def draws_of(rng, n_observers: int, n_actors: int, time_s: float = 0.0) -> DetectorDraws:
    """Random keys for a detector."""
    actor, *observers, site = (
        rng.integers(0, 2**64, n, np.uint64) for n in (n_actors, n_observers, n_observers, n_observers, n_observers, 1)
    )
    step, same, site_step, site_observer = observers
    return DetectorDraws(time_s, actor, step, same, site[0], site_step, site_observer)
