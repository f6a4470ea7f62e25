"""One radio channel shared by everybody: CSMA/CA broadcast, packet by packet, window after window.

    state, outcome = play(state, links, packets, until_ns, chance, receiver, access)

What one window leaves behind (queues, back-offs, frames on the air) is in `State`; cutting a window in two
changes nothing. A packet is (sender's key, sequence number) and every draw depends on that, the receiver's key
and the seed alone: neither rows, nor order, nor vehicles out of range matter.
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Annotated

import numpy as np
from annotated_types import Gt
from jaxtyping import Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.v2x import records
from cosim.v2x.carry import State, carried, renamed, spans, starts
from cosim.v2x.loop import PACKETS, SLOTS, run_until
from cosim.v2x.propagation import fading_quantiles
from cosim.v2x.reception import CURVES, MAC_OVERHEAD_BYTES, ReceiverParams, airtime_ns
from cosim.v2x.relays import NO_RELAYS, Relays, grown

SIFS_NS = 32_000
SLOT_NS = 13_000
_SEQ_MASK = np.uint64((1 << 40) - 1)
EIFS_NS = 120_000
"""Extra silence after a frame received with errors [ns]: SIFS and an acknowledgement at the lowest rate."""


class Fate(IntEnum):
    """What became of a frame at one receiver."""

    RECEIVED = records.RECEIVED
    RANGE = records.RANGE
    """Too weak on average."""
    FADING = records.FADING
    """Too weak or noisy this time, though strong enough on average."""
    COLLISION = records.COLLISION
    """Destroyed by other frames."""
    BUSY = records.BUSY
    """The receiver was at another frame."""
    HALF_DUPLEX = records.HALF_DUPLEX
    """The receiver was sending."""
    EXPIRED = records.EXPIRED
    """Never sent: out of date in the sender's queue."""
    QUEUE = records.QUEUE
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
    """Slots of silence before access, for VO, VI, BE, BK."""
    cw: tuple[int, int, int, int] = (3, 7, 15, 15)
    """Largest back-off [slots], for VO, VI, BE, BK."""
    queue_max: Annotated[int, Gt(0)] = 100
    """Packets that one access category of one radio can hold."""
    lifetime_s: Annotated[float, Gt(0)] = 1.0
    """Age at which a packet that still waits is dropped [s], unless it says otherwise."""

    def __post_init__(self) -> None:
        for name in ("aifsn", "cw"):
            value = getattr(self, name)
            if len(value) != records.N_ACCESS or min(value) < (2 if name == "aifsn" else 0):
                raise ValueError(
                    f"radio.access.{name} = {value} needs four whole numbers (VO, VI, BE, BK) of at least "
                    f"{2 if name == 'aifsn' else 0}."
                )


@dataclass(frozen=True, slots=True)
class Links:
    """N radios and the mean received power of every directed link worth counting, sorted by (sender, receiver)."""

    key: UInt64[ndarray, "n"]
    ptr: Int[ndarray, "n+1"]
    """Where each sender's links begin."""
    receiver: Int[ndarray, "m"]
    power_mw: Float[ndarray, "m"]
    """Mean over fading, shadowing included."""
    fading: UInt8[ndarray, "m"]
    """Class of the fading's distribution: see `propagation.fading_quantiles`."""


@dataclass(frozen=True, slots=True)
class Packets:
    """P frames to be sent; each (sender, seq) once in a run."""

    sender: Int[ndarray, "p"]
    """Row of the radio."""
    seq: UInt64[ndarray, "p"]
    """Below 2^40."""
    generated_ns: Int[ndarray, "p"]
    payload_bytes: Int[ndarray, "p"]
    access: UInt8[ndarray, "p"]
    lifetime_ns: Int[ndarray, "p"]
    tag: Int[ndarray, "p"]
    """The caller's own name for the packet; comes back with its outcome."""

    def __len__(self) -> int:
        return len(self.sender)


@dataclass(frozen=True, slots=True)
class Outcome:
    """P packets that left the sender's hands in one window, and their receptions.

    Sorted by (generation, key, seq); those that relays have made in this window come behind, by generation.
    A packet that has not been sent (EXPIRED, QUEUE) has no receptions and start = end = generation.
    """

    sender_key: UInt64[ndarray, "p"]
    seq: UInt64[ndarray, "p"]
    tag: Int[ndarray, "p"]
    fate: UInt8[ndarray, "p"]
    """RECEIVED where it was sent, else EXPIRED or QUEUE."""
    generated_ns: Int[ndarray, "p"]
    start_ns: Int[ndarray, "p"]
    end_ns: Int[ndarray, "p"]
    """When it was received by whoever received it."""
    ptr: Int[ndarray, "p+1"]
    """Where each packet's receptions begin."""
    receiver: Int[ndarray, "m"]
    """Row of the radio among the window's links."""
    reception: UInt8[ndarray, "m"]
    """A `Fate` for each receiver."""
    busy: Float[ndarray, "n"]
    """Share of the window in which each radio sensed the medium busy or sent."""
    busy_strong: Float[ndarray, "n"]
    """Share of the window in which a frame of at least `cca_dbm` arrived: the busy ratio of DCC."""

    @property
    def latency_s(self) -> Float[ndarray, "p"]:
        """Medium access latency of each packet [s]."""
        return (self.start_ns - self.generated_ns) * 1e-9


@lru_cache
def _constants(receiver: ReceiverParams, access: AccessParams) -> records.Constants:
    def mw(dbm: float) -> float:
        return float(10 ** (dbm / 10))

    x0, w = CURVES[receiver.error_model][receiver.rate_mbps]
    a, b = x0 / w, 10 / (w * np.log(10))
    return records.Constants(
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


def _check(links: Links) -> None:
    n, m = len(links.key), len(links.receiver)
    if len(links.ptr) != n + 1 or links.ptr[0] != 0 or links.ptr[-1] != m or np.any(np.diff(links.ptr) < 0):
        raise ValueError(f"links.ptr must rise from 0 to the number of links ({m}) in {n + 1} steps.")
    if len(links.power_mw) != m or len(links.fading) != m:
        raise ValueError("links.receiver, power_mw and fading must be of one length.")
    if m and (links.receiver.min() < 0 or links.receiver.max() >= n or links.fading.max() >= len(fading_quantiles())):
        raise ValueError(f"links: a receiver is none of the {n} radios, or a class of fading is unknown.")


def _records(packets: Packets, n: int, state: State, until_ns: int, receiver: ReceiverParams) -> ndarray:
    """The packets as the event loop wants them; refuses what cannot be."""
    new = np.zeros(len(packets), records.PACKET)
    if len(packets) == 0:
        return new
    for name, low, high in (("sender", 0, n - 1), ("access", 0, records.N_ACCESS - 1)):
        column = getattr(packets, name)
        if column.min() < low or column.max() > high:
            raise ValueError(f"packets.{name} = {column.min()} ... {column.max()} must lie in {low} ... {high}.")
    air_ns = airtime_ns(packets.payload_bytes, receiver.rate_mbps)
    short = np.flatnonzero(packets.lifetime_ns < air_ns)
    if len(short):
        p = short[0]
        raise ValueError(
            f"lifetime = {packets.lifetime_ns[p] * 1e-6:g} ms of a packet is shorter than its transmission "
            f"({air_ns[p] * 1e-6:g} ms). Set radio.access.lifetime_s higher."
        )
    if packets.generated_ns.min() < state.now_ns or packets.generated_ns.max() >= until_ns:
        raise ValueError(
            f"packets.generated_ns = {packets.generated_ns.min()} ... {packets.generated_ns.max()} lies outside "
            f"the window {state.now_ns} ... {until_ns}. Hand each packet to the window in which it is generated."
        )
    names = np.sort((packets.sender.astype(np.uint64) << np.uint64(40)) | packets.seq)
    twice = np.flatnonzero(names[1:] == names[:-1])
    if len(twice):
        raise ValueError(
            f"sequence number {names[twice[0]] & _SEQ_MASK} comes twice from one sender. Count packets up per sender."
        )
    for name in ("sender", "seq", "generated_ns", "payload_bytes", "access", "tag"):
        new[name] = getattr(packets, name)
    new["airtime_ns"] = air_ns
    new["expires_ns"] = packets.generated_ns + packets.lifetime_ns
    new["next"] = records.NOBODY
    new["fate"] = records.WAITING
    return new


def play(
    state: State,
    links: Links,
    packets: Packets,
    until_ns: int,
    chance: np.uint64,
    receiver: ReceiverParams,
    access: AccessParams,
    gap_ns: Int[ndarray, "n"] | None = None,
    relays: Relays | None = None,
) -> tuple[State, Outcome]:
    """Everything that happens on the channel from `state.now_ns` until `until_ns`.

    Parameters
    ----------
    links
        Who could disturb whom now; frames already on the air keep the links they left with.
    packets
        Generated within the window.
    chance
        Key of the channel's draws, one for the whole run: packets tell windows apart.
    gap_ns
        Least silence between two frames of each radio, imposed by congestion control (see `dcc`).
    relays
        What is passed on among these radios; goes on from window to window, and their frames' outcomes come last.

    Notes
    -----
    A frame is everywhere at the same instant.   Deviations from the standard: no propagation delay (3.3 µs/km);
    the signal field is never lost alone; two queues of one radio that collide draw anew from the same window.
    """
    n = len(links.key)
    _check(links)
    if until_ns <= state.now_ns:
        raise ValueError(f"until_ns = {until_ns} is not after the state's now_ns = {state.now_ns}.")
    new = _records(packets, n, state, until_ns, receiver)
    new["key"] = links.key[new["sender"]]
    new = new[np.lexsort((new["seq"], new["key"], new["generated_ns"]))]
    state = renamed(state, links.key)
    phy, mac = state.phy, state.mac
    phy["busy_ns"] = phy["strong_ns"] = 0
    mac["gap_ns"][:n] = 0 if gap_ns is None else gap_ns
    table = np.concatenate([state.packets, new])

    waiting, aired = table["fate"] == records.WAITING, table["fate"] == records.RECEIVED
    sender = table["sender"][waiting]
    table["edge"][waiting] = links.ptr[sender]
    table["degree"] = np.where(aired, table["degree"], 0)
    table["degree"][waiting] = links.ptr[sender + 1] - links.ptr[sender]
    old_edge = table["edge"][aired]
    table["edge"][aired] += len(links.receiver)
    begins = starts(table["degree"])
    table["slot"] = begins[:-1]
    reception, hearer = np.empty(begins[-1], np.uint8), np.empty(begins[-1], np.int32)
    to, was = spans(table["slot"][aired], table["degree"][aired]), spans(old_edge, table["degree"][aired])
    reception[to], hearer[to] = state.reception[was], state.receiver[was]
    arrival_mw = np.concatenate([np.empty(len(links.receiver), np.float32), state.arrival_mw])
    edges = (
        np.concatenate([links.receiver.astype(np.int32, copy=False), state.receiver]),
        links.power_mw.astype(np.float32, copy=False),
        links.fading.astype(np.uint8, copy=False),
        arrival_mw,
    )
    row_of_rank = np.empty(len(phy), np.int64)
    row_of_rank[mac["rank"]] = np.arange(len(phy))
    n_given, max_degree = len(table), int(np.diff(links.ptr).max(initial=0))
    at = np.array([-1, len(state.packets), n_given, len(hearer)])
    passing = NO_RELAYS if relays is None else relays.passing
    times, codes = np.empty((2, 16 * len(phy) + 16 + len(passing.copies)), np.int64)
    while not run_until(
        until_ns, phy, mac, row_of_rank, table, at, n_given, links.ptr, max_degree, edges, reception, hearer,
        SIFS_NS + SLOT_NS * np.array(access.aifsn), np.array(access.cw), fading_quantiles(),
        _constants(receiver, access), np.uint64(chance), times, codes, passing,
    ):  # fmt: skip
        assert relays is not None  # nothing else wants more room
        relays.grow(max_degree)
        more = len(relays.passing.copies) - len(passing.copies)
        times, codes = grown(times, more), grown(codes, more)
        passing = relays.passing
        if at[PACKETS] == len(table):
            table = grown(table, max(len(table), 64))
        if at[SLOTS] + max_degree > len(hearer):
            more = max(len(hearer), 64 * max_degree)
            reception, hearer = grown(reception, more), grown(hearer, more)
    table, reception, hearer = table[: at[PACKETS]], reception[: at[SLOTS]], hearer[: at[SLOTS]]

    on_air = np.zeros(len(table), bool)
    on_air[phy["packet"][phy["packet"] != records.NOBODY]] = True
    over = ~on_air & (table["fate"] != records.WAITING)
    outcome = _outcome(table, over, phy, n, hearer, reception, until_ns - state.now_ns)
    return carried(phy, mac, table, ~over, on_air, edges[0], arrival_mw, reception, until_ns), outcome


def _outcome(
    table: ndarray, done: ndarray, phy: ndarray, n: int, hearer: ndarray, reception: ndarray, span_ns: int
) -> Outcome:
    rows = table[done]
    sent = rows["fate"] == records.RECEIVED
    count = np.where(sent, rows["degree"], 0)
    if count.sum() < len(hearer):
        at = spans(rows["slot"], count)
        hearer, reception = hearer[at], reception[at]
    if np.any(hearer == records.NOBODY):
        there = hearer != records.NOBODY
        count = np.bincount(np.repeat(np.arange(len(rows)), count)[there], minlength=len(rows))
        hearer, reception = hearer[there], reception[there]
    start = np.where(sent, rows["start_ns"], rows["generated_ns"])
    return Outcome(
        sender_key=rows["key"],
        seq=rows["seq"],
        tag=rows["tag"],
        fate=rows["fate"],
        generated_ns=rows["generated_ns"],
        start_ns=start,
        end_ns=start + np.where(sent, rows["airtime_ns"], 0),
        ptr=starts(count),
        receiver=hearer,
        reception=reception,
        busy=phy["busy_ns"][:n] / span_ns,
        busy_strong=phy["strong_ns"][:n] / span_ns,
    )
