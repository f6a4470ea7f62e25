"""The sweep: ranges worked out by hand, noise that is a function of keys, and bad input."""

import numpy as np
import pytest

from sensors.boxes import Boxes
from sensors.lidar import PROFILES, LidarParams, beams, mount, scan
from sensors.range_noise import RangeNoise, add_noise
from sensors.scene import Hit, Scene
from tests.sensors.town import blocks, boxes_at, car, exact, traffic
from tests.slow import slow

CAR, BUS = 0, 3
LEVEL = {"elevation_deg": (-10.0, 0.0, 10.0), "n_azimuths": 1, "fov_deg": 1.0}


def test_road_wall_and_roof_by_hand():
    # Sensor at 1.5 + 0.23 = 1.73 m. Road at -10 degrees: 1.73 / sin 10 = 9.963 m. A wall at 20 m: 20 m level and
    # 20 / cos 10 = 20.309 m at +10 degrees, if it is at least 1.73 + 20 tan 10 = 5.26 m high.
    high = Scene.from_footprints([[[(20, -5), (30, -5), (30, 5), (20, 5)]]], [0.0], [5.5])
    low = Scene.from_footprints([[[(20, -5), (30, -5), (30, 5), (20, 5)]]], [0.0], [5.0])
    sine, cosine = np.sin(np.radians(10)), np.cos(np.radians(10))
    sweep = exact(car(0, 0), [CAR], [0], high, **LEVEL)
    assert sweep.unrounded_m[0, 0] == pytest.approx([1.73 / sine, 20, 20 / cosine], rel=1e-6)
    assert sweep.hit[0, 0].tolist() == [Hit.GROUND, Hit.BUILDING, Hit.BUILDING]
    assert exact(car(0, 0), [CAR], [0], low, **LEVEL).hit[0, 0].tolist() == [Hit.GROUND, Hit.BUILDING, Hit.NOTHING]
    # From 12 m the beam at -10 degrees meets the roof of 5 m after 7 / sin 10 = 40.31 m, 39.7 m out: past the roof,
    # which ends at 30 m; that of 8 m after 4 / sin 10 = 23.04 m, 22.69 m out: on it.
    for top, hit, distance in ((5.0, Hit.GROUND, 12 / sine), (8.0, Hit.BUILDING, 4 / sine)):
        scene = Scene.from_footprints([[[(20, -5), (30, -5), (30, 5), (20, 5)]]], [0.0], [top])
        sweep = exact(car(0, 0), [CAR], [0], scene, mount_above_roof_m=10.5, **LEVEL)
        assert (sweep.hit[0, 0, 0], sweep.unrounded_m[0, 0, 0]) == (hit, pytest.approx(distance, rel=1e-6))


def test_actor_by_hand():
    # A bus (12 m long, body 0.495 of it to the rear) 30 m ahead: its rear face stands at 30 - 5.94 = 24.06 m.
    boxes = Boxes.concat([car(0, 0), boxes_at((30, 0, 1.6), (12, 2.55, 3.2))])
    sweep = exact(boxes, [CAR, BUS], [0], **LEVEL)
    assert sweep.hit[0, 0].tolist() == [Hit.GROUND, Hit.ACTOR + 1, Hit.NOTHING]
    assert sweep.unrounded_m[0, 0, 1] == pytest.approx(24.06, rel=1e-6)
    assert sweep.xyz(0) == pytest.approx(np.array([[1.73 / np.tan(np.radians(10)), 0, -1.73], [24.06, 0, 0]]), abs=1e-3)
    world = sweep.poses.to_world(0, sweep.xyz(0))
    assert world[1] == pytest.approx([24.06, 0, 1.73], abs=1e-3)


def test_own_body_is_transparent():
    sweep = exact(car(0, 0), [CAR], [0], profile="hdl64e")
    assert (sweep.hit <= Hit.GROUND).all()
    assert not np.isfinite(sweep.unrounded_m[sweep.hit == Hit.NOTHING]).any()
    assert np.isfinite(sweep.unrounded_m[sweep.hit == Hit.GROUND]).all()


@pytest.mark.parametrize("profile", PROFILES)
def test_profiles(profile):
    grid = beams(LidarParams(profile=profile))
    count = {"hdl64e_front": 64, "hdl64e": 64, "vlp16": 16, "vlp32c": 32, "os1_64": 64, "os1_128": 128, "pandar64": 64}
    assert len(grid.elevation_rad) == count[profile]
    assert np.diff(grid.azimuth_rad) == pytest.approx(grid.fov_rad / len(grid.azimuth_rad))
    assert grid.azimuth_rad[0] == pytest.approx(-grid.azimuth_rad[-1])


def test_noise_is_a_function_of_key_and_ray():
    rng = np.random.default_rng(0)
    (boxes, shape), scene = traffic(rng, 60), blocks(rng)
    observers = np.flatnonzero(shape == CAR)
    keys = rng.integers(0, 2**63, len(observers)).astype(np.uint64)
    params = LidarParams(dropout_p=0.1)
    clean = exact(boxes, shape, observers, scene)
    noisy = scan(boxes, shape, observers, scene, params, keys, unrounded=True)
    kept = np.isfinite(noisy.unrounded_m)
    returned = np.isfinite(clean.unrounded_m)
    assert 1 - kept.sum() / returned.sum() == pytest.approx(0.1, abs=0.002)
    assert (noisy.hit[returned & ~kept] == Hit.NOTHING).all() and (noisy.hit[kept] == clean.hit[kept]).all()
    error = noisy.unrounded_m[kept] - clean.unrounded_m[kept].astype(float)
    assert error.mean() == pytest.approx(0, abs=2e-4) and error.std() == pytest.approx(0.02, rel=0.01)
    assert np.mean(np.abs(error) < 0.02) == pytest.approx(0.683, abs=0.005)
    # fewer observers, in another order: the same sweeps
    some = rng.permutation(len(observers))[:5]
    again = scan(boxes, shape, observers[some], scene, params, keys[some], unrounded=True)
    assert (again.unrounded_m == noisy.unrounded_m[some]).all() and (again.hit == noisy.hit[some]).all()
    # written over an earlier result: the same
    reused = scan(
        boxes, shape, observers, scene, params, keys, exact(boxes, shape, observers[::-1].copy(), scene), unrounded=True
    )
    assert (reused.unrounded_m == noisy.unrounded_m).all()


@pytest.mark.parametrize("rows", [64, 30])
def test_noise_of_every_ray_by_hand(rows):
    mask = 2**64 - 1

    def splitmix(x):
        x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 & mask
        x = (x ^ (x >> 27)) * 0x94D049BB133111EB & mask
        return x ^ (x >> 31)

    key, golden, sigma = 2**63 + 12345, 0x9E3779B97F4A7C15, np.float32(0.02)
    noise = RangeNoise.of(np.array([key], np.uint64), 0.02, 0.0)
    ranges, hits = np.full((6, rows), 20.0, np.float32), np.zeros((6, rows), np.int16)
    add_noise(ranges, hits, noise.key[0], noise)
    seed, words = splitmix((key + golden) & mask), -(-rows // 4)
    for c in range(6):
        for r in range(rows):
            drawn = splitmix((seed + (c * words + r // 4) * golden) & mask) >> 16 * (r % 4) & 0xFFFF
            assert ranges[c, r] == np.float32(20.0) + sigma * noise.level[drawn >> 4]


def test_noise_of_neighbouring_rays_is_independent():
    noise = RangeNoise.of(np.arange(1, dtype=np.uint64), 1.0, 0.0)
    ranges, hits = np.full((4000, 64), 100.0, np.float32), np.zeros((4000, 64), np.int16)
    add_noise(ranges, hits, noise.key[0], noise)
    z = ranges.astype(float) - 100.0
    for columns, rows in [(0, 1), (0, 2), (0, 3), (0, 4), (1, 0), (1, 1)]:
        a, b = z[: len(z) - columns, : 64 - rows], z[columns:, rows:]
        for f in (lambda x: x, np.square, np.abs):
            assert abs(np.corrcoef(f(a).ravel(), f(b).ravel())[0, 1]) < 4.5 / np.sqrt(a.size)


def test_noise_never_makes_a_range_negative():
    boxes = Boxes(np.array([[0, 0, 0.75], [0, 0, 1.6]]), np.array([[4.4, 1.8, 1.5], [8, 0.06, 3.2]]), np.zeros(2))
    params = LidarParams(profile="vlp16", range_sigma_m=0.05)  # inside a body 6 cm wide
    sweep = scan(boxes, np.array([0, BUS], np.uint8), np.array([0]), Scene.empty(), params, np.zeros(1, np.uint64))
    assert sweep.range_steps.min() == 0


@pytest.mark.parametrize(
    ("max_range_m", "step_m"),
    [
        (80.0, 1 / 512),
        slow(1000.0, 1 / 64),
        slow(127.0, 1 / 512),
        slow(200.0, 1 / 256),
    ],
)
def test_reported_ranges_are_the_nearest_whole_steps(max_range_m, step_m):
    rng = np.random.default_rng(3)
    (boxes, shape), scene = traffic(rng, 40), blocks(rng)
    keys = np.arange(10, dtype=np.uint64)
    sweep = scan(
        boxes, shape, np.arange(10), scene, LidarParams(max_range_m=max_range_m, dropout_p=0.1), keys, unrounded=True
    )
    returned = np.isfinite(sweep.unrounded_m)
    assert sweep.step_m == step_m and 0.1 < returned.mean() < 0.9
    assert (returned == (sweep.range_steps != 65535)).all()
    assert np.abs(sweep.range_steps[returned] * step_m - sweep.unrounded_m[returned]).max() <= 0.5 * step_m
    assert (sweep.range_m[returned] == sweep.range_steps[returned] * step_m).all()
    assert np.isinf(sweep.range_m[~returned]).all()
    for o in (0, 9):
        xyz = sweep.xyz(o)
        assert (sweep.has_return(o) == returned[o]).all()
        assert np.linalg.norm(xyz, axis=1) == pytest.approx(sweep.unrounded_m[o][returned[o]], abs=0.51 * step_m)
        assert sweep.cloud(o) == pytest.approx(xyz, rel=1e-6, abs=1e-4)


def test_memory_is_reused_as_the_fleet_changes():
    boxes, shape = traffic(np.random.default_rng(0), 40)
    first = exact(boxes, shape, np.arange(16))
    keys, clean = np.arange(18, dtype=np.uint64), LidarParams(range_sigma_m=0.0)
    for n in (9, 18, 16):
        fresh = exact(boxes, shape, np.arange(n))
        again = scan(boxes, shape, np.arange(n), Scene.empty(), clean, keys[:n], out=first)
        assert np.shares_memory(again.range_steps, first.range_steps)
        assert (again.range_steps == fresh.range_steps).all()
        assert (again.hit == fresh.hit).all()
        first = again
    other = LidarParams(range_sigma_m=0.0, profile="vlp16")
    assert scan(boxes, shape, np.arange(9), Scene.empty(), other, keys[:9], out=first).range_steps.shape == (
        9,
        1800,
        16,
    )


def test_mount_and_frames():
    boxes = car(10, 20, yaw=np.pi / 2)
    poses = mount(boxes, np.array([0]), LidarParams())
    assert poses.origin_m[0] == pytest.approx([10, 20, 1.73])
    seen = poses.to_sensor(np.array([0]), car(10, 30, yaw=np.pi))  # 10 m ahead, heading to the left
    assert seen.xyz_m[0] == pytest.approx([10, 0, 0.75 - 1.73]) and seen.yaw_rad[0] == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(
    ("params", "says"),
    [
        ({"elevation_deg": (2.0, 1.0)}, "ascending"),
        ({"elevation_deg": (1.0, 1.0)}, "ascending"),
        ({"elevation_deg": (0.0, 90.0)}, "ascending"),
        ({"elevation_deg": ()}, "ascending"),
        ({"fov_deg": 400.0}, "fov_deg"),
    ],
)
def test_invalid_lidars_are_refused(params, says):
    with pytest.raises(ValueError, match=says):
        exact(car(0, 0), [CAR], [0], **params)


def test_invalid_calls_are_refused():
    with pytest.raises(ValueError, match="rows"):
        exact(car(0, 0), [CAR], [1])
    with pytest.raises(ValueError, match="keys"):
        scan(car(0, 0), np.zeros(1, np.uint8), np.array([0]), Scene.empty(), LidarParams(), np.zeros(2, np.uint64))
