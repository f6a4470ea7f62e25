"""A sweep that takes time: what moves is seen where it is when the sensor looks at it."""

from dataclasses import replace

import numpy as np
import pytest

from sensors import lidar
from sensors.boxes import Boxes
from sensors.evidence import observability, points_in_boxes
from sensors.lidar import LidarParams, SweepMemory, Sweeps, scan
from sensors.scene import Hit, Scene, Shape, prisms
from tests.sensors.town import blocks, random_boxes, traffic
from tests.slow import slow

SLACK_M = 0.01


def sweep(boxes, shape, observers, scene, speed_mps=None, **params) -> Sweeps:
    """A sweep without noise."""
    keys = np.arange(len(observers), dtype=np.uint64)
    table = LidarParams(range_sigma_m=0.0, **params)
    memory = SweepMemory(bodies=None if speed_mps is None else prisms(shape, boxes, speed_mps))
    return scan(boxes, shape, np.asarray(observers), scene, table, keys, memory, unrounded=True)


def later(boxes: Boxes, speed_mps, time_s: float) -> Boxes:
    """The boxes after a time, by constant speed along their headings."""
    along = np.column_stack([np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad), np.zeros(len(boxes))])
    return replace(boxes, xyz_m=boxes.xyz_m + (speed_mps * time_s)[:, None] * along)


def column_by_column(boxes, shape, observer, scene, speed_mps, rotation_hz, grid, own_mps=0.0):
    """Ranges and hits of one sensor by Embree: every column in a scene of its own, at the poses of its time.

    Unless `own_mps` is given, the sensor itself stays: a cloud is compensated for its motion.
    """
    speed_mps = np.where(np.arange(len(boxes)) == observer, own_mps, speed_mps)
    ranges, hits = [], []
    for c, azimuth in enumerate(lidar.beams(LidarParams(**grid)).azimuth_rad):
        moved = later(boxes, speed_mps, azimuth / (2.0 * np.pi * rotation_hz))
        seen = sweep(moved, shape, [observer], scene, engine="embree", **grid)
        ranges.append(seen.unrounded_m[0, c])
        hits.append(seen.hit[0, c])
    return np.array(ranges), np.array(hits)


@pytest.mark.parametrize(("fov_deg", "rotation_hz"), [slow(90.0, 2.0), (360.0, 10.0)])
@pytest.mark.parametrize("seed", [0, slow(1)])
def test_ranges_are_those_of_embree_column_by_column(seed, fov_deg, rotation_hz):
    rng = np.random.default_rng(seed)
    boxes, shape = traffic(rng, 60)
    scene, speed = blocks(rng), rng.uniform(0.0, 35.0, len(boxes))
    grid = {"profile": "vlp32c", "n_azimuths": 120, "fov_deg": fov_deg}
    n_moved = n_rays = n_off = 0
    for observer in np.flatnonzero(shape == Shape.CAR)[: 4 if seed or fov_deg < 360.0 else 2]:
        mine = sweep(boxes, shape, [observer], scene, speed, rotation_hz=rotation_hz, **grid)
        still = sweep(boxes, shape, [observer], scene, **grid)
        ranges, hits = column_by_column(boxes, shape, observer, scene, speed, rotation_hz, grid)
        same = mine.hit[0] == hits
        n_off += int((~same).sum())
        n_rays += same.size
        both = same & np.isfinite(ranges)
        assert np.abs(mine.unrounded_m[0][both] - ranges[both]).max() <= SLACK_M
        n_moved += int((mine.hit[0] != still.hit[0]).sum())
    assert n_moved > 5, "the scene shows no motion"
    assert n_off <= 2e-3 * n_rays, "rays that graze an edge"


@pytest.mark.verify
def test_the_place_from_which_is_seen():
    """A sensor that also moves sees actors by a little more or less: how much the compensated pose leaves out."""
    rng = np.random.default_rng(2)
    boxes, shape = traffic(rng, 60)
    scene, speed = blocks(rng), rng.uniform(0.0, 14.0, len(boxes))
    grid = {"profile": "vlp32c", "n_azimuths": 360, "fov_deg": 360.0}
    counts = []
    for observer in np.flatnonzero(shape == Shape.CAR)[:4]:
        mine = sweep(boxes, shape, [observer], scene, speed, rotation_hz=10.0, **grid)
        _, hits = column_by_column(boxes, shape, observer, scene, speed, 10.0, grid, own_mps=14.0)
        n = len(boxes) + Hit.ACTOR
        counts.append(np.column_stack([np.bincount(h.ravel(), minlength=n)[Hit.ACTOR :] for h in (hits, mine.hit[0])]))
    true, found = np.concatenate(counts).T
    seen = true >= 10
    error = np.abs(found - true)[seen] / true[seen]
    print(f"{seen.sum()} actors, error of returns: median {np.median(error):.1%}, 90 %: {np.quantile(error, 0.9):.1%}")
    assert np.median(error) < 0.1


def passing(speed_mps: float, **params) -> tuple[Sweeps, Boxes]:
    """A sensor at the origin that looks east, and a car that passes 10 m to its left in the same direction."""
    boxes = Boxes(
        np.array([[0.0, 0.0, 0.75], [0.0, 10.0, 0.75]]), np.array([[4.4, 1.8, 1.5], [4.0, 2.0, 1.5]]), np.zeros(2)
    )
    shape = np.array([Shape.PEDESTRIAN, Shape.BUS], np.uint8)
    speed = np.array([0.0, speed_mps])
    return sweep(boxes, shape, [0], Scene.empty(), speed, profile="hdl64e", **params), boxes


def test_a_vehicle_that_passes_at_20_m_s_by_hand():
    moving, boxes = passing(20.0, rotation_hz=10.0)
    still, _ = passing(20.0)
    ends = []
    for seen in (still, moving):
        column, row = np.nonzero(seen.hit[0] == seen.hit[0].max())
        points = seen.points(np.zeros(len(column), int), column, row)
        near = np.abs(points[:, 1] - 9.0) < 0.05  # its right side
        ends.append((points[near, 0].min(), points[near, 0].max()))
    # The rear end is at azimuth a with tan a = 9 / x, when it is at x = -2 + 20 a / (2 pi 10); the front alike.
    for end, found in zip((-2.0, 2.0), ends[1], strict=True):
        x = end
        for _ in range(50):
            x = end + 20.0 * np.arctan2(9.0, x) / (2.0 * np.pi * 10.0)
        assert abs(found - x) < 0.06  # columns are 3 cm apart there, and a body ends a few centimetres inside its box
    # The sensor turns towards the rear while the car drives forward: it is seen shorter, and half a metre ahead.
    assert 0.45 < np.mean(ends[1]) - np.mean(ends[0]) < 0.55
    assert (ends[1][1] - ends[1][0]) < (ends[0][1] - ends[0][0])
    assert np.allclose(moving.moved_m(np.array([0]), boxes, np.array([1])), [[20.0 * 0.025, 0.0, 0.0]])


def test_a_box_with_a_velocity_is_asked_about_where_the_sensor_sees_it():
    """The car of above, at 40 m/s: a quarter of a turn, 0.025 s, after the sweep begins it is 1 m ahead. With its
    velocity, all returns of its side lie in its box. Without, a quarter of the side is outside, and the free space
    through which it came is in it. A box that follows 2 m behind the car is empty either way."""
    seen, boxes = passing(40.0, rotation_hz=10.0)
    n_hits = int((seen.hit[0] == seen.hit[0].max()).sum())
    longer = replace(boxes, lwh_m=boxes.lwh_m + [0.1, 0.1, 0.0]).take(np.array([1, 1]))
    behind = replace(longer, xyz_m=longer.xyz_m - [[0.0, 0.0, -0.05], [6.2, 0.0, -0.05]])  # above the road
    o, velocity = np.zeros(2, int), np.array([[40.0, 0.0], [40.0, 0.0]])
    with_velocity = points_in_boxes(seen, o, behind, velocity_mps=velocity)
    without = points_in_boxes(seen, o, behind)
    assert with_velocity[0] == pytest.approx(n_hits, rel=0.06) and with_velocity[1] == without[1] == 0
    assert 0.6 * n_hits < without[0] < 0.85 * n_hits


def test_without_motion_or_time_it_is_a_sweep_of_one_instant():
    boxes, shape = random_boxes(np.random.default_rng(3), 25)
    scene = blocks(np.random.default_rng(4))
    one = sweep(boxes, shape, np.arange(25), scene)
    for other in (
        sweep(boxes, shape, np.arange(25), scene, np.zeros(25), rotation_hz=10.0),
        sweep(boxes, shape, np.arange(25), scene, np.full(25, 30.0)),
    ):
        assert np.array_equal(one.hit, other.hit) and np.array_equal(one.range_steps, other.range_steps)


def test_what_could_be_seen_moves_with_what_is_seen():
    rng = np.random.default_rng(5)
    boxes, shape = traffic(rng, 40)
    speed = rng.uniform(5.0, 35.0, len(boxes))
    seen = sweep(boxes, shape, np.arange(10), Scene.empty(), speed, profile="vlp32c", rotation_hz=10.0)
    found = observability(seen, boxes, shape)
    alone = []
    for o, a in zip(found.observer, found.actor, strict=True):
        two = boxes.take(np.array([o, a]))
        one = sweep(two, shape[[o, a]], [0], Scene.empty(), speed[[o, a]], profile="vlp32c", rotation_hz=10.0)
        alone.append(int((one.hit[0] == one.hit[0].max()).sum()) if one.hit[0].max() >= 3 else 0)
    hidden_by_road = np.asarray(alone) < found.n_unoccluded  # the road hides nothing in the count
    assert (np.asarray(alone) <= found.n_unoccluded).all()
    assert hidden_by_road.mean() < 0.05
    assert (found.n_returns <= found.n_unoccluded).all()


def test_a_sweep_that_takes_time_needs_speeds():
    boxes, shape = random_boxes(np.random.default_rng(3), 5)
    with pytest.raises(ValueError, match="needs the speed of every actor"):
        sweep(boxes, shape, [0], Scene.empty(), rotation_hz=10.0)
    with pytest.raises(ValueError, match="4 speeds were given for 5 boxes"):
        sweep(boxes, shape, [0], Scene.empty(), np.zeros(4), rotation_hz=10.0)


def test_other_ray_casters_refuse():
    with pytest.raises(ValueError, match=r"lidar\.rotation_hz = 10 needs lidar\.engine"):
        lidar.beams(LidarParams(rotation_hz=10.0, engine="embree"))
    off = lidar.beams(LidarParams(rotation_hz="off", engine="embree"))
    assert off.s_per_rad == lidar.beams(LidarParams()).s_per_rad == 0.0
