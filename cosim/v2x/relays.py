"""Passing messages on, inside the event loop: who has what, whose timer runs, whom a copy silences.

A unit is what travels in one frame: a message or a segment of it. A copy is a unit at a radio other than its author.
Who gets a unit for the first time starts a timer; a second copy heard before it is over stops it; else the unit
joins the radio's queue as a frame of its own. Time and memory follow frames and copies, whatever the windows.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt64
from numpy import ndarray

from cosim.rng import mix, unit
from cosim.v2x.kernel import kernel, push
from cosim.v2x.records import NOBODY, WAITING

RELAY = 4
"""Kind of event: a timer is over. Comes after all others of its instant."""

UNIT = np.dtype([("seq", "u8"), ("airtime_ns", "i8"), ("author", "i4"), ("number", "i4"), ("payload_bytes", "i4")])
FRAME = np.dtype([("unit", "i4"), ("carrier", "i4"), ("hop", "i4")])
COPY = np.dtype([("due_ns", "i8"), ("unit", "i4"), ("radio", "i4"), ("hop", "i4"), ("waits", "u1")])
_FRAMES, _COPIES = range(2)
N_COPIES = 8
"""Copies of each unit that there is room for to begin with."""


class Rules(NamedTuple):
    """Who passes on what, and when: `RelayParams` and what else decides it."""

    max_hops: int  # at 1 nothing is passed on
    contends: bool  # else each passes on by chance
    forward_p: float
    hear_m: float  # a frame from farther away is nobody's message
    pass_m: float  # farthest from the author that anybody passes a unit on
    timer_min_s: float
    timer_max_s: float
    timer_distance_m: float
    end_ns: int  # of the round: what cannot be over by then is not passed on
    lifetime_ns: int
    access: int
    first_tag: int  # of frame 0; smaller ones belong to an earlier round
    chance: np.uint64


class Passing(NamedTuple):
    """What the event loop knows of relays."""

    rules: Rules
    xy_m: ndarray
    name: ndarray
    units: ndarray
    frames: ndarray
    copies: ndarray
    place: ndarray  # open addressing: rows of `copies` by (unit, radio), at most half full
    used: ndarray  # frames and copies so far


@dataclass(slots=True)
class Relays:
    """The relays of one round; the event loop writes into them, and they grow when it asks."""

    passing: Passing

    @staticmethod
    def of(rules: Rules, units: ndarray, name: UInt64[ndarray, "n"], xy_m: Float[ndarray, "n 2"]) -> "Relays":
        """By these rules; frame u is the author's own of unit u."""
        n = len(units)
        copies = np.zeros(N_COPIES * n + 1, COPY)
        return Relays(Passing(
            rules, np.ascontiguousarray(xy_m), np.ascontiguousarray(name), units, grown(own_frames(units), n + 1),
            copies, _places(len(copies)), np.array([n, 0]),
        ))  # fmt: skip

    def grow(self, n_hearers: int) -> None:
        """Make room for more frames, and for copies at so many hearers."""
        p = self.passing
        if p.used[_FRAMES] == len(p.frames):
            self.passing = p = p._replace(frames=grown(p.frames, len(p.frames)))
        if p.used[_COPIES] + n_hearers > len(p.copies):
            copies = grown(p.copies, max(len(p.copies), n_hearers))
            place = _places(len(copies))
            _file(copies, p.used[_COPIES], place)
            self.passing = p._replace(copies=copies, place=place)

    @property
    def frames(self) -> ndarray:
        """All frames so far: own and relayed."""
        return self.passing.frames[: self.passing.used[_FRAMES]]

    @property
    def next_ns(self) -> int:
        """When the next timer is over; the end of the round if none runs."""
        copies = self.passing.copies[: self.passing.used[_COPIES]]
        return int(copies["due_ns"][copies["waits"] > 0].min(initial=self.passing.rules.end_ns))


def own_frames(units: ndarray) -> ndarray:
    """The frames of the authors, in the order of the units."""
    frames = np.empty(len(units), FRAME)
    frames["unit"], frames["carrier"], frames["hop"] = np.arange(len(units)), units["author"], 1
    return frames


def grown(rows: ndarray, more: int) -> ndarray:
    """The same rows, and so many more."""
    return np.concatenate([rows, np.zeros(more, rows.dtype)])


def _places(n_copies: int) -> ndarray:
    return np.full(1 << (2 * n_copies - 1).bit_length(), NOBODY, np.int32)


@kernel
def _find(place, copies, number, radio):
    """Where the row of a copy stands, or would stand."""
    mask = len(place) - 1
    at = np.int64(mix(np.uint64(number), np.uint64(radio)) >> np.uint64(32)) & mask
    while place[at] != NOBODY and (copies[place[at]].unit != number or copies[place[at]].radio != radio):
        at = (at + 1) & mask
    return at


@kernel
def _file(copies, n, place):
    for row in range(n):
        place[_find(place, copies, copies[row].unit, copies[row].radio)] = row


@kernel
def is_full(p, n_hearers):
    """Whether one more event could want more room than there is: a frame, or a copy at everybody who hears one."""
    return p.used[_FRAMES] == len(p.frames) or p.used[_COPIES] + n_hearers > len(p.copies)


@kernel
def wait(p, times, codes, n):
    """Put all timers that run into the heap."""
    for row in range(p.used[_COPIES]):
        if p.copies[row].waits:
            n = push(times, codes, n, p.copies[row].due_ns, (RELAY << 32) | row)
    return n


@kernel
def hear(p, frame, to, t, times, codes, n):
    """A frame is received: a first copy may start a timer, a second one stops it."""
    rules, u = p.rules, p.units[frame.unit]
    dx, dy = p.xy_m[to, 0] - p.xy_m[frame.carrier, 0], p.xy_m[to, 1] - p.xy_m[frame.carrier, 1]
    square = dx * dx + dy * dy
    if to == u.author or square > rules.hear_m * rules.hear_m:
        return n
    at = _find(p.place, p.copies, frame.unit, to)
    if p.place[at] != NOBODY:
        if rules.contends:
            p.copies[p.place[at]].waits = 0
        return n
    row = p.used[_COPIES]
    p.used[_COPIES] += 1
    p.place[at] = row
    copy = p.copies[row]
    copy.unit, copy.radio, copy.hop, copy.waits = frame.unit, to, frame.hop, 0
    away_x, away_y = p.xy_m[to, 0] - p.xy_m[u.author, 0], p.xy_m[to, 1] - p.xy_m[u.author, 1]
    if frame.hop >= rules.max_hops or away_x * away_x + away_y * away_y > rules.pass_m * rules.pass_m:
        return n
    share = min(np.sqrt(square) / rules.timer_distance_m, 1.0)
    if not rules.contends:
        h = mix(mix(mix(rules.chance, p.name[u.author]), np.uint64(u.number)), p.name[to])
        if unit(mix(h, np.uint64(0))) >= rules.forward_p:
            return n
        share = unit(mix(h, np.uint64(1)))
    copy.due_ns = t + round((rules.timer_max_s + (rules.timer_min_s - rules.timer_max_s) * share) * 1e9)
    if copy.due_ns + u.airtime_ns <= rules.end_ns:
        copy.waits = 1
        n = push(times, codes, n, copy.due_ns, (RELAY << 32) | row)
    return n


@kernel
def speak(p, row, packet, key, ptr, slot, t):
    """A timer is over: the copy becomes a frame for its radio's queue."""
    rules, copy, number = p.rules, p.copies[row], p.used[_FRAMES]
    u, j = p.units[copy.unit], copy.radio
    p.used[_FRAMES] += 1
    frame = p.frames[number]
    frame.unit, frame.carrier, frame.hop = copy.unit, j, copy.hop + 1
    copy.waits = 0
    packet.key, packet.sender, packet.tag = key, j, rules.first_tag + number
    packet.seq, packet.airtime_ns, packet.payload_bytes = u.seq, u.airtime_ns, u.payload_bytes
    packet.generated_ns, packet.expires_ns = t, t + min(rules.lifetime_ns, rules.end_ns - t)
    packet.edge, packet.degree, packet.slot = ptr[j], ptr[j + 1] - ptr[j], slot
    packet.access, packet.next, packet.fate = rules.access, NOBODY, WAITING


_NEVER = Rules(1, False, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0, 0, 0, 0, np.uint64(0))
NO_RELAYS = Relays.of(_NEVER, np.zeros(0, UNIT), np.zeros(0, np.uint64), np.zeros((0, 2))).passing
"""A round in which nothing is passed on."""
