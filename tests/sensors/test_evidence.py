"""Evidence: reference vectors of the paper, windows against whole clouds, observability."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensors import evidence_kernels
from sensors.boxes import Boxes
from sensors.evidence import (
    AreaParams,
    edge_slope,
    in_evaluation_area,
    observability,
    plausible,
    points_in_boxes,
)
from sensors.lidar import LidarParams, RangeImages, beams, scan
from sensors.pairs import Poses
from sensors.range_steps import FINEST_M, NO_RETURN
from sensors.scene import Hit, Scene
from tests.seeds import seeds
from tests.sensors import whole_cloud
from tests.sensors.town import (
    SIZE_M,
    boxes_at,
    car,
    cases,
    cloud,
    exact,
    from_camera,
    labelled,
    random_boxes,
    random_scene,
)  # fmt: skip


def blind(n=1, fov_deg=90.0) -> RangeImages:
    """Sensors at the origin that returned nothing."""
    grid = beams(LidarParams(fov_deg=fov_deg))
    empty = np.full((n, len(grid.azimuth_rad), len(grid.elevation_rad)), NO_RETURN, np.uint16)
    poses = Poses(np.zeros((n, 3)), np.zeros(n))
    return RangeImages(poses, np.arange(n), np.zeros(n), grid, 80.0, empty, FINEST_M)


def applies_to(sensed: Boxes, fov_rad: float, road_z: float = 0.0):
    area = AreaParams()
    slope = edge_slope(fov_rad)
    return whole_cloud.applies_to(sensed.xyz_m, sensed.lwh_m, area.range_m, area.height_m, fov_rad, slope, road_z)


def by_cloud(found: list[dict]):
    for name in sorted({c["cloud"] for c in found}):
        yield cloud(name), [c for c in found if c["cloud"] == name]


def test_points_in_boxes_vectors():
    for points, here in by_cloud(cases("g_points_in_box")):
        boxes = labelled([c["box"] for c in here], np.float32)
        counts = whole_cloud.points_in_boxes_xyz(points, boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad)
        assert counts.tolist() == [c["count"] for c in here]


def test_plausibility_vectors():
    early = {"outside_area", "beyond_70m", "lateral", "centre_above_camera"}
    n = 0
    for points, here in by_cloud(cases("f_plausibility")):
        boxes = labelled([c["box"] for c in here])
        asked = applies_to(boxes, np.pi / 2)
        assert asked.tolist() == [c["reason"] not in early for c in here]
        planes, distance = whole_cloud.frusta(boxes.xyz_m[asked], boxes.lwh_m[asked])
        seen, closer = whole_cloud.free_space_xyz(points, planes, distance, 0.25)
        here_asked = [c for c, a in zip(here, asked, strict=True) if a]
        assert seen.tolist() == [c["frustum_points"] for c in here_asked]
        assert closer.tolist() == [c["closer_points"] for c in here_asked]
        assert (closer > 0.1 * seen).tolist() == [c["plausible"] for c in here_asked]
        assert all(c["plausible"] for c, a in zip(here, asked, strict=True) if not a)
        n += len(here)
    assert n == 546


def test_area_vectors():
    found = cases("l_area_filter")
    boxes, o = labelled([c["box"] for c in found]), np.zeros(len(found), int)
    label = np.array([0 if c["box"]["type"] == "Car" else 1 for c in found], np.uint8)
    size = np.ones(len(found))
    own = from_camera([c["own_object_t"] for c in found], size, size, size, size)
    assert in_evaluation_area(blind(), o, boxes, AreaParams()).tolist() == [c["keep_70"] for c in found]
    assert in_evaluation_area(blind(), o, boxes, AreaParams(range_m=140.0)).tolist() == [c["keep_140"] for c in found]
    each = np.arange(len(found))
    kept = in_evaluation_area(blind(len(found)), each, boxes, AreaParams(), label=label, own=own)
    assert kept.tolist() == [c["keep_70_with_own"] for c in found]


def test_transform_vectors():
    # A KITTI camera pose is a sensor pose (forward, left = -right, up) as long as it is level.
    level = 0
    for c in cases("m_transforms"):
        ends = c["pose_from"], c["pose_to"]
        if any(end["up"] != [0.0, 0.0, 1.0] for end in ends):
            continue  # our sensors stand level
        level += 1
        heading = np.array([np.arctan2(end["forward"][1], end["forward"][0]) for end in ends])
        poses = Poses(np.array([end["camPos"] for end in ends]), heading)
        camera = np.array(c["points_from"])
        world = poses.to_world(0, np.column_stack([camera[:, 2], -camera[:, 0], -camera[:, 1]]))
        as_boxes = Boxes(world, np.ones_like(world), np.zeros(len(world)))
        there = poses.to_sensor(np.ones(len(world), int), as_boxes).xyz_m
        there = np.column_stack([-there[:, 1], -there[:, 2], there[:, 0]])
        assert there == pytest.approx(np.array(c["points_to"]), abs=1e-4)
    assert level >= 10


@pytest.mark.parametrize("height_m", [1.5, 2.86, 3.4, 12.0])
def test_the_height_of_the_area_is_that_above_the_road(height_m):
    """SUMO's vans are 2.86 m high, its buses 3.4 m. Bottoms may be 3 m above or below the road under the sensor."""
    body = boxes_at([[0.0, 0.0, 40.0 + height_m / 2]], (5.0, 2.0, height_m))
    one, key = np.zeros(1, int), np.zeros(1, np.uint64)
    sweeps = scan(body, one.astype(np.uint8), one, Scene.empty(), LidarParams(), key)
    others = boxes_at([[20.0, 0.0, 40.75 + up_m] for up_m in (-3.1, -2.9, 0.0, 2.9, 3.1)], (4.0, 1.8, 1.5))
    kept = in_evaluation_area(sweeps, np.zeros(5, int), others, AreaParams())
    assert kept.tolist() == [False, True, True, True, False]


@pytest.mark.parametrize("fov_deg", [60.0, 90.0, 180.0, 270.0, 360.0])
def test_area_follows_the_field_of_view(fov_deg):
    angle = np.radians(np.arange(-179, 180, 2.0))
    ring = boxes_at(np.column_stack([60 * np.cos(angle), 60 * np.sin(angle), 0 * angle]), yaw_rad=angle)
    kept = in_evaluation_area(blind(fov_deg=fov_deg), np.zeros(180, int), ring, AreaParams(slack_m=0.0))
    assert kept.tolist() == (np.abs(angle) <= np.radians(fov_deg) / 2).tolist()
    assert in_evaluation_area(blind(fov_deg=360.0), np.zeros(180, int), ring, AreaParams()).all()
    with_slack = in_evaluation_area(blind(fov_deg=fov_deg), np.zeros(180, int), ring, AreaParams())
    assert (with_slack >= kept).all() and with_slack.sum() <= kept.sum() + 4  # 2 m at 60 m is 1.9 degrees


@pytest.mark.parametrize("n", [1, 30])
def test_rays_without_return_are_in_no_box(n):
    """Boxes at and about the end of the last step, 128 m away, few and many of them."""
    at = np.column_stack([np.linspace(120.0, 130.0, n), np.zeros(n), np.zeros(n)])
    boxes = Boxes(at, np.full((n, 3), 30.0), np.zeros(n))
    assert not points_in_boxes(blind(), np.zeros(n, int), boxes).any()


@pytest.mark.parametrize("n", [1, 3, 4, 5, 6, 7, 9])
def test_a_full_turn_of_few_columns(n):
    """A box behind the sensor lies in the first columns and in the last ones: no return is counted twice."""
    rng, grid = np.random.default_rng(n), beams(LidarParams(profile="vlp16", n_azimuths=n))
    steps = rng.integers(0, 5000, (1, n, len(grid.elevation_rad))).astype(np.uint16)
    poses = Poses(np.zeros((1, 3)), np.zeros(1))
    sweeps = RangeImages(poses, np.arange(1), np.zeros(1), grid, 80.0, steps, FINEST_M)
    asked = Boxes(rng.uniform(-6, 6, (300, 3)), rng.uniform(1, 12, (300, 3)), rng.uniform(-np.pi, np.pi, 300))
    whole = whole_cloud.points_in_boxes_xyz(sweeps.xyz(0), asked.xyz_m, asked.lwh_m, asked.yaw_rad)
    assert whole.sum() > 100
    assert (points_in_boxes(sweeps, np.zeros(300, int), asked) == whole).all()


@settings(max_examples=12)
@given(
    seed=seeds,
    params=st.sampled_from(
        [
            LidarParams(profile="hdl64e_front", dropout_p=0.05),
            LidarParams(profile="vlp32c", dropout_p=0.05),
            LidarParams(profile="os1_128", dropout_p=0.05),
            LidarParams(profile="vlp16", elevation_deg=tuple(np.linspace(-24.0, 4.0, 37)), dropout_p=0.05),
        ]
    ),
)
def test_windows_equal_whole_clouds(seed, params):
    rng = np.random.default_rng(seed)
    (boxes, shape), scene = random_boxes(rng, 20, 25.0), random_scene(rng)
    sweeps = scan(boxes, shape, np.arange(4), scene, params, np.arange(4, dtype=np.uint64))
    asked = Boxes.concat([boxes, random_boxes(rng, 60, 40.0)[0], boxes.take(slice(4))])
    asked = Boxes(asked.xyz_m - np.array([0, 0, 1.0]), asked.lwh_m, asked.yaw_rad)
    for o in range(4):
        at = np.full(len(asked), o)
        sensed = sweeps.poses.to_sensor(at, asked)
        whole = whole_cloud.points_in_boxes_xyz(sweeps.xyz(o), sensed.xyz_m, sensed.lwh_m, sensed.yaw_rad)
        assert (points_in_boxes(sweeps, at, asked) == whole).all()
        fov_rad, area, pairs = sweeps.beams.fov_rad, AreaParams(), sweeps.poses.pairs(at, asked)
        road_z = sweeps.road_z_m()
        free = applies_to(sensed, fov_rad, road_z[o])
        planes, distance = whole_cloud.frusta(sensed.xyz_m[free], sensed.lwh_m[free])
        seen, closer = np.zeros((2, len(asked)), int)
        seen[free], closer[free] = whole_cloud.free_space_xyz(sweeps.xyz(o), planes, distance, 0.25)
        for share in (0.0, 0.1, 0.5, 0.9):
            allowed = evidence_kernels.free_space(
                sweeps.range_steps, sweeps.step_m, sweeps.beams, pairs, pairs.runs(),
                (area.range_m, area.height_m, edge_slope(fov_rad), road_z), 0.25, (share, False, False),
            )  # fmt: skip
            assert (allowed == ~free | (closer > share * seen)).all()
        assert (plausible(sweeps, at, asked)[free] == (closer > 0.1 * seen)[free]).all()


def test_free_space_by_hand():
    # One wall at 30 m. A box on the free road at 15 m is implausible: all returns through its middle come from the
    # wall. One behind the wall is plausible. Where nothing returns at all, a box is implausible.
    scene = Scene.from_footprints([[[(30, -20), (40, -20), (40, 20), (30, 20)]]], [0.0], [10.0])
    ghosts = Boxes.concat([car(15, 0), car(50, 0), car(0.5, 40)])
    o = np.zeros(3, int)
    assert plausible(exact(car(0, 0), [0], [0], scene), o, ghosts).tolist() == [False, True, True]
    assert not plausible(blind(), np.array([0]), car(15, 0, z=-0.98))[0]


def test_between_two_beams_a_sweep_says_nothing():
    """A VLP-16 without any return has beams at -1 and -3 degrees. Middles of people of 1.75 m are at -1.22 degrees at
    40 m and at -1.00 at 49 m. The pyramid is 0.36 degrees high at 40 m: no beam passes it. At 5 m, -9.7 degrees, it is
    2.9 degrees high. At 2 m the middle is at -23 degrees, below the lowest beam."""
    grid = beams(LidarParams(profile="vlp16"))
    empty = np.full((1, len(grid.azimuth_rad), len(grid.elevation_rad)), NO_RETURN, np.uint16)
    sweep = RangeImages(Poses(np.zeros((1, 3)), np.zeros(1)), np.arange(1), np.zeros(1), grid, 80.0, empty, FINEST_M)
    at = np.column_stack([[40.0, 49.0, 5.0, 2.0], np.zeros(4), np.full(4, 0.875 - 1.73)])
    o, people, gaps = np.zeros(4, int), boxes_at(at, (0.5, 0.5, 1.75)), AreaParams(gaps="unknown")
    assert plausible(sweep, o, people, area=gaps).tolist() == [True, False, False, True]
    below = AreaParams(gaps="below")
    assert plausible(sweep, o, people, area=below).tolist() == [False, False, False, True]
    assert not plausible(sweep, o, people).any()  # as in the paper's code

    rng = np.random.default_rng(3)
    at = rng.uniform(-45.0, 45.0, (2000, 3)) * [1.0, 1.0, 0.05]
    boxes = Boxes(at, rng.uniform(0.3, 3.0, (2000, 3)), rng.uniform(-np.pi, np.pi, 2000))
    asked = boxes.take(np.flatnonzero(applies_to(boxes, 2 * np.pi)))
    planes, distance = whole_cloud.frusta(asked.xyz_m, asked.lwh_m)
    across = grid.azimuth_rad[:, None] + 0 * grid.elevation_rad
    up = grid.elevation_rad + 0 * across
    rays = np.stack([np.cos(up) * np.cos(across), np.cos(up) * np.sin(across), np.sin(up)], axis=2).reshape(-1, 3)
    met, _ = whole_cloud.free_space_xyz(rays, planes, distance, 0.0)
    o = np.zeros(len(asked), int)
    x, y, z = asked.xyz_m.T
    is_below = z < np.hypot(x, y) * np.tan(grid.elevation_rad.min())
    found = plausible(sweep, o, asked, area=gaps)
    assert (found == is_below | (met == 0)).all() and 100 < found.sum() < len(asked) - 100
    found = plausible(sweep, o, asked, area=below)
    assert (found == is_below).all() and found.any()


def test_observability_by_hand():
    # A van stands right in front of the sensor and hides the pedestrian behind it, but not the car to the left.
    boxes = Boxes(
        np.array([[0, 0, 0.75], [8, 0, 1.1], [20, 0, 0.88], [20, 12, 0.75]]), SIZE_M[[0, 1, 6, 0]], np.zeros(4)
    )
    shape = np.array([0, 1, 6, 0], np.uint8)
    seen = observability(exact(boxes, shape, [0]), boxes, shape)
    assert (seen.observer.tolist(), seen.actor.tolist()) == ([0, 0, 0], [1, 2, 3])
    assert seen.occlusion.tolist() == [0.0, 1.0, 0.0] and seen.range_m[1] == pytest.approx(np.hypot(20, 0.85))


@settings(max_examples=8)
@given(seed=seeds, profile=st.sampled_from(["hdl64e_front", "vlp32c"]))
def test_unoccluded_returns_equal_casts_alone(seed, profile):
    rng = np.random.default_rng(seed)
    (boxes, shape), scene = random_boxes(rng, 15, 25.0), random_scene(rng)
    boxes = Boxes(boxes.xyz_m + np.array([0, 0, 3.0]), boxes.lwh_m, boxes.yaw_rad)
    sweeps = exact(boxes, shape, np.arange(5), scene, profile=profile)
    seen = observability(sweeps, boxes, shape)
    assert (np.diff(seen.observer * 15 + seen.actor) > 0).all()
    found = {}
    for o in range(5):
        for a in set(range(15)) - {o}:
            pair = boxes.take(np.array([o, a]))
            # Not even the road may hide anything: the observer grows 200 m high and its wheels stand far below.
            top = pair.xyz_m[0, 2] + pair.lwh_m[0, 2] / 2
            pair.xyz_m[0, 2], pair.lwh_m[0, 2] = top - 100.0, 200.0
            alone = exact(pair, shape[[o, a]], [0], profile=profile)
            n = int((alone.hit == Hit.ACTOR + 1).sum())
            if n:
                found[o, a] = (int((sweeps.hit[o] == Hit.ACTOR + a).sum()), n)
    assert found == {
        (o, a): (n, m) for o, a, n, m in zip(seen.observer, seen.actor, seen.n_returns, seen.n_unoccluded, strict=True)
    }
