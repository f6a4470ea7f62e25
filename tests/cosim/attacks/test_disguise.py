"""Fabricated detections among real ones: no single column of a message tells which is which."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import rankdata

from cosim.attacks.disguise import ghosts, numbered
from cosim.messages.content import FABRICATED, SELF, SENSED, Detections
from sensors.boxes import Boxes
from tests.sensors.town import boxes_at

CAR, PEDESTRIAN = 0, 1
N_VEHICLES, N_SEEN = 60, 25


def auc(values, is_lie):
    """Probability that a lie's value is above that of a real detection; ties count half."""
    rank, n = rankdata(values), is_lie.sum()
    return (rank[is_lie].sum() - n * (n + 1) / 2) / (n * (~is_lie).sum())


def a_step(seed=3):
    """Vehicles at random places. Scores, returns and sizes of what they detect depend on class and distance."""
    rng = np.random.default_rng(seed)
    n = N_VEHICLES * N_SEEN
    observer = np.repeat(np.arange(N_VEHICLES), N_SEEN)
    place_m = rng.uniform(0, 300, (N_VEHICLES, 3))
    range_m, angle = rng.uniform(5, 80, n), rng.uniform(-np.pi, np.pi, n)
    xyz = place_m[observer] + np.column_stack([range_m * np.cos(angle), range_m * np.sin(angle), np.zeros(n)])
    index = np.tile(np.arange(N_SEEN), N_VEHICLES)
    label = (rng.random(n) < 0.3).astype(np.uint8)
    size = np.where(label[:, None] == CAR, [4.4, 1.8, 1.6], [0.7, 0.6, 1.7]) * rng.normal(1, 0.05, (n, 3))
    score = 1 / (1 + np.exp(-(2 - range_m / 30 + rng.normal(0, 0.5, n))))
    n_points = (2000 / range_m * np.where(label == CAR, 1.0, 0.2)).astype(np.int32)
    origin = np.where(index == 0, SELF, SENSED).astype(np.uint8)
    boxes = Boxes(xyz, size, rng.uniform(-np.pi, np.pi, n))
    listed = Detections.perceived(observer, index, label, boxes, score, n_points, origin)
    speed = np.where(rng.random(n) < 0.2, np.nan, rng.exponential(5, n))
    speed[origin == SELF] = np.nan
    listed.velocity_mps[:] = speed[:, None] * np.column_stack([np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)])
    by_score = np.lexsort((-score, index > 0, observer))  # as detectors number them, behind the self report
    return replace(listed.take(by_score), detection_index=index), place_m, rng


def context_of(place_m, memory=None):
    boxes = boxes_at(place_m)
    rng = np.random.default_rng(11)
    return SimpleNamespace(
        seen=None, world=SimpleNamespace(boxes=boxes), params=SimpleNamespace(appearance="detected"),
        memory={} if memory is None else memory,
        name_key=lambda rows: np.asarray(rows).astype(np.uint64) + np.uint64(500),
        uniforms=lambda *names, n=1: rng.random((len(names[0]), n)),
    )  # fmt: skip


def with_ghosts():
    """A car and a pedestrian for every vehicle, at distances like those of real objects."""
    listed, place_m, rng = a_step()
    by = np.repeat(np.arange(N_VEHICLES), 2)
    label = np.tile([CAR, PEDESTRIAN], N_VEHICLES).astype(np.uint8)
    away_m = rng.uniform(5, 80, len(by))
    xyz = place_m[by] + np.column_stack([away_m, np.zeros((len(by), 2))])
    boxes = boxes_at(xyz, (4.5, 2.0, 1.6))
    return ghosts(listed, by, label, boxes, context_of(place_m)), listed


@pytest.mark.parametrize("label", [CAR, PEDESTRIAN])
def test_no_column_tells_a_ghost(label):
    made, _ = with_ghosts()
    keys = np.arange(N_VEHICLES).astype(np.uint64)
    made, _ = numbered(made, keys, 7, 12)
    of_class = (made.origin != SELF) & (made.label == label)
    made = made.take(np.flatnonzero(of_class))
    is_lie = made.origin == FABRICATED
    assert is_lie.sum() == N_VEHICLES
    speed = np.hypot(*made.velocity_mps.T)
    columns = {
        "score": made.score, "length": made.boxes.lwh_m[:, 0], "width": made.boxes.lwh_m[:, 1],
        "height": made.boxes.lwh_m[:, 2], "n_points": made.n_points, "has speed": np.isfinite(speed) * 1.0,
        "index": made.detection_index,
    }  # fmt: skip
    for name, values in columns.items():
        assert 0.4 < auc(values, is_lie) < 0.6, name
    moves = np.isfinite(speed)
    assert 0.4 < auc(speed[moves], is_lie[moves]) < 0.6


def test_ghosts_keep_their_ground_and_their_place():
    made, listed = with_ghosts()
    ghost = made.take(np.flatnonzero(made.origin == FABRICATED))
    bottom = ghost.boxes.xyz_m[:, 2] - ghost.boxes.lwh_m[:, 2] / 2
    _, place_m, _ = a_step()
    np.testing.assert_allclose(bottom, place_m[ghost.observer, 2] - 0.8)  # boxes of 1.6 m at the height of the vehicle
    assert set(ghost.score) <= set(listed.score) and len(set(ghost.score)) > 60
    assert (made.take(np.flatnonzero(made.origin != FABRICATED)).score == listed.score).all()


def test_a_class_that_is_not_in_the_step_comes_from_earlier_ones():
    listed, place_m, _ = a_step()
    memory = {}
    box = boxes_at(place_m[:1] + 10.0, (0.8, 0.6, 1.75))
    who, label = np.array([0]), np.array([PEDESTRIAN], np.uint8)
    ghosts(listed, who, label, box, context_of(place_m, memory))
    cars = listed.take(np.flatnonzero(listed.label == CAR))
    made = ghosts(cars, who, label, box, context_of(place_m, memory))
    (score,) = made.score[made.origin == FABRICATED]
    assert score in listed.score[listed.label == PEDESTRIAN]
    nothing = listed.take(np.zeros(0, np.int64))
    made = ghosts(nothing, who, label, box, context_of(place_m))
    assert made.score.tolist() == [1.0] and np.isnan(made.velocity_mps).all()  # nothing to resemble


def test_no_order_tells_a_list_with_ghosts():
    """In all lists, the number of a detection is its place by falling score, behind the self report."""
    made, listed = with_ghosts()
    keys = np.arange(N_VEHICLES).astype(np.uint64)
    honest, order = numbered(listed, keys, 7, 12)
    assert honest is listed and (order == np.arange(len(listed))).all()
    few = made.take(np.flatnonzero((made.origin != FABRICATED) | (made.observer < 5)))
    mixed, order = numbered(few, keys, 7, 12)
    np.testing.assert_array_equal(mixed.score, few.score[order])
    assert (order[mixed.observer >= 5] == np.flatnonzero(few.observer >= 5)).all()
    for observer in range(N_VEHICLES):
        mine = np.flatnonzero(mixed.observer == observer)
        assert mixed.detection_index[mine].tolist() == list(range(N_SEEN + 2 * (observer < 5)))
        assert mixed.origin[mine[0]] == SELF and (np.diff(mixed.score[mine[1:]]) <= 0).all()


def test_chance_numbers_ghosts_among_equal_scores():
    made, _ = with_ghosts()
    made.score[:] = 1.0
    keys = np.arange(N_VEHICLES).astype(np.uint64)
    one, _ = numbered(made, keys, 7, 12)
    again, _ = numbered(made, keys, 7, 13)
    assert (one.origin != again.origin).any()
    others = one.origin != SELF
    assert 0.4 < auc(one.detection_index[others], one.origin[others] == FABRICATED) < 0.6


def test_a_list_with_scores_of_ones_own_is_numbered_by_them():
    """Scores 0.3, 0.9, 0.6 behind a self report, and of another identity, whose number 0 claims to be one."""
    listed, _, _ = a_step()
    keys = np.arange(N_VEHICLES).astype(np.uint64)
    rows = np.flatnonzero(listed.observer == 3)[:4]
    own = replace(listed.take(rows), score=np.array([1.0, 0.3, 0.9, 0.6]))
    other = replace(own, identity=np.ones(4, np.uint8), origin=np.full(4, FABRICATED, np.uint8))
    for identity in (own, other):
        found, order = numbered(identity, keys, 7, 12)
        assert order.tolist() == [0, 2, 3, 1] and found.detection_index.tolist() == [0, 1, 2, 3]
