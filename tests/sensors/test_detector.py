"""The detector: no luck means no error; with luck it has the statistics that its parameters state."""

from dataclasses import fields

import numpy as np
import pytest

from sensors.boxes import Boxes, iou_3d
from sensors.detector import (
    N_SIGHTING_DRAWS,
    DetectorDraws,
    DetectorParams,
    detect,
    found_p,
    luck,
    reported,
    resolved,
    wrap,
)
from sensors.evidence import points_in_boxes, sightings
from sensors.scene import LABEL_OF_SHAPE
from tests.sensors.town import blocks, exact, luck_with_places, traffic

PUBLISHED = ("avod", "pointpillars")
SOUND = {
    "flip_p": 0.0, "duplicate_p": 0.0, "taken_for_p": ((0.0,) * 4,) * 4,
}  # fmt: skip


@pytest.fixture(scope="module")
def street():
    rng = np.random.default_rng(3)
    boxes, shape = traffic(rng, 250)
    sweeps = exact(boxes, shape, np.flatnonzero(shape == 0), blocks(rng), profile="vlp32c")
    return sweeps, sightings(sweeps, boxes, shape), boxes, LABEL_OF_SHAPE[shape]


def draws(street, rng=None) -> DetectorDraws:
    sweeps, seen, boxes, _ = street
    size = len(seen.o), N_SIGHTING_DRAWS
    if rng is None:
        return DetectorDraws(np.zeros(size))
    return DetectorDraws(rng.normal(size=size), luck_with_places(rng, len(sweeps.observers), len(boxes)))


@pytest.mark.parametrize("profile", [*PUBLISHED, "ideal"])
def test_no_luck_no_error(street, profile):
    sweeps, seen, boxes, label = street
    found = detect(*street, draws(street), DetectorParams(profile=profile, min_score=0.0))
    visible = seen.n_returns > 0
    pairs = list(zip(seen.o[visible], seen.actor[visible], strict=True))
    assert sorted(zip(found.o, found.actor, strict=True)) == pairs
    assert not found.is_clutter.any() and (found.label == label[found.actor]).all()
    assert iou_3d(found.boxes, boxes.take(found.actor)) == pytest.approx(np.ones(len(found.o)))
    assert (found.n_points == points_in_boxes(sweeps, found.o, found.boxes)).all()
    assert profile != "ideal" or (found.score == 1.0).all()
    # in the true box lie exactly the returns of its actor, and road or neighbours it overlaps
    own = {(o, a): n for o, a, n in zip(seen.o, seen.actor, seen.n_returns, strict=True)}
    assert all(n >= own[o, a] for o, a, n in zip(found.o, found.actor, found.n_points, strict=True))


def test_luck_is_uniform_and_continuous():
    z = np.random.default_rng(0).normal(size=100_000)
    assert luck(np.zeros(1)) == 0.0 and luck(np.array([-40.0, 40.0])).max() < 1.0
    assert np.histogram(luck(z), 10, (0, 1))[0] == pytest.approx(10_000, abs=500)
    assert np.abs(np.diff(luck(np.linspace(-4, 4, 10_001)))).max() < 1e-3


@pytest.mark.parametrize("profile", PUBLISHED)
def test_statistics_are_those_of_the_parameters(street, profile):
    _, seen, boxes, label = street
    rng, params = np.random.default_rng(0), DetectorParams(profile=profile, min_score=0.0, **SOUND)
    model = resolved(params)
    runs = [detect(*street, draws(street, rng), params) for _ in range(60)]
    expected = found_p(seen.n_returns, seen.occlusion, label[seen.actor], model)
    count = sum((~run.is_clutter).sum() for run in runs) / 60
    assert count == pytest.approx(expected.sum(), abs=4 * np.sqrt((expected * (1 - expected)).sum() / 60) + 1)
    real = np.concatenate([run.score[~run.is_clutter] for run in runs])
    false = np.concatenate([run.score[run.is_clutter] for run in runs])
    assert real.mean() > 0.5 > 0.35 > false.mean()
    turn = np.concatenate([wrap(run.boxes.yaw_rad - boxes.yaw_rad[run.actor])[~run.is_clutter] for run in runs])
    assert abs(turn.mean()) < 0.02 and turn.max() < np.pi


def test_errors_are_those_of_the_parameters():
    # One car with 400 returns at 20 m, 20,000 times: sigma of x is 0.1 + 20 * 0.001 + 2 / sqrt(400) = 0.22 m.
    n = 20_000
    street = alone(n, 400, 20.0)
    params = DetectorParams(
        found_max_p=(1.0,) * 4, half_returns=(1e-9,) * 4, xy_sigma_m=(0.1,) * 4, xy_sigma_per_m=0.001,
        xy_sigma_sparse_m=(2.0,) * 4, z_share=0.5, size_sigma=(0.05,) * 4, size_sigma_sparse=(0.4,) * 4,
        yaw_sigma_rad=(0.03,) * 4, yaw_sigma_sparse_rad=0.4, **SOUND,
    )  # fmt: skip
    z = np.random.default_rng(1).normal(size=(n, N_SIGHTING_DRAWS))
    said = reported(*street, np.zeros((n, 3)), z, resolved(params))
    assert len(said.o) == n
    true = street[1].take(said.actor)
    off = said.boxes.xyz_m - true.xyz_m
    assert off[:, :2].std(axis=0) == pytest.approx([0.22, 0.22], rel=0.03)
    bottom = off[:, 2] - 0.5 * (said.boxes.lwh_m - true.lwh_m)[:, 2]
    assert bottom.std() == pytest.approx(0.11, rel=0.03)  # half of that, and the box keeps standing
    assert np.log(said.boxes.lwh_m / true.lwh_m).std(axis=0) == pytest.approx([0.07] * 3, rel=0.03)
    assert said.boxes.yaw_rad.std() == pytest.approx(0.05, rel=0.03)


def alone(n, n_returns, range_m, length_m=4.4, label=0):
    """n sightings of n actors of one size, each alone before an observer of its own at the origin."""
    seen = type("Seen", (), {})()
    seen.o = seen.actor = np.arange(n)
    seen.n_returns, seen.occlusion, seen.range_m = np.full(n, n_returns), np.zeros(n), np.full(n, range_m)
    boxes = Boxes(np.tile([range_m, 0.0, 0.75], (n, 1)), np.tile([length_m, 1.8, 1.5], (n, 1)), np.zeros(n))
    return seen, boxes, np.full(n, label, np.uint8)


def test_trucks_taken_for_cars_are_as_long_as_cars_and_end_where_the_truck_ends():
    n, truck = 4000, 3
    confused = ((0.0,) * 4, (0.0,) * 4, (0.0,) * 4, (0.3, 0.1, 0.0, 0.0))
    params = DetectorParams(**SOUND | {"taken_for_p": confused}, found_max_p=(1.0,) * 4, half_returns=(1e-9,) * 4)
    z = np.zeros((n, N_SIGHTING_DRAWS))
    z[:, 10] = np.random.default_rng(2).normal(size=n)
    model = resolved(params)
    said = reported(*alone(n, 300, 30.0, 12.0, truck), np.zeros((n, 3)), z, model)
    share = np.bincount(said.label, minlength=4) / n
    assert share == pytest.approx([0.3, 0.1, 0.0, 0.6], abs=0.03)
    # rear at 30 - 6 = 24 m; a car of 4.2 m that ends there has its centre at 26.1 m
    assert said.boxes.xyz_m[said.label == 0, 0] == pytest.approx(24 + model.mean_lwh_m[0, 0] / 2)
    assert said.boxes.lwh_m[said.label == truck, 0] == pytest.approx(12.0)


def test_duplicates_are_farther_off_and_less_sure():
    n = 4000
    params = DetectorParams(**SOUND | {"duplicate_p": 0.25}, found_max_p=(1.0,) * 4, half_returns=(1e-9,) * 4)
    z = np.random.default_rng(3).normal(size=(n, N_SIGHTING_DRAWS))
    street = alone(n, 300, 30.0)
    said = reported(*street, np.zeros((n, 3)), z, resolved(params))
    twice = said.actor[n:]
    assert len(twice) / n == pytest.approx(0.25, abs=0.03) and len(np.unique(twice)) == len(twice)
    assert (said.score[n:] < said.score[twice]).all()
    iou = iou_3d(said.boxes, street[1].take(said.actor))
    assert iou[n:].mean() < 0.8 * iou[:n].mean()


def test_chance_falls_with_occlusion_and_rises_with_returns():
    model = resolved(DetectorParams())
    n = np.array([0, 1, 10, 100, 1000])
    p = found_p(n, np.zeros(5), np.zeros(5, np.uint8), model)
    assert p[0] == 0 and (np.diff(p) > 0).all() and p[-1] < model.found_max_p[0]
    assert found_p(n[2:3], np.ones(1), np.zeros(1, np.uint8), model) < p[2]


def test_farther_is_worse(street):
    rng = np.random.default_rng(4)
    runs = [detect(*street, draws(street, rng), DetectorParams(**SOUND)) for _ in range(30)]
    sweeps, _, boxes, label = street
    near, far = [], []
    for run in runs:
        mine = ~run.is_clutter & (label[run.actor] == 0)
        away = np.linalg.norm(boxes.xyz_m[run.actor] - sweeps.poses.origin_m[run.o], axis=1)
        error = np.linalg.norm((run.boxes.xyz_m - boxes.xyz_m[run.actor])[:, :2], axis=1)
        near.append(error[mine & (away < 20)])
        far.append(error[mine & (away > 40)])
    assert 0.02 < np.concatenate(near).mean() < np.concatenate(far).mean() < 1.0


def test_order_betrays_no_names(street):
    lots = draws(street, np.random.default_rng(2))
    found = detect(*street, lots, DetectorParams())
    order = np.lexsort([found.boxes.xyz_m[:, 1], found.boxes.xyz_m[:, 0], -found.score, found.o])
    assert (order == np.arange(len(order))).all()


def test_nobody_looks():
    boxes, shape = traffic(np.random.default_rng(0), 5)
    sweeps = exact(boxes, shape, [])
    seen = sightings(sweeps, boxes, shape)
    lots = DetectorDraws(np.zeros((0, N_SIGHTING_DRAWS)), luck_with_places(np.random.default_rng(0), 0, 5))
    for profile in (*PUBLISHED, "ideal"):
        found = detect(sweeps, seen, boxes, LABEL_OF_SHAPE[shape], lots, DetectorParams(profile=profile))
        assert len(found.o) == len(found.boxes) == 0


def test_what_is_set_overrides_the_profile():
    plain, own = (resolved(DetectorParams(profile="avod", **words)) for words in ({}, {"steepness": 2.5}))
    assert own.steepness == 2.5 != plain.steepness
    for name in (f.name for f in fields(DetectorParams) if f.name not in ("profile", "steepness")):
        assert np.array_equal(getattr(own, name), getattr(plain, name))
        assert getattr(plain, name) is not None


def test_draws_of_the_wrong_shape_are_refused(street):
    few = luck_with_places(np.random.default_rng(0), 1, 1)
    for lots in (DetectorDraws(np.zeros((1, 2))), DetectorDraws(draws(street).sighting, few)):
        with pytest.raises(ValueError, match="draws"):
            detect(*street, lots, DetectorParams())
