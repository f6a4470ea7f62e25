"""Attacks: where fabricated detections are, whom they concern, and what is left as it was."""

from dataclasses import replace

import numpy as np
import pytest

from cosim.attacks.adversary import Adversary
from cosim.attacks.attack import AttackContext, EvaluationRows
from cosim.attacks.ghost_insertion import GhostInsertion, GhostInsertionParams
from cosim.attacks.params import AttackParams
from cosim.attacks.unreliable import Unreliable, UnreliableParams
from cosim.base.rng import name_key
from cosim.messages.content import FABRICATED, SENSED, Detections, self_reports
from cosim.world import World
from sensors.scene import Shape
from tests.sensors.town import boxes_at

HONEST, MALICIOUS, UNRELIABLE = range(3)
"""Numbers of `World.attack` for the attacks of `adversary_of`."""


def adversary_of(start_s=0.0, seed=1, ghosts="car_and_pedestrian", **keys):
    attacks = GhostInsertion(GhostInsertionParams(ghosts=ghosts)), Unreliable(UnreliableParams())
    params = AttackParams(start_s=start_s, **keys), AttackParams(start_s=start_s, role="unreliable")
    return Adversary.of(params, attacks, seed)


def acting(adversary, world, time_s=0.0):
    return adversary.active(adversary.start(), world, time_s)


def world_of(xy, yaw, attack, step=0):
    n = len(xy)
    return World(
        step=step, actor=np.arange(n, dtype=np.int32), name_key=np.arange(n, dtype=np.uint64) * 31 + 7,
        shape=np.full(n, Shape.CAR, np.uint8),
        boxes=boxes_at(np.column_stack([xy, np.full(n, 0.75)]), (4.4, 1.8, 1.5), np.asarray(yaw, float)),
        speed_mps=np.zeros(n), equipped=np.ones(n, bool), attack=np.asarray(attack, np.uint8),
    )  # fmt: skip


def lists_of(world, n_each):
    """Self reports, and `n_each` detections in each vehicle's list."""
    observers = np.arange(len(world))
    observer = np.repeat(observers, n_each)
    index = np.tile(np.arange(1, n_each + 1), len(world))
    n = len(observer)
    found = Detections.perceived(
        observer, index, np.zeros(n, np.uint8), world.boxes.take(observer), np.full(n, 0.7), np.full(n, 50, np.int32),
        np.full(n, SENSED, np.uint8),
    )  # fmt: skip
    return Detections.by_key([self_reports(world, observers), found])


def ghosts_of(listed):
    return listed.take(np.flatnonzero(listed.origin == FABRICATED))


def test_car_and_pedestrian_in_front_of_the_nearest_neighbour():
    """Victim at (10, 0) heading north (yaw 90 degrees): 8 m ahead is (10, 8), oncoming is yaw -90 degrees.

    The pedestrian stands 2 m to the victim's right: heading north, that is east: (12, 8).
    """
    world = world_of([[0, 0], [10, 0], [60, 0]], [0, np.pi / 2, 0], [MALICIOUS, HONEST, HONEST])
    ghosts = ghosts_of(acting(adversary_of(), world).detections(lists_of(world, 2))[0])
    assert ghosts.observer.tolist() == [0, 0] and ghosts.detection_index.tolist() == [3, 4]
    assert ghosts.label.tolist() == [0, 1]
    assert ghosts.score.tolist() == [0.7, 1.0]  # that of the detected cars; no pedestrian was detected yet
    np.testing.assert_allclose(ghosts.boxes.xyz_m, [[10, 8, 0.75], [12, 8, 0.875]], atol=1e-9)
    np.testing.assert_allclose(ghosts.boxes.yaw_rad, -np.pi / 2)


def test_no_victim_in_range_no_ghost():
    world = world_of([[0, 0], [200, 0]], [0, 0], [MALICIOUS, HONEST])
    assert len(acting(adversary_of(), world).detections(lists_of(world, 1))[0]) == 4


def test_before_the_start_nothing_changes():
    world = world_of([[0, 0], [10, 0]], [0, 0], [MALICIOUS, UNRELIABLE])
    listed = lists_of(world, 20)
    assert acting(adversary_of(start_s=10.0), world, 9.0).detections(listed)[0] is listed
    rows = EvaluationRows(np.array([0]), np.array([0]), np.array([0.5]), np.array([0.5]))
    evaluation, visibility = acting(adversary_of(start_s=10.0), world, 9.0).evaluations(rows, listed)
    assert evaluation is rows.evaluation and visibility is rows.visibility


def test_an_attack_begins_in_its_step_although_the_step_s_time_is_rounded():
    """Three steps of 0.3 s are 0.8999999999999999 s."""
    world, time_s = world_of([[0, 0], [10, 0]], [0, 0], [MALICIOUS, HONEST]), 3 * 0.3
    assert time_s < 0.9
    listed = lists_of(world, 20)
    assert acting(adversary_of(start_s=0.9), world, time_s).detections(listed)[0] is not listed
    assert acting(adversary_of(start_s=0.9), world, 2 * 0.3).detections(listed)[0] is listed
    renewed = [
        adversary_of(start_s=0.9, renewal="newcomer", renew_s=0.3).renewals(world, at_s, None, np.full(2, 9.0))
        for at_s in (2 * 0.3, time_s)
    ]
    assert [one.tolist() for one in renewed] == [[False, False], [True, False]]


def test_unreliable_omits_and_adds_about_a_tenth():
    n = 300
    xy = np.random.default_rng(0).uniform(0, 5000, (n, 2))
    world = world_of(xy, np.zeros(n), np.full(n, UNRELIABLE))
    listed = acting(adversary_of(seed=3), world).detections(lists_of(world, 20))[0]
    omitted = ~listed.transmitted
    added = listed.origin == FABRICATED
    assert not (omitted & (listed.origin != SENSED)).any()
    assert abs(omitted.sum() - 600) < 5 * np.sqrt(600)  # of 6,000 sensed
    assert abs(added.sum() - 630) < 5 * np.sqrt(630)  # of 6,300 with the self reports
    ahead = listed.boxes.xyz_m[added] - world.boxes.xyz_m[listed.observer[added]]  # all head east
    assert (ahead[:, 0] >= 0).all() and (ahead[:, 0] <= 70).all()
    assert (np.abs(ahead[:, 1]) <= ahead[:, 0] / 2 + 1e-9).all()


def test_all_attackers_aim_at_a_named_victim():
    world = world_of([[0, 0], [10, 0], [60, 0], [500, 0]], np.zeros(4), [MALICIOUS, HONEST, MALICIOUS, MALICIOUS])
    world.name_key[1] = name_key("vehicle/ego")
    ghosts = ghosts_of(
        acting(adversary_of(ghosts="car", victim="one", victim_id="ego"), world).detections(lists_of(world, 1))[0]
    )
    assert ghosts.observer.tolist() == [0, 2]  # the third attacker is too far away
    np.testing.assert_allclose(ghosts.boxes.xyz_m[:, 0], 18.0)
    assert not len(
        ghosts_of(acting(adversary_of(victim="one", victim_id="gone"), world).detections(lists_of(world, 1))[0])
    )


@pytest.mark.parametrize("number", [MALICIOUS, UNRELIABLE])
def test_attackers_vouch_for_their_own_fabrications_alone(number):
    """Each of 60 vehicles evaluates every detection with -0.5; attackers report 1 for their own ghosts."""
    attack = np.where(np.arange(60) % 3 == 0, number, HONEST)
    xy = np.random.default_rng(2).uniform(0, 300, (60, 2))
    world = world_of(xy, np.zeros(60), attack)
    adversary = acting(adversary_of(), world)
    listed = adversary.detections(lists_of(world, 4))[0]
    evaluator, detection = (a.ravel() for a in np.meshgrid(np.arange(60), np.arange(len(listed)), indexing="ij"))
    rows = EvaluationRows(evaluator, detection, np.full(len(evaluator), -0.5), np.full(len(evaluator), 0.3))
    evaluation, visibility = adversary.evaluations(rows, listed)
    own = (listed.observer[detection] == evaluator) & (listed.origin[detection] == FABRICATED)
    assert own.sum() > 5
    assert (evaluation == np.where(own, 1.0, -0.5)).all() and (visibility == np.where(own, 1.0, 0.3)).all()
    assert (rows.evaluation == -0.5).all(), "what the vehicle itself thinks stays"


class Deny:
    """An attack on evaluations alone."""

    def evaluations(self, rows, detections, context):
        """Whatever others detect is denied."""
        denied = context.attacker[rows.evaluator] & (rows.evaluator != detections.observer[rows.detection])
        return np.where(denied, -1.0, rows.evaluation), rows.visibility


def test_an_attack_may_have_one_hook_alone():
    world = world_of([[0, 0], [10, 0]], [0, 0], [1, 0])
    listed, adversary = lists_of(world, 0), acting(Adversary.of([AttackParams(start_s=0)], [Deny()], 1), world)
    assert adversary.detections(listed)[0] is listed
    rows = EvaluationRows(np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.full(4, 0.5), np.ones(4))
    evaluation, _ = adversary.evaluations(rows, listed)
    assert evaluation.tolist() == [0.5, -1.0, 0.5, 0.5]


def test_vehicles_without_equipment_attack_nothing():
    world = world_of([[0, 0], [10, 0]], [0, 0], [MALICIOUS, HONEST])
    world = replace(world, equipped=np.array([False, True]))
    listed = lists_of(world, 1)
    assert acting(adversary_of(), world).detections(listed)[0] is listed


def test_draws_depend_on_nothing_but_names():
    """One row's uniforms are the same alone and among others, and differ from attack to attack and step to step."""
    world = world_of([[0, 0], [10, 0]], [0, 0], [1, 1])
    context = AttackContext(world, np.ones(2, bool), 0.0, 5, 0)
    both = context.uniforms(world.name_key, np.array([3, 4]), n=2)
    assert (context.uniforms(world.name_key[1:], np.array([4]), n=2) == both[1:]).all()
    for other in (replace(context, number=1), replace(context, world=replace(world, step=1))):
        assert (other.uniforms(world.name_key, np.array([3, 4]), n=2) != both).all()
