"""One shared radio channel: CSMA/CA broadcast, packet by packet, window after window.

    rules = ChannelRules(rng_key, ReceiverParams(), AccessParams())
    state, result = run_window(state, links, packets, until_ns, rules)

`ChannelState` holds the queues, back-offs and frames on the air at the end of a window. Two windows give the same
result as one window of the same total length. A packet is identified by its sender's key and its sequence number.
Every draw depends only on this identity, the receiver's key and the seed. The order of rows and stations out of range
have no effect.
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Annotated

import numpy as np
from annotated_types import Gt, Le
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.base.ragged import offsets, owner_of_rows, ranges
from cosim.radio import dtypes
from cosim.radio.channel_state import ChannelState, next_state, remap_stations
from cosim.radio.csma_events import PACKETS, SLOTS, Air, Heap, Log, run_until
from cosim.radio.forwarding import NO_FORWARDING, Forwarding, grown
from cosim.radio.phy import CURVES, MAC_OVERHEAD_BYTES, ReceiverParams, airtime_ns
from cosim.radio.propagation import fading_quantiles

SIFS_NS = 32_000
SLOT_NS = 13_000
EIFS_NS = 120_000
"""Extra idle time after a frame received with errors [ns]: SIFS and an acknowledgement at the lowest rate."""


class PhyOutcome(IntEnum):
    """Outcome of a frame at one receiver, or of a packet at its sender."""

    RECEIVED = dtypes.RECEIVED
    RANGE = dtypes.RANGE
    """Too weak on average."""
    FADING = dtypes.FADING
    """Too weak or too noisy because of fading, though strong enough on average."""
    COLLISION = dtypes.COLLISION
    """Destroyed by the interference of other frames."""
    BUSY = dtypes.BUSY
    """The receiver was receiving another frame."""
    HALF_DUPLEX = dtypes.HALF_DUPLEX
    """The receiver was sending."""
    EXPIRED = dtypes.EXPIRED
    """Never sent: it waited in the sender's queue until it could not be transmitted within its lifetime."""
    QUEUE = dtypes.QUEUE
    """Never sent: the sender's queue was full."""


class Access(IntEnum):
    """ITS-G5 access categories, highest priority first (DCC profiles DP0 to DP3)."""

    VO = 0
    VI = 1
    BE = 2
    BK = 3


@dataclass(frozen=True, kw_only=True, slots=True)
class AccessParams:
    """Medium access of ITS-G5 (EDCA outside the context of a BSS): broadcast, no acknowledgement, no retry."""

    aifsn: tuple[int, int, int, int] = (2, 3, 6, 9)
    """Idle slots before access, for VO, VI, BE, BK."""
    cw: tuple[int, int, int, int] = (3, 7, 15, 15)
    """Largest back-off [slots], for VO, VI, BE, BK."""
    queue_max: Annotated[int, Gt(0), Le(100_000)] = 100
    """Capacity of the queue of one access category of one station [packets]."""
    lifetime_s: Annotated[float, Gt(0), Le(3600)] = 1.0
    """Age at which a packet must have been transmitted [s], unless it has its own; it is dropped if it cannot be."""

    def __post_init__(self) -> None:
        for name, least in (("aifsn", 2), ("cw", 0)):
            value = getattr(self, name)
            is_within = min(value, default=-1) >= least and max(value) <= 65_535
            if len(value) != dtypes.N_ACCESS or not is_within:
                raise ValueError(
                    f"radio.access.{name} = {value} needs four whole numbers (VO, VI, BE, BK) of at least {least}."
                )


@dataclass(frozen=True, slots=True)
class ChannelRules:
    """What is the same in all windows of a run."""

    rng_key: np.uint64
    """Key of the channel's draws. Packets distinguish windows, so that one key serves the whole run."""
    receiver: ReceiverParams
    access: AccessParams


@dataclass(frozen=True, slots=True)
class JammedStations:
    """Noise of jammers at N stations, in addition to the receivers' own noise [mW]."""

    constant_mw: Float[ndarray, "n"]
    """Noise at all times."""
    reactive_mw: Float[ndarray, "n"]
    """Noise during the payload of frames that a reactive jammer detects."""
    detected: Bool[ndarray, "n"]
    """Stations whose frames a reactive jammer detects."""


@dataclass(frozen=True, slots=True)
class Links:
    """N stations, and the M directed links with a mean received power above the cut-off, sorted by sender."""

    key: UInt64[ndarray, "n"]
    ptr: Int[ndarray, "n+1"]
    """Where each sender's links begin."""
    receiver: Int[ndarray, "m"]
    power_mw: Float[ndarray, "m"]
    """Mean over fading, shadowing included."""
    fading: UInt8[ndarray, "m"]
    """Class of the fading's distribution: see `propagation.fading_quantiles`."""
    jamming: JammedStations | None = None
    """None if no station jams."""

    def __post_init__(self) -> None:
        n, m = len(self.key), len(self.receiver)
        assert len(self.ptr) == n + 1
        assert self.ptr[0] == 0 and self.ptr[-1] == m
        assert (np.diff(self.ptr) >= 0).all(), "ptr rises"
        assert len(self.power_mw) == len(self.fading) == m
        lowest, highest = self.receiver.min(initial=0), self.receiver.max(initial=-1)
        assert lowest >= 0 and highest < n, "receivers are stations"
        assert self.fading.max(initial=0) < len(fading_quantiles()), "classes of fading are known"
        for name, dtype in (("receiver", np.int32), ("power_mw", np.float32), ("fading", np.uint8)):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype))


@dataclass(frozen=True, slots=True)
class Packets:
    """P frames to be sent. Each pair of sender and sequence number is used once in a run."""

    sender: Int[ndarray, "p"]
    """Row of the station."""
    seq: UInt64[ndarray, "p"]
    """Below 2^40."""
    generated_ns: Int[ndarray, "p"]
    payload_bytes: Int[ndarray, "p"]
    access: UInt8[ndarray, "p"]
    lifetime_ns: Int[ndarray, "p"]
    tag: Int[ndarray, "p"]
    """The caller's number of the packet. It is returned with the result."""

    def __len__(self) -> int:
        return len(self.sender)


@dataclass(frozen=True, slots=True)
class WindowResult:
    """P packets sent or dropped in one window, and their receptions.

    Packets are sorted by generation, key and sequence number. Frames forwarded in this window come last, by generation.
    A packet that was not sent (EXPIRED, QUEUE) has no receptions, and it starts and ends at its generation.
    """

    sender_key: UInt64[ndarray, "p"]
    seq: UInt64[ndarray, "p"]
    tag: Int[ndarray, "p"]
    outcome: UInt8[ndarray, "p"]
    """RECEIVED if the packet was sent, otherwise EXPIRED or QUEUE."""
    generated_ns: Int[ndarray, "p"]
    start_ns: Int[ndarray, "p"]
    end_ns: Int[ndarray, "p"]
    """End of transmission: the time of all its receptions."""
    ptr: Int[ndarray, "p+1"]
    """Where each packet's receptions begin."""
    receiver: Int[ndarray, "m"]
    """Row of the station among the window's links."""
    reception: UInt8[ndarray, "m"]
    """A `PhyOutcome` for each receiver."""
    busy: Float[ndarray, "n"]
    """Share of the window in which each station sensed the medium busy or sent."""
    busy_strong: Float[ndarray, "n"]
    """Share of the window in which a frame of at least `cca_dbm` arrived: the busy ratio of DCC."""


@lru_cache
def _constants(receiver: ReceiverParams, access: AccessParams) -> dtypes.Constants:
    def mw(dbm: float) -> float:
        return float(10 ** (dbm / 10))

    x0, w = CURVES[receiver.error_model][receiver.rate_mbps]
    a, b = x0 / w, 10 / (w * np.log(10))
    return dtypes.Constants(
        noise_mw=mw(receiver.noise_dbm),
        sinr_min=mw(receiver.sinr_min_db),
        detectable_mw=mw(receiver.detectable_dbm),
        cca_mw=mw(receiver.cca_dbm),
        floor_mw=mw(receiver.floor_dbm),
        curve_a=a,
        curve_b=float(b),
        sinr_clean=float(np.exp((a + 15) / b)),
        capture_ratio=mw(receiver.capture_margin_db),
        capture_ns=round(receiver.capture_window_s * 1e9) if receiver.capture else -1,
        slot_ns=SLOT_NS,
        eifs_ns=EIFS_NS,
        queue_max=access.queue_max,
        overhead_bytes=MAC_OVERHEAD_BYTES,
    )


def _records(packets: Packets, n: int, state: ChannelState, until_ns: int, receiver: ReceiverParams) -> ndarray:
    """The packets as records of the event loop. Raises ValueError where a frame outlasts its packet's lifetime."""
    new = np.zeros(len(packets), dtypes.PACKET)
    if len(packets) == 0:
        return new
    assert packets.sender.min() >= 0 and packets.sender.max() < n, "senders are stations"
    assert packets.access.max() < dtypes.N_ACCESS, "classes of access are known"
    air_ns = airtime_ns(packets.payload_bytes, receiver.rate_mbps)
    short = np.flatnonzero(packets.lifetime_ns < air_ns)
    if len(short):
        p = short[0]
        raise ValueError(
            f"lifetime = {packets.lifetime_ns[p] * 1e-6:g} ms of a packet is shorter than its transmission "
            f"({air_ns[p] * 1e-6:g} ms). Set radio.access.lifetime_s higher."
        )
    is_in_window = (packets.generated_ns >= state.now_ns) & (packets.generated_ns < until_ns)
    assert is_in_window.all(), "each packet comes in the window in which it is generated"
    of_sender = packets.sender.astype(np.uint64) << np.uint64(40)
    names = np.sort(of_sender | packets.seq)
    assert (names[1:] != names[:-1]).all(), "each sender counts its packets up"
    for name in ("sender", "seq", "generated_ns", "payload_bytes", "access", "tag"):
        new[name] = getattr(packets, name)
    new["airtime_ns"] = air_ns
    new["expires_ns"] = packets.generated_ns + packets.lifetime_ns
    new["next"] = dtypes.NONE
    new["outcome"] = dtypes.WAITING
    return new


def run_window(
    state: ChannelState,
    links: Links,
    packets: Packets,
    until_ns: int,
    rules: ChannelRules,
    gap_ns: Int[ndarray, "n"] | None = None,
    forwarding: Forwarding | None = None,
) -> tuple[ChannelState, WindowResult]:
    """Process all events on the channel from `state.now_ns` until `until_ns`.

    Parameters
    ----------
    state
        The channel at the beginning of the window. It is not changed.
    links
        Links between the N stations of this window. Frames already on the air keep the links of their start.
    packets
        The packets generated within the window.
    until_ns
        End of the window [ns].
    rules
        Receivers, medium access and the key of the draws.
    gap_ns
        Least time between two frames of each station [ns], from congestion control (see `dcc`). None: no limit.
    forwarding
        Forwarding among these stations. It continues from window to window, and `run_window` writes into it.
        The results of forwarded frames come last.

    Returns
    -------
    The channel at `until_ns`, and the packets sent or dropped in the window with their receptions.

    Raises
    ------
    ValueError
        If the transmission of a packet takes longer than its lifetime.

    Notes
    -----
    A frame arrives at all receivers at the same instant.   Deviations from the standard: no propagation delay
    (3.3 µs/km); the signal field is never lost alone; if two queues of one station collide, both draw again from the
    same contention window. A station that requests an idle medium waits a whole AIFS, as in ns-3, also if it was idle
    before, and draws no back-off if the medium becomes busy meanwhile.
    """
    n = len(links.key)
    assert until_ns > state.now_ns
    new = _records(packets, n, state, until_ns, rules.receiver)
    new["key"] = links.key[new["sender"]]
    new = new[np.lexsort((new["seq"], new["key"], new["generated_ns"]))]
    state = remap_stations(state, links.key)
    state.phy["busy_ns"] = state.phy["strong_ns"] = 0
    state.mac["gap_ns"][:n] = 0 if gap_ns is None else gap_ns

    air = _air_of(state, links, rules)
    log = _run_events(air, _log_of(state, links, new), len(state.packets), until_ns, forwarding)
    on_air = np.zeros(len(log.packets), bool)
    on_air[air.phys["packet"][air.phys["packet"] != dtypes.NONE]] = True
    over = ~on_air & (log.packets["outcome"] != dtypes.WAITING)
    result = _result(log, over, air.phys[:n], until_ns - state.now_ns)
    return next_state(air, log, ~over, on_air, until_ns), result


def _log_of(state: ChannelState, links: Links, new: ndarray) -> Log:
    """The packets of earlier windows and the new ones, with room for the outcomes at their receivers."""
    table = np.concatenate([state.packets, new])
    waiting = table["outcome"] == dtypes.WAITING
    on_the_air = np.flatnonzero(table["outcome"] == dtypes.RECEIVED)
    sender = table["sender"][waiting]
    degree, old_edge = table["degree"][on_the_air], table["edge"][on_the_air]
    table["edge"][waiting] = links.ptr[sender]
    table["edge"][on_the_air] += len(links.receiver)
    table["degree"] = 0
    table["degree"][waiting] = np.diff(links.ptr)[sender]
    table["degree"][on_the_air] = degree
    begins = offsets(table["degree"])
    table["slot"] = begins[:-1]
    outcome = np.empty(begins[-1], np.uint8)
    receiver = np.empty(begins[-1], np.int32)
    if len(on_the_air):
        to, was = ranges(begins[on_the_air], degree), ranges(old_edge, degree)
        outcome[to] = state.reception[was]
        receiver[to] = state.receiver[was]
    return Log(table, outcome, receiver)


def _air_of(state: ChannelState, links: Links, rules: ChannelRules) -> Air:
    """The stations, links and rules of a window; links of frames already on the air come last."""
    phy, mac = state.phy, state.mac
    arrival_mw = np.empty(len(links.receiver) + len(state.arrival_mw), np.float32)
    arrival_mw[len(links.receiver) :] = state.arrival_mw
    row_of_rank = np.empty(len(phy), np.int64)
    row_of_rank[mac["rank"]] = np.arange(len(phy))
    jam_mw, react_mw, is_jammed = _noise_of(links.jamming, len(phy))
    return Air(
        phys=phy,
        macs=mac,
        row_of_rank=row_of_rank,
        ptr=links.ptr,
        receiver=np.concatenate([links.receiver, state.receiver]),
        mean_mw=links.power_mw,
        fading=links.fading,
        arrival_mw=arrival_mw,
        quantiles=fading_quantiles(),
        jam_mw=jam_mw,
        react_mw=react_mw,
        is_jammed=is_jammed,
        aifs_ns=SIFS_NS + SLOT_NS * np.array(rules.access.aifsn),
        cw=np.array(rules.access.cw),
        c=_constants(rules.receiver, rules.access),
        rng_key=np.uint64(rules.rng_key),
    )


def _run_events(air: Air, log: Log, n_old: int, until_ns: int, forwarding: Forwarding | None) -> Log:
    """Process all events before `until_ns`; the first `n_old` packets were generated in earlier windows.

    Changes the arrays of `air` and `log`. Returns the log with the frames that stations forwarded.
    """
    n_given = len(log.packets)
    max_degree = int(np.diff(air.ptr).max(initial=0))
    at = np.array([-1, n_old, n_given, len(log.receiver)])
    forwards = NO_FORWARDING if forwarding is None else forwarding.state
    room = 16 * len(air.phys) + 16 + len(forwards.copies)
    heap = Heap(*np.empty((2, room), np.int64))
    while not run_until(until_ns, air, log, heap, at, n_given, max_degree, forwards):
        assert forwarding is not None  # only forwarding needs more room
        forwarding.grow(max_degree)
        more = len(forwarding.state.copies) - len(forwards.copies)
        heap = Heap(grown(heap.times, more), grown(heap.codes, more))
        forwards = forwarding.state
        if at[PACKETS] == len(log.packets):
            log = log._replace(packets=grown(log.packets, max(len(log.packets), 64)))
        if at[SLOTS] + max_degree > len(log.receiver):
            more = max(len(log.receiver), 64 * max_degree)
            log = log._replace(outcome=grown(log.outcome, more), receiver=grown(log.receiver, more))
    packets = log.packets[: at[PACKETS]]
    used = slice(at[SLOTS])
    return Log(packets, log.outcome[used], log.receiver[used])


def _noise_of(jamming: JammedStations | None, n: int) -> tuple[ndarray, ndarray, ndarray]:
    """Columns of `JammedStations` for n rows. The last rows may be stations that left. Empty where nothing jams."""
    if jamming is None:
        return np.zeros(0), np.zeros(0), np.zeros(0, bool)
    more = n - len(jamming.detected)
    return (
        np.pad(jamming.constant_mw, (0, more)),
        np.pad(jamming.reactive_mw, (0, more)),
        np.pad(jamming.detected, (0, more)),
    )


def _result(log: Log, done: ndarray, phy: ndarray, span_ns: int) -> WindowResult:
    """The packets that are done, and how long each station of `phy` sensed the medium busy in `span_ns`."""
    receiver_row, reception = log.receiver, log.outcome
    rows = log.packets[done]
    sent = rows["outcome"] == dtypes.RECEIVED
    count = np.where(sent, rows["degree"], 0)
    if count.sum() < len(receiver_row):
        at = ranges(rows["slot"], count)
        receiver_row, reception = receiver_row[at], reception[at]
    if np.any(receiver_row == dtypes.NONE):
        there = receiver_row != dtypes.NONE
        packet = owner_of_rows(count)
        count = np.bincount(packet[there], minlength=len(rows))
        receiver_row, reception = receiver_row[there], reception[there]
    start = np.where(sent, rows["start_ns"], rows["generated_ns"])
    return WindowResult(
        sender_key=rows["key"],
        seq=rows["seq"],
        tag=rows["tag"],
        outcome=rows["outcome"],
        generated_ns=rows["generated_ns"],
        start_ns=start,
        end_ns=start + np.where(sent, rows["airtime_ns"], 0),
        ptr=offsets(count),
        receiver=receiver_row,
        reception=reception,
        busy=phy["busy_ns"] / span_ns,
        busy_strong=phy["strong_ns"] / span_ns,
    )
