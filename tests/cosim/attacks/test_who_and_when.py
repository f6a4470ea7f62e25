"""Who attacks, when, and whom; several attacks at once; new identities; bad input."""

import numpy as np
import pytest

from cosim.attacks.params import AttackParams, rings_too_large
from cosim.config.config import load, resolve_data
from tests.cosim.attacks.plain import NAMES, SPACING_M, N, play

LIARS = ["v00", "v07", "v15", "v23"]
WHO = [NAMES.index(name) for name in LIARS]
GHOST = {"ids": LIARS, "attack": "ghost_insertion", "ghosts": "car"}


def liars_by_step(tables):
    found = tables["detections"]
    return found[found.lied].groupby("at").observer.agg(lambda o: sorted(set(o)))


def test_the_share_is_that_of_the_equipped():
    """40 equipped vehicles, a share of 0.5: 20 attackers give or take 4 standard deviations of 3.2."""
    tables = play([{"attack": "removal", "share_p": 0.5}], n_steps=2)
    assert abs(tables["detections"].query("lied").observer.nunique() - 20) < 13


def test_sporadic():
    by_step = liars_by_step(play([GHOST | {"when": "sporadic", "active_p": 0.3}], n_steps=20))
    n = by_step.map(len).sum()
    assert abs(n - 24) < 5 * np.sqrt(80 * 0.3 * 0.7)  # of 80
    assert by_step.map(tuple).nunique() > 3, "each by itself"


@pytest.mark.parametrize("keys", [{"period_s": 4.0}, {"period_windows": 2.0}])
def test_on_off(keys):
    """From step 1 on: three on, one off, with a period of 4 s and a duty of 0.75."""
    attack = GHOST | {"when": "on_off", "start_s": 1.0, "duty_p": 0.75} | keys
    by_step = liars_by_step(play([attack], n_steps=10, trust={"freshness_s": 2.0}))
    assert by_step.index.tolist() == [1, 2, 3, 5, 6, 7, 9] and by_step.map(lambda who: who == WHO).all()


def test_sleeper_wakes_for_good_once_it_is_trusted():
    tables = play([GHOST | {"when": "sleeper", "wake_trust": 0.3}], n_steps=8, trust={"default_trust": 0.2})
    trust, lies = tables["trust"], liars_by_step(tables)
    for who in WHO:
        trusted = trust[(trust.subject == who) & (trust.trust >= 0.3)]["at"].min()
        active = [at for at in lies.index if who in lies[at]]
        assert active == list(range(int(trusted) + 1, 8)), "from the first broadcast that says so"


def test_camouflage_lies_while_it_is_trusted_above_the_threshold():
    tables = play([GHOST | {"when": "camouflage", "keep_above": 0.25}], n_steps=10, trust={"default_trust": 0.5})
    trust = tables["trust"].set_index(["at", "subject"]).trust
    lies = liars_by_step(tables)
    seen = set()
    for at in range(2, 10):
        for who in WHO:
            told = trust.get((at - 1, who), 0.5)  # broadcast in the step before, received within 2 ms
            lied = at in lies.index and who in lies[at]
            assert lied == (told > 0.25)
            seen.add(lied)
    assert seen == {True, False}


@pytest.mark.parametrize("keys", [
    {"victim": "one", "victim_id": "v11"}, {"victim": "region", "region_m": [60.0, 4.0, 20.0]},
    {"victim": "random", "victim_range_m": 40.0}, {"victim": "nearest"}, {"victim": "designated", "victim_p": 0.2},
])  # fmt: skip
def test_victims(keys):
    tables = play([GHOST | keys], n_steps=8, tables=("detections", "actors"))
    found, world = tables["detections"], tables["actors"]
    ghosts = found[found.lied]
    assert len(ghosts) > 8
    pairs = ghosts.merge(world, on="at", suffixes=("", "_of"))
    in_front = (pairs.x_m - pairs.x_m_of - 8.0).abs() + (pairs.y_m - pairs.y_m_of).abs() < 1e-6
    pairs = pairs[in_front]
    assert len(pairs) == len(ghosts) and (pairs.actor != pairs.observer).all()
    x, y = pairs.x_m_of - 10.0 * pairs["at"], pairs.y_m_of
    liar_x, liar_y = SPACING_M * (pairs.observer % 10), 4.0 * (pairs.observer // 10)
    away = np.hypot(x - liar_x, y - liar_y)
    if keys["victim"] == "one":
        assert (pairs.actor == 11).all()
    elif keys["victim"] == "region":
        assert (np.hypot(pairs.x_m_of - 60.0, pairs.y_m_of - 4.0) <= 20.0).all()
    elif keys["victim"] == "random":
        assert (away <= 40.0).all() and pairs.groupby("observer").actor.nunique().min() > 3
    elif keys["victim"] == "designated":
        egos = np.array(sorted(set(pairs.actor)))
        assert 3 <= len(egos) < 20 and not set(egos) & set(WHO), "a share of all, and none that attacks"
        ego_x, ego_y = SPACING_M * (egos % 10), 4.0 * (egos // 10)
        nearest = np.hypot(ego_x[:, None] - liar_x.to_numpy(), ego_y[:, None] - liar_y.to_numpy()).min(axis=0)
        assert (away >= nearest - 1e-9).all(), "the nearest of these"
        assert pairs.groupby("observer").actor.nunique().max() == 1, "and the same in every step"
    else:
        np.testing.assert_allclose(away, 4.0)


def test_two_attacks_by_the_same_vehicles():
    tables = play([GHOST, {"attack": "bad_mouthing", "together_with": 0}], n_steps=3)
    assert set(tables["detections"].query("lied").observer) == set(WHO)
    lies = tables["evaluations"].query("lied")
    assert set(lies.evaluator) == set(WHO) and (lies.evaluation[lies.evaluator != lies.observer] == -1).all()


def test_the_same_vehicles_attack_at_the_same_time_unless_a_section_says_when():
    """The third section goes with the second, and so with the first."""
    sections = [{"start_s": 15.0}, {"together_with": 0}, {"together_with": 1}, {"together_with": 0, "start_s": 40.0}]
    config = resolve_data({"encounters": [{}], "attacks": sections}, "a test", None)
    assert [attack.start_s for attack in config.attacks] == [15.0, 15.0, 15.0, 40.0]


def test_whitewashing_takes_a_new_pseudonym_when_trust_has_fallen():
    attack = GHOST | {"renewal": "whitewashing", "renew_below": 0.5}
    tables = play([attack], n_steps=10)
    names, trust = tables["pseudonyms"], tables["trust"].set_index(["at", "subject"]).trust
    assert names[~names.vehicle.isin(WHO)].pseudonym.tolist() == [i for i in range(N) if i not in WHO]
    changed = names[names.vehicle.isin(WHO) & (names.to_step < 9)]
    assert len(changed) > 2
    for row in changed.itertuples():
        assert trust[row.to_step, row.pseudonym] < 0.5


def test_attackers_read_no_trust_that_nobody_has_broadcast():
    """The default trust, 0.7, was never broadcast: the first values are those that are received in step 1."""
    whitewashing = GHOST | {"renewal": "whitewashing", "renew_below": 0.8}
    names = play([whitewashing], n_steps=2, trust={"default_trust": 0.7})["pseudonyms"]
    assert len(names) == N
    for when in ({"when": "sleeper", "wake_trust": 0.6}, {"when": "camouflage", "keep_above": 0.6}):
        tables = play([GHOST | when], n_steps=2, trust={"default_trust": 0.7})
        assert liars_by_step(tables).empty


def test_newcomers_change_after_a_time():
    names = play([GHOST | {"renewal": "newcomer", "renew_s": 3.0}], n_steps=10)["pseudonyms"]
    mine = names[names.vehicle.isin(WHO)].sort_values(["vehicle", "from_step"])
    assert mine.groupby("vehicle").from_step.apply(list).tolist() == [[0, 3, 6, 9]] * len(LIARS)


@pytest.mark.parametrize(("sets", "told"), [
    ("attacks.0.share_p=0.6 attacks.1.share_p=0.6", "sum to 1.2, more than all equipped vehicles"),
    ('attacks.0.ids=["a","b"] attacks.0.ring_size=3', "ring_size = 3 is larger than its 2 attackers"),
    ("attacks.0.when=on_off attacks.0.period_s=0.5", "a period of 0.5 s is shorter than one step of 1 s"),
    ("attacks.0.when=on_off attacks.0.period_windows=0.5 trust.freshness_s=1.0", "period of 0.5 s"),
    ("attacks.0.when=on_off attacks.0.period_windows=1 trust.freshness_s=off", "there are no windows"),
    ("attacks.0.attack=gohst", 'attacks.attack = "gohst": no such choice'),
    ("attacks.0.attack=offset attacks.0.min_m=9 attacks.0.max_m=3", "min_m = 9 m is above attacks.max_m = 3 m"),
    ("attacks.0.attack=offset attacks.0.ghosts=car", "attacks.0.ghosts: unknown key"),
    ("attacks.0.victim=one", "Set attacks.0.victim_id"),
    ("attacks.0.victim_id=v1", 'used only with victim = "one"'),
    ("attacks.0.together_with=0", "no earlier section"),
    ('attacks.0.ids=["a"] attacks.1.ids=["a"]', '"a" stands in ids twice'),
    ("attacks.0.when=camouflage trust.host=local", 'trust.host = "local"'),
    ("attacks=[] pseudonyms.linkage=server trust.host=local", "needs a trust server"),
    ("attacks=[] pseudonyms.revocation=list trust.host=none", "decided by the trust server"),
])  # fmt: skip
def test_mistakes_are_one_line(sets, told):
    with pytest.raises(ValueError) as error:
        load(None, sets.split())
    assert told in str(error.value) and "\n" not in str(error.value)


def test_a_ring_larger_than_the_attackers_is_told():
    """Ten of forty attack by share: rings of ten are whole, rings of twelve, of the same vehicles, never."""
    attack = np.repeat(np.array([0, 1], np.uint8), [30, 10])
    sections = [AttackParams(ring_size=10), AttackParams(together_with=0, ring_size=12), AttackParams(ring_size=2)]
    first, second = rings_too_large(sections, attack)
    assert first.startswith("attacks.1.ring_size = 12 is larger than its 10 attackers")
    assert second.startswith("attacks.2.ring_size = 2 is larger than its 0 attackers") and "\n" not in first
    assert not rings_too_large(sections[:1], attack)
