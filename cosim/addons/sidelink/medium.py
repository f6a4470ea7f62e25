"""The media `nr_mode2` and `lte_mode4`: rounds of messages over the sidelink, without a base station.

Each station selects its own resources by sensing, and reserves them for its next messages (semi-persistent
scheduling). A message longer than the largest transport block is segmented. A message is received when all its segments
are received. `sidelink_slots` carries out the slots; `sidelink_memory` keeps what lasts.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Int, UInt64
from numpy import ndarray

from cosim.addons.sidelink.memory import SidelinkState, log_of, memory_of, processes_of, room_of, stations_of
from cosim.addons.sidelink.records import MAX_SENT, N_USED, UNIT, SlotAir, SlotLog, SlotRules
from cosim.addons.sidelink.slots import next_period, run_slots
from cosim.base import rng
from cosim.base.kernel import compiled
from cosim.base.ragged import offsets, owner_of_rows, ranges
from cosim.radio.channel import Links
from cosim.radio.dtypes import NEVER, NONE, RECEIVED
from cosim.radio.link_budget import from_db
from cosim.radio.link_cache import LinkCache, jammed
from cosim.radio.message_round import FrameOutcomes, MessageRound, Messages, RoundKind, Stations
from cosim.radio.params import RadioParams
from cosim.radio.propagation import fading_quantiles
from cosim.radio.receptions import ReceptionAttempts, Transmissions, complete_messages
from cosim.radio.segmentation import FRAME_BYTES
from cosim.radio.sidelink_params import allowed_ms
from cosim.radio.sidelink_phy import MAC_OVERHEAD_BYTES, Carrier
from sensors.line_of_sight import LosOfPlaces

_PROCESSING_SLOTS = {1: 3, 2: 5, 4: 9}
"""T_proc,1 by slots per millisecond: table 8.1.4-2 of TS 38.214. Re-evaluation comes this long before transmission."""

TAIL = 6.0
"""Standard deviations beyond which a block is decoded or lost without a draw."""


@dataclass(frozen=True)
class SidelinkMedium:
    """Sensing-based semi-persistent scheduling on a pool of resources, slot by slot.

    A message is generated at a time of its station and kind in the first half of the round, the same in every round, so
    that messages are periodic.
    """

    params: RadioParams
    round_s: float
    """Duration of one round [s]."""
    seed: int
    los: LosOfPlaces | None
    """Lines of sight in the city; None without buildings."""
    is_nr: bool

    def __post_init__(self) -> None:
        if self.round_s / 2 < 0.004:
            raise ValueError(
                f"a round of {self.round_s:g} s is too short for the sidelink: a message may be generated in its first "
                "half and then needs at least 4 ms. Set sensing_interval_s or radio.timeout_s higher."
            )

    def start(self) -> SidelinkState:
        """No stations yet."""
        return SidelinkState()

    def broadcast(
        self, state: SidelinkState, kind: RoundKind, step: int, begin_s: float, stations: Stations, messages: Messages
    ) -> tuple[SidelinkState, MessageRound]:
        """One round of messages."""
        if len(stations) == 0:
            return state, MessageRound.silent()
        cache = state.cache
        if cache is None or not cache.serves(stations):
            cache = self.links(stations)
        links = jammed(cache.links, stations, self.params)
        begin_ns = round(begin_s * 1e9)
        end_ns = round((begin_s + self.round_s) * 1e9)
        number = len(RoundKind) * step + kind
        plan = self._plan(kind, number, begin_ns, end_ns, stations, messages)
        after, log, busy = self._run(state, plan, links, stations)
        happened = self._happened(plan, log, busy, links, cache, stations, messages)
        return replace(after, cache=cache), happened

    def links(self, stations: Stations, senders: Int[ndarray, "k"] | None = None) -> LinkCache:
        """Links and neighbours of these stations; each hears all, so that `senders` make no difference."""
        return LinkCache.of(stations, self.params, self.seed, self.los)

    @cached_property
    def carrier(self) -> Carrier:
        """The carrier and its pool."""
        return self.params.nr.carrier() if self.is_nr else self.params.lte.carrier()

    @property
    def _slot_ns(self) -> int:
        return 1_000_000 // self.carrier.slots_per_ms

    @cached_property
    def rules(self) -> SlotRules:
        """The parameters of the slots."""
        p, carrier = self.params.sidelink, self.carrier
        per_ms = carrier.slots_per_ms
        thermal_mw = 1.380649e-23 * 290.0 * 180e3 * per_ms * 1e3
        noise_mw = thermal_mw * float(from_db(self.params.receiver.noise_figure_db))
        window = round(p.window_s * 1000 * per_ms)
        forced = 0 if p.reservation_s is None else round(p.reservation_s * 1000 * per_ms)
        return SlotRules(
            rng_key=rng.key(self.seed, rng.Stream.CHANNEL),
            n_subchannels=carrier.n_subchannels,
            rbs=carrier.rbs,
            noise_mw=noise_mw,
            control_sinr=float(from_db(p.control_sinr_db)),
            rsrp_mw=float(from_db(p.rsrp_threshold_dbm)),
            share=p.share,
            first=1,
            last=window,
            lead=_PROCESSING_SLOTS[per_ms] if self.is_nr and self.params.nr.re_evaluation else 0,
            max_gap=31 if self.is_nr else 15,
            aligned=p.aligned,
            ranked=not self.is_nr,
            power_slots=1000,
            forced_period=forced,
            keep_p=p.keep_p,
            counter_low=p.counter[0],
            counter_high=p.counter[1],
            short_period=100 * per_ms,
            long_slots=100 * per_ms,
            reselect_after=p.reselect_after,
            busy_mw=float(from_db(p.cbr_threshold_dbm)),
            busy_slots=100 * per_ms,
            limited=p.limits_occupancy,
            with_repeats=p.n_transmissions > 1,
        )

    @cached_property
    def _allowed(self) -> ndarray:
        """Whether each period [slots] may be reserved."""
        allowed = np.zeros(1000 * self.carrier.slots_per_ms + 1, np.bool_)
        allowed[np.array(sorted(allowed_ms(self.is_nr))) * self.carrier.slots_per_ms] = True
        return allowed

    def _plan(
        self, kind: RoundKind, number: int, begin_ns: int, end_ns: int, stations: Stations, messages: Messages
    ) -> "_RoundPlan":
        """Segments of all messages, their processes, and when they are generated."""
        sent = np.flatnonzero(messages.length_bytes > 0)
        count, payload_bytes = messages.segments(sent, min(FRAME_BYTES, self.carrier.largest_bytes))
        n_segments = np.zeros(len(messages), np.int64)
        n_segments[sent] = count
        message = np.repeat(sent, count)
        keys = messages.keys(stations)
        segment = ranges(np.zeros_like(count), count)
        generation = rng.key(self.seed, rng.Stream.GENERATION, kind)
        phase = rng.uniforms(generation, keys)[:, 0]
        generated_ns = messages.generated_ns(phase, begin_ns, end_ns)[message]
        unit = np.zeros(len(message), UNIT)
        unit["key"] = rng.keys(np.uint64(number), keys[message], segment)
        unit["generated"] = generated_ns // self._slot_ns
        unit["deadline"] = end_ns // self._slot_ns - 1
        unit["station"] = messages.station[message]
        unit["width"] = self.carrier.width(np.repeat(payload_bytes, count))
        in_time = unit["generated"] <= unit["deadline"]  # an attacker may delay a message beyond its round
        unit["n_sent"] = np.where(in_time, self.params.sidelink.n_transmissions, 0)
        unit["sinr_db"] = self.carrier.sinr_db[unit["width"] - 1]
        unit["spread_db"] = self.carrier.spread_db[unit["width"] - 1]
        unit["clear_sinr"] = from_db(unit["sinr_db"] + TAIL * unit["spread_db"])
        unit["dead_sinr"] = from_db(unit["sinr_db"] - TAIL * unit["spread_db"])
        unit["slot"] = NEVER
        own_key = rng.key(self.seed, rng.Stream.CHANNEL, 1 + kind)
        process = rng.keys(own_key, keys[message], segment)
        return _RoundPlan(
            begin_ns, end_ns, unit, message, generated_ns, n_segments, np.repeat(payload_bytes, count), process
        )

    def _run(
        self, state: SidelinkState, plan: "_RoundPlan", links: Links, stations: Stations
    ) -> tuple[SidelinkState, SlotLog, Int[ndarray, "n"]]:
        """Carry out the slots of a round; returns the next state, the log and the busy subchannels of each station."""
        rules = self.rules
        begin, end = plan.begin_ns // self._slot_ns, plan.end_ns // self._slot_ns
        station, was = stations_of(state, stations)
        process = processes_of(state.process, plan.unit, plan.process, stations)
        n_periods = begin // rules.busy_slots - (state.until - 1) // rules.busy_slots
        silent = min(n_periods, N_USED + 1)
        if begin % rules.busy_slots == 0:
            silent -= 1
        for _ in range(silent if state.until > 0 else 0):
            next_period(station, rules)
        memory = memory_of(process, station, was, state, plan.unit, links, rules, begin)
        log = log_of(plan.unit, links, end - begin)
        air = self.air(links, stations)
        room = room_of(rules)
        arrival = np.lexsort((plan.unit["key"], plan.unit["generated"]))
        run_slots(begin, begin, end, arrival, air, memory, log, room, rules)
        reservation = memory.reservation[: memory.n_reservations[0]]
        after = SidelinkState(process, station, memory.entry, memory.ptr, memory.n_entries, reservation, end)
        return after, log, air.busy_round

    def air(self, links: Links, stations: Stations) -> SlotAir:
        """Links of a round, and room for the sums of a slot."""
        n, jam = len(stations), links.jamming
        zero = np.zeros(n)
        return SlotAir(
            ptr=links.ptr,
            receiver=links.receiver,
            mean_mw=links.power_mw,
            fading=links.fading,
            key=links.key,
            quantiles=fading_quantiles(),
            leak=self._leak,
            allowed=self._allowed,
            jam_mw=zero if jam is None else jam.constant_mw / self.carrier.n_rbs,
            react_mw=zero if jam is None else jam.reactive_mw / self.carrier.n_rbs,
            is_jammed=np.zeros(n, bool) if jam is None else jam.detected,
            density_mw=np.zeros((n, self.carrier.n_subchannels)),
            arrival_mw=np.zeros(len(links.receiver), np.float32),
            stamp=np.full(n, NONE, np.int64),
            sends=np.full(n, NONE, np.int64),
            touched=np.zeros(n, np.int64),
            busy_round=np.zeros(n, np.int64),
        )

    @cached_property
    def _leak(self) -> ndarray:
        return self.carrier.leak()

    def _happened(
        self,
        plan: "_RoundPlan",
        log: SlotLog,
        busy: Int[ndarray, "n"],
        links: Links,
        cache: LinkCache,
        stations: Stations,
        messages: Messages,
    ) -> MessageRound:
        """Receptions of a round, and the outcome of each segment at every station in range."""
        unit, slot_ns = log.unit, self._slot_ns
        attempts_of = _transmissions(plan, log, links, messages, slot_ns)
        attempts = ReceptionAttempts.of(attempts_of, cache.neighbours)
        receptions, _ = complete_messages(
            attempts_of,
            attempts,
            plan.generated_ns,
            plan.n_segments,
            np.full(len(messages), plan.begin_ns),
            messages.station,
            stations.xyz_m[:, :2],
            plan.begin_ns,
        )
        n_sent = unit["n_sent"].astype(np.int64)
        if self.params.sidelink.n_transmissions > 1:
            _merge(log.reception, unit, np.diff(links.ptr))
            first = Transmissions(*(column[: len(unit)] for column in attempts_of))
            reception = _receptions_of(unit, links, log.reception, np.arange(len(unit)), 0)
            receiver = attempts_of.receiver[: len(reception)]
            first = first._replace(receiver=receiver, reception=reception)
            attempts = ReceptionAttempts.of(first, cache.neighbours)
        outcomes = FrameOutcomes(
            message=attempts.message,
            receiver=attempts.receiver,
            hop=attempts.hop,
            distance_m=attempts.distance_m,
            los_state=attempts.los_state,
            outcome=attempts.outcome,
            n_transmissions=np.bincount(plan.message, n_sent, len(messages)).astype(np.int64),
            n_relayed=0,
            n_duplicate=0,  # the transmissions of a segment are received together, once
            sent_bytes=float(np.sum((plan.payload_bytes + MAC_OVERHEAD_BYTES) * n_sent)),
            cbr=busy / (len(log.head_sent) * self.carrier.n_subchannels),
        )
        return MessageRound(messages.station, receptions, outcomes)


def nr_mode2(params: RadioParams, round_s: float, seed: int, los: LosOfPlaces | None) -> SidelinkMedium:
    """Sidelink of NR-V2X, mode 2."""
    return SidelinkMedium(params, round_s, seed, los, is_nr=True)


def lte_mode4(params: RadioParams, round_s: float, seed: int, los: LosOfPlaces | None) -> SidelinkMedium:
    """Sidelink of LTE-V2X, mode 4."""
    return SidelinkMedium(params, round_s, seed, los, is_nr=False)


@dataclass(frozen=True, slots=True)
class _RoundPlan:
    """What stations send in one round: U segments (units) of M messages."""

    begin_ns: int
    end_ns: int
    unit: ndarray
    message: Int[ndarray, "u"]
    generated_ns: Int[ndarray, "u"]
    n_segments: Int[ndarray, "m"]
    payload_bytes: Int[ndarray, "u"]
    process: UInt64[ndarray, "u"]
    """Key of the process that sends each unit."""


def _receptions_of(
    unit: ndarray,
    links: Links,
    reception: ndarray,
    rows: Int[ndarray, "f"],
    attempt: Int[ndarray, "f"] | int,
) -> ndarray:
    """Outcomes of these transmissions at their receivers, one transmission after the other."""
    degree = np.diff(links.ptr)[unit["station"][rows]]
    return reception[ranges(unit["rows"][rows] + attempt * degree, degree)]


def _transmissions(plan: _RoundPlan, log: SlotLog, links: Links, messages: Messages, slot_ns: int) -> Transmissions:
    """All transmissions: the first of each unit, then further ones."""
    unit = log.unit
    rows_of = [np.arange(len(unit))]
    rows_of += [np.flatnonzero(unit["n_sent"] > a) for a in range(1, MAX_SENT)]
    rows = np.concatenate(rows_of)
    attempt = owner_of_rows(np.array([len(of) for of in rows_of]))
    station = unit["station"][rows].astype(np.int64)
    degree = np.diff(links.ptr)[station]
    on_air = unit["n_sent"][rows] > attempt
    start_ns = np.where(on_air, unit["slot"][rows, attempt], 0) * slot_ns
    return Transmissions(
        unit=rows,
        message=plan.message[rows],
        source=messages.station[plan.message[rows]],
        transmitter=station,
        hop=np.ones(len(rows), np.int64),
        on_air=on_air,
        start_ns=start_ns,
        end_ns=start_ns + slot_ns,
        begin=offsets(degree)[:-1],
        n_receptions=degree,
        receiver=links.receiver[ranges(links.ptr[station], degree)],
        reception=_receptions_of(unit, links, log.reception, rows, attempt),
    )


@compiled
def _merge(reception, unit, degree):
    """Replace the outcome of the first transmission by that of all: received once, or lost as the last one is."""
    for u in range(len(unit)):
        me = unit[u]
        n = degree[me.station]
        for k in range(n):
            for a in range(1, me.n_sent):
                if reception[me.rows + k] != RECEIVED:
                    reception[me.rows + k] = reception[me.rows + a * n + k]
