"""Rounds of messages over the shared channel: receptions, their times, and the outcome of every frame."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

from cosim.base.codes import LosState
from cosim.radio.csma import CsmaMedium
from cosim.radio.dcc import DccParams
from cosim.radio.message_round import ChannelAbuse, Messages, Outcome, RoundKind, Stations
from cosim.radio.params import RadioParams, RelayParams
from cosim.radio.propagation import PropagationParams
from sensors.line_of_sight import LosOfPlaces, WallIndex
from sensors.scene import Scene

QUIET = PropagationParams(
    model="free_space", shadowing=False, fading="none", blockage="none", interference_range_m=5000
)


def line(n, apart_m):
    return np.column_stack([np.arange(n) * apart_m, np.zeros(n), np.full(n, 1.6)])


def los_of(rings):
    """Buildings of 20 m."""
    city = Scene.from_footprints([[np.array(r)] for r in rings], [0.0] * len(rings), [20.0] * len(rings))
    return LosOfPlaces(WallIndex.of(city.buildings))


def keys_of(n):
    return np.arange(1, n + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)


def medium_of(range_m=300.0, propagation=QUIET, los=None, **relay):
    return CsmaMedium(RadioParams(range_m=range_m, propagation=propagation, relay=RelayParams(**relay)), 0.2, 5, los)


def rounds(xyz, length, n=1, sends=None, keys=None, **how):
    """(receptions, frames) of n rounds, half a second apart, of a fifth of a second each."""
    medium = medium_of(**how)
    sends = np.ones(len(xyz), bool) if sends is None else sends
    stations = Stations(keys_of(len(xyz)) if keys is None else keys, xyz, len(xyz))
    messages = Messages.one_each(np.broadcast_to(length, len(xyz)) * sends)
    state, found = medium.start(), []
    for i in range(n):
        state, happened = medium.broadcast(state, RoundKind(i % 2), i // 2, 0.5 * i, stations, messages)
        found.append((happened.receptions, happened.frames))
    return found


def pairs(received):
    return set(zip(received.receiver.tolist(), received.message.tolist(), strict=True))


def test_without_fading_or_load_exactly_the_stations_in_range_receive():
    xyz = line(12, 90.0)
    for i in range(12):  # one at a time: nothing to collide with
        ((received, frames),) = rounds(xyz, 300, sends=np.arange(12) == i)
        near = np.flatnonzero(np.abs(xyz[:, 0] - xyz[i, 0]) <= 300)
        assert pairs(received) == {(r, i) for r in near.tolist() if r != i}
        assert (frames.outcome == Outcome.RECEIVED).all() and len(frames.outcome) == len(near) - 1
        # 40 us + 8 us * ceil((22 + 8 * 336) / 48) = 496 us on the air, after 58 + 6 slots of silence at most
        assert (received.latency_s >= 496e-6).all() and (received.latency_s < 700e-6).all()


def test_every_frame_in_range_has_an_outcome():
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(0, 800, (150, 2)), np.full(150, 1.6)])
    (received, frames), *_ = rounds(xyz, 700, propagation=PropagationParams(model="log_distance"))
    apart = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    assert len(frames.outcome) == (apart <= 300).sum() - 150
    assert (frames.outcome == Outcome.RECEIVED).sum() == len(received.receiver)
    assert {Outcome.RECEIVED, Outcome.PROPAGATION, Outcome.COLLISION} <= set(frames.outcome.tolist())


def test_a_long_message_needs_all_its_segments():
    xyz = line(2, 100.0)
    ((received, frames),) = rounds(xyz, 3000, sends=np.array([True, False]))
    assert pairs(received) == {(1, 0)}
    assert frames.n_transmissions.tolist() == [3, 0] and len(frames.outcome) == 3
    weak = PropagationParams(model="log_distance", exponent=3.0, shadowing=False)
    got = [rounds(xyz, length, n=200, propagation=weak) for length in (1000, 3000)]
    whole, cut = (np.mean([len(received.receiver) for received, _ in many]) / 2 for many in got)
    frame = np.mean([np.mean(frames.outcome == Outcome.RECEIVED) for _, frames in got[1]])
    assert 0.3 < cut < whole < 1
    assert cut == pytest.approx(frame**3, abs=0.1)  # segments fade independently


def test_forwarding_hop_by_hop():
    xyz = line(8, 250.0)
    first = np.arange(8) == 0
    reached = {}
    for hops in (1, 2, 3):
        ((received, frames),) = rounds(xyz, 300, sends=first, max_hops=hops, range_m=260.0)
        reached[hops] = dict(zip(received.receiver.tolist(), received.hops.tolist(), strict=True))
        assert frames.n_relayed == hops - 1
    assert reached == {1: {1: 1}, 2: {1: 1, 2: 2}, 3: {1: 1, 2: 2, 3: 3}}


def test_links_are_kept_while_no_station_moves():
    rng = np.random.default_rng(7)
    xyz = np.column_stack([rng.uniform(0, 500, (50, 2)), np.full(50, 1.6)])
    medium = medium_of(propagation=PropagationParams(model="log_distance"))
    kept = fresh = medium.start()
    for i in range(4):
        if i == 2:
            xyz[:, 0] += 40.0 * rng.random(50)  # in place
        before, stations = kept.cache, Stations(keys_of(50), xyz, 50)
        round_ = RoundKind(i % 2), i // 2, 0.5 * i, stations, Messages.one_each(np.full(50, 400))
        kept, one = medium.broadcast(kept, *round_)
        fresh, other = medium.broadcast(replace(fresh, cache=None), *round_)
        assert (kept.cache is before) == (i in (1, 3))
        one, other = one.receptions, other.receptions
        assert np.array_equal(one.receiver, other.receiver) and np.array_equal(one.latency_s, other.latency_s)


def test_a_state_can_be_copied_pickled_and_used_again():
    medium, stations = medium_of(max_hops=2), Stations(keys_of(40), line(40, 20.0), 40)
    messages = Messages.one_each(np.full(40, 600))
    state, _ = medium.broadcast(medium.start(), RoundKind.CPM, 0, 0.0, stations, messages)
    copies = [state, copy.deepcopy(state), pickle.loads(pickle.dumps(state)), state]  # asking twice changes nothing
    results = [medium.broadcast(s, RoundKind.EVALUATION, 0, 0.2, stations, messages)[1] for s in copies]
    for other in results[1:]:
        for name in ("receiver", "message", "latency_s"):
            assert np.array_equal(getattr(results[0].receptions, name), getattr(other.receptions, name))


def test_several_messages_of_one_station():
    xyz = line(3, 100.0)
    params = RadioParams(propagation=QUIET, dcc=DccParams(enabled=False))  # else its frames are 50 ms apart at least
    medium, stations = CsmaMedium(params, 0.2, 5, None), Stations(keys_of(3), xyz, 3)
    messages = Messages(np.array([0, 1, 1, 1]), np.array([0, 300, 3000, 500]))
    _, happened = medium.broadcast(medium.start(), RoundKind.CPM, 0, 0.0, stations, messages)
    found = happened.receptions
    assert list(zip(found.receiver.tolist(), found.message.tolist(), strict=True)) == [
        (r, m) for r in (0, 2) for m in (1, 2, 3)
    ]  # fmt: skip
    assert happened.frames.n_transmissions.tolist() == [0, 1, 3, 1]
    first = {m: found.generation_offset_s[found.message == m] for m in (1, 2, 3)}
    assert len({float(x[0]) for x in first.values()}) == 3 and all(len(set(x.tolist())) == 1 for x in first.values())
    # The first message of a station is as it would be alone, up to the time of access.
    _, alone = medium.broadcast(
        medium.start(), RoundKind.CPM, 0, 0.0, stations, Messages.one_each(np.array([0, 300, 0]))
    )
    assert alone.receptions.generation_offset_s.tolist() == first[1].tolist()


def test_a_delayed_message_is_generated_later_or_not_sent():
    xyz = line(2, 100.0)
    medium, stations = medium_of(), Stations(keys_of(2), xyz, 2)
    offsets = []
    for delay_s in (None, np.array([0.05, 0.0]), np.array([0.3, 0.0])):
        messages = Messages(np.arange(2), np.array([300, 0]), delay_s)
        _, happened = medium.broadcast(medium.start(), RoundKind.CPM, 0, 0.0, stations, messages)
        offsets.append(happened.receptions.generation_offset_s.tolist())
    assert offsets[1][0] == pytest.approx(offsets[0][0] + 0.05) and offsets[2] == []
    assert happened.frames.outcome.tolist() == [Outcome.EXPIRED]


@pytest.mark.parametrize("max_hops", [1, 3])
def test_no_messages_and_a_single_station(max_hops):
    ((received, frames),) = rounds(line(3, 10.0), 300, sends=np.zeros(3, bool), max_hops=max_hops)
    assert len(received.receiver) == len(frames.outcome) == 0 and frames.sent_bytes == 0
    ((received, frames),) = rounds(line(1, 10.0), 300, max_hops=max_hops)
    assert len(received.receiver) == len(frames.outcome) == 0 and frames.n_transmissions.tolist() == [1]


def test_generation_access_and_reception_of_every_message():
    xyz = line(40, 12.0)
    for length in (400, 2500):  # one frame, and two
        for received, frames in rounds(xyz, length, n=3, max_hops=2):
            assert len(pairs(received)) == len(received.receiver) and (received.receiver != received.message).all()
            assert (frames.cbr > 0.1).all() and (frames.cbr <= 1).all()
            assert (received.generation_offset_s >= 0).all() and (
                received.generation_offset_s < 0.1
            ).all()  # in the first half of the round
            assert (received.access_delay_s >= 58e-6).all()  # AIFS
            assert (received.latency_s > received.access_delay_s).all()
            assert (received.received_s <= 0.2).all()
            first = {}  # a message is generated once for all receivers
            for s, at in zip(received.message.tolist(), received.generation_offset_s.tolist(), strict=True):
                assert first.setdefault(s, at) == at


def test_lower_power_or_a_longer_message_only_reduces_receptions():
    rng = np.random.default_rng(4)
    xyz = np.column_stack([rng.uniform(0, 500, (60, 2)), np.full(60, 1.6)])

    def delivered(length, power_dbm):
        air = PropagationParams(model="log_distance", tx_power_dbm=power_dbm)
        return sum(len(received.receiver) for received, _ in rounds(xyz, length, n=12, propagation=air, range_m=500.0))

    powers = [delivered(400, dbm) for dbm in (23.0, 17.0, 11.0)]
    assert powers == sorted(powers, reverse=True) and powers[2] < 0.7 * powers[0]
    lengths = [delivered(n, 23.0) for n in (200, 1300, 4000)]
    assert lengths == sorted(lengths, reverse=True) and lengths[2] < 0.9 * lengths[0]


def test_los_state_of_frames():
    xyz = np.array([[0.0, 0, 1.6], [50, 0, 1.6], [120, 0, 1.6], [130, 30, 1.6]])
    house = [[[70.0, -50], [90, -50], [90, 90], [70, 90]]]
    urban = PropagationParams(blockage="none")
    ((_, frames),) = rounds(xyz, 300, propagation=urban, los=los_of(house))
    across = (frames.message < 2) != (frames.receiver < 2)
    assert (
        np.array_equal(frames.los_state == LosState.NLOS, across) and (frames.los_state[~across] == LosState.LOS).all()
    )
    ((_, frames),) = rounds(xyz, 300)
    assert (frames.los_state == LosState.UNKNOWN).all()


def test_ends_of_frames():
    xyz = line(5, 100.0)
    ((received, frames),) = rounds(xyz, 300, sends=np.arange(5) == 2, max_hops=2, range_m=150.0)
    own = frames.hop == 1
    assert set(zip(frames.message[own].tolist(), frames.receiver[own].tolist(), strict=True)) == {(2, 1), (2, 3)}
    assert set(frames.receiver[~own].tolist()) <= {0, 1, 3, 4}  # the sender's own message does not count at the sender
    assert pairs(received) == {(0, 2), (1, 2), (3, 2), (4, 2)}


def jammed_line(react, power_dbm=23.0, interference_range_m=5000.0):
    """Who of stations at 150, 200, 270 and 290 m receives from 0 m while the last one, at 600 m, jams."""
    xyz = np.column_stack([[0.0, 150.0, 200.0, 270.0, 290.0, 600.0], np.zeros(6), np.full(6, 1.6)])
    off, on = np.full(6, -np.inf), np.where(np.arange(6) == 5, power_dbm, -np.inf)
    abuse = ChannelAbuse(off if react else on, on if react else off, np.zeros(6, bool))
    medium = medium_of(propagation=replace(QUIET, interference_range_m=interference_range_m))
    messages = Messages.one_each(np.where(np.arange(6) == 0, 300, 0))
    _, happened = medium.broadcast(
        medium.start(), RoundKind.CPM, 0, 0.0, Stations(keys_of(6), xyz, 6, abuse=abuse), messages
    )
    lost = happened.frames.outcome[happened.frames.outcome != Outcome.RECEIVED]
    assert (lost == Outcome.COLLISION).all()
    return sorted(xyz[happened.receptions.receiver, 0].tolist())


def test_jammers_by_hand():
    """In free space the signal is 20 log((600 - d) / d) dB above the noise of a jammer as strong as the sender: 9.5 dB
    at 150 m, 6.0 at 200, 1.7 at 270 and 0.6 at 290; a preamble needs 4 dB, a payload of 300 bytes 2.8."""
    assert jammed_line(react=False) == jammed_line(react=True) == [150.0, 200.0]
    assert jammed_line(react=False, power_dbm=16.0) == [150.0, 200.0, 270.0, 290.0]  # 7 dB less
    assert jammed_line(react=False, power_dbm=33.0) == []  # 10 dB more
    # A jammer that does not detect the sender does not react, and a constant one jams all the same.
    assert jammed_line(react=True, interference_range_m=500.0) == [150.0, 200.0, 270.0, 290.0]
    assert jammed_line(react=False, interference_range_m=500.0) == [150.0, 200.0]


def test_without_congestion_control_frames_follow_at_once():
    """Twenty messages of one station: 50 ms apart under DCC, so that few fit into the round, else all of them."""
    xyz, messages = line(2, 50.0), Messages(np.zeros(20, np.int64), np.full(20, 300))
    sent = []
    for ignores in (False, True):
        abuse = ChannelAbuse(np.full(2, -np.inf), np.full(2, -np.inf), np.array([ignores, False]))
        medium = medium_of()
        _, happened = medium.broadcast(
            medium.start(), RoundKind.CPM, 0, 0.0, Stations(keys_of(2), xyz, 2, abuse=abuse), messages
        )
        sent.append(int(happened.frames.n_transmissions.sum()))
    assert sent[0] <= 5 and sent[1] == 20
