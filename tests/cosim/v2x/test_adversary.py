"""Lies: where they stand, whom they concern, and what they leave alone."""

import numpy as np
import pytest
from cosim.v2x.adversary import AdversaryParams, tamper

from cosim.v2x.messages import FABRICATED, SELF, SENSED, Detections, self_reports
from cosim.world import HONEST, MALICIOUS, UNRELIABLE, World
from sensors.boxes import Boxes
from sensors.scene import Shape


def world_of(xy, yaw, behaviour, step=0):
    n = len(xy)
    return World(
        step=step, actor=np.arange(n, dtype=np.int32), name_key=np.arange(n, dtype=np.uint64) * 31 + 7,
        shape=np.full(n, Shape.CAR, np.uint8),
        boxes=Boxes(np.column_stack([xy, np.full(n, 0.75)]), np.tile([4.4, 1.8, 1.5], (n, 1)), np.asarray(yaw, float)),
        speed_mps=np.zeros(n), equipped=np.ones(n, bool), role=np.asarray(behaviour, np.uint8),
    )  # fmt: skip


def seen_by(world, n_each):
    """Self reports, and `n_each` detections in everybody's list."""
    observers = np.arange(len(world))
    own = self_reports(world, observers)
    observer = np.repeat(observers, n_each)
    k = np.tile(np.arange(1, n_each + 1), len(world))
    n = len(observer)
    found = Detections(
        observer, k, np.zeros(n, np.uint8), world.boxes.take(observer), np.full(n, 0.7), np.full(n, 50),
        np.full(n, SENSED, np.uint8), np.ones(n, bool),
    )  # fmt: skip
    return Detections.concat([own, found])


def test_malicious_inserts_car_and_pedestrian_in_front_of_its_nearest_neighbour():
    """Victim at (10, 0) heading north (yaw 90 degrees): 8 m ahead is (10, 8), oncoming is yaw -90 degrees.

    The pedestrian stands 2 m to the victim's right: heading north, that is east: (12, 8).
    """
    world = world_of([[0, 0], [10, 0], [60, 0]], [0, np.pi / 2, 0], [MALICIOUS, HONEST, HONEST])
    said = tamper(seen_by(world, 2), world, 0.0, 1, AdversaryParams(start_s=0.0))
    lies = said.take(np.flatnonzero(said.origin == FABRICATED))
    assert lies.observer.tolist() == [0, 0] and lies.k.tolist() == [3, 4]
    assert lies.label.tolist() == [0, 1] and (lies.score == 1).all()
    np.testing.assert_allclose(lies.boxes.xyz_m, [[10, 8, 0.75], [12, 8, 0.875]], atol=1e-9)
    np.testing.assert_allclose(lies.boxes.yaw_rad, -np.pi / 2)


def test_nobody_in_reach_no_lie():
    world = world_of([[0, 0], [200, 0]], [0, 0], [MALICIOUS, HONEST])
    assert len(tamper(seen_by(world, 1), world, 0.0, 1, AdversaryParams(start_s=0.0))) == 4


def test_before_the_start_nothing_changes():
    world = world_of([[0, 0], [10, 0]], [0, 0], [MALICIOUS, UNRELIABLE])
    seen = seen_by(world, 20)
    assert tamper(seen, world, 9.0, 1, AdversaryParams(start_s=10.0)) is seen


def test_unreliable_omits_and_adds_about_a_tenth():
    n = 300
    xy = np.random.default_rng(0).uniform(0, 5000, (n, 2))
    world = world_of(xy, np.zeros(n), np.full(n, UNRELIABLE))
    said = tamper(seen_by(world, 20), world, 0.0, 3, AdversaryParams(start_s=0.0))
    omitted = ~said.said
    added = said.origin == FABRICATED
    assert not (omitted & (said.origin != SENSED)).any()
    assert abs(omitted.sum() - 600) < 5 * np.sqrt(600)  # of 6,000 sensed
    assert abs(added.sum() - 630) < 5 * np.sqrt(630)  # of 6,300 with the self reports
    ahead = said.boxes.xyz_m[added] - world.boxes.xyz_m[said.observer[added]]  # all head east
    assert (ahead[:, 0] >= 0).all() and (ahead[:, 0] <= 70).all()
    assert (np.abs(ahead[:, 1]) <= ahead[:, 0] / 2 + 1e-9).all()


@pytest.mark.parametrize("attack", ["car", "car_and_pedestrian", "three_cars"])
def test_honest_rows_are_untouched_and_keys_unique(attack):
    behaviour = np.array([HONEST, MALICIOUS, UNRELIABLE] * 10)
    xy = np.random.default_rng(1).uniform(0, 200, (30, 2))
    world = world_of(xy, np.linspace(-3, 3, 30), behaviour)
    seen = seen_by(world, 5)
    said = tamper(seen, world, 0.0, 1, AdversaryParams(attack=attack, start_s=0.0))
    key = said.observer * 1000 + said.k
    assert (np.diff(key) > 0).all()
    honest, before = behaviour[said.observer] == HONEST, behaviour[seen.observer] == HONEST
    for name in ("observer", "k", "label", "score", "n_points", "origin", "said"):
        assert np.array_equal(getattr(said, name)[honest], getattr(seen, name)[before])
    assert np.array_equal(said.boxes.xyz_m[honest], seen.boxes.xyz_m[before])
    assert (said.origin[said.k == 0] == SELF).all()


def test_all_liars_can_aim_at_one_victim():
    from cosim.rng import name_key

    world = world_of([[0, 0], [10, 0], [60, 0], [500, 0]], np.zeros(4), [MALICIOUS, HONEST, MALICIOUS, MALICIOUS])
    world.name_key[1] = name_key("vehicle/ego")
    said = tamper(seen_by(world, 1), world, 0.0, 1, AdversaryParams(start_s=0.0, attack="car", victim="ego"))
    lies = said.take(np.flatnonzero(said.origin == FABRICATED))
    assert lies.observer.tolist() == [0, 2]  # the third liar is too far away
    np.testing.assert_allclose(lies.boxes.xyz_m[:, 0], 18.0)
    nobody = tamper(seen_by(world, 1), world, 0.0, 1, AdversaryParams(start_s=0.0, victim="gone"))
    assert not (nobody.origin == FABRICATED).any()
