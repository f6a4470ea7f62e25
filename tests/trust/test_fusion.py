"""Final scores by hand, by law, and against the slow transcription."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.trust.worlds import worlds
from tests.verification import paper
from trust.evaluation import evaluate
from trust.fusion import METHODS, Heard, Sight, fuse
from trust.matching import match
from trust.params import Method, TrustParams
from trust.tables import Detections, Groups, Verdicts, Views


def test_every_method_has_a_formula():
    assert set(METHODS) == set(get_args(Method))


# One ego (vehicle 0), groups in the order of their seeds:
#   A  own 0.8, with vehicle 1's 0.6                 B  vehicle 2's 0.9, the ego has not seen it
# verdicts on A's two: ego (0.8, 1), (0.8, 0.5); vehicle 1 (0.6, 1), (0.6, 0.5); on B: vehicle 1 (eta, 1), 2 (0.9, 1)
# trust: ego 1, vehicle 1: 0.5, vehicle 2: 0.25
#   A: sum Phi T e = 0.8 + 0.4 + 0.3 + 0.15 = 1.65, sum Phi T = 1 + 0.5 + 0.5 + 0.25 = 2.25
#   B: sum Phi T e = 0.5 eta + 0.225, sum Phi T = 0.75
TABLE = Detections(
    np.array([0, 1, 2]),
    np.array([1, 1, 1]),
    np.zeros(3, np.uint8),
    np.array([0.8, 0.6, 0.9]),
    np.zeros(3, bool),
    np.zeros(3, bool),
)
VIEWS = Views(np.array([0, 3]), np.arange(3), np.array([0]))
GROUPS = Groups(np.array([0, 0, 2]), np.array([True, True, False]))
SAID = Views(np.array([0, 2, 5, 6]), np.array([0, 1, 0, 1, 2, 2]), np.array([0, 1, 2]))
HEARD = Heard(np.array([0, 2]), np.array([1, 2]), np.array([0.5, 0.25]))
DISTANCE = np.array([30.0, 10.0, 5.0])


def by_hand(method, eta=-1.0, points=0, plausible=True, near=True, heard=HEARD, **options):
    verdicts = Verdicts(np.array([0.8, 0.8, 0.6, 0.6, eta, 0.9]), np.array([1, 0.5, 1, 0.5, 1, 1.0]))
    sight = Sight(np.array([99, points]), np.array([False, plausible]), np.array([False, near]))
    params = TrustParams(method=method, **options)
    return fuse(VIEWS, GROUPS, TABLE, SAID, verdicts, heard, sight, DISTANCE, params)


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
    assert fused.local.tolist() == [True, False]
    assert fused.n_witnesses.tolist() == [2, 1]
    assert fused.n_verdicts.tolist() == [4, 2]


@pytest.mark.parametrize("method", ["trupercept_1", "trupercept_1_local_bias", "trupercept_2", "trupercept_3"])
def test_plausibility_removes_foreign_groups_only(method):
    sure, denied = by_hand(method, 0.0), by_hand(method, 0.0, plausible=False)
    assert denied.score[0] == sure.score[0] > 0
    assert sure.score[1] > denied.score[1] == 0
    off = by_hand(method, 0.0, plausible=False, plausibility_in_fusion=False)
    assert off.score[1] == sure.score[1]


def test_trupercept_3_where_the_ego_can_see():
    assert by_hand("trupercept_3", 0.0, points=9).score[1] > 0
    assert by_hand("trupercept_3", 0.0, points=10).score[1] == 0
    assert by_hand("trupercept_3", 0.0, points=10, blind_points=11).score[1] > 0
    # beyond the sensor's range neither returns nor free space say anything
    assert by_hand("trupercept_3", 0.0, points=10, plausible=False, near=False).score[1] > 0


def test_ego_trust():
    # A with the ego twice as strong: (0.8 + 0.4) 2 + 0.45 over 3 + 0.75
    assert by_hand("trupercept_1", ego_trust=2.0).score[0] == pytest.approx(2.85 / 3.75, abs=1e-12)
    # its own trust as it knows it, 0.25, then the default when it knows nothing
    known = Heard(np.array([0, 3]), np.array([0, 1, 2]), np.array([0.25, 0.5, 0.25]))
    computed = by_hand("trupercept_1", heard=known, ego_trust_from="computed")
    assert computed.score[0] == pytest.approx((0.3 + 0.45) / (0.375 + 0.75), abs=1e-12)
    default = by_hand("trupercept_1", ego_trust_from="computed", default_trust=0.5)
    assert default.score[0] == pytest.approx((0.6 + 0.45) / (0.75 + 0.75), abs=1e-12)
    # what the ego hears of its own trust is not used otherwise, and its verdicts count once
    np.testing.assert_array_equal(by_hand("trupercept_1", heard=known).score, by_hand("trupercept_1").score)


def test_unheard_vehicles_say_nothing():
    alone = by_hand("trupercept_1", 0.0, heard=Heard(np.array([0, 0]), np.zeros(0, int), np.zeros(0)))
    assert alone.score.tolist() == pytest.approx([0.8, 0.0], abs=1e-12)
    assert alone.n_verdicts.tolist() == [2, 0]


def test_hearing_twice_is_hearing_once():
    twice = Heard(np.array([0, 4]), np.array([2, 1, 1, 2]), np.array([0.25, 0.5, 0.5, 0.25]))
    np.testing.assert_array_equal(by_hand("trupercept_2", heard=twice).score, by_hand("trupercept_2").score)


@pytest.mark.parametrize("bad", [(np.nan, 1.0), (1.0, np.nan), (2.0, 1.0), (1.0, 1.5), (1.0, -0.1)])
def test_bad_verdicts_move_nothing(bad):
    e, phi = bad
    good = Verdicts(np.array([0.8]), np.array([1.0]))
    said = Views(np.array([0, 1]), np.array([0]), np.array([0]))
    more = Views(np.array([0, 1, 2]), np.array([0, 0]), np.array([0, 1]))
    sight = Sight(np.zeros(2, int), np.ones(2, bool), np.ones(2, bool))
    a = fuse(VIEWS, GROUPS, TABLE, said, good, HEARD, sight, DISTANCE, TrustParams(method="trupercept_1"))
    both = Verdicts(np.array([0.8, e]), np.array([1.0, phi]))
    b = fuse(VIEWS, GROUPS, TABLE, more, both, HEARD, sight, DISTANCE, TrustParams(method="trupercept_1"))
    np.testing.assert_array_equal(a.score, b.score)
    np.testing.assert_array_equal(a.n_verdicts, b.n_verdicts)


def test_closest_pose():
    assert by_hand("corrected").pose.tolist() == [1, 2]  # 10 m beats 30 m
    assert by_hand("local").pose.tolist() == [0, 2]
    assert by_hand("corrected", code_parity=True).pose.tolist() == [0, 2]
    # a self report at 0 m is taken unless excluded
    reported = replace(TABLE, is_self=np.array([False, True, False]))
    verdicts = Verdicts(np.zeros(6), np.ones(6))
    sight = Sight(np.zeros(2, int), np.ones(2, bool), np.ones(2, bool))
    for allowed, pose in ((True, 1), (False, 0)):
        params = TrustParams(method="corrected", self_report_poses=allowed)
        fused = fuse(VIEWS, GROUPS, reported, SAID, verdicts, HEARD, sight, DISTANCE, params)
        assert fused.pose[0] == pose


def test_the_ego_itself_is_no_output():
    selfish = replace(TABLE, is_self=np.array([True, False, False]))
    verdicts = Verdicts(np.zeros(6), np.ones(6))
    sight = Sight(np.zeros(2, int), np.ones(2, bool), np.ones(2, bool))
    fused = fuse(VIEWS, GROUPS, selfish, SAID, verdicts, HEARD, sight, DISTANCE, TrustParams())
    assert fused.seed.tolist() == [2]


def random_step(world, seed, params):
    """A whole step of a random world: who hears whom, with what trust, and what the egos' sweeps say."""
    rng = np.random.default_rng(seed)
    n = world.n_vehicles
    groups = match(world.views, world.table, world.pairs, params)
    verdicts = evaluate(world.views, groups, world.table, world.points, world.plausible, params)
    ears = rng.random((n, n)) < 0.7
    np.fill_diagonal(ears, False)
    ptr = np.concatenate([[0], np.cumsum(ears.sum(1))])
    heard = Heard(ptr, np.nonzero(ears)[1], rng.random(ptr[-1]))
    g = groups.seeds().size
    sight = Sight(rng.integers(5, 15, g), rng.random(g) < 0.7, rng.random(g) < 0.8)
    return groups, verdicts, heard, sight


@pytest.mark.parametrize("method", get_args(Method))
@given(world=worlds(), seed=st.integers(0, 2**32 - 1), one_per_vehicle=st.booleans())
@settings(max_examples=40, deadline=None)
def test_twin(method, world, seed, one_per_vehicle):
    params = TrustParams(method=method, one_per_vehicle=one_per_vehicle)
    groups, verdicts, heard, sight = random_step(world, seed, params)
    fused = fuse(world.views, groups, world.table, world.views, verdicts, heard, sight, world.distance_m, params)
    names, truth, views = world.names(), world.dictionary(), world.views
    said = {}
    for view in range(world.n_vehicles):
        span = range(views.ptr[view], views.ptr[view + 1])
        said[view] = {names[views.member[p]]: (verdicts.e[p], verdicts.phi[p]) for p in span}
    ours = {
        (v, names[s]): (score, names[p])
        for v, s, score, p in zip(fused.view.tolist(), fused.seed, fused.score, fused.pose, strict=True)
    }
    row = {(int(views.of_member()[p]), names[views.member[p]]): i for i, p in enumerate(groups.seeds())}
    n = 0
    for ego in range(world.n_vehicles):
        who = heard.vehicle[heard.ptr[ego] : heard.ptr[ego + 1]].tolist()
        value = heard.trust[heard.ptr[ego] : heard.ptr[ego + 1]].tolist()
        trust = dict.fromkeys(range(world.n_vehicles), 0.5) | dict(zip(who, value, strict=True)) | {ego: 1.0}
        for group in paper.match(world.lists(ego), truth, world.iou(), params.tau, one_per_vehicle):
            if group[0][0] == ego and truth[group[0]].is_self:
                continue
            i = row[ego, group[0]]
            expected = paper.final_score(
                method, ego, group, truth, {v: said[v] for v in (ego, *who)}, trust,
                int(sight.n_points[i]), bool(sight.plausible[i]), bool(sight.near[i]),
            )  # fmt: skip
            score, pose = ours[ego, group[0]]
            assert score == pytest.approx(expected, abs=1e-12)
            if "corrected" in method and score > 0:
                assert pose == paper.closest(group, truth)
            n += 1
    assert n == fused.score.size


@given(world=worlds(), seed=st.integers(0, 2**32 - 1), parity=st.booleans())
@settings(max_examples=40, deadline=None)
def test_scores_stay_in_bounds(world, seed, parity):
    for method in METHODS:
        params = TrustParams(method=method, code_parity=parity)
        fused = fuse(
            world.views, *(s := random_step(world, seed, params))[:1], world.table, world.views, *s[1:],
            world.distance_m, params,
        )  # fmt: skip
        assert np.all((fused.score >= 0) & (fused.score <= 1))


@given(world=worlds(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_code_parity_ignores_trust(world, seed):
    params = TrustParams(method="trupercept_2", code_parity=True)
    groups, verdicts, heard, sight = random_step(world, seed, params)
    a, b = (
        fuse(world.views, groups, world.table, world.views, verdicts, h, sight, world.distance_m, params)
        for h in (heard, replace(heard, trust=np.zeros(heard.trust.size)))
    )
    np.testing.assert_array_equal(a.score, b.score)
