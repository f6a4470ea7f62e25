"""The medium `csma`: rounds of messages over one shared channel, with forwarding and congestion control.

A message longer than one frame is segmented. Each segment is lost, forwarded and received on its own. A message is
received when all its segments are received.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.radio import channel, dcc
from cosim.radio.channel import Access, ChannelRules, Links, Packets, WindowResult
from cosim.radio.channel_state import ChannelState
from cosim.radio.dcc import DccState
from cosim.radio.forwarding import UNIT, Forwarding, ForwardingRules, own_frames
from cosim.radio.link_cache import LinkCache, jammed
from cosim.radio.message_round import FrameOutcomes, MessageRound, Messages, RoundKind, Stations
from cosim.radio.params import RadioParams
from cosim.radio.phy import MAC_OVERHEAD_BYTES, airtime_ns
from cosim.radio.receptions import NeighbourList, ReceptionAttempts, Transmissions, complete_messages
from cosim.radio.segmentation import FRAME_BYTES
from sensors.line_of_sight import LosOfPlaces


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
        cache = state.cache
        if cache is None or not cache.serves(stations):
            cache = self.links(stations)
        links = jammed(cache.links, stations, self.params)
        plan = self._plan(len(RoundKind) * step + kind, begin_s, stations, messages, state.n_frames)
        forwarding = self._forwarding(plan, stations, messages.refused)
        before = state
        if state.channel.now_ns < plan.begin_ns:
            before = self._idle(state, links, plan.begin_ns)
        after, windows, busy = self._transmit(before, plan, links, stations, forwarding)
        frames = own_frames(plan.units) if forwarding is None else forwarding.frames
        sent = Transmissions.of(frames, plan.units, windows, plan.first_tag)
        happened = _happened(plan, sent, cache.neighbours, stations, messages, busy)
        return replace(after, n_frames=state.n_frames + len(frames), cache=cache), happened

    def gap_s(self, state: ChannelContext, stations: Stations) -> Float[ndarray, "n"]:
        """Least time between two frames of each station that congestion control allows now [s]."""
        gap_s = 1e-9 * dcc.gap_ns(state.dcc, stations.key, self.params.dcc)
        return gap_s if stations.abuse is None else np.where(stations.abuse.ignores_dcc, 0.0, gap_s)

    @property
    def _rules(self) -> ChannelRules:
        return ChannelRules(rng.key(self.seed, rng.Stream.CHANNEL), self.params.receiver, self.params.access)

    def _plan(self, number: int, begin_s: float, stations: Stations, messages: Messages, n_frames: int) -> "_RoundPlan":
        """Segments of all messages, and the random times at which they are generated."""
        begin_ns, end_ns = round(begin_s * 1e9), round((begin_s + self.round_s) * 1e9)
        keys = messages.keys(stations)
        units, n_segments = _units(messages, keys, number, self.params.receiver.rate_mbps)
        phase = rng.uniforms(rng.key(self.seed, rng.Stream.GENERATION, number), keys)[:, 0]
        offset_ns = np.floor(phase * (end_ns - begin_ns) / 2).astype(np.int64)
        if messages.delay_s is not None:
            offset_ns += np.rint(1e9 * messages.delay_s).astype(np.int64)
        return _RoundPlan(
            number=number,
            begin_ns=begin_ns,
            end_ns=end_ns,
            units=units,
            n_segments=n_segments,
            generated_ns=begin_ns + offset_ns[units["message"]],
            lifetime_ns=round(self.params.access.lifetime_s * 1e9),
            first_tag=n_frames,
            is_background=np.zeros(len(messages), bool) if messages.is_background is None else messages.is_background,
        )

    def _forwarding(
        self, plan: "_RoundPlan", stations: Stations, refused: Int[ndarray, "p"] | None
    ) -> Forwarding | None:
        """Forwarding in this round; None where every message has one hop."""
        relay = self.params.relay
        if relay.max_hops <= 1:
            return None
        rules = ForwardingRules(
            max_hops=relay.max_hops,
            contends=relay.rule == "contention",
            forward_p=relay.forward_p,
            range_m=self.params.range_m,
            forward_range_m=relay.forward_range_m,
            timer_min_s=relay.timer_min_s,
            timer_max_s=relay.timer_max_s,
            timer_distance_m=relay.timer_distance_m,
            end_ns=plan.end_ns,
            lifetime_ns=plan.lifetime_ns,
            access=int(Access.BE),
            first_tag=plan.first_tag,
            rng_key=rng.key(self.seed, rng.Stream.RELAY, plan.number),
        )
        return Forwarding.of(rules, plan.units, stations.key, stations.xyz_m[:, :2], refused)

    def _transmit(
        self, state: ChannelContext, plan: "_RoundPlan", links: Links, stations: Stations, forwarding: Forwarding | None
    ) -> tuple[ChannelContext, list[WindowResult], Float[ndarray, "n"]]:
        """The round window by window; congestion control is updated in between.

        Returns
        -------
        The state after the round, the results of all windows, and the share of the round in which each station sensed
        the medium busy.
        """
        now, control, rules, params = state.channel, state.dcc, self._rules, self.params.dcc
        units, own_ns, end_ns, period_ns = plan.units, plan.generated_ns, plan.end_ns, round(params.period_s * 1e9)
        waits = own_ns + units["airtime_ns"] <= end_ns
        airtime_ns = np.zeros(len(stations), np.int64)
        np.maximum.at(airtime_ns, units["source"], units["airtime_ns"])
        windows: list[WindowResult] = []
        busy = np.zeros(len(stations))
        measured, strong = 0, np.zeros(len(stations))  # since the last update of congestion control
        while now.now_ns < end_ns:
            start_ns = stop_ns = now.now_ns
            if not len(now.packets):  # an idle channel until the next generation or timer
                timer_ns = end_ns if forwarding is None else forwarding.next_ns
                stop_ns = min(int(own_ns[waits].min(initial=end_ns)), timer_ns, end_ns - period_ns)
            stop_ns = min(max(start_ns, stop_ns) + period_ns, end_ns)
            due = np.flatnonzero(waits & (own_ns < stop_ns))
            waits[due] = False
            gap_ns = dcc.gap_ns(control, stations.key, params, airtime_ns)
            if stations.abuse is not None:
                gap_ns = np.where(stations.abuse.ignores_dcc, 0, gap_ns)
            now, out = channel.run_window(now, links, plan.packets(due), stop_ns, rules, gap_ns, forwarding)
            windows.append(out)
            span = stop_ns - start_ns
            busy += out.busy * span
            strong, measured = strong + out.busy_strong * span, measured + span
            while measured >= params.period_s * 1e9 - 1:
                control = dcc.update(control, stations.key, np.minimum(strong / measured, 1.0), params)
                strong *= max(0.0, 1 - params.period_s * 1e9 / measured)
                measured -= period_ns
        return replace(state, channel=now, dcc=control), windows, busy / (end_ns - plan.begin_ns)

    def links(self, stations: Stations) -> LinkCache:
        """Links and neighbours of these stations."""
        return LinkCache.of(stations, self.params, self.seed, self.los)

    def _idle(self, state: ChannelContext, links: Links, until_ns: int) -> ChannelContext:
        """The state after the time between two rounds, in which nothing is generated."""
        control, params, since_ns = state.dcc, self.params.dcc, state.channel.now_ns
        none = np.zeros(0, np.int64)
        nothing = Packets(none, none.astype(np.uint64), none, none, none.astype(np.uint8), none, none)
        now, out = channel.run_window(state.channel, links, nothing, until_ns, self._rules)
        for _ in range(min(int((until_ns - since_ns) * 1e-9 / params.period_s), 10)):
            control = dcc.update(control, links.key, np.minimum(out.busy_strong, 1.0), params)
        return replace(state, channel=now, dcc=control)


@dataclass(frozen=True, kw_only=True, slots=True)
class _RoundPlan:
    """What stations send in one round, and when: U segments of M messages."""

    number: int
    """Of the round, counted over the whole run."""
    begin_ns: int
    end_ns: int
    units: ndarray
    """Segments, as `forwarding.UNIT`."""
    n_segments: Int[ndarray, "m"]
    """Of each message."""
    generated_ns: Int[ndarray, "u"]
    """When each segment is generated."""
    lifetime_ns: int
    """Longest wait of a segment in its sender's queue."""
    first_tag: int
    """Number of the first frame of the round, counted over the whole run."""
    is_background: Bool[ndarray, "m"]

    def packets(self, due: Int[ndarray, "p"]) -> Packets:
        """These segments as packets of their senders."""
        own_ns = self.generated_ns[due]
        return Packets(
            sender=self.units["source"][due],
            seq=self.units["seq"][due],
            generated_ns=own_ns,
            payload_bytes=self.units["payload_bytes"][due],
            access=np.where(self.is_background[self.units["message"][due]], Access.BK, Access.BE).astype(np.uint8),
            lifetime_ns=np.minimum(self.lifetime_ns, self.end_ns - own_ns),
            tag=self.first_tag + due,
        )


def _happened(
    plan: _RoundPlan, sent: Transmissions, neighbours: NeighbourList, stations: Stations, messages: Messages,
    busy: Float[ndarray, "n"],
) -> MessageRound:  # fmt: skip
    """Receptions of a round, and the outcome of each frame at every station in range."""
    attempts = ReceptionAttempts.of(sent, neighbours)
    receptions, n_duplicate = complete_messages(
        sent, attempts, plan.generated_ns, plan.n_segments, plan.begin_ns, messages, stations.xyz_m[:, :2]
    )
    on_air = sent.on_air
    outcomes = FrameOutcomes(
        message=attempts.message,
        receiver=attempts.receiver,
        hop=attempts.hop,
        distance_m=attempts.distance_m,
        los_state=attempts.los_state,
        outcome=attempts.outcome,
        n_transmissions=np.bincount(sent.message[on_air], minlength=len(messages)),
        n_relayed=int((sent.hop[on_air] > 1).sum()),
        n_duplicate=n_duplicate,
        sent_bytes=float(np.sum(plan.units["payload_bytes"][sent.unit[on_air]] + MAC_OVERHEAD_BYTES)),
        cbr=busy,
    )
    return MessageRound(messages.station, receptions, outcomes)


def without_cache(state: ChannelContext) -> ChannelContext:
    """The same state without its cache: the next round computes all links again."""
    return replace(state, cache=None)


def _units(
    messages: Messages, keys: UInt64[ndarray, "m"], round_number: int, rate_mbps: float
) -> tuple[ndarray, Int[ndarray, "m"]]:
    """Segments of all messages, by message, and their number for each message."""
    sent = np.flatnonzero(messages.length_bytes > 0)
    count, payload_bytes = messages.segments(sent, FRAME_BYTES)
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
