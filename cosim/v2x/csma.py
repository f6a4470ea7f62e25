"""Rounds of messages over one shared channel: packets, relays by contention, congestion control.

A message longer than a frame is cut into segments; each is lost, relayed and received on its own, and the message
is there when all of them are.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim import rng
from cosim.v2x import channel, dcc
from cosim.v2x.channel import Access, AccessParams, Packets
from cosim.v2x.dcc import Control, DccParams
from cosim.v2x.exchange import Fate, Frames, Heard, RelayParams, View, both_ways, by_two, heard_of, neighbours, rows_of
from cosim.v2x.links import Pairs, between
from cosim.v2x.messages import expand, ptr_of, segments
from cosim.v2x.obstruction import Sight
from cosim.v2x.propagation import PropagationParams
from cosim.v2x.reception import MAC_OVERHEAD_BYTES, ReceiverParams, airtime_ns

SLOT_NS = 2_000_000
"""Resolution at which an overheard copy silences a relay that waits: 8 m of the contention timer's slope."""

FATE_OF = np.zeros(max(channel.Fate) + 1, np.int64)
for _theirs, _ours in {
    channel.Fate.RECEIVED: Fate.RECEIVED,
    channel.Fate.RANGE: Fate.PROPAGATION,
    channel.Fate.FADING: Fate.PROPAGATION,
    channel.Fate.COLLISION: Fate.COLLISION,
    channel.Fate.BUSY: Fate.RECEIVER_BUSY,
    channel.Fate.HALF_DUPLEX: Fate.RECEIVER_BUSY,
    channel.Fate.EXPIRED: Fate.EXPIRED,
    channel.Fate.QUEUE: Fate.EXPIRED,
}.items():
    FATE_OF[_theirs] = _ours


@dataclass(slots=True)
class Air:
    """What the channel remembers from one round to the next."""

    sight: Sight | None
    """Lines of sight between the city's walls; None without buildings."""
    seed: int
    state: channel.State
    control: Control
    n_frames: int = 0
    """Frames handed to the channel so far: the number of the next one."""

    @staticmethod
    def start(sight: Sight | None, seed: int) -> "Air":
        return Air(sight, seed, channel.State.start(), Control.start())


@dataclass(frozen=True, slots=True)
class Sent:
    """Frames handed to the channel in one slot."""

    unit: Int[ndarray, "p"]
    carrier: Int[ndarray, "p"]
    hop: Int[ndarray, "p"]
    at_ns: Int[ndarray, "p"]

    def take(self, rows: ndarray) -> "Sent":
        return Sent(self.unit[rows], self.carrier[rows], self.hop[rows], self.at_ns[rows])

    @staticmethod
    def concat(parts: list["Sent"]) -> "Sent":
        return Sent(*(np.concatenate([getattr(p, name) for p in parts]) for name in Sent.__slots__))


def broadcast(
    air: Air,
    xyz_m: Float[ndarray, "n 3"],
    name_key: UInt64[ndarray, "n"],
    talks: Bool[ndarray, "n"],
    length_bytes: Int[ndarray, "n"],
    round_number: int,
    begin_s: float,
    timeout_s: float,
    reach_m: float,
    propagation: PropagationParams,
    receiver: ReceiverParams,
    access: AccessParams,
    congestion: DccParams,
    relay: RelayParams,
) -> tuple[Heard, Frames]:
    """One message from every radio that talks, generated at a random time in the first half of the round.

    Parameters
    ----------
    xyz_m
        Antennas.
    round_number
        Counts the rounds of the run: with the sender it names a message.
    reach_m
        Frames from farther away interfere, but are nobody's message.
    """
    n = len(xyz_m)
    begin_ns, end_ns = round(begin_s * 1e9), round((begin_s + timeout_s) * 1e9)
    chance = rng.key(air.seed, rng.Stream.CHANNEL)
    shadows = rng.key(air.seed, rng.Stream.SHADOWING)
    links, pairs, _ = between(xyz_m, name_key, propagation, shadows, air.sight)

    phase = rng.uniforms(rng.key(air.seed, rng.Stream.GENERATION, round_number), name_key)[:, 0]
    talkers = np.flatnonzero(talks)
    n_segments, segment_bytes = segments(length_bytes[talkers])
    origin = np.repeat(talkers, n_segments)  # of each unit: a segment of a message
    number = np.arange(len(origin)) - np.repeat(np.cumsum(n_segments) - n_segments, n_segments)
    unit_bytes = np.repeat(segment_bytes, n_segments)
    unit_air_ns = airtime_ns(unit_bytes, receiver.rate_mbps)
    unit_seq = rng.keys(np.uint64(round_number), name_key[origin], number) >> np.uint64(24)  # 40 bits are allowed

    own_ns = begin_ns + np.floor(phase[origin] * (end_ns - begin_ns) / 2).astype(np.int64)
    waiting = Sent(np.arange(len(origin)), origin, np.ones(len(origin), int), own_ns)
    contends = relay.rule == "contention"
    slot_ns = SLOT_NS if relay.max_hops > 1 else round(congestion.period_s * 1e9)
    first_frame = air.n_frames
    sent = waiting.take(np.zeros(0, np.int64))
    aired_parts, tag_parts, receiver_parts, fate_parts = [], [], [], []
    aired_ns = np.zeros(len(origin), np.int64)  # of each unit: when its author's frame was on the air
    have = np.zeros(0, np.int64)  # (unit, receiver) that are there, sorted
    have_hop, have_ns = np.zeros(0, np.int64), np.zeros(0, np.int64)
    n_duplicate = 0
    busy = np.zeros(n)
    measured, strong = 0, np.zeros(n)  # since congestion control last looked
    if air.state.now_ns < begin_ns:
        _idle(air, links, begin_ns, chance, receiver, access, congestion)
    while air.state.now_ns < end_ns:
        start_ns = stop_ns = air.state.now_ns
        if not len(air.state.packets):  # silence until somebody has something to say
            stop_ns = int(waiting.at_ns.min(initial=end_ns - slot_ns))
        stop_ns = min(max(start_ns, stop_ns) + slot_ns, end_ns)
        due = waiting.at_ns < stop_ns
        frames, waiting = waiting.take(due), waiting.take(~due)
        packets = Packets(
            sender=frames.carrier, seq=unit_seq[frames.unit], generated_ns=frames.at_ns,
            payload_bytes=unit_bytes[frames.unit], access=np.full(len(frames.unit), Access.BE, np.uint8),
            lifetime_ns=np.minimum(round(access.lifetime_s * 1e9), end_ns - frames.at_ns),
            tag=air.n_frames + np.arange(len(frames.unit)),
        )  # fmt: skip
        air.n_frames += len(frames.unit)
        if len(frames.unit):
            sent = Sent.concat([sent, frames])
        gap_ns = dcc.gap_ns(air.control, name_key, congestion)
        air.state, out = channel.play(air.state, links, packets, stop_ns, chance, receiver, access, gap_ns)
        span = stop_ns - start_ns
        busy += out.busy * span
        strong, measured = strong + out.busy_strong * span, measured + span
        while measured >= congestion.period_s * 1e9 - 1:
            air.control = dcc.react(air.control, name_key, np.minimum(strong / measured, 1.0), congestion)
            strong *= max(0.0, 1 - congestion.period_s * 1e9 / measured)
            measured -= round(congestion.period_s * 1e9)

        ours = np.flatnonzero(out.tag >= first_frame)  # a straggler of the last round is nobody's any more
        if not len(ours):
            continue
        on_air = ours[out.fate[ours] == channel.Fate.RECEIVED]
        aired_parts.append(out.tag[on_air] - first_frame)
        own = on_air[sent.hop[out.tag[on_air] - first_frame] == 1]
        aired_ns[sent.unit[out.tag[own] - first_frame]] = out.start_ns[own]
        rows, which = expand(out.ptr[ours], out.ptr[ours + 1])
        tag, hearer = out.tag[ours][which] - first_frame, out.receiver[rows].astype(np.int64)
        tag_parts.append(tag)
        receiver_parts.append(hearer)
        fate_parts.append(FATE_OF[out.reception[rows]])

        got = out.reception[rows] == channel.Fate.RECEIVED
        unit, end_ns_of = sent.unit[tag[got]], out.end_ns[ours][which][got]
        to, via, hop = hearer[got], sent.carrier[tag[got]], sent.hop[tag[got]]
        apart_m = np.linalg.norm(xyz_m[to, :2] - xyz_m[via, :2], axis=1)
        fair = (to != origin[unit]) & (apart_m <= reach_m) & (end_ns_of <= end_ns)
        order = np.flatnonzero(fair)
        order = order[np.lexsort((via[order], end_ns_of[order], unit[order] * n + to[order]))]
        key = unit[order] * n + to[order]
        again = np.zeros(len(key), bool)
        again[1:] = key[1:] == key[:-1]
        again |= np.isin(key, have)
        n_duplicate += int(again.sum())
        if relay.max_hops > 1:
            overheard = np.isin(key, key[again]) & contends
            silenced = np.isin(waiting.unit * n + waiting.carrier, key[again]) & (waiting.hop > 1) & contends
            waiting = waiting.take(~silenced)
        new = order[~again]
        place = np.searchsorted(have, key[~again])
        have = np.insert(have, place, key[~again])
        have_hop, have_ns = np.insert(have_hop, place, hop[new]), np.insert(have_ns, place, end_ns_of[new])
        if relay.max_hops > 1:
            from_origin_m = np.linalg.norm(xyz_m[to[new], :2] - xyz_m[origin[unit[new]], :2], axis=1)
            on = ~overheard[~again] & (hop[new] < relay.max_hops) & (from_origin_m <= relay.reach_m)
            share = np.minimum(apart_m[new] / relay.timer_distance_m, 1.0)
            if not contends:
                who = name_key[origin[unit[new]]], number[unit[new]], name_key[to[new]]
                draws = rng.uniforms(rng.key(air.seed, rng.Stream.RELAY, round_number), *who, n=2)
                on &= draws[:, 0] < relay.forward_p
                share = draws[:, 1]
            share = share[on]
            timer_s = relay.timer_max_s + (relay.timer_min_s - relay.timer_max_s) * share
            at_ns = np.maximum(end_ns_of[new][on] + np.round(timer_s * 1e9).astype(np.int64), stop_ns)
            relays = Sent(unit[new][on], to[new][on], hop[new][on] + 1, at_ns)
            waiting = Sent.concat([waiting, relays.take(at_ns + unit_air_ns[relays.unit] <= end_ns)])

    heard = _messages(
        have, have_hop, have_ns, origin, own_ns, aired_ns, n_segments, talkers, begin_ns, xyz_m[:, :2]
    )
    nothing = [np.zeros(0, np.int64)]
    aired = np.sort(np.concatenate(nothing + aired_parts))
    receptions = tuple(np.concatenate(nothing + parts) for parts in (tag_parts, receiver_parts, fate_parts))
    sight = None if air.sight is None or not propagation.knows_walls else (pairs, propagation.reach_m)
    accounts = _accounts(sent, origin, aired, receptions, xyz_m[:, :2], reach_m, sight)
    on_air = sent.take(aired)
    return heard, Frames(
        *accounts, np.bincount(origin[on_air.unit], minlength=n), int((on_air.hop > 1).sum()), n_duplicate,
        float(np.sum(unit_bytes[on_air.unit] + MAC_OVERHEAD_BYTES)), busy / (end_ns - begin_ns),
    )  # fmt: skip


def _idle(
    air: Air, links: channel.Links, until_ns: int, chance: np.uint64, receiver: ReceiverParams, access: AccessParams,
    congestion: DccParams,
) -> None:  # fmt: skip
    """Let the time between two rounds pass."""
    since_ns = air.state.now_ns
    none = np.zeros(0, np.int64)
    nothing = Packets(none, none.astype(np.uint64), none, none, none.astype(np.uint8), none, none)
    air.state, out = channel.play(air.state, links, nothing, until_ns, chance, receiver, access)
    for _ in range(min(int((until_ns - since_ns) * 1e-9 / congestion.period_s), 10)):
        air.control = dcc.react(air.control, links.key, np.minimum(out.busy_strong, 1.0), congestion)


def _messages(
    have: Int[ndarray, "h"], hop: Int[ndarray, "h"], end_ns: Int[ndarray, "h"], origin: Int[ndarray, "u"],
    own_ns: Int[ndarray, "u"], aired_ns: Int[ndarray, "u"], n_segments: Int[ndarray, "t"],
    talkers: Int[ndarray, "t"], begin_ns: int, xy_m: Float[ndarray, "n 2"],
) -> Heard:  # fmt: skip
    """Messages of which all segments are there."""
    n = len(xy_m)
    unit, to = np.divmod(have, max(n, 1))
    if len(origin) == len(talkers):  # no message is longer than a frame
        since_ns = own_ns[unit]
        return heard_of(
            to, origin[unit], hop, 1e-9 * (since_ns - begin_ns), 1e-9 * (aired_ns[unit] - since_ns),
            1e-9 * (end_ns - since_ns), xy_m,
        )  # fmt: skip
    pair, at = np.unique(origin[unit] * n + to, return_inverse=True)
    there = np.bincount(at, minlength=len(pair))
    sender, receiver = np.divmod(pair, max(n, 1))
    whole = there == n_segments[np.searchsorted(talkers, sender)]
    last_ns, access_ns, hops = (np.zeros(len(pair), np.int64) for _ in range(3))
    np.maximum.at(last_ns, at, end_ns - own_ns[unit])
    np.maximum.at(access_ns, at, aired_ns[unit] - own_ns[unit])
    np.maximum.at(hops, at, hop)
    born_ns = np.zeros(n, np.int64)
    born_ns[origin] = own_ns - begin_ns
    sender, receiver = sender[whole], receiver[whole]
    return heard_of(
        receiver, sender, hops[whole], 1e-9 * born_ns[sender], 1e-9 * access_ns[whole], 1e-9 * last_ns[whole], xy_m
    )


def _accounts(
    sent: Sent, origin: Int[ndarray, "u"], aired: Int[ndarray, "a"], receptions: tuple[ndarray, ...],
    xy_m: Float[ndarray, "n 2"], reach_m: float, sight: tuple[Pairs, float] | None,
) -> tuple[ndarray, ndarray, ndarray, ndarray, ndarray, ndarray]:  # fmt: skip
    """Origin, receiver, hop, distance, view and fate of every (frame, radio within reach of its carrier)."""
    n = len(xy_m)
    a, b, length_m = neighbours(xy_m, reach_m)
    ptr = ptr_of(a, n)
    link, frame = expand(ptr[sent.carrier], ptr[sent.carrier + 1])
    elsewhere = b[link] != origin[sent.unit[frame]]
    link, frame = link[elsewhere], frame[elsewhere]
    on_air = np.zeros(len(sent.unit), bool)
    on_air[aired] = True
    fate = np.where(on_air[frame], Fate.PROPAGATION, Fate.EXPIRED)  # too weak even to count as a link, or never sent
    tag, receiver, known = receptions
    order = by_two(tag, receiver, max(n, len(sent.unit)))
    at = rows_of(frame * n + b[link], (tag * n + receiver)[order])
    found = at >= 0
    fate[found] = known[order[at[found]]]
    view = np.full(len(a), View.UNKNOWN, np.uint8) if sight is None else _views(a, b, length_m, *sight, n)
    return origin[sent.unit[frame]], b[link], sent.hop[frame], length_m[link], view[link], fate


def _views(
    a: Int[ndarray, "l"], b: Int[ndarray, "l"], length_m: Float[ndarray, "l"], pairs: Pairs, asked_m: float, n: int
) -> UInt8[ndarray, "l"]:
    """Whether a wall stands between the ends of each (a, b), given what is known of all pairs up to `asked_m`."""
    free = np.flatnonzero(~pairs.nlos)
    x, y, _ = both_ways(n, pairs.a[free], pairs.b[free], pairs.distance_m[free])
    seen = rows_of(a * n + b, x * n + y) >= 0
    return np.where(seen, View.OPEN, np.where(length_m < asked_m, View.WALL, View.UNKNOWN)).astype(np.uint8)
