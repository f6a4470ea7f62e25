"""The columnar caster against Embree and Open3D, ray by ray."""

import importlib.util

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.base.threads import n_threads, use_threads
from sensors.boxes import Boxes
from sensors.lidar import PROFILES, LidarParams, Sweeps, beams
from sensors.pairs import Poses
from sensors.raycast.column import below, slopes_of
from sensors.raycast.mesh import STEP_M, directions
from sensors.scene import Hit, Scene, prisms
from tests.sensors.town import blocks, boxes_at, car, exact, random_boxes, random_scene, sizes, traffic
from tests.slow import slow

NUDGE_RAD = 3e-5
REFERENCES = ["embree", pytest.param("open3d", marks=pytest.mark.skipif(
    importlib.util.find_spec("open3d") is None, reason="Open3D is not installed: make extra NAME=open3d"
))]  # fmt: skip
each_reference = pytest.mark.parametrize("reference", REFERENCES)


def compare(reference, boxes, shape, observers, scene, **params) -> float:
    """At least 99.99 % of the rays agree to 1 mm, and every other one grazes an edge; the share of those.

    A ray grazes an edge or a face: the reference's range lies between those that the columnar caster gives to rays
    around it. Or the reference, which restarts a ray a little behind each face of the observer's own body, started
    behind another body that crosses that face there.
    """
    shape = np.asarray(shape, np.uint8)
    ours = exact(boxes, shape, observers, scene, **params)
    reference = exact(boxes, shape, observers, scene, engine=reference, **params)
    wrong = ~(np.abs(finite(ours) - finite(reference)) <= 1e-3)
    assert wrong.mean() <= 1e-4
    assert np.mean(ours.hit[~wrong] != reference.hit[~wrong]) <= 1e-4  # where two surfaces meet
    n = len(ours.beams.tan_el)
    for o in np.unique(np.nonzero(wrong)[0]):
        nearby = nudged(boxes, shape, observers[o], scene, ours, params)
        seen = finite(reference)[o]
        grazing = (seen >= nearby.min(axis=0) - 1e-3) & (seen <= nearby.max(axis=0) + 1e-3)
        column, row = np.nonzero(wrong[o] & ~grazing)
        end = ours.poses.to_world(
            o, ours.unrounded_m[o, column, row, None] * directions(0.0, ours.beams)[column * n + row]
        )
        assert (gap_to_body(end, boxes, shape, observers[o]) < 2 * STEP_M).all()
    return float(wrong.mean())


def nudged(boxes, shape, observer, scene, sweep, params) -> np.ndarray:
    """The columnar sweeps of one observer with its sensor turned and tilted a little, in nine ways."""
    images = []
    for turn in (-NUDGE_RAD, 0.0, NUDGE_RAD):
        turned = boxes.yaw_rad.copy()
        turned[observer] += turn
        for tilt in (-NUDGE_RAD, 0.0, NUDGE_RAD):
            table = {**params, "elevation_deg": tuple(np.degrees(sweep.beams.elevation_rad + tilt))}
            pose = Boxes(boxes.xyz_m, boxes.lwh_m, turned)
            images.append(finite(exact(pose, shape, np.array([observer]), scene, **table))[0])
    return np.array(images)


def gap_to_body(point, boxes, shape, actor) -> np.ndarray:
    """Distance of points from the nearest face of an actor's body."""
    bodies = prisms(shape, boxes)
    gap = np.full(len(point), np.inf)
    for k in range(bodies.ptr[actor], bodies.ptr[actor + 1]):
        dx, dy = point[:, 0] - bodies.x_m[k], point[:, 1] - bodies.y_m[k]
        along, aside = bodies.cos[k] * dx + bodies.sin[k] * dy, bodies.cos[k] * dy - bodies.sin[k] * dx
        middle, half = (bodies.top_m[k] + bodies.bottom_m[k]) / 2, (bodies.top_m[k] - bodies.bottom_m[k]) / 2
        out = [abs(along) - bodies.half_l_m[k], abs(aside) - bodies.half_w_m[k], abs(point[:, 2] - middle) - half]
        gap = np.minimum(gap, np.abs(np.max(out, axis=0)))
    return gap


def finite(sweep: Sweeps) -> np.ndarray:
    """Ranges, with the end of the range for what did not return."""
    return np.where(np.isfinite(sweep.unrounded_m), sweep.unrounded_m, np.float32(sweep.max_range_m)).astype(float)


@each_reference
@pytest.mark.parametrize("seed", [0, slow(1), slow(2), slow(3)])
@pytest.mark.parametrize("profile", ["hdl64e_front", "vlp32c", "os1_64"])
def test_random_scenes_agree(seed, profile, reference):
    rng = np.random.default_rng(seed)
    boxes, shape = random_boxes(rng, 30)
    compare(reference, boxes, shape, np.arange(30), random_scene(rng), profile=profile)


@each_reference
@pytest.mark.parametrize(
    "params", [{}, {"profile": "hdl64e"}, {"profile": "pandar64", "mount_above_roof_m": 3.0}, {"profile": "os1_128"}]
)
def test_streets_agree(params, reference):
    rng = np.random.default_rng(7)
    boxes, shape = traffic(rng, 150)
    compare(reference, boxes, shape, np.flatnonzero(shape == 0)[:12], blocks(rng), **params)


PLACES = {
    "beside a wall": (40.0, 7.99),
    "in a courtyard": (30.0, 30.0),
    "in a building": (12.0, 12.0),
    "on the corner": (7.999, 7.999),
    "far outside": (-70.0, -70.0),
}


@each_reference
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("mount", [0.23, 1.0, 4.5, 30.0])
def test_awkward_places_agree(place, mount, reference):
    square = [[(8, 8), (52, 8), (52, 52), (8, 52)], [(20, 20), (40, 20), (40, 40), (20, 40)]]
    low = [[(60, 0), (80, 0), (80, 30), (60, 30)]]
    passage = [[(-20, -20), (0, -20), (0, 60), (-20, 60)]]
    scene = Scene.from_footprints([square, low, passage], [-0.1, -0.1, 3.0], [12.0, 2.2, 9.0])
    x, y = PLACES[place]
    boxes = Boxes.concat([car(x, y, 0.7), car(x + 1.5, y + 0.4, 0.9), car(x + 30, y + 3, 2.0), car(x, y, 0.7)])
    boxes = Boxes(boxes.xyz_m, boxes.lwh_m * np.array([1.0, 1.01, 1.02, 1.03])[:, None], boxes.yaw_rad)
    compare(reference, boxes, np.zeros(4, np.uint8), np.arange(4), scene, profile="os1_128", mount_above_roof_m=mount)


def test_inside_a_closed_body():
    # The sensor stands at 1.73 m in a bus whose floor is 5 cm over the road: it sees its inner faces, nothing else.
    boxes = Boxes.concat([car(0, 0), boxes_at((0, 0, 1.65), (12, 2.55, 3.2), 0.3)])
    sweep = exact(boxes, [0, 3], [0], profile="os1_128")
    assert (sweep.hit == Hit.ACTOR + 1).all()
    compare("embree", boxes, np.array([0, 3], np.uint8), np.array([0]), Scene.empty(), profile="os1_128")


def test_thread_count_invariance():
    rng = np.random.default_rng(5)
    (boxes, shape), scene = traffic(rng, 100), blocks(rng)
    threads = n_threads()
    several = exact(boxes, shape, np.arange(40), scene)
    use_threads(1)
    try:
        one = exact(boxes, shape, np.arange(40), scene)
    finally:
        use_threads(threads)
    assert (one.unrounded_m == several.unrounded_m).all() and (one.hit == several.hit).all()


@settings(max_examples=50)
@given(
    elevation=st.lists(st.floats(-89.0, 89.0), min_size=1, max_size=140, unique=True),
    slope=st.lists(st.floats(), min_size=1, max_size=50),
)
def test_a_slope_finds_its_row(elevation, slope):
    try:
        grid = beams(LidarParams(elevation_deg=tuple(sorted(elevation)), n_azimuths=1))
    except ValueError:  # two of them are nearly equal
        return
    beside = np.concatenate([np.nextafter(grid.tan_el, side) for side in (-np.inf, np.inf)])
    for s in [*slope, *grid.tan_el, *beside]:
        assert below(slopes_of(grid), s) == (grid.tan_el < s).sum()


def test_no_ray_passes_between_adjacent_walls():
    # a ring of 720 short walls around the sensor, whose corners lie on column azimuths: every ray stops at it
    angle = np.radians(np.arange(0, 360, 0.5) + 0.1)
    ring = 30.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    scene = Scene.from_footprints([[2 * ring, ring]], [-1.0], [50.0])
    sweep = exact(car(0, 0), [0], [0], scene, profile="os1_128", n_azimuths=3600)
    assert np.isfinite(sweep.unrounded_m).all() and sweep.unrounded_m.max() < 34


def test_empty_worlds():
    assert exact(car(0, 0), [0], []).unrounded_m.shape == (0, 520, 64)
    none = Poses(np.empty((0, 3)), np.empty(0))
    assert len(none.to_sensor(np.zeros(0, int), Boxes.concat([]))) == 0


def test_long_bodies_agree():
    # articulated buses and tractors with trailers, beside, ahead and crossing
    x, y, yaw, length, high = np.array([
        (20, 3.1, 0.1, 18, 3.2), (25.0, -4.0, 1.3, 16.5, 4.0), (-9.0, 4.0, 3.0, 18.75, 4.0), (45.0, 0.5, 0.0, 16, 4.0),
    ]).T  # fmt: skip
    long = Boxes(np.column_stack([x, y, high / 2]), np.column_stack([length, np.full(4, 2.55), high]), yaw)
    boxes = Boxes.concat([car(0, 0), long])
    compare("embree", boxes, [0, 3, 2, 2, 2], np.arange(5), Scene.empty(), profile="os1_128")


@pytest.mark.verify
@each_reference
@pytest.mark.parametrize("profile", PROFILES)
def test_helsinki_agrees(profile, reference):
    catalogue = pytest.importorskip("sumo_nets.catalogue")
    try:
        prints = catalogue.find("helsinki").footprints()
    except (ValueError, OSError) as missing:
        pytest.skip(f"no footprints of Helsinki: {missing}")
    base = np.array([f.base_z_m for f in prints]) - 0.1  # floors below the road: no two surfaces in one plane
    scene = Scene.from_footprints([[f.outer, *f.holes] for f in prints], base, [f.top_z_m for f in prints])
    rng = np.random.default_rng(1)
    west, south, east, north = scene.buildings.bounds_m.T
    n = 400
    shape = rng.integers(0, 7, n).astype(np.uint8)
    lwh = sizes(rng, shape)
    long = (shape == 2) | (shape == 3)
    lwh[long, 0] = rng.uniform(8.0, 18.5, long.sum())  # trucks with and without trailer, buses of both kinds
    x, y = rng.uniform(west.min(), east.max(), n), rng.uniform(south.min(), north.max(), n)
    boxes = Boxes(np.column_stack([x, y, lwh[:, 2] / 2]), lwh, rng.uniform(-np.pi, np.pi, n))
    share = compare(reference, boxes, shape, np.arange(60), scene, profile=profile)
    print(f"{profile} against {reference}: {share:.2e} of the rays differ by more than 1 mm, all of them at edges")
