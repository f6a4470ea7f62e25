"""Evaluations by hand, by law, and against the slow transcription."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.trust.worlds import GAMMAS, worlds
from tests.verification import paper
from trust.evaluation import denial_weight, evaluate, miss_p, visibility
from trust.matching import match
from trust.params import TrustParams, eta_of
from trust.tables import ObjectLists, SentDetections


def evaluations_of(world, params):
    groups = match(world.lists, world.table, world.pairs, params)
    return groups, evaluate(world.lists, groups, world.table, world.points, world.plausible, params)


def test_visibility_by_hand():
    # limits 10 and 50: (30 - 10) / 40; nothing below, everything above
    params = TrustParams(gamma_lower_points=(10.0,) * 4, gamma_upper_points=(50.0,) * 4)
    label = np.zeros(5, np.uint8)
    phi = visibility(np.array([0, 10, 30, 50, 1000]), label, params)
    assert phi.tolist() == [0, 0, 0.5, 1, 1]
    # pedestrians need 40 returns, the other classes 100
    phi = visibility(np.full(4, 20), np.arange(4, dtype=np.uint8), TrustParams())
    assert phi.tolist() == [0.2, 0.5, 0.2, 0.2]
    # equal limits are a step
    step = TrustParams(gamma_lower_points=(5.0,) * 4, gamma_upper_points=(5.0,) * 4)
    assert visibility(np.array([5, 6]), label[:2], step).tolist() == [0, 1]


def test_eta_follows_the_method():
    assert eta_of(TrustParams(method="trupercept_1")) == 0
    assert eta_of(TrustParams(method="trupercept_2")) == -1
    assert eta_of(TrustParams(method="trupercept_2", eta=-0.5)) == -0.5
    assert eta_of(TrustParams(method="trupercept_1", eta=-1.0)) == -1


def test_by_hand():
    # vehicle 0 evaluates: its self report, its own detection (0.8) with vehicle 1's matched to it, its detection 2,
    # vehicle 1's self report matched to 0's detection 3 (0.6), and an unmatched one that is implausible
    table = SentDetections(
        np.array([0, 0, 0, 0, 1, 1, 1, 1]),
        np.array([0, 1, 2, 3, 0, 1, 2, 3]),
        np.zeros(8, np.uint8),
        np.array([1, 0.8, 1, 0.6, 1, 0.5, 0.9, 0.7]),
        np.array([1, 0, 0, 0, 1, 0, 0, 0], bool),
    )
    lists = ObjectLists(np.array([0, 8]), np.arange(8), np.array([0]))
    i, j = np.array([0, 1, 3]), np.array([7, 5, 4])
    params = TrustParams()
    groups = match(lists, table, (i, j, np.full(3, 0.5)), params)
    points = np.array([0, 50, 0, 50, 25, 10, 30, 0])
    plausible = np.array([1, 1, 1, 1, 1, 1, 0, 1], bool)
    evaluated = evaluate(lists, groups, table, points, plausible, params)
    #                        self own own own self' matched implausible matched to the self report
    assert evaluated.evaluation.tolist() == [1, 0.8, 1, 0.6, 0.6, 0.8, -1, 1]
    assert evaluated.visibility.tolist() == [1, 0.5, 0, 0.5, 0.25, 0.1, 1, 1]
    no_check = replace(params, plausibility_in_evaluation=False)
    evaluated = evaluate(lists, groups, table, points, plausible, no_check)
    assert evaluated.visibility[[2, 6]].tolist() == [0, 0.3]


@pytest.mark.parametrize("one_per_vehicle", [False, True])
@given(world=worlds(), eta=st.sampled_from([None, 0.0, -0.5]))
@settings(max_examples=100)
def test_twin(world, one_per_vehicle, eta):
    params = TrustParams(one_per_vehicle=one_per_vehicle, eta=eta)
    _, evaluated = evaluations_of(world, params)
    names, truth = world.names(), world.dictionary()
    for view in range(world.n_vehicles):
        positions = range(world.lists.ptr[view], world.lists.ptr[view + 1])
        at = {names[world.lists.member[p]]: p for p in positions}
        groups = paper.match(world.names_in(view), truth, world.iou(), params.tau, one_per_vehicle)
        expected = paper.evaluate(
            int(world.lists.owner[view]),
            groups,
            truth,
            lambda name, at=at: int(world.points[at[name]]),
            lambda name, at=at: bool(world.plausible[at[name]]),
            GAMMAS,
            eta_of(params),
        )
        assert {name: (evaluated.evaluation[p], evaluated.visibility[p]) for name, p in at.items()} == expected


@pytest.mark.parametrize("compared", [1.0, 0.7])
@pytest.mark.parametrize("permitted", [1.0, 0.4, 0.0])
@pytest.mark.parametrize("recall", [0.0, 0.1, 0.6, 0.99, 1.0])
def test_a_denial_says_what_bayes_makes_of_a_miss(recall, permitted, compared):
    """A million boxes, half of them of objects, are drawn and counted.

    An object is in the region that was compared or not, at a place that the sweep permits or not, and reported or not.
    What is not permitted is not found: an evaluator whose sweep looks like this knows that the object is elsewhere.
    """
    rng = np.random.default_rng(1)
    there, in_region, at_permitted, reported = rng.random((4, 1_000_000)) < np.array(
        [[0.5], [compared], [permitted], [recall]]
    )
    agrees = ~there | ~in_region | (at_permitted & ~reported)  # with the sweep, and with a list without a match
    q = miss_p(np.array([recall]), np.array([permitted]), np.array([compared]))
    assert agrees[there].mean() == pytest.approx(q[0], abs=0.002)
    expected = np.where(there[agrees], 1.0, -1.0).mean()
    assert -denial_weight(q)[0] == pytest.approx(expected if q[0] <= 0.5 else 0.0, abs=0.004)


def test_denials_are_weighed_by_recall():
    """A match, a miss of an object that could be seen, one of which half could, and one that free space contradicts."""
    table = SentDetections(
        np.array([0, 0, 1, 1, 1, 1]), np.array([0, 1, 1, 2, 3, 4]), np.zeros(6, np.uint8),
        np.array([1, 0.8, 0.5, 0.9, 0.7, 0.6]), np.array([1, 0, 0, 0, 0, 0], bool),
    )  # fmt: skip
    lists = ObjectLists(np.array([0, 6]), np.arange(6), np.array([0]))
    params = TrustParams(denials="recall")
    groups = match(lists, table, (np.array([1]), np.array([2]), np.array([0.5])), params)
    points, plausible = np.array([50, 50, 50, 100, 50, 0]), np.array([1, 1, 1, 1, 1, 0], bool)
    evaluated = evaluate(lists, groups, table, points, plausible, params, np.full(6, 0.8))
    assert evaluated.evaluation[2:].tolist() == [0.8, -1, -1, -1]
    # of 100 returns: q = 1 - 0.8; of 50: q = 1 - 0.5 x 0.8, which is above 1/2
    assert evaluated.visibility[2:].tolist() == pytest.approx([0.5, 0.8 / 1.2, 0.0, 1.0])
    known_half = evaluate(lists, groups, table, points, plausible, params, np.full(6, 0.8), np.full(6, 0.5))
    # half of the region: q = 0.5 + 0.5 x 0.2 where the sweep permits it, 0.5 where it does not
    assert known_half.visibility[2:].tolist() == pytest.approx([0.5, 0.0, 0.0, 0.5 / 1.5])
