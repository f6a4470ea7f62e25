"""The medium `csma`: rounds of messages over one shared channel, with forwarding and congestion control.

A message longer than one frame is segmented. Each segment is lost, forwarded and received on its own. A message is
received when all its segments are received.
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.base import rng
from cosim.base.ragged import as_slice, expand, ptr_of
from cosim.radio import channel, dcc
from cosim.radio.channel import Access, ChannelRules, Links, Packets, WindowResult
from cosim.radio.channel_state import ChannelState
from cosim.radio.dcc import BusyMeasurement, DccState
from cosim.radio.dtypes import NONE
from cosim.radio.forwarding import COPY, FRAME, UNIT, Forwarding, ForwardingRules, own_frames
from cosim.radio.link_cache import LinkCache, jammed
from cosim.radio.message_round import (
    EarlierMessages,
    FrameOutcomes,
    MessageRound,
    Messages,
    Outcome,
    Receptions,
    RoundKind,
    Stations,
)
from cosim.radio.params import RadioParams
from cosim.radio.phy import MAC_OVERHEAD_BYTES, airtime_ns
from cosim.radio.receptions import FrameState, NeighbourList, ReceptionAttempts, Transmissions, complete_messages
from cosim.radio.segmentation import FRAME_BYTES
from cosim.radio.underway import MESSAGE, SENT_FRAME, Underway, rows_of_keys
from sensors.line_of_sight import LosOfPlaces


@dataclass(frozen=True, slots=True)
class ChannelContext:
    """All that lasts from one round to the next."""

    channel: ChannelState
    dcc: DccState
    measured: BusyMeasurement
    underway: Underway
    """Messages that go on in the next round."""
    cache: LinkCache | None = None


@dataclass(frozen=True, slots=True)
class CsmaMedium:
    """CSMA/CA broadcast, packet by packet, with path loss, blockage, shadowing and fading.

    A message that is not sent by the end of its round goes on in the rounds after it, until it is too old: detection
    messages `radio.timeout_s` after the beginning of their step, evaluation messages twice that.
    """

    params: RadioParams
    round_s: float
    """Duration of one round [s]."""
    seed: int
    los: LosOfPlaces | None
    """Lines of sight in the city; None without buildings."""

    def start(self) -> ChannelContext:
        """An idle channel without stations."""
        return ChannelContext(ChannelState.start(), DccState.start(), BusyMeasurement.start(), Underway())

    def broadcast(
        self, state: ChannelContext, kind: RoundKind, step: int, begin_s: float, stations: Stations, messages: Messages
    ) -> tuple[ChannelContext, MessageRound]:
        """One round of messages, each generated at a random time in the first half of the round."""
        if len(stations) == 0:
            return state, MessageRound.silent()
        plan, channel_now = self._plan(kind, step, begin_s, stations, messages, state)
        n_later = len(RoundKind) - 1 - kind  # rounds of this step, which use the same links
        until_ns = plan.end_ns + n_later * (plan.end_ns - plan.begin_ns)
        cache = self._cache(state, stations, messages, until_ns)
        links = jammed(cache.links, stations, self.params)
        forwarding = self._forwarding(plan, stations)
        before = replace(state, channel=channel_now)
        idle: list[WindowResult] = []
        busy_before_ns = np.zeros(len(stations))
        if channel_now.now_ns < plan.begin_ns:  # what is underway goes on between two rounds
            before, idle, busy_before_ns = self._transmit(before, plan, links, stations, forwarding, plan.begin_ns)
        after, windows, busy_ns = self._transmit(before, plan, links, stations, forwarding, plan.end_ns)
        busy = (busy_before_ns + busy_ns) / (plan.end_ns - plan.begin_ns)
        frames = plan.frames if forwarding is None else forwarding.frames
        sent = Transmissions.of(frames, plan.units, [*idle, *windows], plan.sent)
        ending = _RoundEnd.of(plan, sent, after.channel, forwarding)
        happened, attempts = _happened(plan, sent, ending, cache.neighbours, stations, channel_now.now_ns, busy)
        underway, frame_number = ending.underway(plan, sent, attempts, stations, forwarding)
        channel_after = _with_tags(after.channel, frame_number)
        return replace(after, channel=channel_after, underway=underway, cache=cache), happened

    def gap_s(self, state: ChannelContext, stations: Stations) -> Float[ndarray, "n"]:
        """Least time between two frames of each station that congestion control allows now [s].

        With adaptive control it follows the time on air of the station's last message.
        """
        control = state.dcc.of(stations.key)
        gap_s = 1e-9 * dcc.gap_ns(control, stations.key, self.params.dcc, control.airtime_ns)
        return gap_s if stations.abuse is None else np.where(stations.abuse.ignores_dcc, 0.0, gap_s)

    @property
    def _rules(self) -> ChannelRules:
        of_channel = rng.key(self.seed, rng.Stream.CHANNEL)
        return ChannelRules(of_channel, self.params.receiver, self.params.access)

    def _lasts_s(self, kind: RoundKind) -> float:
        """How long a message may take, from the beginning of its round [s].

        A step has a detection round and then an evaluation round. A detection message is too old `timeout_s` after the
        step has begun, an evaluation message twice that, however short the rounds are.
        """
        timeout_s = self.round_s if self.params.timeout_s is None else max(self.params.timeout_s, self.round_s)
        return timeout_s + kind * (timeout_s - self.round_s)

    def _plan(
        self, kind: RoundKind, step: int, begin_s: float, stations: Stations, messages: Messages, state: ChannelContext
    ) -> tuple["_RoundPlan", ChannelState]:
        """What is to be sent: the segments of new messages at random times, and those of messages underway.

        Returns
        -------
        The plan, and the channel with packets that carry the plan's numbers of frames.
        """
        number = len(RoundKind) * step + kind
        begin_ns = round(begin_s * 1e9)
        end_ns = round((begin_s + self.round_s) * 1e9)
        keys = messages.keys(stations)
        units, n_segments = _units(messages, keys, number, self.params.receiver.rate_mbps)
        of_round = rng.key(self.seed, rng.Stream.GENERATION, number)
        phase = rng.uniforms(of_round, keys)[:, 0]
        generated_ns = messages.generated_ns(phase, begin_ns, end_ns)
        units["generated_ns"] = generated_ns[units["message"]]
        units["end_ns"] = round((begin_s + self._lasts_s(kind)) * 1e9)
        new = np.zeros(len(messages), MESSAGE)
        new["name"] = -1 if messages.name is None else messages.name
        new["step"], new["kind"], new["begin_ns"] = step, kind, begin_ns
        new["end_ns"] = round((begin_s + self._lasts_s(kind)) * 1e9)
        new["n_segments"], new["station"] = n_segments, messages.station
        new["is_background"] = False if messages.is_background is None else messages.is_background
        earlier, frame_number = state.underway.among(stations.key)
        plan = _RoundPlan.of(number, begin_ns, end_ns, new, units, messages.refused, earlier)
        frame_number = np.where(frame_number == NONE, NONE, frame_number + len(units))
        return plan, _with_tags(state.channel, frame_number)

    def _forwarding(self, plan: "_RoundPlan", stations: Stations) -> Forwarding | None:
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
            lifetime_ns=round(self.params.access.lifetime_s * 1e9),
            access=int(Access.BE),
            rng_key=rng.key(self.seed, rng.Stream.RELAY, plan.number),
        )
        xy_m = stations.xyz_m[:, :2]
        return Forwarding.of(rules, plan.units, stations.key, xy_m, plan.refused, plan.frames, plan.copies)

    def _transmit(
        self,
        state: ChannelContext,
        plan: "_RoundPlan",
        links: Links,
        stations: Stations,
        forwarding: Forwarding | None,
        until_ns: int,
    ) -> tuple[ChannelContext, list[WindowResult], Float[ndarray, "n"]]:
        """The channel until a time, window by window; congestion control is updated in between.

        Returns
        -------
        The state at that time, the results of all windows, and for how long each station sensed the medium busy [ns].
        """
        now = state.channel
        control = state.dcc
        rules = self._rules
        params = self.params.dcc
        measured = state.measured.of(stations.key)
        units = plan.units
        own_ns = plan.units["generated_ns"]
        period_ns = round(params.period_s * 1e9)
        lifetime_ns = round(self.params.access.lifetime_s * 1e9)
        waits = (own_ns >= now.now_ns) & (own_ns + units["airtime_ns"] <= units["end_ns"])
        airtime_ns = np.zeros(len(stations), np.int64)
        np.maximum.at(airtime_ns, units["source"], units["airtime_ns"])
        mean_ns = units["airtime_ns"].sum() // max(len(units), 1)  # of what stations forward that send nothing else
        on_air_ns = np.where(airtime_ns > 0, airtime_ns, mean_ns)
        windows: list[WindowResult] = []
        busy_ns = np.zeros(len(stations))
        while now.now_ns < until_ns:
            start_ns = stop_ns = now.now_ns
            if not len(now.packets):  # an idle channel until the next generation or timer
                timer_ns = until_ns if forwarding is None else forwarding.next_ns
                stop_ns = min(int(own_ns[waits].min(initial=until_ns)), timer_ns, until_ns - period_ns)
            stop_ns = min(max(start_ns, stop_ns) + period_ns, until_ns)
            due = np.flatnonzero(waits & (own_ns < stop_ns))
            waits[due] = False
            gap_ns = dcc.gap_ns(control, stations.key, params, on_air_ns)
            if stations.abuse is not None:
                gap_ns = np.where(stations.abuse.ignores_dcc, 0, gap_ns)
            packets = plan.packets(due, lifetime_ns)
            now, out = channel.run_window(now, links, packets, stop_ns, rules, gap_ns, forwarding)
            windows.append(out)
            span = stop_ns - start_ns
            busy_ns += out.busy * span
            control, measured = measured.after(out.busy_strong, span).updated(control, params)
        control = control.of(stations.key).after_messages(airtime_ns)
        return replace(state, channel=now, dcc=control, measured=measured), windows, busy_ns

    def links(self, stations: Stations, senders: Int[ndarray, "k"] | None = None) -> LinkCache:
        """Links and neighbours of these stations, from the senders of messages; None: from all.

        Where messages are forwarded, any station may send.
        """
        if senders is None or self.params.relay.max_hops > 1:
            return LinkCache.of(stations, self.params, self.seed, self.los)
        sends = np.zeros(len(stations), bool)
        sends[senders] = True
        return LinkCache.of(stations, self.params, self.seed, self.los, sends)

    def _cache(self, state: ChannelContext, stations: Stations, messages: Messages, until_ns: int) -> LinkCache:
        """Links of the stations that may send or give up a frame by `until_ns`, and of jammers."""
        sends = np.zeros(len(stations), bool)
        sends[messages.station] = True
        earlier = rows_of_keys(stations.key, _active_keys(state, until_ns))
        sends[earlier[earlier != NONE]] = True
        if stations.abuse is not None:
            sends |= np.isfinite(stations.abuse.jam_dbm) | np.isfinite(stations.abuse.react_dbm)
        cache = state.cache
        if cache is None or not cache.serves(stations):
            return self.links(stations, np.flatnonzero(sends))
        missing = np.flatnonzero(sends & ~cache.sends)
        return cache.and_also(self.links(stations, missing)) if len(missing) else cache


@dataclass(frozen=True, kw_only=True, slots=True)
class _RoundPlan:
    """What is sent in one round: the messages of the round, then those that are underway from earlier rounds."""

    number: int
    """Of the round, counted over the whole run."""
    begin_ns: int
    end_ns: int
    messages: ndarray
    """Records of `MESSAGE`."""
    n_new: int
    """Number of messages of this round."""
    units: ndarray
    """Segments, as `forwarding.UNIT`."""
    frames: ndarray
    """Frames so far, as `forwarding.FRAME`: that of each segment's sender, then forwarded ones."""
    sent: ndarray
    """What is known of these frames, as `underway.SENT_FRAME`."""
    copies: ndarray
    """Segments at other stations, as `forwarding.COPY`."""
    got_ptr: Int[ndarray, "f+1"]
    """Where the stations begin that have received each frame in earlier rounds."""
    got_by: Int[ndarray, "g"]
    """Rows of these stations."""
    refused: Int[ndarray, "p"] | None
    """As `Messages.refused`."""

    @staticmethod
    def of(
        number: int,
        begin_ns: int,
        end_ns: int,
        messages: ndarray,
        units: ndarray,
        refused: Int[ndarray, "p"] | None,
        earlier: Underway,
    ) -> "_RoundPlan":
        """The plan of new messages and of earlier ones, whose stations have rows."""
        n_new, n_units = len(messages), len(units)
        own = own_frames(units)
        sent = np.zeros(n_units, SENT_FRAME)
        sent["unit"] = own["unit"]
        sent["transmitter"] = own["transmitter"]
        sent["hop"] = own["hop"]
        got_ptr = np.zeros(n_units + 1, np.int64)
        got_by = np.zeros(0, np.int64)
        copies = np.zeros(0, COPY)
        if len(earlier):
            older_units = earlier.units.copy()
            older = earlier.frames.copy()
            copies = earlier.copies.copy()
            older_units["message"] += n_new
            older["unit"] += n_units
            copies["unit"] += n_units
            messages = np.concatenate([messages, earlier.messages])
            units = np.concatenate([units, older_units])
            sent = np.concatenate([sent, older])
            got_ptr = ptr_of(n_units + earlier.got_frame, len(sent))
            got_by = earlier.got_by
            if len(earlier.refused_message):
                more = n_new + earlier.refused_message << 32 | earlier.refused_by
                refused = np.sort(more if refused is None else np.concatenate([refused, more]))
        frames = np.empty(len(sent), FRAME)
        for name in ("unit", "transmitter", "hop"):
            frames[name] = sent[name]
        return _RoundPlan(
            number=number,
            begin_ns=begin_ns,
            end_ns=end_ns,
            messages=messages,
            n_new=n_new,
            units=units,
            frames=frames,
            sent=sent,
            copies=copies,
            got_ptr=got_ptr,
            got_by=got_by,
            refused=refused,
        )

    def packets(self, due: Int[ndarray, "p"], lifetime_ns: int) -> Packets:
        """These segments as packets of their senders, with a longest wait in the queue."""
        units = self.units[due]
        is_background = self.messages["is_background"][units["message"]]
        return Packets(
            sender=units["source"],
            seq=units["seq"],
            generated_ns=units["generated_ns"],
            payload_bytes=units["payload_bytes"],
            access=np.where(is_background, Access.BK, Access.BE).astype(np.uint8),
            lifetime_ns=np.minimum(lifetime_ns, units["end_ns"] - units["generated_ns"]),
            tag=due,
        )


@dataclass(frozen=True, slots=True)
class _RoundEnd:
    """What goes on after the end of a round."""

    goes_on: Bool[ndarray, "m"]
    """Messages that go on in the next round."""
    waits: Bool[ndarray, "f"]
    """Their frames that are neither sent nor lost."""

    @staticmethod
    def of(plan: _RoundPlan, sent: Transmissions, now: ChannelState, forwarding: Forwarding | None) -> "_RoundEnd":
        """At the time of the channel `now`."""
        waits = np.zeros(len(sent.unit), bool)
        n_messages = len(plan.messages)
        is_young = plan.messages["end_ns"] > now.now_ns
        if not is_young.any():
            return _RoundEnd(np.zeros(n_messages, bool), waits)
        tag = now.packets["tag"]
        waits[tag[tag != NONE]] = True
        units = plan.units
        unborn = (units["generated_ns"] >= now.now_ns) & (
            units["generated_ns"] + units["airtime_ns"] <= units["end_ns"]
        )
        waits[: len(units)] |= unborn
        goes_on = np.zeros(n_messages, bool)
        goes_on[sent.message[waits]] = True
        if forwarding is not None:
            timers = forwarding.copies["unit"][forwarding.copies["waits"] > 0]
            goes_on[units["message"][timers]] = True
        goes_on &= is_young
        return _RoundEnd(goes_on, waits & goes_on[sent.message])

    def underway(
        self,
        plan: _RoundPlan,
        sent: Transmissions,
        attempts: ReceptionAttempts,
        stations: Stations,
        forwarding: Forwarding | None,
    ) -> tuple[Underway, Int[ndarray, "f"]]:
        """The messages that go on, and the number that each frame has from now on; NONE if its message does not."""
        if not self.goes_on.any():
            return Underway(), np.full(len(sent.unit), NONE)
        frames = np.zeros(len(sent.unit), SENT_FRAME)
        for name in ("unit", "transmitter", "hop", "on_air", "start_ns", "end_ns"):
            frames[name] = getattr(sent, name)
        frames["is_decided"] = ~self.waits
        going = np.flatnonzero(self.goes_on[sent.message])
        rows, of = expand(attempts.first[going], attempts.first[going + 1])
        got = attempts.outcome[rows] == Outcome.RECEIVED
        refused = np.zeros(0, np.int64) if plan.refused is None else plan.refused
        copies = plan.copies if forwarding is None else forwarding.copies
        everything = Underway(
            key=stations.key,
            messages=plan.messages,
            units=plan.units,
            frames=frames,
            copies=copies,
            got_frame=going[of[got]],
            got_by=attempts.receiver[rows[got]],
            refused_message=refused >> 32,
            refused_by=refused & 0xFFFFFFFF,
        )
        return everything.only(self.goes_on)


def _happened(
    plan: _RoundPlan,
    sent: Transmissions,
    ending: _RoundEnd,
    neighbours: NeighbourList,
    stations: Stations,
    since_ns: int,
    busy: Float[ndarray, "n"],
) -> tuple[MessageRound, ReceptionAttempts]:
    """Receptions since `since_ns`, and the outcome of each frame at every station in range."""
    state = _frame_states(plan, ending)
    attempts = ReceptionAttempts.of(sent, neighbours, state, plan.got_ptr, plan.got_by)
    receptions, n_duplicate = complete_messages(
        sent,
        attempts,
        plan.units["generated_ns"],
        plan.messages["n_segments"],
        plan.messages["begin_ns"],
        plan.messages["station"],
        stations.xyz_m[:, :2],
        since_ns,
    )
    is_reported = state == FrameState.REPORTED
    everything = _Outcomes(plan, sent, attempts, receptions, n_duplicate, is_reported)
    n_older = len(plan.messages) - plan.n_new
    happened = everything.of_messages(None if n_older == 0 else np.arange(plan.n_new), busy)
    older, earlier = plan.messages[plan.n_new :], []
    for kind, is_background in product(RoundKind, (False, True)):
        rows = np.flatnonzero((older["kind"] == kind) & (older["is_background"] == is_background))
        if len(rows):
            of_kind = everything.of_messages(plan.n_new + rows, None)
            step, name = older["step"][rows], older["name"][rows]
            earlier.append(EarlierMessages(kind, step, name, of_kind, is_background))
    return replace(happened, earlier=tuple(earlier)), attempts


def _frame_states(plan: _RoundPlan, ending: _RoundEnd) -> UInt8[ndarray, "f"]:
    """The `FrameState` of each frame: what was told in an earlier round is not told again."""
    state = np.where(ending.waits, FrameState.WAITS, FrameState.DECIDED).astype(np.uint8)
    n_new_frames = int(np.searchsorted(plan.units["message"], plan.n_new))
    older = slice(n_new_frames, len(plan.sent))
    is_told = plan.sent["is_decided"] | (plan.sent["transmitter"] == NONE)
    is_told |= ending.waits[: len(plan.sent)]
    state[older][is_told[older]] = FrameState.REPORTED
    return state


class _Outcomes(NamedTuple):
    """What happened to all messages of a round, those of earlier rounds included."""

    plan: _RoundPlan
    sent: Transmissions
    attempts: ReceptionAttempts
    receptions: Receptions
    n_duplicate: Int[ndarray, "m"]
    """Repeated segments of each message."""
    is_reported: Bool[ndarray, "f"]
    """Frames whose outcomes belong to an earlier round."""

    def of_messages(
        self,
        chosen: Int[ndarray, "m"] | None,
        busy: Float[ndarray, "n"] | None,
    ) -> MessageRound:
        """What happened to these messages, renumbered; None: to all. `busy`: channel busy ratio of the stations."""
        plan, sent, attempts, receptions = self.plan, self.sent, self.attempts, self.receptions
        station = plan.messages["station"].astype(np.int64)
        of_attempt = attempts.message
        of_frame = sent.message
        on_air = sent.on_air & ~self.is_reported
        columns = {name: getattr(attempts, name) for name in _OF_ATTEMPTS}
        if chosen is not None:
            row = np.full(len(plan.messages), NONE)
            row[chosen] = np.arange(len(chosen))
            station = station[chosen]
            receptions = receptions.take(row[receptions.message] != NONE)
            receptions = replace(receptions, message=row[receptions.message])
            of_frame = row[of_frame]
            is_chosen = of_frame != NONE
            on_air &= is_chosen
            # Mostly the first ones, which need not be copied.
            is_new = np.repeat(is_chosen & ~self.is_reported, np.diff(attempts.first))
            shown = as_slice(np.flatnonzero(is_new))
            of_attempt = row[of_attempt[shown]]
            columns = {name: column[shown] for name, column in columns.items()}
        outcomes = FrameOutcomes(
            message=of_attempt,
            **columns,
            n_transmissions=np.bincount(of_frame[on_air], minlength=len(station)),
            n_relayed=int((sent.hop[on_air] > 1).sum()),
            n_duplicate=int(self.n_duplicate[slice(None) if chosen is None else chosen].sum()),
            sent_bytes=float(np.sum(plan.units["payload_bytes"][sent.unit[on_air]] + MAC_OVERHEAD_BYTES)),
            cbr=busy,
        )
        return MessageRound(station, receptions, outcomes)


_OF_ATTEMPTS = ("receiver", "hop", "distance_m", "los_state", "outcome")
"""Columns of `ReceptionAttempts` with a row for each frame and station, besides `message`."""


def _active_keys(state: ChannelContext, until_ns: int) -> UInt64[ndarray, "k"]:
    """Keys of stations that may send or give up a frame of an earlier message by `until_ns`.

    Congestion control holds the frames of the other stations back for longer. The wait after a frame is fixed when the
    frame ends.
    """
    now, underway = state.channel, state.underway
    waiting = np.unique(now.packets["sender"])
    mac = now.mac[waiting]
    is_silent = now.phy["packet"][waiting] == NONE
    is_held_back = is_silent & (mac["gated"] > 0) & (mac["gate_ns"] >= until_ns)
    may_change = underway.messages["end_ns"] <= until_ns
    may_change[underway.units["message"][underway.units["generated_ns"] >= now.now_ns]] = True  # not in a queue yet
    senders = underway.key[underway.messages["station"][may_change]]
    return np.concatenate([senders, now.phy["key"][waiting[~is_held_back]]])


def _with_tags(now: ChannelState, number: Int[ndarray, "f"]) -> ChannelState:
    """The channel with the numbers of frames that its packets carry replaced; `number` has NONE for dropped frames."""
    if not len(now.packets):
        return now
    packets, tag = now.packets.copy(), now.packets["tag"]
    packets["tag"] = np.append(number, NONE)[tag]  # NONE, the last row, stays NONE
    return replace(now, packets=packets)


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
    first = np.cumsum(count) - count
    units["number"] = np.arange(len(units)) - np.repeat(first, count)
    units["payload_bytes"] = np.repeat(payload_bytes, count)
    units["airtime_ns"] = airtime_ns(units["payload_bytes"], rate_mbps)
    named = rng.keys(np.uint64(round_number), units["key"], units["number"])
    units["seq"] = named >> np.uint64(24)  # 40 bits are allowed
    return units, n_segments
