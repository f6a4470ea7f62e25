"""Messages that outlast the round in which they were sent, over the medium `csma`."""

import pickle
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from cosim.radio.csma import CsmaMedium
from cosim.radio.dcc import DccParams
from cosim.radio.message_round import Messages, Outcome, RoundKind, Stations
from cosim.radio.params import RadioParams, RelayParams
from cosim.radio.phy import airtime_ns
from cosim.radio.propagation import PropagationParams
from cosim.radio.segmentation import ENVELOPE_BYTES, FRAME_BYTES, segments

N = 30


def town(n=N, side_m=400.0) -> Stations:
    rng = np.random.default_rng(4)
    xyz_m = np.column_stack([rng.uniform(0, side_m, (n, 2)), np.full(n, 1.6)])
    return Stations(np.arange(100, 100 + n).astype(np.uint64), xyz_m, n)


def medium_of(round_s=0.08, timeout_s=0.4, **params) -> CsmaMedium:
    quiet = PropagationParams(shadowing=False, fading=False) if params.pop("is_clear", False) else PropagationParams()
    return CsmaMedium(RadioParams(timeout_s=timeout_s, propagation=quiet, **params), round_s, 1, None)


def silence() -> Messages:
    none = np.zeros(0, np.int64)
    return Messages(none, none)


def play(medium, messages, later_s, stations=None):
    """A round of messages at time 0, then rounds without new ones: outcomes of frames, and receptions by name."""
    stations = town() if stations is None else stations
    medium_state, first = medium.broadcast(medium.start(), RoundKind.CPM, 0, 0.0, stations, messages)
    decided, got = Counter(), {}

    def note(found, name):
        outcome = found.frames.outcome
        for message, to, what in zip(name[found.frames.message], found.frames.receiver, outcome, strict=True):
            decided[int(message), int(to), int(what)] += 1
        r = found.receptions
        for message, to, *times in zip(
            name[r.message], r.receiver, r.generation_offset_s, r.latency_s, r.hops, strict=True
        ):
            assert (int(message), int(to)) not in got  # each reception is told once
            got[int(message), int(to)] = [round(float(t), 9) for t in times]

    note(first, messages.name)
    for step, begin_s in enumerate(later_s, 1):
        medium_state, found = medium.broadcast(medium_state, RoundKind.CPM, step, begin_s, stations, silence())
        assert not len(found.receptions.message)
        for earlier in found.earlier:
            assert earlier.step.tolist() == [0] * len(earlier.name)
            note(earlier.round, earlier.name)
    return decided, got, medium_state


def long_messages() -> Messages:
    return Messages(np.arange(N), np.where(np.arange(N) % 3 == 0, 3000, 400), name=np.arange(N))


def test_a_message_of_four_frames_takes_three_gaps_of_congestion_control():
    """Frames of one station are 50 ms apart, from the end of one to the beginning of the next, so the message takes
    three gaps, four times on air, and the access to an idle medium (at most AIFS 110 us + 15 slots of 13 us each)."""
    stations = Stations(np.array([1, 2], np.uint64), np.array([[0.0, 0.0, 1.6], [40.0, 0.0, 1.6]]), 2)
    messages = Messages(np.array([0]), np.array([4000]), name=np.array([7]))
    count, payload = segments(np.array([4000]), np.array([ENVELOPE_BYTES]), FRAME_BYTES)
    assert count.tolist() == [4]
    on_air_s = 4 * airtime_ns(payload, 6.0)[0] * 1e-9
    _, got, state = play(medium_of(), messages, [0.2, 0.4], stations)
    assert list(got) == [(7, 1)]
    latency_s = got[7, 1][1]
    assert 0.150 + on_air_s <= latency_s <= 0.150 + on_air_s + 4 * (110e-6 + 15 * 13e-6)
    assert not len(state.underway)


@pytest.mark.parametrize("relay", [RelayParams(), RelayParams(max_hops=3, timer_distance_m=200.0)], ids=["1", "3 hops"])
def test_how_rounds_cut_the_time_has_no_effect(relay):
    """The same messages, with the time after their round cut in many ways, under a constant gap between frames."""
    messages, dcc = long_messages(), DccParams(t_off_s=(0.05,) * 5)
    plain = play(medium_of(relay=relay, dcc=dcc), messages, [0.38])
    for later_s in ([0.08, 0.16, 0.24, 0.31, 0.39], [0.1, 0.3, 0.38], [0.2, 0.38]):
        decided, got, _ = play(medium_of(relay=relay, dcc=dcc), messages, later_s)
        assert got == plain[1]
        without_waiting = {key: n for key, n in decided.items() if key[2] != Outcome.WAITING}
        assert without_waiting == {key: n for key, n in plain[0].items() if key[2] != Outcome.WAITING}
    assert any(latency_s > 0.08 for _, latency_s, _ in plain[1].values())
    if relay.max_hops == 3:
        assert any(hops > 1 for _, _, hops in plain[1].values())


def test_every_frame_is_decided_once_at_every_station_in_range():
    """A station with four frames and a gap of 0.25 s sends two of them in 0.4 s; the others expire."""
    medium = medium_of(dcc=DccParams(t_off_s=(0.25, 0.3, 0.4, 0.5, 1.0)))
    messages = Messages(np.arange(N), np.where(np.arange(N) == 3, 4000, 0), name=np.arange(N))
    decided, got, state = play(medium, messages, [0.2, 0.4, 0.6])
    of_receiver = Counter()
    for (message, to, outcome), n in decided.items():
        assert message == 3
        if outcome != Outcome.WAITING:
            of_receiver[to] += n
    assert set(of_receiver.values()) == {4} and len(of_receiver) > 10
    n_expired = sum(n for (_, _, outcome), n in decided.items() if outcome == Outcome.EXPIRED)
    assert n_expired == 2 * len(of_receiver)
    assert not got and not len(state.underway)


def test_a_round_as_long_as_the_lifetime_leaves_nothing():
    medium = medium_of(round_s=0.4)
    decided, _, state = play(medium, long_messages(), [])
    assert not len(state.underway) and not any(outcome == Outcome.WAITING for _, _, outcome in decided)


def test_stations_that_leave_and_change_their_rows():
    """Row 3 leaves before its message is sent: nobody receives it. The others go on under new rows."""
    stations, messages, medium = town(), long_messages(), medium_of()
    state, first = medium.broadcast(medium.start(), RoundKind.CPM, 0, 0.0, stations, messages)
    waits = set(first.frames.message[first.frames.outcome == Outcome.WAITING].tolist())
    assert 3 in waits and len(waits) == 10
    _, plain = medium.broadcast(state, RoundKind.CPM, 1, 0.2, stations, silence())
    kept = np.delete(np.arange(N), 3)[::-1]
    moved = replace(stations, key=stations.key[kept], xyz_m=stations.xyz_m[kept], n_vehicles=N - 1)
    _, found = medium.broadcast(state, RoundKind.CPM, 1, 0.2, moved, silence())
    (earlier,), (before,) = found.earlier, plain.earlier
    assert 3 not in earlier.name
    assert (kept[earlier.round.station] == earlier.name).all()

    def pairs(late, row):
        got = late.round.receptions
        return {(int(late.name[m]), int(row[to])) for m, to in zip(got.message, got.receiver, strict=True)}

    alike = {(m, to) for m, to in pairs(before, np.arange(N)) if 3 not in (m, to)}
    ours = pairs(earlier, kept)
    assert len(ours) > 50 and len(ours ^ alike) <= 0.05 * len(alike)  # one station less on the channel


def test_evaluation_messages_last_until_two_timeouts_after_their_step():
    """With rounds of 0.08 s and a timeout of 0.4 s: from 0.08 s to 0.8 s, whatever the length of a round."""
    for round_s in (0.04, 0.08, 0.2, 0.4):
        medium = medium_of(round_s)
        begin_s = round_s  # the second round of the step
        messages = Messages(np.array([0]), np.array([30_000]), name=np.array([0]))
        state, _ = medium.broadcast(medium.start(), RoundKind.EVALUATION, 0, begin_s, town(), messages)
        if round_s < 0.4:
            assert state.underway.messages["end_ns"].tolist() == [800_000_000]


def test_stations_held_back_need_no_links():
    """The same rounds with the links of all stations, and with those of the stations that may send in the step."""
    medium = medium_of(timeout_s=0.3)
    plain = full = medium.start()
    n_spared = 0
    for step in range(8):
        stations = replace(town(), xyz_m=town().xyz_m + 0.1 * step)  # so that links are computed anew
        station = np.arange(step % 3, N, 3)
        delay_s = np.where(station % 2, 0.0, 0.1)
        messages = Messages(station, np.full(len(station), 3000), delay_s=delay_s, name=station)
        for kind in RoundKind:
            begin_s = 0.2 * step + 0.08 * kind
            every = replace(full, cache=medium.links(stations))
            full, expected = medium.broadcast(every, kind, step, begin_s, stations, messages)
            plain, found = medium.broadcast(plain, kind, step, begin_s, stations, messages)
            n_spared += len(full.underway) and int((~plain.cache.sends).sum())
            assert pickle.dumps(found) == pickle.dumps(expected)
    assert n_spared > 0
