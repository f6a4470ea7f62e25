"""The medium `csma`: rounds of messages over one shared channel, with forwarding and congestion control.

A message longer than one frame is segmented; each segment is lost, forwarded and received on its own, and the message
is received when all its segments are.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.radio import channel, dcc
from cosim.radio.channel import Access, Jamming, Links, Packets, WindowResult
from cosim.radio.channel_state import ChannelState
from cosim.radio.dcc import DccState
from cosim.radio.forwarding import UNIT, Forwarding, ForwardingRules, own_frames
from cosim.radio.link_budget import from_db, links_between, los_pairs
from cosim.radio.message_round import FrameOutcomes, MessageRound, Messages, RoundKind, Stations
from cosim.radio.params import RadioParams
from cosim.radio.phy import MAC_OVERHEAD_BYTES, airtime_ns
from cosim.radio.receptions import NeighbourList, ReceptionAttempts, Transmissions, complete_messages, slant_m
from cosim.radio.segmentation import segments
from sensors.line_of_sight import LosOfPlaces


@dataclass(frozen=True, slots=True)
class LinkCache:
    """Links and neighbours of the stations of the last round; both rounds of a step have the same positions."""

    stations: Stations
    links: Links
    neighbours: NeighbourList


@dataclass(frozen=True, slots=True)
class ChannelContext:
    """All that lasts from one round to the next."""

    channel: ChannelState
    dcc: DccState
    n_frames: int = 0
    """Frames handed to the channel so far: the number of the next one."""
    cache: LinkCache | None = None


@dataclass(frozen=True, slots=True)
class CsmaMedium:
    """CSMA/CA broadcast, packet by packet, with path loss, blockage, shadowing and fading."""

    params: RadioParams
    round_s: float
    """Duration of one round [s]."""
    seed: int
    los: LosOfPlaces | None
    """Lines of sight in the city; None without buildings."""

    def start(self) -> ChannelContext:
        """An idle channel without stations."""
        return ChannelContext(ChannelState.start(), DccState.start())

    def broadcast(
        self, state: ChannelContext, kind: RoundKind, step: int, begin_s: float, stations: Stations, messages: Messages
    ) -> tuple[ChannelContext, MessageRound]:
        """One round of messages, each generated at a random time in the first half of the round."""
        if len(stations) == 0:
            return state, MessageRound.silent()
        p, n = self.params, len(stations)
        begin_ns, end_ns = round(begin_s * 1e9), round((begin_s + self.round_s) * 1e9)
        lifetime_ns = round(p.access.lifetime_s * 1e9)
        cache = state.cache
        if cache is None or not cache.stations.equals(stations):
            cache = self.links(stations)
        links, abuse = self._jammed(cache.links, stations), stations.abuse
        round_number = len(RoundKind) * step + kind

        keys = messages.keys(stations)
        units, n_segments = _units(messages, keys, round_number, p.receiver.rate_mbps)
        phase = rng.uniforms(rng.key(self.seed, rng.Stream.GENERATION, round_number), keys)[:, 0]
        offset_ns = np.floor(phase * (end_ns - begin_ns) / 2).astype(np.int64)
        if messages.delay_s is not None:
            offset_ns += np.rint(1e9 * messages.delay_s).astype(np.int64)
        own_ns = begin_ns + offset_ns[units["message"]]
        first_tag = state.n_frames
        forwarding = None
        if p.relay.max_hops > 1:
            rules = ForwardingRules(
                max_hops=p.relay.max_hops, contends=p.relay.rule == "contention", forward_p=p.relay.forward_p,
                range_m=p.range_m, forward_range_m=p.relay.forward_range_m, timer_min_s=p.relay.timer_min_s,
                timer_max_s=p.relay.timer_max_s, timer_distance_m=p.relay.timer_distance_m, end_ns=end_ns,
                lifetime_ns=lifetime_ns, access=int(Access.BE), first_tag=first_tag,
                rng_key=rng.key(self.seed, rng.Stream.RELAY, round_number),
            )  # fmt: skip
            forwarding = Forwarding.of(rules, units, stations.key, stations.xyz_m[:, :2])

        now, control = state.channel, state.dcc
        if now.now_ns < begin_ns:
            now, control = self._idle(now, control, links, begin_ns)
        rng_key, period_ns = rng.key(self.seed, rng.Stream.CHANNEL), round(p.dcc.period_s * 1e9)
        waits = own_ns + units["airtime_ns"] <= end_ns
        windows: list[WindowResult] = []
        busy = np.zeros(n)
        measured, strong = 0, np.zeros(n)  # since the last update of congestion control
        while now.now_ns < end_ns:
            start_ns = stop_ns = now.now_ns
            if not len(now.packets):  # an idle channel until the next generation or timer
                timer_ns = end_ns if forwarding is None else forwarding.next_ns
                stop_ns = min(int(own_ns[waits].min(initial=end_ns)), timer_ns, end_ns - period_ns)
            stop_ns = min(max(start_ns, stop_ns) + period_ns, end_ns)
            due = np.flatnonzero(waits & (own_ns < stop_ns))
            waits[due] = False
            packets = Packets(
                sender=units["source"][due], seq=units["seq"][due], generated_ns=own_ns[due],
                payload_bytes=units["payload_bytes"][due], access=np.full(len(due), Access.BE, np.uint8),
                lifetime_ns=np.minimum(lifetime_ns, end_ns - own_ns[due]), tag=first_tag + due,
            )  # fmt: skip
            gap_ns = dcc.gap_ns(control, stations.key, p.dcc)
            if abuse is not None:
                gap_ns = np.where(abuse.ignores_dcc, 0, gap_ns)
            now, out = channel.run_window(
                now, links, packets, stop_ns, rng_key, p.receiver, p.access, gap_ns, forwarding
            )
            windows.append(out)
            span = stop_ns - start_ns
            busy += out.busy * span
            strong, measured = strong + out.busy_strong * span, measured + span
            while measured >= p.dcc.period_s * 1e9 - 1:
                control = dcc.update(control, stations.key, np.minimum(strong / measured, 1.0), p.dcc)
                strong *= max(0.0, 1 - p.dcc.period_s * 1e9 / measured)
                measured -= period_ns

        frames = own_frames(units) if forwarding is None else forwarding.frames
        sent = Transmissions.of(frames, units, windows, first_tag)
        attempts = ReceptionAttempts.of(sent, cache.neighbours)
        receptions, n_duplicate = complete_messages(
            sent, attempts, own_ns, n_segments, begin_ns, messages, stations.xyz_m[:, :2]
        )
        on_air = sent.on_air
        outcomes = FrameOutcomes(
            attempts.message, attempts.receiver, attempts.hop, attempts.distance_m, attempts.los_state,
            attempts.outcome, np.bincount(sent.message[on_air], minlength=len(messages)),
            int((sent.hop[on_air] > 1).sum()), n_duplicate,
            float(np.sum(units["payload_bytes"][sent.unit[on_air]] + MAC_OVERHEAD_BYTES)), busy / (end_ns - begin_ns),
        )  # fmt: skip
        after = ChannelContext(now, control, state.n_frames + len(frames), cache)
        return after, MessageRound(messages.station, receptions, outcomes)

    def links(self, stations: Stations) -> LinkCache:
        """Links and neighbours of these stations."""
        p, xyz_m = self.params, stations.xyz_m
        knows_walls = self.los is not None and p.propagation.knows_walls
        found = los_pairs(xyz_m, p.propagation, self.los, slant_m(xyz_m, p.range_m))
        near = NeighbourList.of(xyz_m, p.range_m, found, knows_walls)
        shadowing = rng.key(self.seed, rng.Stream.SHADOWING)
        links, _, _ = links_between(
            xyz_m, stations.key, p.propagation, shadowing, self.los, found=found,
            above_street_m=stations.above_street_m,
        )  # fmt: skip
        kept = replace(
            stations, abuse=None, key=stations.key.copy(), xyz_m=xyz_m.copy()
        )  # the caller may go on to move its own
        return LinkCache(kept, links, near)

    def _jammed(self, links: Links, stations: Stations) -> Links:
        """The links with the noise of jammers among the stations.

        Notes
        -----
        A jammer's noise reaches the receivers with the mean power of a frame of that strength, links above the cut-off
        alone, and does not fade. Carrier sense and the channel busy ratio do not notice it. A reactive jammer detects
        what arrives with `detectable_dbm` or more on average, and is quick enough for the payload, not for the
        preamble; where several react, the noise of all counts for each frame that one of them detects.
        """
        abuse = stations.abuse
        if abuse is None or not (np.isfinite(abuse.jam_dbm).any() or np.isfinite(abuse.react_dbm).any()):
            return links
        sender = np.repeat(np.arange(len(stations)), np.diff(links.ptr))
        noise = [
            np.bincount(links.receiver, links.power_mw * from_db(dbm - self.params.propagation.tx_power_dbm)[sender],
                        len(stations))
            for dbm in (abuse.jam_dbm, abuse.react_dbm)
        ]  # fmt: skip
        detects = np.isfinite(abuse.react_dbm)[links.receiver]
        detects &= links.power_mw >= from_db(self.params.receiver.detectable_dbm)
        detected = np.bincount(sender, detects, len(stations)) > 0
        return replace(links, jamming=Jamming(noise[0], noise[1], detected))

    def _idle(
        self, state: ChannelState, control: DccState, links: Links, until_ns: int
    ) -> tuple[ChannelState, DccState]:
        """The time between two rounds."""
        p, since_ns, rng_key = self.params, state.now_ns, rng.key(self.seed, rng.Stream.CHANNEL)
        none = np.zeros(0, np.int64)
        nothing = Packets(none, none.astype(np.uint64), none, none, none.astype(np.uint8), none, none)
        state, out = channel.run_window(state, links, nothing, until_ns, rng_key, p.receiver, p.access)
        for _ in range(min(int((until_ns - since_ns) * 1e-9 / p.dcc.period_s), 10)):
            control = dcc.update(control, links.key, np.minimum(out.busy_strong, 1.0), p.dcc)
        return state, control


def without_cache(state: ChannelContext) -> ChannelContext:
    """The same state, of which all links are computed again."""
    return replace(state, cache=None)


def _units(
    messages: Messages, keys: UInt64[ndarray, "m"], round_number: int, rate_mbps: float
) -> tuple[ndarray, Int[ndarray, "m"]]:
    """Segments of all messages, by message, and their number for each message."""
    sent = np.flatnonzero(messages.length_bytes > 0)
    count, payload_bytes = segments(messages.length_bytes[sent])
    n_segments = np.zeros(len(messages), np.int64)
    n_segments[sent] = count
    units = np.zeros(int(count.sum()), UNIT)
    units["message"] = np.repeat(sent, count)
    units["source"] = messages.station[units["message"]]
    units["key"] = keys[units["message"]]
    units["number"] = np.arange(len(units)) - np.repeat(np.cumsum(count) - count, count)
    units["payload_bytes"] = np.repeat(payload_bytes, count)
    units["airtime_ns"] = airtime_ns(units["payload_bytes"], rate_mbps)
    named = rng.keys(np.uint64(round_number), units["key"], units["number"])
    units["seq"] = named >> np.uint64(24)  # 40 bits are allowed
    return units, n_segments
