"""Roadside units, server, relays and piggybacked verdicts through the whole cycle; three vehicles in a street."""

from dataclasses import replace

import numpy as np
import pytest
from trust.page import Refusal

from cosim import cycle, rng
from cosim.config import load
from cosim.cycle import FROM_SERVER, State, turn
from cosim.radio.message_round import Receptions
from cosim.radio.rsu import NO_RSUS, RsuAntennas
from cosim.reproduce import FOLDER, Stage
from cosim.stopwatch import Stopwatch
from tests.drive import cosim

BASE = ("server.cellular.delay_min_s=0.001", "server.cellular.delay_mean_s=0.002", "server.backhaul_s=0.005",
        "adversary.start_s=1000")  # fmt: skip


def unit(x, y):
    return RsuAntennas(np.array([[x, y, 6.0]]), np.array([rng.name_key("rsu")], np.uint64))


def play(n, *overrides, sites=NO_RSUS):
    """Turns of the paper's scene, second by second, and the state at the end."""
    stage, config = Stage.load(), load(FOLDER / "scenario-2.toml", [*BASE, *overrides])
    state, watch = State.start(config, stage.city, sites), Stopwatch()
    turns = [turn(stage.world(step), stage.city, state, config, watch, stage.perceive) for step in range(n)]
    return turns, state


def by_server(happened):
    return (happened.known.source == FROM_SERVER).sum()


def test_an_outage_leaves_everybody_with_what_they_last_heard():
    turns, _ = play(12, "server.outages=[[4, 8]]")
    reached = [t.to_server.up.n_reached for t in turns]
    assert reached == [0 if 4 <= step < 8 else 3 for step in range(12)]
    assert [t.standing is None for t in turns] == [4 <= step < 8 for step in range(12)]
    assert all(t.to_server.n_addressed == 0 for t in turns[4:8])
    # Broadcast at every step, used at 0.8 s after it; while the server is out, what was computed at 3 s grows old.
    ages = [float(t.known.age_s.max()) for t in turns]
    assert ages == pytest.approx([0.0] + [0.8] * 3 + [1.8, 2.8, 3.8, 4.8] + [0.8] * 4)
    assert all(by_server(t) == 6 for t in turns[1:])
    before, after = turns[7].known.trust, turns[3].known.trust
    assert np.array_equal(before, after)


def test_through_a_roadside_unit():
    turns, _ = play(4, "server.uplink=rsu", "rsu.n_at_junctions=1", sites=unit(20.0, 20.0))
    assert [t.to_server.up.n_reached for t in turns] == [3] * 4
    assert [t.to_server.n_informed for t in turns] == [3] * 4  # the first edition knows nobody, and says so
    assert [by_server(t) for t in turns] == [0, 6, 6, 6]
    for t in turns:  # it hears and speaks, and is nobody's witness
        assert t.links[0].uplink.message.tolist() == [0, 1, 2] and t.links[1].downlink.receiver.tolist() == [0, 1, 2]
        assert t.links[0].vehicles.message.max() <= 2 and t.said.observer.max() <= 2
    turns, _ = play(4, "server.uplink=rsu", "rsu.n_at_junctions=1", sites=unit(5000.0, 20.0))
    assert all(t.to_server.up.n_lost == 3 and t.to_server.n_informed == 0 and by_server(t) == 0 for t in turns)


def test_a_relay_takes_reports_to_a_unit_out_of_reach():
    way = ("server.uplink=rsu", "rsu.n_at_junctions=1", "radio.range_m=60")
    near_the_third = unit(-8.0, 100.0)  # 52 m from it, 70 and more from the others
    for hops, reached in ((1, 1), (2, 3)):
        turns, _ = play(3, *way, f"radio.relay.max_hops={hops}", sites=near_the_third)
        assert [t.to_server.up.n_reached for t in turns] == [reached] * 3
        assert [t.to_server.n_informed for t in turns] == [reached] * 3


def test_a_unit_far_away_changes_nothing():
    air = ("radio.model=csma", "radio.propagation.model=log_distance")
    alone, _ = play(3, *air)
    beside, _ = play(3, *air, sites=unit(50_000.0, 0.0))
    for one, other in zip(alone, beside, strict=True):
        for a, b in zip(one.links, other.links, strict=True):
            for name in Receptions.__slots__:
                assert np.array_equal(getattr(a.vehicles, name), getattr(b.vehicles, name)), name


def test_a_relayed_verdict_counts_once(monkeypatch):
    """The relays' copies never reach the ledger; and if they did, it would refuse them."""
    local = ("trust.where=local", "radio.relay.max_hops=3")
    turns, state = play(5, *local)
    assert sum(t.rounds[1].frames.n_duplicate for t in turns) > 0
    assert state.refusals() == {}
    honest = cycle.by_link

    def twice(happened, n):
        got = honest(happened, n)
        return got._replace(vehicles=got.vehicles.take(np.repeat(np.arange(len(got.vehicles.message)), 2)))

    monkeypatch.setattr(cycle, "by_link", twice)
    views = cycle._views  # no detection is looked at twice, or nothing would match
    monkeypatch.setattr(cycle, "_views", lambda heard, *rest: views(heard.take(np.s_[::2]), *rest))
    _, again = play(5, *local)
    n = sum(int(np.diff(t.views.ptr).sum()) for t in turns)
    assert again.ledger.refused[Refusal.DUPLICATE] > n > 0
    one, other = state.ledger.standing(), again.ledger.standing()
    assert np.array_equal(one.trust, other.trust) and np.array_equal(one.n_verdicts, other.n_verdicts)


def test_piggybacked_verdicts_come_a_turn_later():
    local = "trust.where=local"
    alone, one = play(6, local)
    riding, other = play(7, local, "radio.evaluations=piggybacked")
    # The same verdicts on the first six steps; of the seventh only one's own.
    for step in range(2):
        assert alone[step].rounds[1].frames.sent_bytes > 0 == riding[step].rounds[1].frames.sent_bytes
    # 16 bytes and 12 per verdict of the last turn more, one hop, no loss.
    told = int(riding[0].views.ptr[-1])
    extra = riding[1].rounds[0].frames.sent_bytes - riding[0].rounds[0].frames.sent_bytes
    assert extra == 3 * 16 + 12 * told
    pages = [(one.ledger.pages[s], other.ledger.pages[s]) for s in range(6)]
    for a, b in pages:
        assert np.array_equal(a.n_used, b.n_used)
    assert one.refusals() == other.refusals() == {}
    # In fusion each has its own judgement only.
    assert riding[3].fused.n_verdicts.max(initial=0) <= alone[3].fused.n_verdicts.max()
    assert riding[3].fused.n_verdicts.sum() < alone[3].fused.n_verdicts.sum()


def test_piggybacked_through_a_unit():
    turns, _ = play(4, "server.uplink=rsu", "rsu.n_at_junctions=1", "radio.evaluations=piggybacked", sites=unit(20, 20))
    assert [t.to_server.up.n_reached for t in turns] == [0, 3, 3, 3]
    assert [by_server(t) for t in turns] == [0, 0, 6, 6]


def test_causality_in_the_cycle():
    turns, _ = play(3, "radio.model=csma", "radio.relay.max_hops=2", sites=unit(20.0, 20.0))
    for t in turns:
        for links in t.links:
            for heard in links:
                assert (heard.generation_offset_s >= 0).all() and (heard.access_delay_s > 0).all()
                assert (heard.latency_s > heard.access_delay_s).all() and (heard.received_s <= 0.4 + 1e-9).all()
    bad = turns[0].links[0].vehicles
    with pytest.raises(AssertionError):
        replace(bad, latency_s=bad.access_delay_s - 1e-6)


def test_with_nothing_new_to_say_nobody_speaks():
    every = ("sensing_interval_s=0.5", "traffic.step_s=0.5", "radio.cpm_rules=etsi")
    turns, _ = play(5, *every)
    # The scene stands still: vehicles are said once a second, the pedestrian every half second by who sees it.
    assert [int(t.said.said.sum()) for t in turns] == [10, 2, 10, 2, 10]
    # Who says nothing sends nothing: the ego does not see the pedestrian.
    assert [t.rounds[0].frames.n_transmissions.tolist() for t in turns[:2]] == [[1, 1, 1], [0, 1, 1]]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("rsu.at=[[99999, 0, 6]]", r"rsu.at[0] = [99999, 0] m lies outside the network"),
        ("server.uplink=rsu", "there are no roadside units"),
        ("rsu.n_at_junctions=100000", "the network has no more than"),
        ("server.outages=[[9, 3]]", "server.outages[0] = [9, 3] s is not an interval of time"),
        ("radio.access.lifetime_s=0.0001", "shorter than the transmission"),
    ],
)
def test_what_cannot_be_is_said_before_a_folder_is_made(tmp_path, override, words):
    done = cosim("run", "--set", override, "--out", str(tmp_path / "run"))
    said = " ".join(done.stderr.split())
    assert done.returncode == 2 and words in said and "Traceback" not in said
    assert not (tmp_path / "run").exists()
