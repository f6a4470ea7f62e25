"""What a round over the shared channel came to: the fate of every frame at everybody in reach, and who got what.

One pass over the frames and one over what was received, by counting: nothing is searched for or compared.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numba import njit
from numpy import ndarray

from cosim.v2x import channel
from cosim.v2x.channel import Outcome
from cosim.v2x.exchange import Fate, Heard, View, counted
from cosim.v2x.links import Seen

_FATE_OF = np.full(max(channel.Fate) + 1, Fate.PROPAGATION, np.int8)
"""Of what became of a frame at a receiver, and of a frame that was never sent."""
for _theirs, _ours in {
    channel.Fate.RECEIVED: Fate.RECEIVED,
    channel.Fate.COLLISION: Fate.COLLISION,
    channel.Fate.BUSY: Fate.RECEIVER_BUSY,
    channel.Fate.HALF_DUPLEX: Fate.RECEIVER_BUSY,
    channel.Fate.EXPIRED: Fate.EXPIRED,
    channel.Fate.QUEUE: Fate.EXPIRED,
}.items():
    _FATE_OF[_theirs] = _ours
_RECEIVED, _PROPAGATION, _EXPIRED = int(Fate.RECEIVED), int(Fate.PROPAGATION), int(Fate.EXPIRED)


@dataclass(frozen=True, slots=True)
class Near:
    """Radios within reach of each radio, by the one end."""

    ptr: Int[ndarray, "n+1"]
    radio: Int[ndarray, "m"]
    length_m: Float[ndarray, "m"]
    view: UInt8[ndarray, "m"]
    """As `View`."""

    @staticmethod
    def of(xyz_m: Float[ndarray, "n 3"], reach_m: float, seen: Seen, knows_walls: bool) -> "Near":
        """From all pairs up to `slant_m` and more."""
        view = np.where(seen.nlos, View.WALL, View.OPEN) if knows_walls else np.full(len(seen.a), View.UNKNOWN)
        return Near(*_near(
            np.ascontiguousarray(xyz_m[:, :2]), reach_m, seen.a, seen.b, seen.distance_m, slant_m(xyz_m, reach_m),
            view.astype(np.uint8),
        ))  # fmt: skip


def slant_m(xyz_m: Float[ndarray, "n 3"], reach_m: float) -> float:
    """How far apart in space radios can be that are within reach on the map."""
    return reach_m + (float(np.ptp(xyz_m[:, 2])) if len(xyz_m) else 0.0) + 1e-6


@njit(cache=True)
def _near(xy, reach_m, a, b, distance_m, slant_m, view):
    near, length_m = np.empty(len(a), np.int32), np.empty(len(a))
    ptr = np.zeros(len(xy) + 1, np.int64)
    n = 0
    for m in range(len(a)):
        if distance_m[m] <= slant_m:
            dx, dy = xy[a[m], 0] - xy[b[m], 0], xy[a[m], 1] - xy[b[m], 1]
            square = dx * dx + dy * dy
            if square <= reach_m * reach_m:
                near[n], length_m[n] = m, np.sqrt(square)
                n += 1
                ptr[a[m] + 1] += 1
                ptr[b[m] + 1] += 1
    for i in range(len(xy)):
        ptr[i + 1] += ptr[i]
    put = ptr[:-1].copy()
    radio, apart_m, what = np.empty(2 * n, np.int32), np.empty(2 * n), np.empty(2 * n, np.uint8)
    for k in range(n):
        m = near[k]
        for one, other in ((a[m], b[m]), (b[m], a[m])):
            row = put[one]
            radio[row], apart_m[row], what[row] = other, length_m[k], view[m]
            put[one] = row + 1
    return ptr, radio, apart_m, what


@dataclass(frozen=True, slots=True)
class Aired:
    """F frames of a round, and what came of them."""

    author: Int[ndarray, "f"]
    carrier: Int[ndarray, "f"]
    unit: Int[ndarray, "f"]
    hop: Int[ndarray, "f"]
    on_air: Bool[ndarray, "f"]
    start_ns: Int[ndarray, "f"]
    end_ns: Int[ndarray, "f"]
    begin: Int[ndarray, "f"]
    """Where the receptions of each begin, and how many there are."""
    count: Int[ndarray, "f"]
    hearer: Int[ndarray, "m"]
    reception: UInt8[ndarray, "m"]

    @staticmethod
    def of(frames: ndarray, units: ndarray, outcomes: list[Outcome], first_tag: int) -> "Aired":
        """From the outcomes of all windows; frames of earlier rounds are nobody's any more."""
        n = len(frames)
        start_ns, end_ns, begin, count = (np.zeros(n, np.int64) for _ in range(4))
        on_air = np.zeros(n, bool)
        before = 0
        for out in outcomes:
            ours = np.flatnonzero((out.tag >= first_tag) & (out.fate == channel.Fate.RECEIVED))
            frame = out.tag[ours] - first_tag
            on_air[frame] = True
            start_ns[frame], end_ns[frame] = out.start_ns[ours], out.end_ns[ours]
            begin[frame], count[frame] = before + out.ptr[ours], out.ptr[ours + 1] - out.ptr[ours]
            before += len(out.receiver)
        return Aired(
            units["author"][frames["unit"]], frames["carrier"], frames["unit"], frames["hop"], on_air, start_ns, end_ns,
            begin, count, np.concatenate([np.zeros(0, np.int32)] + [out.receiver for out in outcomes]),
            np.concatenate([np.zeros(0, np.uint8)] + [out.reception for out in outcomes]),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Tries:
    """Every (frame, radio within reach of its carrier, not the author), frame by frame."""

    first: Int[ndarray, "f+1"]
    """Where the rows of each frame begin."""
    author: Int[ndarray, "m"]
    receiver: Int[ndarray, "m"]
    hop: Int[ndarray, "m"]
    distance_m: Float[ndarray, "m"]
    view: UInt8[ndarray, "m"]
    fate: Int[ndarray, "m"]

    @staticmethod
    def of(aired: Aired, near: Near) -> "Tries":
        """Of all frames of a round."""
        return Tries(*_tries(
            near.ptr, near.radio, near.length_m, near.view, aired.author, aired.carrier, aired.hop, aired.on_air,
            aired.begin, aired.count, aired.hearer, aired.reception, _FATE_OF,
        ))  # fmt: skip


@njit(cache=True)
def _tries(
    ptr, radio, length_m, view, author, carrier, hop, on_air, begin, count, hearer, reception, fate_of
):  # fmt: skip
    room = 0
    for f in range(len(carrier)):
        room += ptr[carrier[f] + 1] - ptr[carrier[f]]
    first = np.empty(len(carrier) + 1, np.int64)
    by, to, hops = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room, np.int8)
    apart_m, what, fate = np.empty(room), np.empty(room, np.uint8), np.empty(room, np.int8)
    here = np.full(len(ptr) - 1, _PROPAGATION, np.int8)  # too weak even to count as a link
    m = 0
    for f in range(len(carrier)):
        first[f] = m
        for k in range(begin[f], begin[f] + count[f]):
            here[hearer[k]] = fate_of[reception[k]]
        for row in range(ptr[carrier[f]], ptr[carrier[f] + 1]):
            r = radio[row]
            if r != author[f]:
                by[m], to[m], hops[m], apart_m[m], what[m] = author[f], r, hop[f], length_m[row], view[row]
                fate[m] = here[r] if on_air[f] else _EXPIRED
                m += 1
        for k in range(begin[f], begin[f] + count[f]):
            here[hearer[k]] = _PROPAGATION
    first[len(carrier)] = m
    return first, by[:m], to[:m], hops[:m], apart_m[:m], what[:m], fate[:m]


def deliveries(
    aired: Aired, tries: Tries, own_ns: Int[ndarray, "u"], n_segments: Int[ndarray, "n"], begin_ns: int,
    xy_m: Float[ndarray, "n 2"],
) -> tuple[Heard, int]:  # fmt: skip
    """Messages of which all segments are there, and how many frames brought what was there already.

    Parameters
    ----------
    own_ns
        When each unit was generated: frame u is the author's own of unit u.
    n_segments
        Of each radio's message.
    """
    m, n_duplicate, receiver, sender, hops, times_ns = _deliveries(
        len(xy_m), tries.receiver, tries.fate, tries.first, counted(aired.unit, len(own_ns)), aired.author,
        aired.carrier, aired.unit, aired.hop, aired.start_ns, aired.end_ns, own_ns, n_segments,
    )  # fmt: skip
    receiver, sender, hops, times_ns = receiver[:m], sender[:m], hops[:m], times_ns[:, :m]
    distance_m = np.hypot(*(xy_m[receiver] - xy_m[sender]).T)
    generated_s = 1e-9 * (times_ns[0] - begin_ns)
    return Heard(receiver, sender, hops, generated_s, 1e-9 * times_ns[1], 1e-9 * times_ns[2], distance_m), n_duplicate


@njit(cache=True)
def _deliveries(
    n, to, fate, first, by_unit, author, carrier, unit, hop, start_ns, end_ns, own_ns, n_segments
):  # fmt: skip
    at = np.zeros(n + 1, np.int64)
    for row in range(len(fate)):
        at[to[row] + 1] += fate[row] == _RECEIVED
    for r in range(n):
        at[r + 1] += at[r]
    got = np.empty(at[n], np.int32)  # frames by receiver, unit
    put = at[:-1].copy()
    for f in by_unit:
        for row in range(first[f], first[f + 1]):
            if fate[row] == _RECEIVED:
                r = to[row]
                got[put[r]] = f
                put[r] += 1
    receiver, sender, hops = np.empty(len(got), np.int64), np.empty(len(got), np.int64), np.empty(len(got), np.int32)
    times_ns = np.empty((3, len(got)), np.int64)  # generation; from there to the last own frame, and to reception
    m = n_duplicate = 0
    for r in range(n):
        k = at[r]
        while k < at[r + 1]:
            s, there, hop_of, access_ns, last_ns = author[got[k]], 0, 0, 0, 0
            while k < at[r + 1] and author[got[k]] == s:
                best = got[k]
                k += 1
                while k < at[r + 1] and unit[got[k]] == unit[best]:
                    f = got[k]
                    if end_ns[f] < end_ns[best] or (end_ns[f] == end_ns[best] and carrier[f] < carrier[best]):
                        best = f
                    n_duplicate += 1
                    k += 1
                u = unit[best]
                there += 1
                hop_of = max(hop_of, hop[best])
                access_ns = max(access_ns, start_ns[u] - own_ns[u])
                last_ns = max(last_ns, end_ns[best] - own_ns[u])
            if there == n_segments[s]:
                receiver[m], sender[m], hops[m] = r, s, hop_of
                times_ns[0, m], times_ns[1, m], times_ns[2, m] = own_ns[u], access_ns, last_ns
                m += 1
    return m, n_duplicate, receiver, sender, hops, times_ns
