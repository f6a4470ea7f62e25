"""One round of messages: who heard whom, and what became of every frame."""

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, Int, UInt8
from numba import njit
from numpy import ndarray

from cosim.v2x.links import within


@dataclass(frozen=True, kw_only=True, slots=True)
class RelayParams:
    """Whether, and how far, messages are passed on."""

    max_hops: Annotated[int, Ge(1), Le(10)] = 1
    """Hops that a message may travel; 1 is no relay."""
    reach_m: Annotated[float, Gt(0)] = 600.0
    """Farthest from its origin that a message is passed on [m]."""
    rule: Literal["contention", "probability"] = "contention"
    """`contention`: the farthest speaks first and silences who hears it (under `disk` nobody is silenced: all speak).
    `probability`: each passes on with `forward_p`, whatever it hears."""
    forward_p: Annotated[float, Ge(0), Le(1)] = 0.5
    """Chance that a radio passes a message on, under `probability`."""
    timer_min_s: Annotated[float, Gt(0)] = 0.001
    """Contention timer of a relay at `timer_distance_m` from the previous hop, and beyond [s]."""
    timer_max_s: Annotated[float, Gt(0)] = 0.1
    """Contention timer of a relay beside the previous hop [s]: who is farther away speaks first. Under `probability`
    timers are drawn evenly between the two."""
    timer_distance_m: Annotated[float, Gt(0)] = 400.0
    """Distance at which the contention timer is shortest [m]."""

    def __post_init__(self) -> None:
        if self.timer_max_s < self.timer_min_s:
            raise ValueError(
                f"radio.relay.timer_max_s = {self.timer_max_s:g} s is below radio.relay.timer_min_s = "
                f"{self.timer_min_s:g} s. Set the larger one as maximum."
            )


class Fate(IntEnum):
    """What became of one frame at one radio within reach."""

    RECEIVED = 0
    PROPAGATION = 1
    """Too weak, or lost by the flat chance of the disk model."""
    COLLISION = 2
    RECEIVER_BUSY = 3
    EXPIRED = 4
    """Never sent: too old, or no room in the queue."""
    LATE = 5
    """Received after the time-out of the round."""


class View(IntEnum):
    """What stands between the two ends of a hop."""

    OPEN = 0
    """No building."""
    WALL = 1
    UNKNOWN = 2
    """The model of the air does not ask."""


@dataclass(frozen=True, slots=True)
class Heard:
    """M deliveries of one round, each (receiver, sender) once, sorted by receiver, then sender; radio rows.

    No message is received before it is sent, nor sent before it is there.
    """

    receiver: Int[ndarray, "m"]
    sender: Int[ndarray, "m"]
    hops: Int[ndarray, "m"]
    generated_s: Float[ndarray, "m"]
    """From the beginning of the round to generation."""
    access_s: Float[ndarray, "m"]
    """From generation until the author's last frame of it is on the air."""
    latency_s: Float[ndarray, "m"]
    """From generation to reception."""
    distance_m: Float[ndarray, "m"]

    def __post_init__(self) -> None:
        assert (self.generated_s >= 0).all() and (self.access_s >= 0).all() and (self.latency_s >= self.access_s).all()

    @property
    def received_s(self) -> Float[ndarray, "m"]:
        """From the beginning of the round to reception."""
        return self.generated_s + self.latency_s

    def take(self, rows: ndarray) -> "Heard":
        """The chosen rows (a mask or row numbers)."""
        return Heard(*(getattr(self, name)[rows] for name in Heard.__slots__))


@dataclass(frozen=True, slots=True)
class Frames:
    """F (frame, radio within reach) of one round, all hops, in no particular order; radio rows."""

    origin: Int[ndarray, "f"]
    """Author of the frame's message."""
    receiver: Int[ndarray, "f"]
    hop: Int[ndarray, "f"]
    distance_m: Float[ndarray, "f"]
    """Between the two ends of the hop."""
    view: UInt8[ndarray, "f"]
    """As `View`, between the two ends of the hop."""
    fate: Int[ndarray, "f"]
    """As `Fate`."""
    n_transmissions: Int[ndarray, "n"]
    """Frames of each radio's message, relays included."""
    n_relayed: int
    """Of all these, those sent by others than the author."""
    n_duplicate: int
    """Of the frames received, those whose message the receiver had or got elsewhere earlier."""
    sent_bytes: float
    """On the air, relays and medium access headers included."""
    busy: Float[ndarray, "n"] | None
    """Share of the round in which each radio sensed the medium busy; None where that is not modelled."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """One round of messages of vehicles and of roadside units; rows of the ones and of the others."""

    heard: Heard
    """Vehicles of vehicles."""
    frames: Frames
    """Roadside units are rows behind those of the vehicles."""
    up: Heard
    """Roadside units of vehicles."""
    down: Heard
    """Vehicles of roadside units."""

    @staticmethod
    def of(heard: Heard, frames: Frames, n_vehicles: int) -> "Exchange":
        """From a round in which the radios of roadside units come behind those of `n_vehicles` vehicles."""
        if heard.receiver.max(initial=-1) < n_vehicles and heard.sender.max(initial=-1) < n_vehicles:
            nobody = heard.take(np.zeros(0, np.int64))
            return Exchange(heard, frames, nobody, nobody)
        hears, says = heard.receiver < n_vehicles, heard.sender < n_vehicles
        up, down = heard.take(~hears & says), heard.take(hears & ~says)
        return Exchange(
            heard.take(hears & says), frames, replace(up, receiver=up.receiver - n_vehicles),
            replace(down, sender=down.sender - n_vehicles),
        )  # fmt: skip


def heard_of(
    receiver: Int[ndarray, "m"], sender: Int[ndarray, "m"], hops: Int[ndarray, "m"], generated_s: Float[ndarray, "m"],
    access_s: Float[ndarray, "m"], latency_s: Float[ndarray, "m"], xy_m: Float[ndarray, "n 2"],
) -> Heard:  # fmt: skip
    """Deliveries in canonical order."""
    order = by_two(receiver, sender, len(xy_m))
    receiver, sender = receiver[order], sender[order]
    distance_m = np.hypot(*(xy_m[receiver] - xy_m[sender]).T)
    return Heard(
        receiver, sender, hops[order].astype(np.int32), generated_s[order], access_s[order], latency_s[order],
        distance_m,
    )  # fmt: skip


def neighbours(xy_m: Float[ndarray, "n 2"], reach_m: float) -> tuple[ndarray, ndarray, ndarray]:
    """All ordered pairs within reach: sender, receiver, distance [m]; sorted by sender, then receiver."""
    return both_ways(len(xy_m), *within(np.column_stack([xy_m, np.zeros(len(xy_m))]), reach_m))


@njit(cache=True)
def both_ways(n, a, b, length_m):
    """Each pair in both directions, sorted by counting: by the one end, then by the other."""
    at = np.zeros(n + 1, np.int64)
    for m in range(len(a)):
        at[a[m] + 1] += 1
        at[b[m] + 1] += 1
    for i in range(n):
        at[i + 1] += at[i]
    put = at[:-1].copy()
    from_, of = np.empty(2 * len(a), np.int32), np.empty(2 * len(a), np.int32)  # by receiver only
    for m in range(len(a)):
        for one, other in ((a[m], b[m]), (b[m], a[m])):
            from_[put[one]], of[put[one]] = other, m
            put[one] += 1
    put = at[:-1].copy()
    sender, receiver = np.empty(len(of), np.int64), np.empty(len(of), np.int64)
    apart_m = np.empty(len(of))
    for to in range(n):
        for row in range(at[to], at[to + 1]):
            k = put[from_[row]]
            sender[k], receiver[k], apart_m[k] = from_[row], to, length_m[of[row]]
            put[from_[row]] += 1
    return sender, receiver, apart_m


def by_two(first: Int[ndarray, "m"], second: Int[ndarray, "m"], n: int) -> Int[ndarray, "m"]:
    """Order of rows by the one, then by the other column; both hold numbers from 0 to n - 1."""
    order = counted(np.asarray(second, np.int64), n)
    return order[counted(np.asarray(first, np.int64)[order], n)]


@njit(cache=True)
def counted(value, n):
    """Stable order of rows by counting."""
    at = np.zeros(n + 1, np.int64)
    for v in value:
        at[v + 1] += 1
    for i in range(n):
        at[i + 1] += at[i]
    order = np.empty(len(value), np.int64)
    for row in range(len(value)):
        order[at[value[row]]] = row
        at[value[row]] += 1
    return order
