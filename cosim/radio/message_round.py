"""One round of messages between stations: what is sent, what is received, and the outcome of every frame."""

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.base import rng
from cosim.base.codes import LosState
from cosim.base.ragged import order_by_two, place_in_group
from cosim.base.rows import Rows
from cosim.radio.bodies import Bodies
from cosim.radio.segmentation import ENVELOPE_BYTES, segments


class RoundKind(IntEnum):
    """The two rounds of messages in each step."""

    CPM = 0
    """Collective perception messages: detections."""
    EVALUATION = 1
    """Evaluations, and the roadside units' trust broadcasts."""


class Outcome(IntEnum):
    """Outcome of one frame at one station in range."""

    RECEIVED = 0
    PROPAGATION = 1
    """Too weak; under `unit_disk` lost with the constant probability."""
    COLLISION = 2
    RECEIVER_BUSY = 3
    EXPIRED = 4
    """Never sent: too old, or no room in the queue."""
    LATE = 5
    """Received after the end of the round."""
    WAITING = 6
    """Not sent by the end of the round. The frame has its outcome in the round in which it is sent or expires."""


@dataclass(frozen=True, slots=True)
class ChannelAbuse:
    """How N stations break the rules of the channel."""

    jam_dbm: Float[ndarray, "n"]
    """Power of noise that they transmit all the time; -inf for none [dBm]."""
    react_dbm: Float[ndarray, "n"]
    """Power of noise that they transmit while they detect a frame; -inf for none [dBm]."""
    ignores_dcc: Bool[ndarray, "n"]
    """Whether they send without congestion control."""


@dataclass(frozen=True, slots=True)
class Stations:
    """N stations: first vehicles, then roadside units."""

    key: UInt64[ndarray, "n"]
    """Key of each station's draws; all are different."""
    xyz_m: Float[ndarray, "n 3"]
    """Antennas."""
    n_vehicles: int
    above_street_m: Float[ndarray, "n"] | None = None
    """Heights of the antennas above the street under them [m]. None: the streets are at height 0."""
    abuse: ChannelAbuse | None = None
    """None where all stations keep the rules of the channel."""
    bodies: Bodies | None = None
    """Road users that may block links, of all traffic; None where they are not known."""

    def __len__(self) -> int:
        return len(self.key)

    def equals(self, other: "Stations") -> bool:
        """Whether these are the same stations at the same positions."""
        return np.array_equal(self.key, other.key) and np.array_equal(self.xyz_m, other.xyz_m)


@dataclass(frozen=True, slots=True)
class Messages:
    """M messages of one round, sorted by station; a station may send several."""

    station: Int[ndarray, "m"]
    """Row of the sender."""
    length_bytes: Int[ndarray, "m"]
    """0 where nothing is sent."""
    delay_s: Float[ndarray, "m"] | None = None
    """Added to the time of generation [s]. A message that is too late for the round is not sent or not received."""
    envelope_bytes: Int[ndarray, "m"] | None = None
    """What every segment of a long message repeats. None: `segmentation.ENVELOPE_BYTES`."""
    refused: Int[ndarray, "p"] | None = None
    """Messages that stations receive and do not forward: row of the message << 32 | row of the station, ascending.
    None: there are none."""
    is_background: Bool[ndarray, "m"] | None = None
    """Messages that wait in a queue of their own, behind all others of the station (`csma`). None: there are none."""
    name: Int[ndarray, "m"] | None = None
    """The caller's name for each message. A later round in which the message goes on returns it. None: all are -1."""

    def __post_init__(self) -> None:
        assert (np.diff(self.station) >= 0).all() and (self.length_bytes >= 0).all()

    def __len__(self) -> int:
        return len(self.station)

    def segments(
        self,
        sent: Int[ndarray, "k"],
        frame_bytes: int,
    ) -> tuple[Int[ndarray, "k"], Int[ndarray, "k"]]:
        """Number of frames of these messages, and the length of each frame [B], as `segmentation.segments`."""
        envelope = ENVELOPE_BYTES if self.envelope_bytes is None else self.envelope_bytes[sent]
        return segments(self.length_bytes[sent], envelope, frame_bytes)

    def generated_ns(self, phase: Float[ndarray, "m"], begin_ns: int, end_ns: int) -> Int[ndarray, "m"]:
        """When messages are generated in a round [ns]: after this share of its first half, and their delay."""
        offset_ns = np.floor(phase * (end_ns - begin_ns) / 2).astype(np.int64)
        if self.delay_s is not None:
            offset_ns += np.rint(1e9 * self.delay_s).astype(np.int64)
        return begin_ns + offset_ns

    def followed_by(self, other: "Messages") -> tuple["Messages", Bool[ndarray, "k"]]:
        """Behind the messages of each station, those that it has among the others; and which messages are others.

        Keys of the first messages stay as they are. The others are background, without delay, of the usual envelope.
        """
        station = np.concatenate([self.station, other.station])
        order = np.argsort(station, kind="stable")

        def joined(mine: ndarray | None, usual: float) -> ndarray | None:
            if mine is None:
                return None
            of_other = np.full(len(other), usual, mine.dtype)
            return np.append(mine, of_other)[order]

        length = np.concatenate([self.length_bytes, other.length_bytes])[order]
        is_other = order >= len(self)
        name = joined(self.name, -1)
        if name is not None and other.name is not None:
            name[is_other] = other.name
        refused = self.refused
        if refused is not None:  # the messages keep their order, so the pairs stay sorted
            row = np.flatnonzero(~is_other)[refused >> 32]
            refused = row << 32 | refused & 0xFFFFFFFF
        both = Messages(
            station[order],
            length,
            joined(self.delay_s, 0.0),
            joined(self.envelope_bytes, ENVELOPE_BYTES),
            refused=refused,
            is_background=is_other,
            name=name,
        )
        return both, is_other

    @staticmethod
    def one_each(length_bytes: Int[ndarray, "n"]) -> "Messages":
        """One message per station: message row and station row are the same."""
        return Messages(np.arange(len(length_bytes)), np.asarray(length_bytes))

    def keys(self, stations: Stations) -> UInt64[ndarray, "m"]:
        """Key of each message's draws: the station's key for its first message, hashes of that key for the others."""
        key = stations.key[self.station]
        number = place_in_group(self.station)
        more = np.flatnonzero(number)
        if len(more):
            key[more] = rng.keys(np.uint64(0), key[more], number[more])
        return key


@dataclass(frozen=True, slots=True)
class Receptions(Rows):
    """R receptions of one round, sorted by receiver, then message. Each pair of receiver and message is there once.

    In each row, generation is not later than access, and access is not later than reception.
    """

    receiver: Int[ndarray, "r"]
    """Row of the station."""
    message: Int[ndarray, "r"]
    """Row of the message."""
    hops: Int[ndarray, "r"]
    generation_offset_s: Float[ndarray, "r"]
    """From the beginning of the round to generation."""
    access_delay_s: Float[ndarray, "r"]
    """From generation until the sender's last frame of the message is on the air."""
    latency_s: Float[ndarray, "r"]
    """From generation to reception."""
    distance_m: Float[ndarray, "r"]
    """Between sender and receiver."""

    def __post_init__(self) -> None:
        with np.errstate(invalid="ignore"):
            in_order = (self.generation_offset_s >= 0) & (self.access_delay_s >= 0)
            in_order &= self.latency_s >= self.access_delay_s
        if not in_order.all():
            raise ValueError(
                "a reception with a negative delay, or with latency_s less than access_delay_s: no message is received "
                "before it is generated and sent."
            )

    @property
    def received_s(self) -> Float[ndarray, "r"]:
        """From the beginning of the round to reception."""
        return self.generation_offset_s + self.latency_s

    @staticmethod
    def none() -> "Receptions":
        """No receptions."""
        row, real = np.zeros(0, np.int64), np.zeros(0)
        return Receptions(row, row, np.zeros(0, np.int32), real, real, real, real)


@dataclass(frozen=True, slots=True)
class FrameOutcomes:
    """F pairs of a frame and a station in range, of one round, all hops, in no particular order."""

    message: Int[ndarray, "f"]
    """Row of the message that the frame carries."""
    receiver: Int[ndarray, "f"]
    """Row of the station."""
    hop: Int[ndarray, "f"]
    distance_m: Float[ndarray, "f"]
    """Between the two ends of the hop."""
    los_state: UInt8[ndarray, "f"]
    """As `LosState`, between the two ends of the hop."""
    outcome: Int[ndarray, "f"]
    """As `Outcome`."""
    n_transmissions: Int[ndarray, "m"]
    """Frames of each message, forwarded ones included."""
    n_relayed: int
    """How many of these frames were sent by other stations than the message's sender."""
    n_duplicate: int
    """How many of the received frames had a content that their receiver already had."""
    sent_bytes: float
    """Bytes transmitted, with forwarded frames and MAC headers."""
    cbr: Float[ndarray, "n"] | None
    """For how long each station sensed the channel busy, from the end of the round before to the end of this one, in
    lengths of a round; None where the medium does not model it."""


_OF_FRAMES = ("receiver", "hop", "distance_m", "los_state", "outcome")
"""Columns of `FrameOutcomes` with a row for each frame and station, besides `message`."""


@dataclass(frozen=True, slots=True)
class MessageRound:
    """One round of messages."""

    station: Int[ndarray, "m"]
    """Sender of each message."""
    receptions: Receptions
    frames: FrameOutcomes
    earlier: tuple["EarlierMessages", ...] = ()
    """What happened in this round to messages of earlier ones, by kind of round."""

    @staticmethod
    def of(
        stations: Stations,
        messages: Messages,
        receiver: Int[ndarray, "r"],
        message: Int[ndarray, "r"],
        *,
        latency_s: Float[ndarray, "r"] | float = 0.0,
        lost_receiver: Int[ndarray, "l"] | None = None,
        lost_message: Int[ndarray, "l"] | None = None,
        cbr: Float[ndarray, "n"] | None = None,
    ) -> "MessageRound":
        """A round without forwarding: every message is sent in one frame, directly to each station in range.

        Parameters
        ----------
        receiver, message
            Rows of the receiving stations and of the received messages, in any order, each pair once.
        latency_s
            From generation to reception [s]; one number for all or one per reception.
        lost_receiver, lost_message
            The same for messages that a station in range does not receive. None: there are no such messages.
        cbr
            Channel busy ratio of the round at each station. None: the medium does not model it.

        Returns
        -------
        Receptions sorted by receiver, then message, and the outcome of every frame. A message is generated
        `messages.delay_s` after the beginning of the round, and it is on the air at once.
        """
        none = np.zeros(0, np.int64)
        to = np.concatenate([receiver, none if lost_receiver is None else lost_receiver])
        of = np.concatenate([message, none if lost_message is None else lost_message])
        _check_rows("receiver", to, len(to), len(stations), "stations")
        _check_rows("message", of, len(to), len(messages), "messages")
        xy_m, n = stations.xyz_m[:, :2], len(receiver)
        is_received = np.arange(len(to)) < n
        zero, ones = np.zeros(n), np.ones(n, np.int64)
        latency_s = np.broadcast_to(np.asarray(latency_s, float), n)
        offset_s = zero if messages.delay_s is None else messages.delay_s[message]
        receptions = receptions_of(receiver, message, ones, offset_s, zero, latency_s, messages.station, xy_m)
        frames = FrameOutcomes(
            message=of,
            receiver=to,
            hop=np.ones(len(to), np.int64),
            distance_m=np.hypot(*(xy_m[to] - xy_m[messages.station[of]]).T),
            los_state=np.full(len(to), LosState.UNKNOWN, np.uint8),
            outcome=np.where(is_received, int(Outcome.RECEIVED), int(Outcome.PROPAGATION)),
            n_transmissions=(messages.length_bytes > 0).astype(np.int64),
            n_relayed=0,
            n_duplicate=0,
            sent_bytes=float(messages.length_bytes.sum()),
            cbr=cbr,
        )
        return MessageRound(messages.station, receptions, frames)

    def only(self, chosen: Bool[ndarray, "m"]) -> "MessageRound":
        """The round of these messages alone, renumbered. Sums and the channel busy ratio stay those of all messages."""
        number, found, frames = np.cumsum(chosen) - 1, self.receptions, self.frames
        found = found.take(chosen[found.message])
        mine = chosen[frames.message]
        columns = {name: getattr(frames, name)[mine] for name in _OF_FRAMES}
        return MessageRound(
            self.station[chosen],
            replace(found, message=number[found.message]),
            replace(
                frames, message=number[frames.message[mine]], n_transmissions=frames.n_transmissions[chosen], **columns
            ),
            self.earlier,
        )

    @staticmethod
    def silent() -> "MessageRound":
        """A round without messages."""
        row = np.zeros(0, np.int64)
        real = np.zeros(0)
        code = np.zeros(0, np.uint8)
        frames = FrameOutcomes(row, row, row, real, code, row, row, 0, 0, 0.0, None)
        return MessageRound(row, Receptions.none(), frames)


@dataclass(frozen=True, slots=True)
class EarlierMessages:
    """Messages of earlier rounds that went on in this one."""

    kind: RoundKind
    step: Int[ndarray, "m"]
    """Step of the round of each message."""
    name: Int[ndarray, "m"]
    """As `Messages.name`."""
    round: MessageRound
    """What was sent, received and lost in this round. `generation_offset_s` counts from the message's own round."""
    is_background: bool = False
    """As `Messages.is_background`, of all of them."""


class LinkReceptions(NamedTuple):
    """Receptions of a round by kind of link; messages keep their rows."""

    vehicles: Receptions
    """From vehicles by vehicles."""
    uplink: Receptions
    """From vehicles by roadside units; receivers are rows of the units."""
    downlink: Receptions
    """From roadside units by vehicles."""


def _check_rows(name: str, rows: Int[ndarray, "f"], n_frames: int, n_rows: int, what: str) -> None:
    """Raise ValueError if these are not numbers of rows of a table, one for each frame."""
    is_number = rows.dtype.kind in "iu" and len(rows) == n_frames
    if not is_number or ((rows < 0) | (rows >= n_rows)).any():
        raise ValueError(f"{name} is not one row of the {n_rows} {what} for each frame.")


def by_link(happened: MessageRound, n_vehicles: int) -> LinkReceptions:
    """Receptions of a round by kind of link, without those from roadside units by roadside units."""
    found = happened.receptions
    receives = found.receiver < n_vehicles
    sends = happened.station[found.message] < n_vehicles
    if receives.all() and sends.all():
        return LinkReceptions(found, Receptions.none(), Receptions.none())
    uplink = found.take(~receives & sends)
    return LinkReceptions(
        found.take(receives & sends),
        replace(uplink, receiver=uplink.receiver - n_vehicles),
        found.take(receives & ~sends),
    )


def receptions_of(
    receiver: Int[ndarray, "r"],
    message: Int[ndarray, "r"],
    hops: Int[ndarray, "r"],
    generation_offset_s: Float[ndarray, "r"],
    access_delay_s: Float[ndarray, "r"],
    latency_s: Float[ndarray, "r"],
    station: Int[ndarray, "m"],
    xy_m: Float[ndarray, "n 2"],
) -> Receptions:
    """Receptions sorted by receiver, then message, with their distances.

    Parameters
    ----------
    receiver, message
        Rows of stations and of messages, in any order, each pair once. The columns up to `latency_s` are aligned.
    station
        Sender of each message.
    xy_m
        Horizontal positions of all stations.

    Raises
    ------
    ValueError
        If a time is negative, or a latency is shorter than its access delay.
    """
    order = order_by_two(receiver, message, max(len(xy_m), len(station)))
    receiver, message = receiver[order], message[order]
    distance_m = np.hypot(*(xy_m[receiver] - xy_m[station[message]]).T)
    return Receptions(
        receiver,
        message,
        hops[order].astype(np.int32),
        generation_offset_s[order],
        access_delay_s[order],
        latency_s[order],
        distance_m,
    )
