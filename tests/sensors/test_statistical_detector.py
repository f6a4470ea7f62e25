"""The statistical detector: exact boxes for draws of zero, and the distributions that its parameters state."""

from dataclasses import fields, replace

import numpy as np
import pytest

from cosim.base.hash_rng import normals, persistent_normals
from cosim.base.plane import wrapped
from sensors.boxes import iou_3d
from sensors.detector import detect
from sensors.evidence import Observability
from sensors.statistical_detector import (
    N_DRAWS,
    DetectorParams,
    StatisticalDetector,
    detection_p,
    pair_normals,
    reports_of_actors,
    resolved,
    uniform_of,
)
from tests.sensors.town import boxes_at, draws_of
from tests.slow import slow

PUBLISHED = ("avod", "pointpillars", "pv_rcnn")
SOUND = {
    "flip_p": 0.0, "duplicate_p": 0.0, "confusion_p": ((0.0,) * 4,) * 4,
}  # fmt: skip


def run_once(street, params: DetectorParams, rng):
    """One step of the detector with new draws."""
    sweeps, _, boxes, _ = street
    return detect(StatisticalDetector(params), *street, draws_of(rng, len(sweeps.observers), len(boxes)))


@pytest.mark.parametrize("name", PUBLISHED)
def test_zero_draws_give_exact_boxes(street, name):
    sweeps, seen, boxes, label = street
    z = np.zeros((len(seen.actor), N_DRAWS))
    found = reports_of_actors(seen, boxes, label, sweeps.poses.origin_m, z, resolved(DetectorParams(model=name)))
    visible = seen.n_returns > 0
    assert (found.observer == seen.observer[visible]).all() and (found.actor == seen.actor[visible]).all()
    assert not found.is_false_positive.any() and (found.label == label[found.actor]).all()
    assert iou_3d(found.boxes, boxes.take(found.actor)) == pytest.approx(np.ones(len(found.observer)))


def test_uniform_of_a_normal_is_uniform_and_continuous():
    z = np.random.default_rng(0).normal(size=100_000)
    assert uniform_of(np.zeros(1)) == 0.0 and uniform_of(np.array([-40.0, 40.0])).max() < 1.0
    assert np.histogram(uniform_of(z), 10, (0, 1))[0] == pytest.approx(10_000, abs=500)
    assert np.abs(np.diff(uniform_of(np.linspace(-4, 4, 10_001)))).max() < 1e-3


@pytest.mark.parametrize("name", [slow("avod"), slow("pointpillars"), "pv_rcnn"])
def test_detection_probability_and_scores(street, name):
    _, seen, boxes, label = street
    rng, params = np.random.default_rng(0), DetectorParams(model=name, min_score=0.0, **SOUND)
    model = resolved(params)
    runs = [run_once(street, params, rng) for _ in range(60)]
    expected = detection_p(seen.n_returns, seen.occlusion, label[seen.actor], model)
    count = sum((~run.is_false_positive).sum() for run in runs) / 60
    assert count == pytest.approx(expected.sum(), abs=4 * np.sqrt((expected * (1 - expected)).sum() / 60) + 1)
    real = np.concatenate([run.score[~run.is_false_positive] for run in runs])
    false = np.concatenate([run.score[run.is_false_positive] for run in runs])
    assert real.mean() > 0.5 > 0.35 > false.mean()
    turn = np.concatenate(
        [wrapped(run.boxes.yaw_rad - boxes.yaw_rad[run.actor])[~run.is_false_positive] for run in runs]
    )
    assert abs(turn.mean()) < 0.02 and turn.max() < np.pi


def test_error_distributions():
    # One car with 400 returns at 20 m, 20,000 times: sigma of x is 0.1 + 20 * 0.001 + 2 / sqrt(400) = 0.22 m.
    n = 20_000
    street = alone(n, 400, 20.0)
    params = DetectorParams(
        found_max_p=(1.0,) * 4, half_returns=(1e-9,) * 4, xy_sigma_m=(0.1,) * 4, xy_sigma_per_m=0.001,
        xy_sigma_sparse_m=(2.0,) * 4, z_share=0.5, size_sigma=(0.05,) * 4, size_sigma_sparse=(0.4,) * 4,
        yaw_sigma_rad=(0.03,) * 4, yaw_sigma_sparse_rad=0.4, **SOUND,
    )  # fmt: skip
    z = np.random.default_rng(1).normal(size=(n, N_DRAWS))
    found = reports_of_actors(*street, np.zeros((n, 3)), z, resolved(params))
    assert len(found.observer) == n
    true = street[1].take(found.actor)
    off = found.boxes.xyz_m - true.xyz_m
    assert off[:, :2].std(axis=0) == pytest.approx([0.22, 0.22], rel=0.03)
    bottom = off[:, 2] - 0.5 * (found.boxes.lwh_m - true.lwh_m)[:, 2]
    assert bottom.std() == pytest.approx(0.11, rel=0.03)  # half of that, with the bottom of the box on the road
    assert np.log(found.boxes.lwh_m / true.lwh_m).std(axis=0) == pytest.approx([0.07] * 3, rel=0.03)
    assert found.boxes.yaw_rad.std() == pytest.approx(0.05, rel=0.03)


@pytest.mark.parametrize("label", [0, 1], ids=["car", "pedestrian"])
def test_what_scores_say_about_the_error(label):
    """20,000 drawn boxes of one object, by score: the mean squared error in units of that of all is what the detector
    says of each of them, in every tenth of the scores. For pedestrians it differs by more than a factor of 4."""
    n = 20_000
    street, detector = alone(n, 60, 20.0, label=label), StatisticalDetector(DetectorParams(model="pv_rcnn", **SOUND))
    z = np.random.default_rng(2).normal(size=(n, N_DRAWS))
    z[:, 0] = 0.0  # all are detected
    found = reports_of_actors(*street, np.zeros((n, 3)), z, detector.model)
    off = (found.boxes.xyz_m - street[1].take(found.actor).xyz_m)[:, :2]
    points, labels = np.full(n, 60), np.full(n, label, np.uint8)
    sigma_m = detector.position_sigma_m(points, labels, np.full(n, 20.0))
    square = (off**2).sum(axis=1) / sigma_m**2 / 2
    said = detector.error_by_score(found.score, points, labels)
    means = []
    for rows in np.array_split(np.argsort(found.score), 10):
        means.append(said[rows].mean())
        assert square[rows].mean() == pytest.approx(means[-1], rel=0.1)
    assert (np.diff(means) < 0).all()
    assert means[0] / means[-1] > (4 if label == 1 else 1.5)


def test_headings_and_sizes_are_as_accurate_as_the_detector_says():
    """As drawn: the heading modulo pi, with reversed headings, and the logarithms of the sizes."""
    n = 20_000
    street, detector = alone(n, 25, 20.0), StatisticalDetector(DetectorParams(model="pv_rcnn", duplicate_p=0.0))
    z = np.random.default_rng(3).normal(size=(n, N_DRAWS))
    z[:, 0] = 0.0
    found = reports_of_actors(*street, np.zeros((n, 3)), z, detector.model)
    rows = found.label == 0
    turn = np.mod(found.boxes.yaw_rad[rows] + np.pi / 2, np.pi) - np.pi / 2
    one = (np.array([25]), np.zeros(1, np.uint8), np.array([20.0]))
    assert turn.std() == pytest.approx(detector.heading_sigma_rad(*one)[0], rel=0.03)
    sizes = np.log(found.boxes.lwh_m / street[1].take(found.actor).lwh_m)[rows]
    assert sizes.std(axis=0) == pytest.approx([detector.size_sigma(*one)[0]] * 3, rel=0.03)


def alone(n, n_returns, range_m, length_m=4.4, label=0):
    """n actors of one size, each unoccluded before an observer of its own at the origin."""
    row, returns = np.arange(n, dtype=np.int32), np.full(n, n_returns, np.int32)
    seen = Observability(row, row, returns, returns, np.full(n, range_m))
    boxes = boxes_at(np.tile([range_m, 0.0, 0.75], (n, 1)), (length_m, 1.8, 1.5))
    return seen, boxes, np.full(n, label, np.uint8)


def test_trucks_reported_as_cars_have_the_length_of_cars_at_the_near_end():
    n, truck = 4000, 3
    confused = ((0.0,) * 4, (0.0,) * 4, (0.0,) * 4, (0.3, 0.1, 0.0, 0.0))
    params = DetectorParams(**SOUND | {"confusion_p": confused}, found_max_p=(1.0,) * 4, half_returns=(1e-9,) * 4)
    z = np.zeros((n, N_DRAWS))
    z[:, 10] = np.random.default_rng(2).normal(size=n)
    model = resolved(params)
    found = reports_of_actors(*alone(n, 300, 30.0, 12.0, truck), np.zeros((n, 3)), z, model)
    share = np.bincount(found.label, minlength=4) / n
    assert share == pytest.approx([0.3, 0.1, 0.0, 0.6], abs=0.03)
    # rear at 30 - 6 = 24 m; a car of 4.2 m that ends there has its centre at 26.1 m
    assert found.boxes.xyz_m[found.label == 0, 0] == pytest.approx(24 + model.mean_lwh_m[0, 0] / 2)
    assert found.boxes.lwh_m[found.label == truck, 0] == pytest.approx(12.0)


def test_duplicates_have_larger_errors_and_lower_scores():
    n = 4000
    params = DetectorParams(**SOUND | {"duplicate_p": 0.25}, found_max_p=(1.0,) * 4, half_returns=(1e-9,) * 4)
    z = np.random.default_rng(3).normal(size=(n, N_DRAWS))
    street = alone(n, 300, 30.0)
    found = reports_of_actors(*street, np.zeros((n, 3)), z, resolved(params))
    twice = found.actor[n:]
    assert len(twice) / n == pytest.approx(0.25, abs=0.03) and len(np.unique(twice)) == len(twice)
    assert (found.score[n:] < found.score[twice]).all()
    iou = iou_3d(found.boxes, street[1].take(found.actor))
    assert iou[n:].mean() < 0.8 * iou[:n].mean()


def test_detection_probability_falls_with_occlusion_and_rises_with_returns():
    model = resolved(DetectorParams())
    n = np.array([0, 1, 10, 100, 1000])
    p = detection_p(n, np.zeros(5), np.zeros(5, np.uint8), model)
    assert p[0] == 0 and (np.diff(p) > 0).all() and p[-1] < model.found_max_p[0]
    assert detection_p(n[2:3], np.ones(1), np.zeros(1, np.uint8), model) < p[2]


def test_detection_probability_by_hand_and_at_the_bound():
    # n^s / (n^s + h^s) at n = 0, h/2, h, 2h for s = 2: 0, 1/5, 1/2, 4/5; for s = 100 a step at h.
    for steepness, expected in ((2.0, (0, 0.2, 0.5, 0.8)), (100.0, (0, 0, 0.5, 1))):
        model = resolved(DetectorParams(steepness=steepness, half_returns=(10_000.0,) * 4))
        p = detection_p(np.array([0, 5_000, 10_000, 20_000]), np.zeros(4), np.zeros(4, np.uint8), model)
        assert p == pytest.approx(np.array(expected) * model.found_max_p[0], abs=1e-12)


def test_parameters_that_are_set_override_the_profile():
    plain, own = (resolved(DetectorParams(model="avod", **words)) for words in ({}, {"steepness": 2.5}))
    assert own.steepness == 2.5 != plain.steepness
    for name in (f.name for f in fields(DetectorParams) if f.name not in ("model", "steepness")):
        assert np.array_equal(getattr(own, name), getattr(plain, name))
        assert getattr(plain, name) is not None


def test_persistent_share_of_the_draws():
    # Of the variance of a draw, memory_share persists, here almost unchanged over 1 s of 100 s; the rest is new.
    n = 40_000
    row, returns = np.arange(n, dtype=np.int32), np.ones(n, np.int32)
    seen, rng = Observability(row, row, returns, returns, np.ones(n)), np.random.default_rng(0)
    first = draws_of(rng, n, n, time_s=5.0)
    later = replace(first, time_s=6.0, observer_step=draws_of(rng, n, n).observer_step)
    for share in (0.6, 0.0):
        model = resolved(DetectorParams(memory_share=share, memory_s=100.0))
        one, other = (pair_normals(seen, keys, model)[:, 0] for keys in (first, later))
        assert one.std() == pytest.approx(1, abs=0.015)
        assert np.mean(one * other) == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_errors_that_observers_have_in_common(share):
    """Two observers of one object: correlation memory_share x object_share; the variance stays 1."""
    n = 20_000
    draws = draws_of(np.random.default_rng(5), 2, n)
    observer, actor, ones = np.repeat([0, 1], n), np.tile(np.arange(n), 2), np.ones(2 * n, int)
    model = resolved(DetectorParams(memory_share=0.8, object_share=share))
    z = pair_normals(Observability(observer, actor, ones, ones, ones.astype(float)), draws, model)[:, 0].reshape(2, n)
    assert z.std() == pytest.approx(1, abs=0.015)
    assert np.mean(z[0] * z[1]) == pytest.approx(0.8 * share, abs=0.025)


def test_a_near_car_is_nearly_always_found():
    """Unlike `avod`, which misses one in four at any distance."""
    many, none = np.full(1, 1000), np.zeros(1)
    p = {
        name: detection_p(many, none, np.zeros(1, np.uint8), resolved(DetectorParams(model=name)))[0]
        for name in PUBLISHED
    }
    assert p["avod"] < 0.8 and p["pv_rcnn"] > 0.97


def test_correlation_of_persistent_normals():
    # Over a lag of d memories with d <= 1, both times fall into one interval with probability 1 - d; measured once over
    # a million keys: 0.72 at half a memory, 0.28 at one, 0 from two on.
    keys = np.random.default_rng(1).integers(0, 2**64, 40_000, np.uint64)
    first = persistent_normals(keys, 2, 50.0, 3.0)
    assert first.mean() == pytest.approx(0, abs=0.015) and first.std() == pytest.approx(1, abs=0.015)
    assert np.corrcoef(first.T)[0, 1] == pytest.approx(0, abs=0.015)
    assert normals(keys, 2).std() == pytest.approx(1, abs=0.01)
    for lag_s, expected in ((0.0, 1.0), (1.5, 0.72), (3.0, 0.28), (6.0, 0.0), (9.0, 0.0)):
        later = persistent_normals(keys, 2, 50.0 + lag_s, 3.0)
        assert np.mean(first[:, 0] * later[:, 0]) == pytest.approx(expected, abs=0.02)
    some = np.array([17, 3, 39_999])
    assert (persistent_normals(keys[some], 2, 50.0, 3.0) == first[some]).all()
