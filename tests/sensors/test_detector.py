"""The detector: no luck means no error; with luck it has the statistics that its parameters state."""

import numpy as np
import pytest

from sensors.boxes import iou_3d
from sensors.detector import N_CLUTTER_DRAWS, N_SIGHTING_DRAWS, DetectorDraws, DetectorParams, detect, found_p, wrap
from sensors.evidence import points_in_boxes, sightings
from sensors.lidar import Hit
from sensors.scene import LABEL_OF_SHAPE
from tests.sensors.town import blocks, exact, traffic


@pytest.fixture(scope="module")
def street():
    rng = np.random.default_rng(3)
    boxes, shape = traffic(rng, 250)
    sweeps = exact(boxes, shape, np.flatnonzero(shape == 0), blocks(rng), profile="vlp32c")
    return sweeps, sightings(sweeps, boxes, shape), boxes, LABEL_OF_SHAPE[shape]


def draws(street, rng=None, slots=4) -> DetectorDraws:
    sweeps, seen, _, _ = street
    sizes = (len(seen.o), N_SIGHTING_DRAWS), (len(sweeps.observers), slots, N_CLUTTER_DRAWS)
    return DetectorDraws(*(np.zeros(size) if rng is None else rng.random(size) for size in sizes))


def test_no_luck_no_error(street):
    sweeps, seen, boxes, label = street
    for params in (DetectorParams(), DetectorParams(profile="ideal")):
        found = detect(*street, draws(street), params)
        visible = seen.n_returns > 0
        assert sorted(zip(found.o, found.actor, strict=True)) == list(
            zip(seen.o[visible], seen.actor[visible], strict=True)
        )
        assert not found.is_clutter.any() and (found.label == label[found.actor]).all()
        assert iou_3d(found.boxes, boxes.take(found.actor)) == pytest.approx(np.ones(len(found.o)))
        assert (found.n_points == points_in_boxes(sweeps, found.o, found.boxes)).all()
    assert (found.score == 1.0).all()
    # in the true box lie exactly the returns of its actor, and road or neighbours it overlaps
    own = {(o, a): n for o, a, n in zip(seen.o, seen.actor, seen.n_returns, strict=True)}
    assert all(n >= own[o, a] for o, a, n in zip(found.o, found.actor, found.n_points, strict=True))


def test_statistics_are_those_of_the_parameters(street):
    _, seen, boxes, label = street
    rng, params = np.random.default_rng(0), DetectorParams(flip_p=0.0)
    runs = [detect(*street, draws(street, rng), params) for _ in range(60)]
    expected = found_p(seen.n_returns, seen.occlusion, label[seen.actor], params)
    count = sum((~run.is_clutter).sum() for run in runs) / 60
    assert count == pytest.approx(expected.sum(), abs=4 * np.sqrt((expected * (1 - expected)).sum() / 60) + 1)
    clutter = sum(run.is_clutter.sum() for run in runs) / 60 / len(street[0].observers)
    assert clutter == pytest.approx(params.clutter_per_sweep, rel=0.1)
    real = np.concatenate([run.score[~run.is_clutter] for run in runs])
    false = np.concatenate([run.score[run.is_clutter] for run in runs])
    assert real.mean() > 0.6 > 0.3 > false.mean()

    error = np.concatenate([run.boxes.xyz_m[~run.is_clutter] - boxes.xyz_m[run.actor[~run.is_clutter]] for run in runs])
    distance = np.concatenate(
        [
            np.linalg.norm(boxes.xyz_m[run.actor] - street[0].poses.origin_m[run.o], axis=1)[~run.is_clutter]
            for run in runs
        ]
    )
    assert abs(error.mean(axis=0)).max() < 0.02
    near, far = error[distance < 20, :2].std(), error[distance > 40, :2].std()
    assert 0.05 < near < far < 1.0  # farther is worse
    turn = np.concatenate([wrap(run.boxes.yaw_rad - boxes.yaw_rad[run.actor])[~run.is_clutter] for run in runs])
    assert abs(turn.mean()) < 0.02 and turn.max() < np.pi


def test_chance_falls_with_occlusion_and_rises_with_returns():
    params = DetectorParams()
    n = np.array([0, 1, 10, 100, 1000])
    p = found_p(n, np.zeros(5), np.zeros(5, np.uint8), params)
    assert p[0] == 0 and (np.diff(p) > 0).all() and p[-1] < params.found_max_p[0]
    assert found_p(n[2:3], np.ones(1), np.zeros(1, np.uint8), params) < p[2]


def test_clutter_sits_on_returns(street):
    sweeps, seen, _, _ = street
    rng = np.random.default_rng(1)
    found = detect(*street, draws(street, rng, 8), DetectorParams(clutter_per_sweep=8.0))
    false = np.flatnonzero(found.is_clutter)
    assert len(false) > 5 * len(sweeps.observers)
    hidden = {(o, a) for o, a, occlusion in zip(seen.o, seen.actor, seen.occlusion, strict=True) if occlusion > 0.8}
    for k in false[:200]:
        o = found.o[k]
        world = sweeps.poses.to_world(o, sweeps.xyz(o))
        hits = sweeps.hit[o][np.isfinite(sweeps.range_m[o])]
        at = np.linalg.norm(world[:, :2] - found.boxes.xyz_m[k, :2], axis=1) < 1e-6
        assert at.any()
        assert any(h in (Hit.GROUND, Hit.BUILDING) or (o, h - Hit.ACTOR) in hidden for h in hits[at])


def test_order_betrays_no_names(street):
    luck = draws(street, np.random.default_rng(2))
    found = detect(*street, luck, DetectorParams())
    order = np.lexsort([found.boxes.xyz_m[:, 1], found.boxes.xyz_m[:, 0], -found.score, found.o])
    assert (order == np.arange(len(order))).all()


def test_nobody_looks():
    boxes, shape = traffic(np.random.default_rng(0), 5)
    sweeps = exact(boxes, shape, [])
    seen = sightings(sweeps, boxes, shape)
    luck = DetectorDraws(np.zeros((0, N_SIGHTING_DRAWS)), np.zeros((0, 4, N_CLUTTER_DRAWS)))
    for profile in ("avod", "ideal"):
        found = detect(sweeps, seen, boxes, LABEL_OF_SHAPE[shape], luck, DetectorParams(profile=profile))
        assert len(found.o) == len(found.boxes) == 0


def test_draws_of_the_wrong_shape_are_refused(street):
    with pytest.raises(ValueError, match="draws"):
        detect(*street, DetectorDraws(np.zeros((1, 2)), np.zeros((1, 1, 1))), DetectorParams())
