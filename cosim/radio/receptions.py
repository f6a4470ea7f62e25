"""Result of a round over the shared channel: the outcome of every frame in range, and the messages received.

The functions pass once over the frames and once over their receptions. They sort by counting.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.codes import LosState
from cosim.base.kernel import compiled
from cosim.base.ragged import counting_order
from cosim.radio.channel import PhyOutcome, WindowResult
from cosim.radio.event_heap import comes_before
from cosim.radio.link_budget import PairLos
from cosim.radio.message_round import Outcome, Receptions

_OUTCOME_OF = np.full(max(PhyOutcome) + 1, Outcome.PROPAGATION, np.int8)
"""`Outcome` by `PhyOutcome`."""
for _phy, _outcome in {
    PhyOutcome.RECEIVED: Outcome.RECEIVED,
    PhyOutcome.COLLISION: Outcome.COLLISION,
    PhyOutcome.BUSY: Outcome.RECEIVER_BUSY,
    PhyOutcome.HALF_DUPLEX: Outcome.RECEIVER_BUSY,
    PhyOutcome.EXPIRED: Outcome.EXPIRED,
    PhyOutcome.QUEUE: Outcome.EXPIRED,
}.items():
    _OUTCOME_OF[_phy] = _outcome
_RECEIVED, _PROPAGATION = int(Outcome.RECEIVED), int(Outcome.PROPAGATION)
_EXPIRED = int(Outcome.EXPIRED)
_WAITING = int(Outcome.WAITING)


class FrameState(IntEnum):
    """What a round knows of a frame."""

    DECIDED = 0
    """It was sent in this round, or it never will be."""
    WAITS = 1
    """It waits for a later round."""
    REPORTED = 2
    """An earlier round has reported it. Only the stations that received it are listed."""


_WAITS, _REPORTED = int(FrameState.WAITS), int(FrameState.REPORTED)


class NeighbourList(NamedTuple):
    """Stations in range of each station, ascending, compressed rows."""

    ptr: Int[ndarray, "n+1"]
    station: Int[ndarray, "m"]
    length_m: Float[ndarray, "m"]
    los_state: UInt8[ndarray, "m"]
    """As `LosState`."""

    @staticmethod
    def of(xyz_m: Float[ndarray, "n 3"], range_m: float, found: PairLos, knows_walls: bool) -> "NeighbourList":
        """The stations in range of each station.

        Parameters
        ----------
        xyz_m
            Antennas.
        range_m
            Largest horizontal distance.
        found
            Pairs that include at least all pairs up to the distance `slant_m(xyz_m, range_m)`.
        knows_walls
            Whether `found` contains lines of sight. If not, `los_state` is UNKNOWN.
        """
        most_m = slant_m(xyz_m, range_m)
        columns = found.a, found.b, found.distance_m, found.nlos
        ptr, station, length_m, is_nlos = _neighbours(xyz_m, range_m, most_m, *columns)
        los_state = np.where(is_nlos, LosState.NLOS, LosState.LOS).astype(np.uint8)
        if not knows_walls:
            los_state[:] = LosState.UNKNOWN
        return NeighbourList(ptr, station, length_m, los_state)


@compiled
def _neighbours(xyz_m, range_m, slant_m, a, b, distance_m, nlos):
    """Where the neighbours of each station begin, the neighbours ascending, and length and blockage of each line."""
    n = len(xyz_m)
    ptr = np.zeros(n + 1, np.int64)
    square_m2 = np.empty(len(a))
    for pair in range(len(a)):
        i, j = a[pair], b[pair]
        dx = xyz_m[i, 0] - xyz_m[j, 0]
        dy = xyz_m[i, 1] - xyz_m[j, 1]
        may_be_near = distance_m[pair] <= slant_m
        square_m2[pair] = dx * dx + dy * dy if may_be_near else np.inf
        if square_m2[pair] <= range_m * range_m:
            ptr[i + 1] += 1
            ptr[j + 1] += 1
    for i in range(n):
        ptr[i + 1] += ptr[i]
    m = ptr[n]
    at = ptr.copy()
    other = np.empty(m, np.int32)
    pair_of = np.empty(m, np.int32)
    for pair in range(len(a)):
        if square_m2[pair] <= range_m * range_m:
            one, two = a[pair], b[pair]
            for i, j in ((one, two), (two, one)):
                other[at[i]], pair_of[at[i]] = j, pair
                at[i] += 1
    # Each station is noted at its neighbours, in ascending order. As neighbours are mutual, all lists are then sorted.
    at = ptr.copy()
    station = np.empty(m, np.int32)
    length_m = np.empty(m)
    is_nlos = np.empty(m, np.bool_)
    for i in range(n):
        for k in range(ptr[i], ptr[i + 1]):
            row, pair = at[other[k]], pair_of[k]
            station[row] = i
            length_m[row] = np.sqrt(square_m2[pair])
            is_nlos[row] = nlos[pair]
            at[other[k]] += 1
    return ptr, station, length_m, is_nlos


def slant_m(xyz_m: Float[ndarray, "n 3"], range_m: float) -> float:
    """Upper bound of the distance in space of two stations whose horizontal distance is at most `range_m`."""
    if not len(xyz_m):
        return range_m + 1e-6
    return range_m + float(np.ptp(xyz_m[:, 2])) + 1e-6


class Transmissions(NamedTuple):
    """F frames of a round with their receptions."""

    unit: Int[ndarray, "f"]
    message: Int[ndarray, "f"]
    source: Int[ndarray, "f"]
    """Station that sends the message."""
    transmitter: Int[ndarray, "f"]
    """Station that sends this frame."""
    hop: Int[ndarray, "f"]
    on_air: Bool[ndarray, "f"]
    start_ns: Int[ndarray, "f"]
    end_ns: Int[ndarray, "f"]
    begin: Int[ndarray, "f"]
    """Where the receptions of each frame begin."""
    n_receptions: Int[ndarray, "f"]
    receiver: Int[ndarray, "m"]
    reception: UInt8[ndarray, "m"]
    """As `PhyOutcome`."""

    @staticmethod
    def of(frames: ndarray, units: ndarray, windows: list[WindowResult], earlier: ndarray) -> "Transmissions":
        """The frames of a round, from the results of its windows.

        Parameters
        ----------
        frames, units
            Records of `FRAME` and `UNIT` of the round.
        windows
            Results of all windows of the round. Packets carry the row of their frame; those below 0 are left out.
        earlier
            What earlier rounds know of the first frames: records of `underway.SENT_FRAME`.
        """
        n = len(frames)
        start_ns, end_ns, begin, count = (np.zeros(n, np.int64) for _ in range(4))
        on_air = np.zeros(n, bool)
        for name, column in (("start_ns", start_ns), ("end_ns", end_ns), ("on_air", on_air)):
            column[: len(earlier)] = earlier[name]
        before = 0
        for out in windows:
            ours = np.flatnonzero((out.tag >= 0) & (out.outcome == PhyOutcome.RECEIVED))
            frame, first = out.tag[ours], out.ptr[ours]
            on_air[frame] = True
            start_ns[frame] = out.start_ns[ours]
            end_ns[frame] = out.end_ns[ours]
            begin[frame] = before + first
            count[frame] = out.ptr[ours + 1] - first
            before += len(out.receiver)
        unit = frames["unit"]
        return Transmissions(
            unit=unit,
            message=units["message"][unit],
            source=units["source"][unit],
            transmitter=frames["transmitter"],
            hop=frames["hop"],
            on_air=on_air,
            start_ns=start_ns,
            end_ns=end_ns,
            begin=begin,
            n_receptions=count,
            receiver=np.concatenate([np.zeros(0, np.int32)] + [out.receiver for out in windows]),
            reception=np.concatenate([np.zeros(0, np.uint8)] + [out.reception for out in windows]),
        )


class ReceptionAttempts(NamedTuple):
    """One row for each frame and each station in range of its transmitter, without the message's sender; by frame."""

    first: Int[ndarray, "f+1"]
    """Where the rows of each frame begin."""
    message: Int[ndarray, "m"]
    receiver: Int[ndarray, "m"]
    hop: Int[ndarray, "m"]
    distance_m: Float[ndarray, "m"]
    los_state: UInt8[ndarray, "m"]
    outcome: Int[ndarray, "m"]

    @staticmethod
    def of(
        sent: Transmissions,
        near: NeighbourList,
        state: UInt8[ndarray, "f"] | None = None,
        got_ptr: Int[ndarray, "g+1"] | None = None,
        got_by: Int[ndarray, "r"] | None = None,
    ) -> "ReceptionAttempts":
        """Of all frames of a round.

        Parameters
        ----------
        state
            `FrameState` of each frame. None: all are decided.
        got_ptr, got_by
            The stations that received each of the first g frames in earlier rounds, compressed rows. None: there are
            no such frames.
        """
        if state is None:
            state = np.zeros(len(sent.unit), np.uint8)
        got_ptr = np.zeros(1, np.int64) if got_ptr is None else got_ptr
        got_by = np.zeros(0, np.int64) if got_by is None else got_by
        return ReceptionAttempts(*_attempts(sent, near, _OUTCOME_OF, state, got_ptr, got_by))


@compiled
def _attempts(sent, near, outcome_of, state, got_ptr, got_by):
    """Columns of `ReceptionAttempts`."""
    ptr, transmitter = near.ptr, sent.transmitter
    begin, count = sent.begin, sent.n_receptions
    receiver = sent.receiver
    room = len(got_by)
    for f in range(len(transmitter)):
        if state[f] != _REPORTED:
            room += ptr[transmitter[f] + 1] - ptr[transmitter[f]]
    first = np.empty(len(transmitter) + 1, np.int64)
    of = np.empty(room, np.int32)
    to = np.empty(room, np.int32)
    hops = np.empty(room, np.int8)
    apart_m = np.empty(room)
    los = np.empty(room, np.uint8)
    outcome = np.empty(room, np.int8)
    here = np.full(len(ptr) - 1, _PROPAGATION, np.int8)  # below the cut-off power of links
    m = 0
    for f in range(len(transmitter)):
        first[f] = m
        if state[f] == _REPORTED:
            if f < len(got_ptr) - 1:
                for k in range(got_ptr[f], got_ptr[f + 1]):
                    of[m] = sent.message[f]
                    to[m] = got_by[k]
                    hops[m] = sent.hop[f]
                    apart_m[m], los[m], outcome[m] = 0.0, 0, _RECEIVED
                    m += 1
            continue
        not_sent = _WAITING if state[f] == _WAITS else _EXPIRED
        for k in range(begin[f], begin[f] + count[f]):
            here[receiver[k]] = outcome_of[sent.reception[k]]
        for row in range(ptr[transmitter[f]], ptr[transmitter[f] + 1]):
            r = near.station[row]
            if r != sent.source[f]:
                of[m], to[m] = sent.message[f], r
                hops[m] = sent.hop[f]
                apart_m[m] = near.length_m[row]
                los[m] = near.los_state[row]
                outcome[m] = here[r] if sent.on_air[f] else not_sent
                m += 1
        for k in range(begin[f], begin[f] + count[f]):
            here[receiver[k]] = _PROPAGATION
    first[len(transmitter)] = m
    return (
        first,
        of[:m],
        to[:m],
        hops[:m],
        apart_m[:m],
        los[:m],
        outcome[:m],
    )


def complete_messages(
    sent: Transmissions,
    attempts: ReceptionAttempts,
    own_ns: Int[ndarray, "u"],
    n_segments: Int[ndarray, "m"],
    begin_ns: Int[ndarray, "m"],
    station: Int[ndarray, "m"],
    xy_m: Float[ndarray, "n 2"],
    since_ns: int,
) -> tuple[Receptions, Int[ndarray, "m"]]:
    """Messages of which all segments are received, and the number of frames that repeated a received segment of each.

    Parameters
    ----------
    own_ns
        When each unit (segment) was generated [ns]. Frame u is the frame in which the message's sender sends unit u.
    n_segments
        Number of segments of each message.
    begin_ns
        Beginning of the round of each message [ns].
    station
        Sender of each message.
    xy_m
        Horizontal positions of the stations [m].
    since_ns
        What was complete or repeated before this time is left out [ns].

    Returns
    -------
    Receptions sorted by receiver, then message; and the number of repeated segments of each message.
    """
    unit, station, *of_messages = (
        np.ascontiguousarray(column, np.int64) for column in (sent.unit, station, own_ns, n_segments, begin_ns)
    )
    by_unit = counting_order(unit, len(own_ns))
    n_duplicate, columns = _complete(xy_m, station, attempts, sent, by_unit, *of_messages, since_ns)
    return Receptions(*columns), n_duplicate


@compiled
def _received_frames(n, attempts, by_unit):
    """Where the frames that each of n stations received begin, and the frames by receiver, then unit."""
    to, outcome, first = attempts.receiver, attempts.outcome, attempts.first
    at = np.zeros(n + 1, np.int64)
    for row in range(len(outcome)):
        at[to[row] + 1] += outcome[row] == _RECEIVED
    for r in range(n):
        at[r + 1] += at[r]
    got = np.empty(at[n], np.int32)
    put = at[:-1].copy()
    for f in by_unit:
        for row in range(first[f], first[f + 1]):
            if outcome[row] == _RECEIVED:
                r = to[row]
                got[put[r]] = f
                put[r] += 1
    return at, got


@compiled
def _complete(xy, station, attempts, sent, by_unit, own_ns, n_segments, begin_ns, since_ns):
    """Repeated segments of each message, and the columns of `Receptions`; `by_unit` are the frames sorted by unit."""
    message_of, transmitter, unit, end_ns = sent.message, sent.transmitter, sent.unit, sent.end_ns
    at, got = _received_frames(len(xy), attempts, by_unit)
    most = len(got)
    receiver = np.empty(most, np.int64)
    message = np.empty(most, np.int64)
    hops = np.empty(most, np.int32)
    offset_s, access_s, latency_s, apart_m = np.empty((4, most))
    m, n_duplicate = 0, np.zeros(len(n_segments), np.int64)
    for r in range(len(xy)):
        k, end = at[r], at[r + 1]
        while k < end:
            s = message_of[got[k]]
            n_received = hop_of = access_ns = last_ns = 0
            is_new = False
            while k < end and message_of[got[k]] == s:
                best = got[k]
                k += 1
                # The first frame to end counts; of two at once that of the transmitter of lower number.
                while k < end and unit[got[k]] == unit[best]:
                    f = got[k]
                    if comes_before(end_ns[f], transmitter[f], end_ns[best], transmitter[best]):
                        best = f
                    n_duplicate[s] += end_ns[f] >= since_ns
                    k += 1
                u = unit[best]
                n_received += 1
                hop_of = max(hop_of, sent.hop[best])
                access_ns = max(access_ns, sent.start_ns[u] - own_ns[u])
                last_ns = max(last_ns, end_ns[best] - own_ns[u])
                is_new |= end_ns[best] >= since_ns
            if is_new and n_received == n_segments[s]:
                sender = station[s]
                dx = xy[r, 0] - xy[sender, 0]
                dy = xy[r, 1] - xy[sender, 1]
                receiver[m], message[m], hops[m] = r, s, hop_of
                offset_s[m] = 1e-9 * (own_ns[u] - begin_ns[s])
                access_s[m] = 1e-9 * access_ns
                latency_s[m] = 1e-9 * last_ns
                apart_m[m] = np.sqrt(dx * dx + dy * dy)
                m += 1
    return n_duplicate, (
        receiver[:m],
        message[:m],
        hops[:m],
        offset_s[:m],
        access_s[:m],
        latency_s[:m],
        apart_m[:m],
    )
