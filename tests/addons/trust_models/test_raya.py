"""Models that score objects: votes by hand and against a literal count, the five rules, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings

from cosim.addons.trust_models.raya import RayaParams
from tests.seeds import seeds
from tests.trust import test_fusion as f
from tests.trust.worlds import worlds
from trust.fusion import SensorEvidence, fuse
from trust.models import MODELS
from trust.object_reports import ObjectReports
from trust.params import TrustParams
from trust.tables import Evaluations, FusionInput

RULES = ("raya_majority", "raya_most_trusted", "raya_weighted", "raya_bayes", "raya_dempster_shafer")


def scored(name, reports, **own):
    return MODELS[name](RayaParams(**own), 1.0).score_objects(reports)


# Two in favour, F = 0.8 and 0.4, one against, F = 0.6; a second object with one in favour, F = 0.8
REPORTS = ObjectReports(
    np.array([0, 0, 0, 1]), np.array([True, True, False, True]), np.array([1.0, 0.5, 0.75, 1.0]), np.full(4, 0.8), 2
)


@pytest.mark.parametrize(
    ("name", "a", "b"),
    [
        ("raya_majority", 2 / 3, 1.0),
        ("raya_most_trusted", 0.8 / 1.4, 1.0),
        ("raya_weighted", 1.2 / 1.8, 1.0),
        # 0.8 0.4 0.4 against 0.2 0.6 0.6: 0.128 / 0.2
        ("raya_bayes", 0.64, 0.8),
        # p = 0.2 0.6 = 0.12, q = 0.4: belief 0.88 0.4 / (1 - 0.88 0.6) = 0.352 / 0.472
        ("raya_dempster_shafer", 0.352 / 0.472, 0.8),
    ],
)
def test_rules_by_hand(name, a, b):
    assert scored(name, REPORTS).tolist() == pytest.approx([a, b], abs=1e-12)
    # trust 0.8 in every vehicle is the fixed 0.8
    assert scored(name, REPORTS, trust_from="vehicle").tolist() == pytest.approx([a, b], abs=1e-12)


@pytest.mark.parametrize("n", [3, 9, 60, 400])
def test_belief_by_dempster_where_many_contradict_each_other(n):
    """As many against as in favour, all with F = 0.8: (1 - p) p / (2 p - p^2) = (1 - p) / (2 - p), with p = 0.2^n."""
    in_favour = np.repeat([True, False], n)
    reports = ObjectReports(np.zeros(2 * n, int), in_favour, np.ones(2 * n), np.full(2 * n, 0.8), 1)
    p = 0.2**n
    assert scored("raya_dempster_shafer", reports).tolist() == pytest.approx([(1 - p) / (2 - p)], rel=1e-12)
    one_sided = ObjectReports(np.zeros(n, int), np.zeros(n, bool), np.ones(n), np.full(n, 0.8), 1)
    assert scored("raya_dempster_shafer", one_sided).tolist() == [0.0]


def captured(*args):
    """Votes that a fusion asks a model about, by (group, seed detection)."""
    seen = []

    def keep(reports):
        seen.append(reports)
        return np.full(reports.n_groups, 0.5)

    fuse(FusionInput(*args[:6]), *args[6:], TrustParams(), keep)
    return seen[0]


def test_a_vehicle_has_one_vote_per_object():
    # as in test_fusion: A is seen by ego and vehicle 1 (matched), B by vehicle 2 alone, vehicle 1 denies it
    e = Evaluations(np.array([0.8, 0.8, 0.6, 0.6, -1.0, 0.9]), np.array([1, 0.5, 0.25, 0.5, 1, 1.0]))
    evidence = SensorEvidence(np.zeros(2, int), np.ones(2, bool), np.ones(2, bool))
    got = captured(f.LISTS, f.GROUPS, f.TABLE, f.EVALUATED, e, e, f.SENDER_TRUST, evidence, f.DISTANCE)
    votes = sorted(
        zip(got.group.tolist(), got.in_favour.tolist(), got.visibility.tolist(), got.trust.tolist(), strict=True)
    )
    assert votes == [(0, True, 0.5, 0.5), (0, True, 1.0, 1.0), (1, False, 1.0, 0.5), (1, True, 1.0, 0.25)]


@given(world=worlds(), seed=seeds)
@settings(max_examples=25)
def test_twin(world, seed):
    """Votes counted one by one with dictionaries, and the rules as products over them."""
    params = TrustParams()
    groups, own, reported, senders, evidence = f.random_step(world, seed, params)
    arrived = np.random.default_rng(seed).random(senders.message.size) < 0.8
    senders = replace(senders, has_evaluations=arrived)
    lists = world.lists
    args = (lists, groups, world.table, lists, own, reported, senders, evidence, world.distance_m)
    got = captured(*args)
    message, seeds = world.table.message, groups.seeds().tolist()
    expected = {}
    for x in range(world.n_vehicles):
        positions = range(lists.ptr[x], lists.ptr[x + 1])
        at = {int(lists.member[p]): p for p in positions}
        heard = {x: (1.0, True)}
        for h in range(senders.ptr[x], senders.ptr[x + 1]):
            heard[int(senders.message[h])] = senders.trust[h], arrived[h]
        for v, (trust, has) in heard.items():
            votes = {}
            for p in positions:
                if message[lists.member[p]] == v:
                    votes.setdefault(seeds.index(groups.seed[p]), []).append((2, None))
            for s in range(lists.ptr[v], lists.ptr[v + 1]) if has else ():
                p = at.get(int(lists.member[s]))
                source = own if v == x else reported
                if p is not None and source.visibility[s] > 0:
                    side = 2 if source.evaluation[s] > 0 else 1
                    votes.setdefault(seeds.index(groups.seed[p]), []).append((side, source.visibility[s]))
            for g, of_group in votes.items():
                side = max(side for side, _ in of_group)
                phi = [phi for s, phi in of_group if s == side and phi is not None]
                expected[g, v] = side == 2, max(phi, default=1.0), trust
    assert len(expected) == got.group.size
    rows = sorted(
        zip(got.group.tolist(), got.in_favour.tolist(), got.visibility.tolist(), got.trust.tolist(), strict=True)
    )
    assert rows == sorted((g, *map(float, vote)) for (g, _), vote in expected.items())
    for name in RULES:
        ours = scored(name, got, trust_from="vehicle")
        for g in range(got.n_groups):
            votes = [(a, float(np.clip(phi * t, 0.01, 0.99))) for (h, _), (a, phi, t) in expected.items() if h == g]
            assert ours[g] == pytest.approx(literal(name, votes), abs=1e-9)
            assert 0 <= ours[g] <= 1


def literal(name, votes):
    """A rule over votes (in favour, F)."""
    yes, no = [w for a, w in votes if a], [w for a, w in votes if not a]
    if not votes:
        return 0.5 if name == "raya_bayes" else 0.0
    if name == "raya_majority":
        return len(yes) / len(votes)
    if name == "raya_most_trusted":
        return max(yes, default=0) / (max(yes, default=0) + max(no, default=0))
    if name == "raya_weighted":
        return sum(yes) / sum(yes + no)
    if name == "raya_bayes":
        event = np.prod(yes) * np.prod([1 - w for w in no])
        nothing = np.prod([1 - w for w in yes]) * np.prod(no)
        return event / (event + nothing)
    belief, disbelief, either = 0.0, 0.0, 1.0
    for a, w in votes:
        mine, other = (w, 0.0) if a else (0.0, w)
        m = belief * (mine + 1 - w) + either * mine, disbelief * (other + 1 - w) + either * other, either * (1 - w)
        belief, disbelief, either = (x / sum(m) for x in m)
    return belief
