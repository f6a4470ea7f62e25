"""Pseudonyms that change, who links them, and what it costs an attacker."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from cosim.messages.linkage import Linkage
from cosim.messages.pseudonyms import PseudonymParams, PseudonymState
from cosim.messages.relinking import KnownSenders, ReceivedSenders, update_senders
from tests.cosim.attacks.plain import NAMES, N, play
from tests.drive import noted
from tests.slow import slow
from tests.trust.histories import messages_from_rows
from trust.claims import claim_number
from trust.params import KINDS
from trust.tables import SERVER, TrustScores

LIARS = ["v00", "v07", "v15", "v23"]
WHO = [NAMES.index(name) for name in LIARS]
GHOST = {"ids": LIARS, "attack": "ghost_insertion", "ghosts": "car"}
POLICIES = {
    "periodical": {"period_s": 2.0}, "disposable": {"n_messages": 3}, "distance": {"distance_m": 25.0},
    "random": {"change_p": 0.4}
}  # fmt: skip
NAMED = {"observer", "evaluator", "sender", "subject", "source", "pose", "pseudonym"}


def with_vehicles(tables):
    """All tables with vehicles in the place of their pseudonyms, in one order."""
    names = tables["pseudonyms"].set_index("pseudonym").vehicle
    renamed = {}
    for table, rows in tables.items():
        if table in ("pseudonyms", "observability"):
            continue
        rows = rows.copy()
        for name in NAMED & set(rows.columns):
            if not (table == "fused" and name == "observer"):
                rows[name] = rows[name].map(names)
        renamed[table] = rows.sort_values(list(rows.columns), kind="stable").reset_index(drop=True)
    return renamed


@pytest.fixture(scope="module")
def constant():
    return with_vehicles(play([GHOST], n_steps=8))


@pytest.mark.verify
@pytest.mark.parametrize("policy", POLICIES)
def test_linkage_at_the_server_equals_no_policy_but_for_names(policy, constant):
    """Bit for bit, in every table, though pseudonyms change several times."""
    pseudonyms = {"policy": policy, "linkage": "server"} | POLICIES[policy]
    tables = play([GHOST], n_steps=8, pseudonyms=pseudonyms)
    assert tables["pseudonyms"].groupby("vehicle").size().mean() > 1.5
    assert not set(tables["pseudonyms"].pseudonym) <= set(range(N))
    found = with_vehicles(tables)
    for name in constant:
        pd.testing.assert_frame_equal(found[name], constant[name], check_exact=True, check_dtype=False)


@pytest.mark.verify
def test_sybil_identities_are_one_vehicle_to_a_linking_server():
    attack = {"ids": LIARS, "attack": "bad_mouthing", "n_identities": 4}
    linked = play([attack], pseudonyms={"linkage": "server"})
    alone = play([attack | {"n_identities": 1}])
    a, b = (t["trust"].set_index(["at", "subject"]).trust for t in (linked, alone))
    of_own = a[a.index.get_level_values("subject") < N]
    assert len(b) > 100 and of_own.equals(b), "four identities of one vehicle count once"
    assert len(a) > len(b), "and each of them has its value"
    many = play([attack])["trust"].set_index(["at", "subject"]).trust
    honest = [i for i in range(N) if i not in WHO]
    assert many[many.index.get_level_values("subject").isin(honest)].mean() < alone["trust"].set_index("subject").trust[
        honest].mean(), "without linkage each identity counts"  # fmt: skip


FAST, SLOW_STEPS = [500.0] * 8, {"traffic": {"step_s": 50.0}, "sensing_interval_s": 50.0}
"""Everybody drives half a kilometre per step; steps of 50 s, so that rules in minutes and kilometres change names."""


@pytest.mark.parametrize("policy", ["c2c", slow("bsp"), slow("scms")])
def test_the_same_of_policies_in_minutes_and_kilometres(policy):
    given = {"n_steps": 8, "speeds": FAST, "trust": {"freshness_s": 1000.0}} | (SLOW_STEPS if policy != "bsp" else {})
    tables = play([GHOST], pseudonyms={"policy": policy, "linkage": "server"}, **given)
    assert tables["pseudonyms"].groupby("vehicle").size().mean() > 1.05
    found, constant = with_vehicles(tables), with_vehicles(play([GHOST], **given))
    for name in constant:
        pd.testing.assert_frame_equal(found[name], constant[name], check_exact=True, check_dtype=False)


def trust_used(tables):
    """Trust that receivers look up for attackers in the last four steps, and the share of defaults among it."""
    names = tables["pseudonyms"].set_index("pseudonym").vehicle
    used = tables["trust_lookups"]
    used = used[used.subject.map(names).isin(WHO) & (used["at"] >= 8)]
    return used.trust.mean(), (used.source == 2).mean()


@pytest.mark.verify
def test_whitewashing_beats_a_server_without_linkage_and_not_one_with_it():
    attack = GHOST | {"renewal": "whitewashing", "renew_below": 0.45}
    plain = trust_used(play([GHOST], n_steps=12))
    free = trust_used(play([attack], n_steps=12))
    held = trust_used(play([attack], n_steps=12, pseudonyms={"linkage": "server"}))
    assert held == plain
    assert free[0] > plain[0] and free[1] > 0.2 > plain[1]


def test_linkage_on_demand_begins_with_the_accused_pseudonym():
    pseudonyms = {"policy": "periodical", "period_s": 4.0, "linkage": "on_demand", "n_accusations": 5}
    tables = play([GHOST], n_steps=12, pseudonyms=pseudonyms)
    state = tables.state.pseudonyms
    linked = np.flatnonzero(state.linked >= 0)
    owners = tables.parts.pseudonyms.owners(state, state.linked[linked])[0]
    assert (owners == linked).all()
    assert set(WHO) & set(linked.tolist()) or not len(linked)


@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_claims_of_further_identities_keep_their_kind(kind):
    """Detection 4 of the third further identity of vehicle 0, and of its own; no number of one is one of the other."""
    owned = SimpleNamespace(owners=lambda state, pseudonym: (np.zeros(2, int), np.array([0, 3])))
    numbers = claim_number(np.array([4, 4]), kind)
    _, index = Linkage(PseudonymParams(linkage="server"), owned).keys(None, np.array([7, 8]), numbers)
    most = claim_number(np.array([256]), 0)[0]
    assert (index % len(KINDS) == kind).all() and index[1] - index[0] > most


def test_a_report_that_is_relayed_accuses_once():
    """Two accusations are wanted. One report arrives twice, in two steps; then there is one of the next step."""
    owned = SimpleNamespace(owners=lambda state, pseudonym: (np.zeros(len(pseudonym), int), None))
    linkage = Linkage(PseudonymParams(linkage="on_demand", n_accusations=2), owned)
    state = PseudonymState(linked=np.array([-1]))
    reports = [messages_from_rows(step, [7], [3], [1], [-1.0], [1.0]) for step in (4, 4, 5)]
    for report, is_linked in zip(reports, (False, False, True), strict=True):
        state = linkage.accused(state, [report])
        assert (state.linked[0] == 3) == is_linked
    assert not state.accusations


def test_a_sender_is_silent_after_an_interval_only():
    """Receiver 0 hears 1 and 2 once a second, at other times, and then 3 where 1 would be. 2 is not silent yet."""
    params = PseudonymParams(linkage="own", own_gap_s=1.5, own_gate_m=3.0)

    def heard(known, time_s, pseudonym, x_m):
        received = ReceivedSenders(
            np.array([0]), np.array([pseudonym]), np.array([[x_m, 0.0]]), np.array([[10.0, 0.0]])
        )
        return update_senders(known, received, time_s, 1.0, lambda of: of, params)

    known = heard(heard(KnownSenders(), 0.0, 1, 0.0), 0.6, 2, 6.0)
    known = heard(known, 1.0, 3, 10.0)
    assert known.n_linked == 1 and sorted(known.pseudonym.tolist()) == [2, 3], "both would be at 10 m"
    known = heard(KnownSenders(), 0.0, 1, 0.0)
    known = heard(known, 0.8, 3, 8.0)
    assert known.n_linked == 0 and sorted(known.pseudonym.tolist()) == [1, 3]


@pytest.mark.parametrize("gap_s", [0.2, 0.5, 1.0])
def test_a_sender_that_sends_often_is_silent_soon(gap_s):
    """One sender at 10 m/s changes its pseudonym once, in a fleet in which others send once a second."""
    params = PseudonymParams(linkage="own", own_gap_s=1.5, own_gate_m=3.0)
    known = KnownSenders()
    for k, pseudonym in enumerate([1, 1, 1, 2, 2]):
        place = np.array([[10.0 * gap_s * k, 0.0]])
        received = ReceivedSenders(np.array([0]), np.array([pseudonym]), place, np.array([[10.0, 0.0]]))
        known = update_senders(known, received, gap_s * k, 1.0, lambda of: 0 * of, params)
    assert (known.n_changes, known.n_linked, known.n_right) == (1, 1, 1)
    assert known.gap_s.tolist() == pytest.approx([gap_s])


def test_reports_that_accuse_nobody_change_nothing():
    owned = SimpleNamespace(owners=lambda state, pseudonym: (np.zeros(len(pseudonym), int), None))
    state = PseudonymState(linked=np.array([-1]))
    kind = messages_from_rows(4, [7], [3], [1], [1.0], [1.0])
    after = Linkage(PseudonymParams(linkage="on_demand"), owned).accused(state, [kind])
    assert after.linked.tolist() == [-1] and not after.accusations


def test_a_gap_that_nobody_fits_is_noted():
    sets = ["pseudonyms.linkage=own", "sensing_groups.0.share_p=0.5", "sensing_groups.0.interval_s=5"]
    (line,) = [line for line in noted(*sets) if "own_gap_s" in line]
    assert "shorter than the 5 s that may lie between two messages" in line
    assert not [line for line in noted(*sets[:1]) if "own_gap_s" in line]


@pytest.mark.parametrize(("linkage", "n"), [("server", 10), ("server", 1), ("none", 10)])
def test_identities_that_a_server_links_are_noted(linkage, n):
    sets = ["attacks.0.attack=bad_mouthing", f"attacks.0.n_identities={n}", f"pseudonyms.linkage={linkage}"]
    lines = [line for line in noted(*sets) if "n_identities" in line]
    assert len(lines) == (linkage == "server" and n > 1)
    assert all(line.startswith("note: attacks.0.n_identities = 10") and "one evaluator" in line for line in lines)


def test_identities_that_are_linked_to_the_accused_one_have_its_value():
    """Pseudonyms 3, 5, 8 and 9 of vehicle 0 are in use at once, 9 is the vehicle's own, and 5 is accused.

    From then on, 8 and 9 are known as 5, and what was known of 9 itself is superseded. 3 came before the accused one.
    """
    owned = SimpleNamespace(
        owners=lambda state, pseudonym: (np.zeros(len(pseudonym), int), np.zeros(len(pseudonym), int))
    )
    linkage = Linkage(PseudonymParams(linkage="on_demand"), owned)
    extra = np.zeros((3, 4), int)
    extra[:, 1] = 3, 5, 8
    state = SimpleNamespace(current=np.array([9]), linked=np.array([5]), extra=extra)
    n = np.arange(3)
    columns = dict.fromkeys(("n_evaluations", "newest_step", "oldest_step", "newest_evaluation_step"), n)
    scores = TrustScores(
        step=4, holder=SERVER + 0 * n, subject=np.array([3, 5, 9]),
        trust=0.1 * n, uncertainty=0.0 * n, weight=0.0 * n,
        oldest_evaluation_step=n, is_evaluated=n >= 0, **columns,
    )  # fmt: skip
    found = linkage.scores(state, scores)
    assert found.subject.tolist() == [3, 5, 8, 9] and found.trust.tolist() == [0.0, 0.1, 0.1, 0.1]
    state = SimpleNamespace(current=np.array([4]), linked=np.array([5]), extra=extra[:2])
    before = linkage.scores(state, scores.take(n[:2]))
    assert before.subject.tolist() == [3, 5]


def test_detections_of_the_accused_identity_and_of_the_vehicle_s_own_are_kept_apart():
    """Pseudonyms 5, 8 and 9 of vehicle 0 are its identities 2, 3 and 0; 5 is accused, and each reports itself."""
    of = {5: (0, 2), 8: (0, 3), 9: (0, 0)}
    owned = SimpleNamespace(owners=lambda state, pseudonym: np.array([of[p] for p in pseudonym]).T)
    linkage = Linkage(PseudonymParams(linkage="on_demand"), owned)
    subject, index = linkage.keys(SimpleNamespace(linked=np.array([5])), np.array([5, 8, 9]), np.array([0, 0, 0]))
    assert subject.tolist() == [5, 5, 5]
    assert index[0] == 0, "as before the link"
    assert len(set(index)) == 3


def test_receivers_link_by_place_and_speed():
    """All change every 3 s, drive straight on and are received every second: nearly all links are found, and right."""
    pseudonyms = {"policy": "periodical", "period_s": 3.0, "linkage": "own"}
    tables = play([GHOST], n_steps=10, pseudonyms=pseudonyms)
    known = tables.state.known_senders
    assert known.n_changes > 1000 and known.n_linked > 0.95 * known.n_changes
    assert known.n_right > 0.95 * known.n_linked


@pytest.mark.parametrize(("how", "first"), [("immediate", None), ("list", 6)])
def test_revocation(how, first):
    """Messages of attackers whose trust is below the limit are received no more."""
    pseudonyms = {"revocation": how, "revoke_below": 0.45, "min_evaluations": 1, "list_every_s": 6.0}
    tables = play([GHOST], n_steps=10, pseudonyms=pseudonyms)
    names = tables["pseudonyms"].dropna(subset="refused_step")
    assert len(names) > 0
    trust = tables["trust"].set_index(["at", "subject"]).trust
    for row in names.itertuples():
        low = [at for at in range(10) if trust.get((at, row.pseudonym), 1.0) < 0.45]
        assert row.refused_step == (low[0] if first is None else first)
        used = tables["trust_lookups"].query("subject == @row.pseudonym")
        assert used["at"].max() < row.refused_step
        assert tables["evaluations"].query("observer == @row.pseudonym and evaluator != observer")["at"].max() < (
            row.refused_step)  # fmt: skip


def test_who_is_not_renewed_falls_silent_after_the_present_pseudonym():
    pseudonyms = {"policy": "periodical", "period_s": 4.0, "revocation": "not_renewed", "revoke_below": 0.45,
                  "min_evaluations": 1}  # fmt: skip
    tables = play([GHOST], n_steps=12, pseudonyms=pseudonyms)
    names = tables["pseudonyms"]
    refused = names.dropna(subset="refused_step")
    assert len(refused) > 0 and (refused.from_step == refused.refused_step).all() and (refused.from_step % 4 == 0).all()
    assert set(refused.vehicle) <= set(tables["pseudonyms"].vehicle)
