"""Roadside units, server, forwarding and piggybacked evaluations through the whole cycle of three vehicles."""

from dataclasses import replace

import numpy as np
import pytest

from cosim.addons.compare.scenarios import FOLDER, ScriptedScene
from cosim.base import rng
from cosim.base.codes import TrustSource
from cosim.config.config import load
from cosim.messages.trust_hosts import TrustHosts
from cosim.radio.message_round import RoundKind
from cosim.radio.rsu import NO_RSUS, RsuAntennas
from cosim.step import cycle
from cosim.step.parts import Parts
from cosim.step.state import State
from tests.drive import cosim
from tests.parts import DuplicatingMedium
from tests.scene import QUIET, play
from trust.open_steps import RejectReason


def unit(x, y):
    return RsuAntennas(np.array([[x, y, 6.0]]), np.array([rng.name_key("rsu")], np.uint64), np.array([6.0]))


def by_server(sensed):
    return (sensed.looked_up.lookups[0].source == TrustSource.SERVER).sum()


def test_in_an_outage_the_last_broadcast_ages():
    steps, _ = play(12, "server.outages=[[4, 8]]")
    reached = [t.servers[0].up.n_reached for t in steps]
    assert reached == [0 if 4 <= step < 8 else 3 for step in range(12)]
    assert [t.published[0] is None for t in steps] == [4 <= step < 8 for step in range(12)]
    assert all(t.servers[0].down.n_addressed == 0 for t in steps[4:8])
    # Broadcast at every step, used at 0.8 s after it; while the server is out, what was computed at 3 s grows old.
    ages = [float(t.looked_up.lookups[0].age_s.max()) for t in steps]
    assert ages == pytest.approx([0.0] + [0.8] * 3 + [1.8, 2.8, 3.8, 4.8] + [0.8] * 4)
    assert all(by_server(t) == 6 for t in steps[1:])
    before, after = steps[7].looked_up.lookups[0].trust, steps[3].looked_up.lookups[0].trust
    assert np.array_equal(before, after)


def test_after_an_outage_the_period_begins_anew():
    """Broadcasts at 0 s and 3 s; the next would be at 6 s, in the outage."""
    steps, _ = play(15, "server.outages=[[4, 8]]", "trust.server_period_s=3")
    assert [step for step, t in enumerate(steps) if t.published[0] is not None] == [0, 3, 8, 11, 14]


def test_without_a_server_its_uplink_needs_no_roadside_units():
    assert load(None, ["server.uplink=rsu", "trust.host=local", "trust_variant=[]"]).server.uplink == "rsu"


def test_through_a_roadside_unit():
    steps, _ = play(4, "server.uplink=rsu", "rsu.n_at_junctions=1", rsus=unit(20.0, 20.0))
    assert [t.servers[0].up.n_reached for t in steps] == [3] * 4
    assert [t.servers[0].down.n_informed for t in steps] == [3] * 4  # the first broadcast is empty
    assert [by_server(t) for t in steps] == [0, 6, 6, 6]
    for t in steps:  # it receives and sends, and evaluates nothing
        assert t.rounds[0].links.uplink.message.tolist() == [0, 1, 2] and t.rounds[
            1
        ].links.downlink.receiver.tolist() == [0, 1, 2]
        assert t.rounds[0].links.vehicles.message.max() <= 2 and t.listed.objects.observer.max() <= 2
    steps, _ = play(4, "server.uplink=rsu", "rsu.n_at_junctions=1", rsus=unit(5000.0, 20.0))
    assert all(t.servers[0].up.n_lost == 3 and t.servers[0].down.n_informed == 0 and by_server(t) == 0 for t in steps)


def test_a_relay_takes_reports_to_a_unit_out_of_reach():
    way = ("server.uplink=rsu", "rsu.n_at_junctions=1", "radio.range_m=60")
    near_the_third = unit(-8.0, 100.0)  # 52 m from it, 70 and more from the others
    for hops, reached in ((1, 1), (2, 3)):
        steps, _ = play(3, *way, f"radio.relay.max_hops={hops}", rsus=near_the_third)
        assert [t.servers[0].up.n_reached for t in steps] == [reached] * 3
        assert [t.servers[0].down.n_informed for t in steps] == [reached] * 3


def test_a_forwarded_evaluation_counts_once():
    """Copies by forwarding never reach the trust model; copies by the medium are rejected by it."""
    local = ("trust.host=local", "radio.relay.max_hops=3")
    steps, state = play(5, *local)
    assert sum(t.rounds[1].round.frames.n_duplicate for t in steps) > 0
    model = state.trust.hosts[0].model
    assert not model.rejected.any()
    config = load(FOLDER / "scenario-2.toml", [*QUIET, *local])
    steps, state = play(5, *local, medium=DuplicatingMedium(config.radio, config.round_s, config.seed))
    again = state.trust.hosts[0].model
    n = sum(
        int((t.evaluated.lists.of_member() != t.listed.detections.message[t.evaluated.lists.member]).sum())
        for t in steps
    )
    assert again.rejected[RejectReason.DUPLICATE] > n > 0
    one, other = model.scores(), again.scores()
    assert np.array_equal(one.trust, other.trust) and np.array_equal(one.n_evaluations, other.n_evaluations)


def test_piggybacked_evaluations_come_a_step_later():
    local = "trust.host=local"
    alone, one = play(6, local)
    carried, other = play(7, local, "radio.evaluations=piggybacked")
    for step in range(2):
        assert alone[step].rounds[1].round.frames.sent_bytes > 0 == carried[step].rounds[1].round.frames.sent_bytes
    # 16 bytes and 12 per evaluation of the last step more, one hop, no loss.
    n = int(carried[0].evaluated.lists.ptr[-1])
    extra = carried[1].rounds[0].round.frames.sent_bytes - carried[0].rounds[0].round.frames.sent_bytes
    assert extra == 3 * 16 + 12 * n
    # The same evaluations of the first six steps; of the seventh only one's own.
    one, other = one.trust.hosts[0].model, other.trust.hosts[0].model
    for step in range(6):
        a, b = one.store.steps[step], other.store.steps[step]
        assert np.array_equal(a.pairs, b.pairs) and np.array_equal(a.sums, b.sums)
    assert not one.rejected.any() and not other.rejected.any()
    # In fusion each has its own evaluations only.
    fused = carried[3].fused()[0].n_evaluations, alone[3].fused()[0].n_evaluations
    assert fused[0].max(initial=0) <= fused[1].max() and fused[0].sum() < fused[1].sum()


def test_piggybacked_through_a_unit():
    steps, _ = play(4, "server.uplink=rsu", "rsu.n_at_junctions=1", "radio.evaluations=piggybacked", rsus=unit(20, 20))
    assert [t.servers[0].up.n_reached for t in steps] == [0, 3, 3, 3]
    assert [by_server(t) for t in steps] == [0, 0, 6, 6]


def in_turns(n, *overrides, rsus=NO_RSUS):
    """Steps in which vehicles sense, every 4 s at times of their own; their evaluations travel with detections."""
    scene, turns = ScriptedScene.load(), ("sensing_interval_s=4", "sensing_phase=random")
    overrides = (*QUIET, *turns, "radio.evaluations=piggybacked", *overrides)
    parts = Parts.of(load(FOLDER / "scenario-2.toml", overrides), scene.city, rsus)
    state = State.start(parts)
    for number in range(n):
        state, result = cycle.step(scene.world(number), state, parts)
        if result.sensed is not None:
            yield result.sensed


def test_evaluations_that_wait_for_a_message_are_no_reports_yet():
    """Vehicles sense, and send, every 4 s at times of their own. What they evaluate in between waits."""
    through_unit = "server.uplink=rsu", "rsu.n_at_junctions=1", "radio.model=unit_disk"
    steps = list(in_turns(16, *through_unit, rsus=unit(20, 20)))
    made = sum(int((np.diff(t.evaluated.sent.ptr) > 0).sum()) for t in steps)
    up = [t.servers[0].up for t in steps]
    assert made - 3 == sum(one.n_reports for one in up) == sum(one.n_reached for one in up) > 0
    assert sum(one.n_lost for one in up) == 0


def test_piggybacked_evaluations_of_a_message_that_outlasts_its_round():
    """Frames of a station are 4.3 s apart, so messages arrive in the second round of their step or later."""
    given, original = set(), TrustHosts.add_local

    def noted(hosts, state, messages, vehicle, message, of_others=True):
        if of_others:
            given.update(zip(vehicle.tolist(), messages.evaluator[message].tolist(), strict=True))
        return original(hosts, state, messages, vehicle, message, of_others)

    slow = "radio.model=csma", "radio.timeout_s=2", "radio.dcc.t_off_s=[4.3, 4.3, 4.3, 4.3, 4.3]"
    n_arrived = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrustHosts, "add_local", noted)
        for t in in_turns(20, "trust.host=local", *slow):
            carrier = t.carried[-1]
            for late in (one for one in t.rounds[1].late if one.kind == RoundKind.CPM and carrier.evaluations):
                got = late.links.vehicles
                now = late.step[got.message] == carrier.step
                sender = t.senders.pseudonym[np.searchsorted(carrier.sender, late.sender[got.message[now]])]
                says = np.diff(carrier.evaluations.messages.ptr) > 0
                tells = np.isin(sender, carrier.evaluations.messages.evaluator[says])
                receiver = t.vehicles.actor[got.receiver[now][tells]]
                assert set(zip(receiver.tolist(), sender[tells].tolist(), strict=True)) <= given
                n_arrived += len(receiver)
            given.clear()
    assert n_arrived > 5


def test_causality_in_the_cycle():
    steps, _ = play(3, "radio.model=csma", "radio.relay.max_hops=2", rsus=unit(20.0, 20.0))
    for t in steps:
        for broadcast in t.rounds:
            for got in (broadcast.links.vehicles, broadcast.links.uplink, broadcast.links.downlink):
                assert (got.generation_offset_s >= 0).all() and (got.access_delay_s > 0).all()
                assert (got.latency_s > got.access_delay_s).all() and (got.received_s <= 0.4 + 1e-9).all()
    bad = steps[0].rounds[0].links.vehicles
    with pytest.raises(ValueError, match="before it is generated and sent"):
        replace(bad, latency_s=bad.access_delay_s - 1e-6)


def test_without_new_objects_no_message_is_sent():
    every = ("sensing_interval_s=0.5", "traffic.step_s=0.5", "cpm.rules=etsi")
    steps, _ = play(5, *every)
    # The scene stands still: vehicles are sent once a second, the pedestrian every half second by its observers.
    assert [int(t.listed.objects.transmitted.sum()) for t in steps] == [10, 2, 10, 2, 10]
    # No object, no message: the ego does not see the pedestrian.
    assert [t.rounds[0].round.frames.n_transmissions.tolist() for t in steps[:2]] == [[1, 1, 1], [0, 1, 1]]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("rsu.at=[[99999, 0, 6]]", r"rsu.at[0] = [99999, 0] m lies outside the network"),
        ("server.uplink=rsu", "there are no roadside units"),
        ("rsu.n_at_junctions=9999", "the network has no more than"),
        ("server.outages=[[9, 3]]", "server.outages[0] = [9, 3] s is no span of time"),
        ("radio.access.lifetime_s=0.0001", "shorter than the transmission"),
    ],
)
def test_a_mistake_is_reported_before_a_folder_is_made(tmp_path, override, words):
    done = cosim("run", "--set", override, "--out", str(tmp_path / "run"))
    line = " ".join(done.stderr.split())
    assert done.returncode == 2 and words in line and "Traceback" not in line
    assert not (tmp_path / "run").exists()
