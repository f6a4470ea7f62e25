"""Contention-based forwarding inside the event loop.

A unit is the content of one frame: a message or a segment of it. A copy is a unit at a station other than its source.
A station that receives a unit for the first time starts a timer, unless it refuses the message. If it receives a
second copy before the timer expires, it cancels the timer. Otherwise it puts the unit into its own queue as a new
frame. Computing time and memory grow with the number of frames and copies. They do not depend on the length of windows.

References
----------
.. [1] ETSI EN 302 636-4-1, "GeoNetworking", annex F: contention-based forwarding.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt64
from numpy import ndarray

from cosim.base.hash_rng import mix, unit
from cosim.base.kernel import inlined, kernel
from cosim.radio.dtypes import NEVER, NONE, WAITING
from cosim.radio.event_heap import push

TIMER = 4
"""Kind of event: a contention timer expires. It comes after all other events of the same time."""

UNIT = np.dtype(
    [
        ("seq", "u8"),
        ("airtime_ns", "i8"),
        ("key", "u8"),
        ("message", "i4"),
        ("source", "i4"),
        ("number", "i4"),
        ("payload_bytes", "i4"),
        ("generated_ns", "i8"),
        ("end_ns", "i8"),
    ]
)
"""A segment of a message. What cannot be transmitted by `end_ns` is neither sent nor forwarded."""
FRAME = np.dtype([("unit", "i4"), ("transmitter", "i4"), ("hop", "i4")])
COPY = np.dtype([("due_ns", "i8"), ("unit", "i4"), ("station", "i4"), ("hop", "i4"), ("waits", "u1")])
_FRAMES, _COPIES = range(2)
N_COPIES = 8
"""Copies of each unit for which there is room at the beginning of a round."""


class ForwardingRules(NamedTuple):
    """Everything that decides which station forwards which unit, and when."""

    max_hops: int  # at 1 nothing is forwarded
    contends: bool  # else each station forwards with a probability
    forward_p: float
    range_m: float  # a frame from farther away is not received
    forward_range_m: float  # largest distance from its source at which a unit is forwarded
    timer_min_s: float
    timer_max_s: float
    timer_distance_m: float
    lifetime_ns: int
    access: int
    rng_key: np.uint64


class ForwardingState(NamedTuple):
    """The event loop's view of forwarding."""

    rules: ForwardingRules
    xy_m: ndarray
    key: ndarray
    units: ndarray
    frames: ndarray
    copies: ndarray
    slot: ndarray  # open addressing: rows of `copies` by (unit, station), at most half full
    used: ndarray  # frames and copies so far
    refused: ndarray  # `Messages.refused`


@dataclass(slots=True)
class Forwarding:
    """Forwarding in one round. The event loop writes into its state; `grow` makes room for more."""

    state: ForwardingState

    @staticmethod
    def of(
        rules: ForwardingRules,
        units: ndarray,
        key: UInt64[ndarray, "n"],
        xy_m: Float[ndarray, "n 2"],
        refused: Int[ndarray, "p"] | None = None,
        frames: ndarray | None = None,
        copies: ndarray | None = None,
    ) -> "Forwarding":
        """The beginning of a round: frame u is the frame in which the source sends unit u.

        Parameters
        ----------
        units
            Records of `UNIT`.
        key, xy_m
            Keys and horizontal positions of all stations.
        refused
            As `Messages.refused`.
        frames, copies
            Records of `FRAME` and `COPY` of messages that have been underway since an earlier round. The frames of
            the sources come first. None: nothing has been forwarded yet.
        """
        frames = own_frames(units) if frames is None else frames
        earlier = np.zeros(0, COPY) if copies is None else copies
        n = len(units)
        copies = grown(earlier, N_COPIES * n + 1)
        slot = _empty_slots(len(copies))
        if len(earlier):  # without any, the module is imported without compiled code, which takes 0.1 s to load
            _fill_slots(copies, len(earlier), slot)
        state = ForwardingState(
            rules=rules,
            xy_m=np.ascontiguousarray(xy_m),
            key=np.ascontiguousarray(key),
            units=units,
            frames=grown(frames, n + 1),
            copies=copies,
            slot=slot,
            used=np.array([len(frames), len(earlier)]),
            refused=np.zeros(0, np.int64) if refused is None else refused,
        )
        return Forwarding(state)

    def grow(self, n_receivers: int) -> None:
        """Make room for more frames, and for copies at `n_receivers` more receivers."""
        p = self.state
        if p.used[_FRAMES] == len(p.frames):
            self.state = p = p._replace(frames=grown(p.frames, len(p.frames)))
        if p.used[_COPIES] + n_receivers > len(p.copies):
            copies = grown(p.copies, max(len(p.copies), n_receivers))
            slot = _empty_slots(len(copies))
            _fill_slots(copies, p.used[_COPIES], slot)
            self.state = p._replace(copies=copies, slot=slot)

    @property
    def frames(self) -> ndarray:
        """All frames so far: those of sources and forwarded ones."""
        return self.state.frames[: self.state.used[_FRAMES]]

    @property
    def copies(self) -> ndarray:
        """All copies so far."""
        return self.state.copies[: self.state.used[_COPIES]]

    @property
    def next_ns(self) -> int:
        """When the next timer expires; `NEVER` if none runs."""
        return int(self.copies["due_ns"][self.copies["waits"] > 0].min(initial=NEVER))


def own_frames(units: ndarray) -> ndarray:
    """Records of `FRAME` of the sources: one frame per record of `UNIT`, in the same order."""
    frames = np.empty(len(units), FRAME)
    frames["unit"] = np.arange(len(units))
    frames["transmitter"] = units["source"]
    frames["hop"] = 1
    return frames


def grown(rows: ndarray, more: int) -> ndarray:
    """A copy of the rows, followed by `more` rows of zeros."""
    return np.concatenate([rows, np.zeros(more, rows.dtype)])


def _empty_slots(n_copies: int) -> ndarray:
    return np.full(1 << (2 * n_copies - 1).bit_length(), NONE, np.int32)


@kernel
def _find(slot, copies, number, station):
    """Where the row of a copy is, or would be inserted."""
    mask = len(slot) - 1
    hashed = mix(np.uint64(number), np.uint64(station))
    at = np.int64(hashed >> np.uint64(32)) & mask
    while slot[at] != NONE:
        copy = copies[slot[at]]
        if copy.unit == number and copy.station == station:
            break
        at = (at + 1) & mask
    return at


@kernel
def _fill_slots(copies, n, slot):
    for row in range(n):
        slot[_find(slot, copies, copies[row].unit, copies[row].station)] = row


@kernel
def is_full(p, n_receivers):
    """Whether one more event might need more room: for a frame, or for a copy at each receiver of a frame."""
    lacks_copies = p.used[_COPIES] + n_receivers > len(p.copies)
    return p.used[_FRAMES] == len(p.frames) or lacks_copies


@kernel
def schedule_timers(p, times, codes, n):
    """Put all running timers into the heap."""
    for row in range(p.used[_COPIES]):
        copy = p.copies[row]
        if copy.waits:
            n = push(times, codes, n, copy.due_ns, (TIMER << 32) | row)
    return n


@kernel
def _is_refused(refused, code):
    low, high = 0, len(refused)
    while low < high:
        middle = (low + high) >> 1
        if refused[middle] < code:
            low = middle + 1
        else:
            high = middle
    return low < len(refused) and refused[low] == code


@inlined
def _square_m2(xy_m, i, j):
    """Squared distance of two stations."""
    dx = xy_m[j, 0] - xy_m[i, 0]
    dy = xy_m[j, 1] - xy_m[i, 1]
    return dx * dx + dy * dy


@kernel
def on_receive(p, frame, to, t, times, codes, n):
    """A station receives a frame: a first copy may start a timer, a second copy cancels it."""
    rules, u = p.rules, p.units[frame.unit]
    square = _square_m2(p.xy_m, frame.transmitter, to)
    if to == u.source or square > rules.range_m * rules.range_m:
        return n
    at = _find(p.slot, p.copies, frame.unit, to)
    if p.slot[at] != NONE:
        if rules.contends:
            p.copies[p.slot[at]].waits = 0
        return n
    row = p.used[_COPIES]
    p.used[_COPIES] += 1
    p.slot[at] = row
    copy = p.copies[row]
    copy.unit, copy.station = frame.unit, to
    copy.hop, copy.waits = frame.hop, 0
    is_far = _square_m2(p.xy_m, u.source, to) > rules.forward_range_m * rules.forward_range_m
    if frame.hop >= rules.max_hops or is_far:
        return n
    if _is_refused(p.refused, np.int64(u.message) << 32 | to):
        return n
    share = min(np.sqrt(square) / rules.timer_distance_m, 1.0)
    if not rules.contends:
        of_unit = mix(mix(rules.rng_key, u.key), np.uint64(u.number))
        h = mix(of_unit, p.key[to])
        if unit(mix(h, np.uint64(0))) >= rules.forward_p:
            return n
        share = unit(mix(h, np.uint64(1)))
    shorter_s = (rules.timer_min_s - rules.timer_max_s) * share
    copy.due_ns = t + round((rules.timer_max_s + shorter_s) * 1e9)
    if copy.due_ns + u.airtime_ns <= u.end_ns:
        copy.waits = 1
        n = push(times, codes, n, copy.due_ns, (TIMER << 32) | row)
    return n


@kernel
def enqueue_forward(p, row, packet, key, ptr, slot, t):
    """A timer expires: the copy becomes a frame for its station's queue."""
    copy, number = p.copies[row], p.used[_FRAMES]
    u, j = p.units[copy.unit], copy.station
    p.used[_FRAMES] += 1
    frame = p.frames[number]
    frame.unit, frame.transmitter = copy.unit, j
    frame.hop = copy.hop + 1
    copy.waits = 0
    packet.key, packet.sender, packet.tag = key, j, number
    packet.seq, packet.airtime_ns = u.seq, u.airtime_ns
    packet.payload_bytes = u.payload_bytes
    packet.generated_ns = t
    packet.expires_ns = t + min(p.rules.lifetime_ns, u.end_ns - t)
    packet.edge, packet.slot = ptr[j], slot
    packet.degree = ptr[j + 1] - ptr[j]
    packet.access = p.rules.access
    packet.next, packet.outcome = NONE, WAITING


_NEVER = ForwardingRules(1, False, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0, 0, np.uint64(0))
_NO_UNITS = np.zeros(0, UNIT)
NO_FORWARDING = Forwarding.of(_NEVER, _NO_UNITS, np.zeros(0, np.uint64), np.zeros((0, 2))).state
"""A round in which nothing is forwarded."""
