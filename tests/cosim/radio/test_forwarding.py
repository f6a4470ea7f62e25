"""Forwarding inside the event loop against a slow literal twin that stops the channel at every timer."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from cosim.base import rng
from cosim.radio import channel
from cosim.radio.channel import AccessParams, Packets, PhyOutcome
from cosim.radio.csma import CsmaMedium
from cosim.radio.dcc import DccParams
from cosim.radio.forwarding import N_COPIES
from cosim.radio.message_round import Messages, Outcome, RoundKind, Stations
from cosim.radio.params import RadioParams, RelayParams
from cosim.radio.phy import ReceiverParams, airtime_ns
from cosim.radio.propagation import PropagationParams
from cosim.radio.segmentation import segments

AIR = PropagationParams(model="log_distance", exponent=3.0)
RANGE_M, ROUND_S = 250.0, 0.4
OURS = {
    PhyOutcome.RECEIVED: Outcome.RECEIVED, PhyOutcome.COLLISION: Outcome.COLLISION,
    PhyOutcome.RANGE: Outcome.PROPAGATION, PhyOutcome.FADING: Outcome.PROPAGATION,
    PhyOutcome.BUSY: Outcome.RECEIVER_BUSY, PhyOutcome.HALF_DUPLEX: Outcome.RECEIVER_BUSY,
}  # fmt: skip


def town(n, side_m):
    g = np.random.default_rng(n)
    xyz = np.column_stack([g.uniform(0, side_m, (n, 2)), np.full(n, 1.6)])
    return Stations(rng.keys(np.uint64(3), np.arange(n)), xyz, n)


def medium_of(relay):
    params = RadioParams(range_m=RANGE_M, propagation=AIR, relay=relay, dcc=DccParams(enabled=False))
    return CsmaMedium(params, ROUND_S, 5, None)


def fast(stations, messages, medium, state, i):
    state, happened = medium.broadcast(state, RoundKind(i % 2), i // 2, 0.5 * i, stations, messages)
    found, frames = happened.receptions, happened.frames
    columns = found.receiver, found.message, found.hops, np.round(1e9 * found.latency_s)
    rows = np.stack(columns).astype(np.int64).T.tolist()
    columns = frames.message, frames.receiver, frames.hop, frames.outcome
    attempts = Counter(zip(*(c.tolist() for c in columns), strict=True))
    return state, ({(r, m): (hops, ns) for r, m, hops, ns in rows}, frames.n_relayed, frames.n_duplicate, attempts)


def literal(stations, messages, medium, state, i):
    """The same by dictionaries: the channel has no forwarding, and its windows end at every timer."""
    begin, end = round(0.5e9 * i), round(1e9 * (0.5 * i + ROUND_S))
    xyz, keys, relay = stations.xyz_m, stations.key, medium.params.relay
    links = medium.links(stations).links
    now_state = state.channel
    count, payload = segments(messages.length_bytes)
    n_segments = dict(enumerate(count.tolist()))
    units = [(m, number, int(payload[m])) for m in range(len(messages)) for number in range(count[m])]
    seq = [rng.keys(np.uint64(i), keys[[m]], np.array([number]))[0] >> np.uint64(24) for m, number, _ in units]
    phase = rng.uniforms(rng.key(medium.seed, rng.Stream.GENERATION, i), keys)[:, 0]
    born = [begin + int(np.floor(phase[m] * (end - begin) / 2)) for m, _, _ in units]
    channel_key, relay_key = rng.key(medium.seed, rng.Stream.CHANNEL), rng.key(medium.seed, rng.Stream.RELAY, i)
    frames = []  # unit, transmitter, hop
    ready = [(born[u], u, units[u][0], 1) for u in range(len(units))]
    timers = {}  # (unit, station): when it expires, hop
    copies = {}  # (unit, station): hop, when
    outcomes = {}  # (frame, receiver): by the channel
    n_relayed = n_duplicate = 0

    def run(until, due):
        nonlocal now_state
        for _, *frame in due:
            frames.append(tuple(frame))
        chosen = [u for _, u, _, _ in due]
        at = np.array([t for t, *_ in due], np.int64)
        packets = Packets(
            np.array([c for _, _, c, _ in due], np.int64), np.array([seq[u] for u in chosen], np.uint64), at,
            np.array([units[u][2] for u in chosen], np.int64),
            np.full(len(due), 2, np.uint8), np.minimum(10**9, end - at), len(frames) - len(due) + np.arange(len(due)),
        )  # fmt: skip
        now_state, out = channel.run_window(
            now_state, links, packets, until, channel.ChannelRules(channel_key, ReceiverParams(), AccessParams())
        )
        return out

    if now_state.now_ns < begin:
        run(begin, [])
    while now_state.now_ns < end:
        now = now_state.now_ns
        over = [(due, *who, hop) for who, (due, hop) in timers.items() if due == now]
        for _, u, station, _ in over:
            del timers[u, station]
        stop = min([now + round(1e9 * relay.timer_min_s), end] + [due for due, _ in timers.values()])
        own = [frame for frame in ready if frame[0] < stop]
        ready = [frame for frame in ready if frame[0] >= stop]
        out = run(stop, own + over)
        for p in np.argsort(out.end_ns, kind="stable"):
            if out.outcome[p] != PhyOutcome.RECEIVED or out.generated_ns[p] < begin:
                continue
            u, via, hop = frames[out.tag[p]]
            n_relayed += hop > 1
            source = units[u][0]
            for k in range(out.ptr[p], out.ptr[p + 1]):
                to = int(out.receiver[k])
                outcomes[int(out.tag[p]), to] = OURS[PhyOutcome(out.reception[k])]
                apart = np.hypot(*(xyz[to] - xyz[via])[:2])
                if out.reception[k] != PhyOutcome.RECEIVED or to == source or apart > RANGE_M:
                    continue
                if (u, to) in copies:
                    n_duplicate += 1
                    if relay.rule == "contention":
                        timers.pop((u, to), None)
                    continue
                copies[u, to] = hop, int(out.end_ns[p])
                if messages.refused is not None and (source << 32) + to in messages.refused:
                    continue
                if hop == relay.max_hops or np.hypot(*(xyz[to] - xyz[source])[:2]) > relay.forward_range_m:
                    continue
                share = min(apart / relay.timer_distance_m, 1.0)
                if relay.rule == "probability":
                    who = keys[[source]], np.array([units[u][1]]), keys[[to]]
                    draw, share = rng.uniforms(relay_key, *who, n=2)[0]
                    if draw >= relay.forward_p:
                        continue
                wait_s = relay.timer_max_s + (relay.timer_min_s - relay.timer_max_s) * share
                due = int(out.end_ns[p]) + int(np.round(wait_s * 1e9))
                if due + airtime_ns(np.array([units[u][2]]), 6.0)[0] <= end:
                    timers[u, to] = due, hop + 1
    assert len(copies) > N_COPIES * len(units)  # more than fit at first
    attempts = Counter()
    on_air = {f for f, _ in outcomes}
    for f, (u, via, hop) in enumerate(frames):
        source = units[u][0]
        for to in range(len(xyz)):
            if to not in (via, source) and np.hypot(*(xyz[to] - xyz[via])[:2]) <= RANGE_M:
                outcome = outcomes.get((f, to), Outcome.PROPAGATION) if f in on_air else Outcome.EXPIRED
                attempts[source, to, hop, int(outcome)] += 1
    whole = {}
    for (u, to), (hop, at) in copies.items():
        whole.setdefault((to, units[u][0]), []).append((hop, at - born[u]))
    return {
        pair: (max(h for h, _ in got), max(t for _, t in got))
        for pair, got in whole.items() if len(got) == n_segments[pair[1]]
    }, n_relayed, n_duplicate, attempts  # fmt: skip


@pytest.mark.parametrize("refused_p", [None, 0.4])
@pytest.mark.parametrize("relay", [
    RelayParams(max_hops=3, timer_distance_m=200.0),
    RelayParams(max_hops=2, rule="probability", forward_p=0.4),
], ids=lambda p: p.rule)  # fmt: skip
def test_forwarding_equals_the_literal_twin(relay, refused_p):
    """Two rounds of messages of one and of two segments: hops, times to the nanosecond, copies, outcomes of frames."""
    stations = town(45, 700.0)
    messages = Messages.one_each(np.where(np.arange(45) % 3 == 0, 1900, 400))
    if refused_p is not None:
        message, station = np.nonzero(np.random.default_rng(1).random((45, 45)) < refused_p)
        messages = replace(messages, refused=message << 32 | station)
    medium = medium_of(relay)
    state = medium.start()
    for i in range(2):
        expected = literal(stations, messages, medium, state, i)
        state, found = fast(stations, messages, medium, state, i)
        assert found == expected
        assert found[1] > 50 and found[2] > 50 and max(hops for hops, _ in found[0].values()) == relay.max_hops


def test_adaptive_control_holds_forwarded_frames_back():
    """Four vehicles around a fifth one, which alone hears them. At the least share it rests longer than the round."""
    xyz = np.array([[200, 0, 1.6], [0, 200, 1.6], [-200, 0, 1.6], [0, -200, 1.6], [0, 0, 1.6]])
    stations = Stations(rng.keys(np.uint64(3), np.arange(5)), xyz, 5)
    air = replace(AIR, shadowing=False, fading="none", exponent=2.0)
    relay, control = RelayParams(max_hops=2), DccParams(algorithm="adaptive")
    medium = CsmaMedium(RadioParams(range_m=RANGE_M, propagation=air, relay=relay, dcc=control), ROUND_S, 5, None)
    messages = Messages(np.arange(4), np.full(4, 300))
    for share, n_relayed in ((0.03, 4), (0.0006, 1)):
        state = medium.start()
        state = replace(state, dcc=replace(state.dcc.of(stations.key), share=np.full(5, share)))
        _, happened = medium.broadcast(state, RoundKind(0), 0, 0.0, stations, messages)
        assert happened.frames.n_relayed == n_relayed
