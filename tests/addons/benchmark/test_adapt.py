from dataclasses import replace

import numpy as np
import pytest

from cosim.addons.benchmark.adapt import AdaptedEvidence, Policy, Search
from cosim.addons.benchmark.evidence import TABLES, load
from cosim.addons.benchmark.play import candidate
from tests.addons.benchmark.worlds import ATTACKERS, RULES, N, stream, tiny_set

HONEST = Policy("none", 1.0, 10.0, 0.0, 0.0, False)


def under(policy, seed=2):
    of = AdaptedEvidence(stream("none", seed), stream("collusion", seed), stream(policy.attack, seed))
    return of.under(policy, RULES)


def same(one, other, tables=tuple(TABLES)):
    return all(
        np.array_equal(getattr(one, name)[column], getattr(other, name)[column])
        for name in tables for column in TABLES[name].columns
    )  # fmt: skip


def test_the_extremes_are_recorded_worlds():
    """Law: to do nothing, to attack in all messages, and to falsify all evaluations are the recorded cases."""
    assert same(under(HONEST), stream("none", 2))
    assert same(under(replace(HONEST, attack="speed", deny_p=0.0)), stream("speed", 2))
    assert same(under(replace(HONEST, deny_p=1.0, praises=True)), stream("collusion", 2))
    assert same(under(replace(HONEST, deny_p=1.0)), stream("bad_mouthing", 2))
    attacked = under(replace(HONEST, attack="ghost_insertion"))
    assert same(attacked, stream("ghost_insertion", 2))


def test_a_schedule_mixes_true_and_false_messages():
    policy = replace(HONEST, attack="ghost_insertion", lie_p=0.5, period_s=4.0, sleep_s=2.0)
    steps = np.arange(RULES.n_steps)
    assert steps[policy.lies(steps, RULES)].tolist() == [6, 7, 10, 11]  # from 4 + 2 on, two of every four
    rows = under(policy).detections
    ghosts = rows["detection_index"] == 3
    assert set(rows["step"][ghosts].tolist()) == {6, 7, 10, 11}
    assert set(rows["observer"][ghosts].tolist()) == set(ATTACKERS)
    told = under(policy).evaluations
    assert set(told["step"][told["detection_index"] == 3].tolist()) == {6, 7, 10, 11}


def test_only_chosen_vehicles_are_denied_and_only_after_the_sleep():
    policy = replace(HONEST, deny_p=0.5, sleep_s=3.0)
    rows, plain = under(policy).evaluations, stream("none", 2).evaluations
    false = (rows["evaluation"] == -100) & (rows["visibility"] == 100) & np.isin(rows["evaluator"], ATTACKERS)
    denied = set(rows["observer"][false & (rows["step"] >= 7)].tolist())
    assert 0 < len(denied) < N - len(ATTACKERS) and not denied & set(ATTACKERS)
    for name in ("step", "evaluator", "observer", "evaluation"):
        before, after = (of[name][of["step"] < 7] for of in (rows, plain))
        assert np.array_equal(before, after), "asleep, they are honest"
    others = [~np.isin(of["evaluator"], ATTACKERS) for of in (rows, plain)]
    assert np.array_equal(rows["visibility"][others[0]], plain["visibility"][others[1]])


def test_in_disguise_falsified_evaluations_have_values_of_honest_ones():
    """The same rows are falsified, with the same signs; no honest evaluation here is 1 with full visibility."""
    policy = replace(HONEST, attack="ghost_insertion", deny_p=1.0, praises=True)
    plain, hidden = under(policy).evaluations, under(replace(policy, disguised=True)).evaluations
    keys = ("step", "evaluator", "observer", "detection_index")
    assert all(np.array_equal(plain[c], hidden[c]) for c in keys)
    assert np.array_equal(np.sign(plain["evaluation"]), np.sign(hidden["evaluation"]))
    false = np.isin(plain["evaluator"], ATTACKERS) & (plain["step"] >= RULES.start_step)
    assert (plain["visibility"][false] == 100).all() and (hidden["visibility"][false] < 100).all()
    assert len(np.unique(hidden["evaluation"][false])) > 10, "confirmed with many values"
    for name in ("evaluation", "visibility"):
        assert np.array_equal(plain[name][~false], hidden[name][~false]), "those of honest vehicles stay"
    assert "in disguise" in replace(policy, disguised=True).words


def test_the_search_finds_more_harm_than_it_begins_with_and_the_same_again():
    search = Search(tiny_set(), candidate("beta", [], RULES), 0.5, lambda *_: None)
    assert search.attacks() == ["none", "ghost_insertion"], "speed leaves no trace in the evidence"
    assert search.worlds() == [0, 2], "of each city the first with the highest penetration"
    harm = {n: search.run(n, seed=1) for n in (6, 20)}
    assert [found.budget for found in harm.values()] == [6, 20]
    assert harm[20].figures.harm.value >= harm[6].figures.harm.value
    assert repr(search.run(20, seed=1)) == repr(harm[20])
    with pytest.raises(ValueError, match="--budget 4"):
        search.run(4)
    few = replace(search.evidence, rules=replace(RULES, cases=RULES.cases[:3]))
    with pytest.raises(ValueError, match="mixes collusion with an attack on detections"):
        replace(search, evidence=few).run(20)


@pytest.mark.verify
def test_on_the_shipped_set_a_policy_without_schedule_is_almost_the_recorded_attack():
    """Detections are equal. What differs are receptions, because other messages change the load of the channel: less
    than 0.5 % of the evaluations, and 2 % of the look-ups, most in the busiest world (Helsinki, 30 %, seed 1002), and
    under attacks that make messages shorter, or add some.
    """
    found = load()
    rules, of = found.rules, {}
    for world in range(len(found.worlds)):
        for attack in rules.cases[1:9]:
            case = found.stream(world, rules.cases.index(attack))
            policy = replace(HONEST, attack=attack)
            other = found.stream(world, rules.cases.index("collusion"))
            made = AdaptedEvidence(found.stream(world, 0), other, case).under(policy, rules)
            for name in ("detections", "evaluations", "lookups"):
                one, other = (
                    {*zip(*(v.tolist() for v in getattr(s, name).values()), strict=True)} for s in (made, case)
                )
                share = len(one ^ other) / len(other)
                of[name] = max(of.get(name, 0.0), share)
    assert of["detections"] == 0 and of["evaluations"] < 0.005 and of["lookups"] < 0.02, of
