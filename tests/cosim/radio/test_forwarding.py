"""Forwarding inside the event loop against a slow literal twin that stops the channel at every timer."""

from collections import Counter

import numpy as np
import pytest

from cosim import rng
from cosim.radio import channel, csma
from cosim.radio.channel import AccessParams, Packets, PhyOutcome
from cosim.radio.dcc import DccParams
from cosim.radio.forwarding import N_COPIES
from cosim.radio.message_round import RelayParams
from cosim.radio.phy import ReceiverParams
from cosim.radio.propagation import PropagationParams

AIR = PropagationParams(model="log_distance", exponent=3.0)
HEAR_M, SPAN_S = 250.0, 0.4
OURS = {
    PhyOutcome.RECEIVED: message_round.Outcome.RECEIVED, PhyOutcome.COLLISION: message_round.Outcome.COLLISION,
    PhyOutcome.RANGE: message_round.Outcome.PROPAGATION, PhyOutcome.FADING: message_round.Outcome.PROPAGATION,
    PhyOutcome.BUSY: message_round.Outcome.RECEIVER_BUSY, PhyOutcome.HALF_DUPLEX: message_round.Outcome.RECEIVER_BUSY,
}  # fmt: skip


def town(n, side_m):
    g = np.random.default_rng(n)
    xyz = np.column_stack([g.uniform(0, side_m, (n, 2)), np.full(n, 1.6)])
    return xyz, rng.keys(np.uint64(3), np.arange(n))


def real(xyz, names, length, relay, air, i):
    heard, frames = csma.broadcast(
        air, xyz, names, np.ones(len(xyz), bool), length, i, 0.5 * i, SPAN_S, HEAR_M, AIR, ReceiverParams(),
        AccessParams(), DccParams(enabled=False), relay,
    )  # fmt: skip
    columns = heard.receiver, heard.sender, heard.hops, np.round(1e9 * heard.latency_s)
    said = np.stack(columns).astype(np.int64).T.tolist()
    tries = zip(*(c.tolist() for c in (frames.origin, frames.receiver, frames.hop, frames.fate)), strict=True)
    return {(r, s): (hops, ns) for r, s, hops, ns in said}, frames.n_relayed, frames.n_duplicate, Counter(tries)


def literal(xyz, names, length, relay, air, i):
    """The same by dictionaries: the channel knows of no relay, and stops whenever a timer is over."""
    begin, end = round(0.5e9 * i), round(1e9 * (0.5 * i + SPAN_S))
    ground = air.over(xyz, names, AIR, HEAR_M)
    units, n_segments = csma._units(np.ones(len(xyz), bool), length, names, i, 6.0)
    phase = rng.uniforms(rng.key(air.seed, rng.Stream.GENERATION, i), names)[:, 0]
    born = [begin + int(np.floor(phase[u["author"]] * (end - begin) / 2)) for u in units]
    chance, relaying = rng.key(air.seed, rng.Stream.CHANNEL), rng.key(air.seed, rng.Stream.RELAY, i)
    frames = []  # unit, carrier, hop
    ready = [(born[u], u, int(units[u]["author"]), 1) for u in range(len(units))]
    timers = {}  # (unit, radio): when it is over, hop
    copies = {}  # (unit, radio): hop, when
    fates = {}  # (frame, receiver): what the channel says
    n_relayed = n_duplicate = 0

    def play(until, due):
        for _, *frame in due:
            frames.append(tuple(frame))
        chosen = [u for _, u, _, _ in due]
        at = np.array([t for t, *_ in due], np.int64)
        packets = Packets(
            np.array([c for _, _, c, _ in due], np.int64), units["seq"][chosen], at, units["payload_bytes"][chosen],
            np.full(len(due), 2, np.uint8), np.minimum(10**9, end - at), len(frames) - len(due) + np.arange(len(due)),
        )  # fmt: skip
        air.state, out = channel.play(air.state, ground.links, packets, until, chance, ReceiverParams(), AccessParams())
        return out

    if air.state.now_ns < begin:
        play(begin, [])
    while air.state.now_ns < end:
        now = air.state.now_ns
        over = [(due, *who, hop) for who, (due, hop) in timers.items() if due == now]
        for _, u, radio, _ in over:
            del timers[u, radio]
        stop = min([now + round(1e9 * relay.timer_min_s), end] + [due for due, _ in timers.values()])
        own = [frame for frame in ready if frame[0] < stop]
        ready = [frame for frame in ready if frame[0] >= stop]
        out = play(stop, own + over)
        for p in np.argsort(out.end_ns, kind="stable"):
            if out.fate[p] != PhyOutcome.RECEIVED or out.generated_ns[p] < begin:
                continue
            u, via, hop = frames[out.tag[p]]
            n_relayed += hop > 1
            author = int(units[u]["author"])
            for k in range(out.ptr[p], out.ptr[p + 1]):
                to = int(out.receiver[k])
                fates[int(out.tag[p]), to] = OURS[PhyOutcome(out.reception[k])]
                apart = np.hypot(*(xyz[to] - xyz[via])[:2])
                if out.reception[k] != PhyOutcome.RECEIVED or to == author or apart > HEAR_M:
                    continue
                if (u, to) in copies:
                    n_duplicate += 1
                    if relay.rule == "contention":
                        timers.pop((u, to), None)
                    continue
                copies[u, to] = hop, int(out.end_ns[p])
                if hop == relay.max_hops or np.hypot(*(xyz[to] - xyz[author])[:2]) > relay.reach_m:
                    continue
                share = min(apart / relay.timer_distance_m, 1.0)
                if relay.rule == "probability":
                    who = names[[author]], units["number"][[u]], names[[to]]
                    draw, share = rng.uniforms(relaying, *who, n=2)[0]
                    if draw >= relay.forward_p:
                        continue
                wait_s = relay.timer_max_s + (relay.timer_min_s - relay.timer_max_s) * share
                due = int(out.end_ns[p]) + int(np.round(wait_s * 1e9))
                if due + units[u]["airtime_ns"] <= end:
                    timers[u, to] = due, hop + 1
    assert len(copies) > N_COPIES * len(units)  # more than there is room for at first
    tries = Counter()
    aired = {f for f, _ in fates}
    for f, (u, via, hop) in enumerate(frames):
        author = int(units[u]["author"])
        for to in range(len(xyz)):
            if to not in (via, author) and np.hypot(*(xyz[to] - xyz[via])[:2]) <= HEAR_M:
                fate = fates.get((f, to), message_round.Outcome.PROPAGATION) if f in aired else message_round.Outcome.EXPIRED
                tries[author, to, hop, int(fate)] += 1
    whole = {}
    for (u, to), (hop, at) in copies.items():
        whole.setdefault((to, int(units[u]["author"])), []).append((hop, at - born[u]))
    return {
        pair: (max(h for h, _ in got), max(t for _, t in got))
        for pair, got in whole.items() if len(got) == n_segments[pair[1]]
    }, n_relayed, n_duplicate, tries  # fmt: skip


@pytest.mark.parametrize("relay", [
    RelayParams(max_hops=3, timer_distance_m=200.0),
    RelayParams(max_hops=2, rule="probability", forward_p=0.4),
], ids=lambda p: p.rule)  # fmt: skip
def test_relays_do_exactly_what_the_literal_twin_does(relay):
    """Two rounds of messages of one and of two segments: hops, times to the nanosecond, copies, every frame's fates."""
    xyz, names = town(45, 700.0)
    length = np.where(np.arange(45) % 3 == 0, 1900, 400)
    one, other = (csma.Air.start(None, 5) for _ in range(2))
    for i in range(2):
        found, expected = real(xyz, names, length, relay, one, i), literal(xyz, names, length, relay, other, i)
        assert found == expected
        assert found[1] > 50 and found[2] > 50 and max(hops for hops, _ in found[0].values()) == relay.max_hops
