"""False positives: their number, their sites, and their persistence against the closed form."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from cosim.base.threads import n_threads, use_threads
from sensors.evidence import observability
from sensors.false_positives import CELL_M, COLUMN_STEP, ROW_STEP, false_positives
from sensors.scene import Hit, Scene
from sensors.statistical_detector import DetectorParams, resolved
from tests.sensors.town import blocks, car, draws_of, exact, traffic
from tests.slow import slow

FRONT = Scene.from_footprints([[np.array([(-60.0, 8.5), (60, 8.5), (60, 20), (-60, 20)])]], [-0.1], [12.0])
"""A wall along x, 8.5 m to the left of an observer at the origin that faces +x, inside its cells."""


def model(**words):
    return resolved(DetectorParams(**words))


@pytest.fixture(scope="module")
def street():
    rng = np.random.default_rng(3)
    boxes, shape = traffic(rng, 250)
    sweeps = exact(boxes, shape, np.flatnonzero(shape == 0), blocks(rng), profile="vlp32c", n_azimuths=450)
    return sweeps, observability(sweeps, boxes, shape), len(boxes)


def drawn(street, seed):
    """Sweeps, observability and draws of the street."""
    sweeps, seen, n_actors = street
    return sweeps, seen, draws_of(np.random.default_rng(seed), len(sweeps.observers), n_actors)


@pytest.fixture(scope="module")
def queue():
    """Twenty sensors at one point, beside a wall."""
    one, shape = car(0, 0), np.zeros(1, np.uint8)
    sweeps = exact(one, shape, [0], FRONT, profile="vlp16", n_azimuths=180)
    n = 20
    poses = replace(
        sweeps.poses, origin_m=np.tile(sweeps.poses.origin_m, (n, 1)), yaw_rad=np.tile(sweeps.poses.yaw_rad, n)
    )
    sweeps = replace(
        sweeps, poses=poses, observers=np.zeros(n, int), ground_m=np.tile(sweeps.ground_m, n),
        range_steps=np.tile(sweeps.range_steps, (n, 1, 1)), hit=np.tile(sweeps.hit, (n, 1, 1)),
    )  # fmt: skip
    return sweeps, observability(sweeps, one, shape), 1


def probabilities(sweeps, o, per_sweep, road_p) -> np.ndarray:
    """Probability of every aspect in sweep o, counted ray by ray; there are no hidden actors."""
    walls, roads = Counter(), Counter()
    for c in range(0, sweeps.hit.shape[1], COLUMN_STEP):
        for r in range(0, sweeps.hit.shape[2], ROW_STEP):
            code = sweeps.hit[o, c, r]
            if code in (Hit.GROUND, Hit.BUILDING):
                point = sweeps.points(np.array([o]), np.array([c]), np.array([r]))
                x, y, _ = sweeps.poses.to_world(o, point)[0]
                (roads if code == Hit.GROUND else walls)[int(np.floor(x / CELL_M)), int(np.floor(y / CELL_M))] += 1
    n_walls, n_all = walls.total(), walls.total() + roads.total()
    p = [n * ((1 - road_p) / n_walls + road_p / n_all) for n in walls.values()]
    return per_sweep * np.array(p + [n * road_p / n_all for n in roads.values()])


@pytest.mark.parametrize("words", [{}, {"false_positive_memory_share": 0.0}, {"false_positive_memory_share": 1.0}])
def test_mean_number_per_sweep(street, words):
    # 100 independent steps of about 90 sensors: four standard errors are below a tenth.
    sweeps, seen, n_actors = street
    rng = np.random.default_rng(0)
    hits = (sweeps.hit == Hit.BUILDING).any(axis=(1, 2))
    runs = [false_positives(sweeps, seen, draws_of(rng, len(hits), n_actors), model(**words)) for _ in range(100)]
    per_sweep = np.array([hits[run.observer].sum() / hits.sum() for run in runs])
    error = per_sweep.std() / np.sqrt(len(runs))
    assert error < 0.025 * 0.5 and abs(per_sweep.mean() - 0.5) < 4 * error


def test_score_and_class_distributions(street):
    sweeps, seen, n_actors = street
    rng, stated, n = np.random.default_rng(1), model(false_positive_memory_share=0.7), len(sweeps.observers)
    runs = [false_positives(sweeps, seen, draws_of(rng, n, n_actors), stated) for _ in range(150)]
    label, score = (np.concatenate([getattr(run, name) for run in runs]) for name in ("label", "score"))
    logit = np.log(score / (1 - score))
    assert logit.mean() == pytest.approx(stated.false_positive_logit, abs=0.06)
    assert logit.std() == pytest.approx(stated.false_positive_sigma, rel=0.04)
    assert np.bincount(label, minlength=4) / len(label) == pytest.approx(stated.false_positive_mix, abs=0.05)


@pytest.mark.parametrize(("share", "shared"), [(0.6, 0.5), slow(1.0, 0.0), slow(0.9, 1.0)])
def test_temporal_and_common_covariance_follow_the_closed_form(queue, share, shared):
    sweeps, seen, _ = queue
    rate, memory_s, n = 3.0, 4.0, len(sweeps.observers)
    stated = model(
        false_positive_per_sweep=rate,
        false_positive_memory_s=memory_s,
        false_positive_memory_share=share,
        false_positive_shared=shared,
    )
    q = 1.0 - probabilities(sweeps, 0, rate, stated.false_positive_road_p)
    assert 1.0 - q.min() > 0.05 and (1.0 - q).sum() == pytest.approx(rate)
    common, own, fresh = share * shared, share * (1 - shared), 1 - share

    def covariance(lag_s):  # of the number of false boxes of one sensor, now and later
        same = np.exp(-lag_s / memory_s)
        neither = q ** (2 * fresh) * np.prod([same * q**s + (1 - same) * q ** (2 * s) for s in (common, own)], axis=0)
        return (neither - q**2).sum()

    def count(draws):
        return np.bincount(false_positives(sweeps, seen, draws, stated).observer, minlength=n)

    rng, lags_s, times = np.random.default_rng(2), (0.5, 4.0, 12.0), 300
    later, beside = np.zeros((times, len(lags_s))), np.zeros(times)
    for k in range(times):
        draws = draws_of(rng, n, 1, time_s=100.0)
        now = count(draws) - rate
        beside[k] = (now.sum() ** 2 - (now**2).sum()) / (n * (n - 1))
        for j, lag_s in enumerate(lags_s):
            fresh_keys = rng.integers(0, 2**64, n, np.uint64)
            later[k, j] = np.mean(now * (count(replace(draws, time_s=100.0 + lag_s, site_step=fresh_keys)) - rate))
    for j, lag_s in enumerate(lags_s):
        error = later[:, j].std() / np.sqrt(len(later))
        assert error < 0.25 and abs(later[:, j].mean() - covariance(lag_s)) < 4 * error, lag_s
    # Two sensors at one point and one moment have the common part and nothing else in common.
    error = beside.std() / np.sqrt(len(beside))
    assert error < 0.25 and abs(beside.mean() - (q ** (2 - common) - q**2).sum()) < 4 * error + 1e-12


def test_persistent_false_positives_do_not_move(street):
    sweeps, seen, draws = drawn(street, 4)
    stated = model(false_positive_per_sweep=2.0, false_positive_memory_share=1.0, false_positive_memory_s=1e6)
    one, other = (false_positives(sweeps, seen, replace(draws, time_s=t), stated) for t in (7.0, 17.0))
    assert len(one.boxes) > 100
    assert (one.boxes.xyz_m == other.boxes.xyz_m).all() and (one.boxes.yaw_rad == other.boxes.yaw_rad).all()
    assert all((getattr(one, name) == getattr(other, name)).all() for name in ("observer", "label", "score"))


@pytest.mark.parametrize(("shared", "low", "high"), [(1.0, 0.5, 1.0), (0.0, 0.0, 0.2)])
def test_shared_false_positives_of_two_passing_observers(shared, low, high):
    # A car, and another 3 m ahead of it: how many of one's false boxes have one of the other's within half a metre.
    # Not all: shares of the returns differ, and where they are larger there is more.
    boxes, shape = car(0, 0), np.zeros(1, np.uint8)
    stated = model(
        false_positive_per_sweep=3.0,
        false_positive_memory_share=1.0,
        false_positive_shared=shared,
        false_positive_mix=(0, 1, 0, 0),
    )
    views = [exact(car(x, 0), shape, [0], FRONT, profile="vlp32c", n_azimuths=900) for x in (0, 3)]
    seen = [observability(sweeps, boxes, shape) for sweeps in views]
    rng, near = np.random.default_rng(5), []
    for _ in range(100):
        draws = draws_of(rng, 1, 1)
        other = replace(draws, site_observer=draws.site_observer + np.uint64(1))
        here, there = (
            false_positives(sweeps, sight, keys, stated).boxes.xyz_m[:, :2]
            for sweeps, sight, keys in zip(views, seen, (draws, other), strict=True)
        )
        apart = np.linalg.norm(here[:, None] - there[None], axis=2)
        near.append(apart.min(axis=1, initial=np.inf) < 0.5)
    assert low <= np.concatenate(near).mean() <= high


def test_invariance_to_order_other_observers_and_threads(street):
    sweeps, seen, draws = drawn(street, 6)
    whole = false_positives(sweeps, seen, draws, model(false_positive_per_sweep=3.0))
    threads = n_threads()
    use_threads(1)
    alone = false_positives(sweeps, seen, draws, model(false_positive_per_sweep=3.0))
    use_threads(threads)
    assert (whole.boxes.xyz_m == alone.boxes.xyz_m).all() and (whole.score == alone.score).all()
    few = np.array([11, 4, 30, 2, 50, 41, 17, 60])
    poses = replace(sweeps.poses, origin_m=sweeps.poses.origin_m[few], yaw_rad=sweeps.poses.yaw_rad[few])
    some = replace(
        sweeps, range_steps=sweeps.range_steps[few], hit=sweeps.hit[few], poses=poses, observers=sweeps.observers[few],
        ground_m=sweeps.ground_m[few],
    )  # fmt: skip
    rows = np.concatenate([np.flatnonzero(seen.observer == o) for o in few])
    theirs = type(seen)(
        np.repeat(np.arange(len(few), dtype=np.int32), [(seen.observer == o).sum() for o in few]),
        *(getattr(seen, name)[rows] for name in ("actor", "n_returns", "n_unoccluded", "range_m")),
    )
    keys = replace(draws, site_observer=draws.site_observer[few], site_step=draws.site_step[few])
    again = false_positives(some, theirs, keys, model(false_positive_per_sweep=3.0))
    expected = np.concatenate([np.flatnonzero(whole.observer == o) for o in few])
    assert len(expected) > 3
    assert (again.boxes.xyz_m == whole.boxes.xyz_m[expected]).all() and (again.score == whole.score[expected]).all()


def test_more_than_the_initial_capacity(street):
    sweeps, seen, draws = drawn(street, 7)
    n = np.bincount(false_positives(sweeps, seen, draws, model(false_positive_per_sweep=40.0)).observer)
    assert n.max() > 25


def test_sites_are_walls_road_and_hidden_actors(street):
    sweeps, seen, draws = drawn(street, 1)
    found = false_positives(sweeps, seen, draws, model(false_positive_per_sweep=8.0))
    o_of, boxes = found.observer, found.boxes
    assert len(o_of) > 5 * len(sweeps.observers)
    hidden = {
        (o, a) for o, a, occlusion in zip(seen.observer, seen.actor, seen.occlusion, strict=True) if occlusion > 0.8
    }
    for k in range(0, len(o_of), 3):
        o, reach = o_of[k], 0.51 * np.hypot(*boxes.lwh_m[k, :2])
        world = sweeps.poses.to_world(o, sweeps.xyz(o))
        hits = sweeps.hit[o][sweeps.has_return(o)]
        close = np.linalg.norm(world[:, :2] - boxes.xyz_m[k, :2], axis=1) < reach
        assert any(h in (Hit.GROUND, Hit.BUILDING) or (o, h - Hit.ACTOR) in hidden for h in hits[close])


def test_false_cars_at_a_wall_lie_along_it():
    # Boxes at the front head east or west, with their side at the wall or before it.
    sweeps = exact(car(0, 0), [0], [0], FRONT, profile="os1_64")
    seen = observability(sweeps, car(0, 0), np.zeros(1, np.uint8))
    draws = draws_of(np.random.default_rng(0), 1, 1)
    stated = model(false_positive_per_sweep=12.0, false_positive_mix=(1.0, 0.0, 0.0, 0.0), false_positive_road_p=0.0)
    boxes = false_positives(sweeps, seen, draws, stated).boxes
    assert len(boxes) > 5
    # where the next ray meets the road just before the wall, the heading is a little off
    # ranges are rounded to 2 mm, and headings are those from one ray to the fourth beside it
    assert np.median(np.abs(np.sin(boxes.yaw_rad))) < 2e-3 and (np.abs(np.sin(boxes.yaw_rad)) < 0.1).all()
    near = np.abs(boxes.xyz_m[:, 0]) < 20
    assert (boxes.xyz_m[near, 1] + boxes.lwh_m[near, 1] / 2 < 8.8).all() and near.sum() > 3
