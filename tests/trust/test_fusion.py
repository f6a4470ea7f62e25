"""Final scores by hand, by law, and against the slow transcription."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.seeds import seeds
from tests.trust.worlds import worlds
from tests.verification import paper
from trust.evaluation import evaluate
from trust.fusion import METHODS, SensorEvidence, first_least, fuse
from trust.matching import match
from trust.params import Method, TrustParams
from trust.tables import Evaluations, FusionInput, Groups, ObjectLists, SenderTrust, SentDetections


@given(st.lists(st.tuples(st.integers(0, 4), st.sampled_from([0.0, -0.0, 1.0, 2.0, np.inf, np.nan]))))
def test_the_first_least_of_each_group_against_a_stable_sort(rows):
    """NumPy sorts a NaN last, and keeps the order of equal values."""
    group, value = np.array([g for g, _ in rows], np.int32), np.array([v for _, v in rows], float)
    order = np.lexsort((value, group))
    expected = order[np.flatnonzero(np.diff(group[order], prepend=-1))]
    found = first_least(group, value, 5)
    np.testing.assert_array_equal(found[found >= 0], expected)


def test_every_method_has_a_formula():
    assert set(METHODS) == set(get_args(Method))


# One ego (vehicle 0), groups in the order of their seeds:
#   A  own 0.8, with vehicle 1's 0.6                 B  vehicle 2's 0.9, the ego has not seen it
# evaluations on A's two: ego (0.8, 1), (0.8, 0.5); vehicle 1 (0.6, 1), (0.6, 0.5); on B: vehicle 1 (eta, 1), 2 (0.9, 1)
# trust: ego 1, vehicle 1: 0.5, vehicle 2: 0.25
#   A: sum Phi T e = 0.8 + 0.4 + 0.3 + 0.15 = 1.65, sum Phi T = 1 + 0.5 + 0.5 + 0.25 = 2.25
#   B: sum Phi T e = 0.5 eta + 0.225, sum Phi T = 0.75
TABLE = SentDetections(
    np.array([0, 1, 2]),
    np.array([1, 1, 1]),
    np.zeros(3, np.uint8),
    np.array([0.8, 0.6, 0.9]),
    np.zeros(3, bool),
)
LISTS = ObjectLists(np.array([0, 3]), np.arange(3), np.array([0]))
GROUPS = Groups(np.array([0, 0, 2]), np.array([True, True, False]))
EVALUATED = ObjectLists(np.array([0, 2, 5, 6]), np.array([0, 1, 0, 1, 2, 2]), np.array([0, 1, 2]))
SENDER_TRUST = SenderTrust(np.array([0, 2]), np.array([1, 2]), np.array([0.5, 0.25]))
DISTANCE = np.array([30.0, 10.0, 5.0])


def by_hand(method, eta=-1.0, points=0, plausible=True, in_range=True, sender_trust=SENDER_TRUST, **options):
    evaluations = Evaluations(np.array([0.8, 0.8, 0.6, 0.6, eta, 0.9]), np.array([1, 0.5, 1, 0.5, 1, 1.0]))
    evidence = SensorEvidence(np.array([99, points]), np.array([False, plausible]), np.array([False, in_range]))
    params = TrustParams(method=method, **options)
    return fuse(
        FusionInput(LISTS, GROUPS, TABLE, EVALUATED, evaluations, evaluations), sender_trust, evidence, DISTANCE, params
    )


@pytest.mark.parametrize(
    ("method", "eta", "a", "b"),
    [
        ("trupercept_1", 0.0, 1.65 / 2.25, 0.225 / 0.75),
        ("trupercept_1_local_bias", 0.0, (1.65 / 2.25 + 0.8) / 2, 0.225 / 0.75),
        ("trupercept_2", 0.0, 1.65 / 2, 0.225),
        ("trupercept_2", -1.0, 1.65 / 2, 0.0),  # -0.275, clipped
        ("trupercept_3", 0.0, 0.8, 0.225),
        ("trupercept_3_corrected", 0.0, 0.8, 0.225),
        ("corrected", -1.0, 0.8, 0.0),
        ("local", -1.0, 0.8, 0.0),
        ("any", -1.0, 1.0, 1.0),
        ("any_confirmed", -1.0, 1.0, 0.9),
        ("confirmed_or_local", -1.0, 1.0, 0.0),
        ("local_confirmed", -1.0, 1.0, 0.0),
        ("averaging", -1.0, (0.8 + 0.3) / 1.5, 0.9),
        ("additive", -1.0, 1.0, 0.225),  # 1.1, clipped
        ("half_additive", -1.0, 1.0, 0.45),  # (0.8 + 0.6 + 0.8) / 2, clipped
    ],
)
def test_scores_by_hand(method, eta, a, b):
    fused = by_hand(method, eta)
    assert fused.score.tolist() == pytest.approx([a, b], abs=1e-12)
    assert fused.seed.tolist() == [0, 2]
    assert fused.ego_detected.tolist() == [True, False]
    assert fused.n_sources.tolist() == [2, 1]
    assert fused.n_evaluations.tolist() == [4, 2]


@pytest.mark.parametrize("method", ["trupercept_1", "trupercept_1_local_bias", "trupercept_2", "trupercept_3"])
def test_plausibility_removes_only_groups_that_the_ego_did_not_detect(method):
    plausible, implausible = by_hand(method, 0.0), by_hand(method, 0.0, plausible=False)
    assert implausible.score[0] == plausible.score[0] > 0
    assert plausible.score[1] > implausible.score[1] == 0
    off = by_hand(method, 0.0, plausible=False, plausibility_in_fusion=False)
    assert off.score[1] == plausible.score[1]


def test_trupercept_3_where_the_ego_can_see():
    assert by_hand("trupercept_3", 0.0, points=9).score[1] > 0
    assert by_hand("trupercept_3", 0.0, points=10).score[1] == 0
    assert by_hand("trupercept_3", 0.0, points=10, blind_points=11).score[1] > 0
    # beyond the sensor's range neither returns nor free space are evidence
    assert by_hand("trupercept_3", 0.0, points=10, plausible=False, in_range=False).score[1] > 0


def test_ego_trust():
    # A with the ego twice as strong: (0.8 + 0.4) 2 + 0.45 over 3 + 0.75
    assert by_hand("trupercept_1", ego_trust=2.0).score[0] == pytest.approx(2.85 / 3.75, abs=1e-12)
    # its own trust as it knows it, 0.25, then the default when it knows nothing
    known = SenderTrust(np.array([0, 3]), np.array([0, 1, 2]), np.array([0.25, 0.5, 0.25]))
    computed = by_hand("trupercept_1", sender_trust=known, ego_trust_from="computed")
    assert computed.score[0] == pytest.approx((0.3 + 0.45) / (0.375 + 0.75), abs=1e-12)
    default = by_hand("trupercept_1", ego_trust_from="computed", default_trust=0.5)
    assert default.score[0] == pytest.approx((0.6 + 0.45) / (0.75 + 0.75), abs=1e-12)
    # the ego's own trust as received is not used otherwise, and its evaluations count once
    np.testing.assert_array_equal(by_hand("trupercept_1", sender_trust=known).score, by_hand("trupercept_1").score)


def test_a_message_received_twice_counts_once():
    twice = SenderTrust(np.array([0, 4]), np.array([2, 1, 1, 2]), np.array([0.25, 0.5, 0.5, 0.25]))
    np.testing.assert_array_equal(by_hand("trupercept_2", sender_trust=twice).score, by_hand("trupercept_2").score)


@pytest.mark.parametrize("bad", [(np.nan, 1.0), (1.0, np.nan), (2.0, 1.0), (1.0, 1.5), (1.0, -0.1)])
def test_bad_evaluations_have_no_effect(bad):
    e, phi = bad
    good = Evaluations(np.array([0.8]), np.array([1.0]))
    one = ObjectLists(np.array([0, 1]), np.array([0]), np.array([0]))
    more = ObjectLists(np.array([0, 1, 2]), np.array([0, 0]), np.array([0, 1]))
    evidence = SensorEvidence(np.zeros(2, int), np.ones(2, bool), np.ones(2, bool))
    both = Evaluations(np.array([0.8, e]), np.array([1.0, phi]))
    a, b = (
        fuse(
            FusionInput(LISTS, GROUPS, TABLE, lists, said, said),
            SENDER_TRUST,
            evidence,
            DISTANCE,
            TrustParams(method="trupercept_1"),
        )
        for lists, said in ((one, good), (more, both))
    )
    np.testing.assert_array_equal(a.score, b.score)
    np.testing.assert_array_equal(a.n_evaluations, b.n_evaluations)


def with_self_report(is_self, **options):
    """Fused objects where some detections are self reports, and no evaluation says anything."""
    table, said = replace(TABLE, is_self=np.array(is_self)), Evaluations(np.zeros(6), np.ones(6))
    evidence = SensorEvidence(np.zeros(2, int), np.ones(2, bool), np.ones(2, bool))
    of = FusionInput(LISTS, GROUPS, table, EVALUATED, said, said)
    return fuse(of, SENDER_TRUST, evidence, DISTANCE, TrustParams(**options))


def test_closest_pose():
    assert by_hand("corrected").pose.tolist() == [1, 2]  # 10 m beats 30 m
    assert by_hand("local").pose.tolist() == [0, 2]
    assert by_hand("corrected", code_parity=True).pose.tolist() == [0, 2]
    # a self report at 0 m is taken unless excluded
    for allowed, pose in ((True, 1), (False, 0)):
        fused = with_self_report([False, True, False], method="corrected", self_report_poses=allowed)
        assert fused.pose[0] == pose


def test_the_ego_itself_is_no_output():
    assert with_self_report([True, False, False]).seed.tolist() == [2]


def test_the_ego_uses_its_own_evaluations_and_the_others_as_reported():
    # ego 0 made (0.8, 1), (0.8, 0.5) on A and reported -1; vehicle 1 made 0.6 and reported -0.2 on A:
    # sum = 0.8 + 0.4 - 0.5 * 0.2 - 0.5 * 0.5 * 0.2 = 1.05, weight 2.25
    own = Evaluations(np.array([0.8, 0.8, 0.6, 0.6, 0.0, 0.9]), np.array([1, 0.5, 1, 0.5, 1, 1.0]))
    reported = Evaluations(np.array([-1.0, -1.0, -0.2, -0.2, 0.0, 0.9]), own.visibility)
    evidence = SensorEvidence(np.array([99, 0]), np.array([False, True]), np.array([False, True]))
    params = TrustParams(method="trupercept_1")
    fused = fuse(FusionInput(LISTS, GROUPS, TABLE, EVALUATED, own, reported), SENDER_TRUST, evidence, DISTANCE, params)
    assert fused.score[0] == pytest.approx(1.05 / 2.25, abs=1e-12)
    assert fused.n_evaluations.tolist() == [4, 2]


def random_step(world, seed, params):
    """A step of a random world: groups, evaluations as made and as reported, trust in the senders, sensor evidence."""
    rng = np.random.default_rng(seed)
    n = world.n_vehicles
    groups = match(world.lists, world.table, world.pairs, params)
    own = evaluate(world.lists, groups, world.table, world.points, world.plausible, params)
    altered = rng.random(own.evaluation.size) < 0.2
    reported = Evaluations(np.where(altered, -own.evaluation, own.evaluation), np.where(altered, 1.0, own.visibility))
    arrived = rng.random((n, n)) < 0.7
    np.fill_diagonal(arrived, False)
    ptr = np.concatenate([[0], np.cumsum(arrived.sum(1))])
    sender_trust = SenderTrust(ptr, np.nonzero(arrived)[1], rng.random(ptr[-1]))
    g = groups.seeds().size
    evidence = SensorEvidence(rng.integers(5, 15, g), rng.random(g) < 0.7, rng.random(g) < 0.8)
    return groups, own, reported, sender_trust, evidence


@pytest.mark.parametrize("method", get_args(Method))
@given(world=worlds(), seed=seeds, one_per_vehicle=st.booleans())
@settings(max_examples=20)
def test_twin(method, world, seed, one_per_vehicle):
    params = TrustParams(method=method, one_per_vehicle=one_per_vehicle)
    lists = world.lists
    groups, own, reported, sender_trust, evidence = random_step(world, seed, params)
    fused = fuse(
        FusionInput(lists, groups, world.table, lists, own, reported), sender_trust, evidence, world.distance_m, params
    )
    names, detections = world.names(), world.dictionary()
    made, sent = (
        [
            {names[lists.member[p]]: (x.evaluation[p], x.visibility[p]) for p in range(lists.ptr[v], lists.ptr[v + 1])}
            for v in range(world.n_vehicles)
        ]
        for x in (own, reported)
    )
    ours = {
        (v, names[s]): (score, names[p])
        for v, s, score, p in zip(fused.ego.tolist(), fused.seed, fused.score, fused.pose, strict=True)
    }
    row = {(int(lists.of_member()[p]), names[lists.member[p]]): i for i, p in enumerate(groups.seeds())}
    n = 0
    for ego in range(world.n_vehicles):
        span = slice(sender_trust.ptr[ego], sender_trust.ptr[ego + 1])
        senders, value = sender_trust.message[span].tolist(), sender_trust.trust[span].tolist()
        trust = dict.fromkeys(range(world.n_vehicles), 0.5) | dict(zip(senders, value, strict=True)) | {ego: 1.0}
        for group in paper.match(world.names_in(ego), detections, world.iou(), params.tau, one_per_vehicle):
            if group[0][0] == ego and detections[group[0]].is_self:
                continue
            i = row[ego, group[0]]
            expected = paper.final_score(
                method, ego, group, detections, {v: sent[v] for v in senders} | {ego: made[ego]}, trust,
                int(evidence.n_points[i]), bool(evidence.plausible[i]), bool(evidence.in_range[i]),
            )  # fmt: skip
            score, pose = ours[ego, group[0]]
            assert score == pytest.approx(expected, abs=1e-12)
            if "corrected" in method and score > 0:
                assert pose == paper.closest(group, detections)
            n += 1
    assert n == fused.score.size


@given(world=worlds(), seed=seeds)
@settings(max_examples=30)
def test_code_parity_ignores_trust(world, seed):
    params = TrustParams(method="trupercept_2", code_parity=True)
    groups, own, reported, sender_trust, evidence = random_step(world, seed, params)
    a, b = (
        fuse(
            FusionInput(world.lists, groups, world.table, world.lists, own, reported),
            t,
            evidence,
            world.distance_m,
            params,
        )
        for t in (sender_trust, replace(sender_trust, trust=np.zeros(sender_trust.trust.size)))
    )
    np.testing.assert_array_equal(a.score, b.score)
