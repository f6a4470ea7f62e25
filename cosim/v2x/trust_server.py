"""Links of the trust server: evaluations in the uplink, trust values in the downlink, with delay, loss and outages.

Uplink and downlink are part of the state of a run: plain arrays that can be copied and pickled.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.radio.message_round import Receptions
from cosim.ragged import expand
from cosim.v2x import cellular
from cosim.v2x.cellular import CellularParams, transfer_delay_s, within_capacity
from cosim.v2x.messages import report_bytes, trust_broadcast_bytes
from trust.tables import Told


@dataclass(frozen=True, kw_only=True, slots=True)
class ServerParams:
    """Links of the trust server and its outages."""

    uplink: Literal["cellular", "rsu"] = "cellular"
    """Link of evaluations to the server and of trust values back: cellular, or through roadside units in range."""
    backhaul_s: Annotated[float, Ge(0)] = 0.01
    """Delay between a roadside unit and the server, either way [s]."""
    outages: tuple[tuple[float, float], ...] = ()
    """Recorded times [start, end) of outages: nothing is sent or received by the server [s]."""
    cellular: CellularParams = field(default_factory=CellularParams)

    def __post_init__(self) -> None:
        for i, (start, end) in enumerate(self.outages):
            if not 0 <= start < end:
                raise ValueError(
                    f"server.outages[{i}] = [{start:g}, {end:g}] s is not an interval of time. "
                    "Give [start, end] in recorded seconds, 0 <= start < end."
                )

    def is_out(self, time_s: Float[ndarray, "..."] | float) -> Bool[ndarray, "..."]:
        """Whether these times lie in an outage."""
        time_s = np.asarray(time_s)
        out = np.zeros(time_s.shape, bool)
        for start, end in self.outages:
            out |= (time_s >= start) & (time_s < end)
        return out


@dataclass(frozen=True, slots=True)
class LinkStats:
    """Reports of one step in the uplink."""

    n_reports: int = 0
    """Reports with at least one evaluation."""
    n_reached: int = 0
    """Of these, those that reach the server, now or later."""
    n_lost: int = 0
    """Of these, those lost on the link, or received by no roadside unit."""
    n_over_capacity: int = 0
    n_outage: int = 0
    uplink_bytes: int = 0
    """Of all reports, where the link is cellular."""


@dataclass(frozen=True, slots=True)
class BroadcastStats:
    """Vehicles and one broadcast of trust values."""

    n_addressed: int = 0
    """Vehicles that the broadcast is meant for."""
    n_informed: int = 0
    """Of these, those that receive it, now or later."""


@dataclass(slots=True)
class Uplink:
    """Reports of evaluations on their way to the server."""

    params: ServerParams
    seed: int
    interval_s: float
    """Time between two steps [s]."""
    _under_way: list[tuple[Float[ndarray, "v"], Told]] = field(default_factory=list)

    def send_cellular(
        self, told: Told, key: UInt64[ndarray, "v"], xy_m: Float[ndarray, "v 2"], time_s: float
    ) -> LinkStats:
        """Every evaluator sends its report at `time_s`; the other arguments are aligned with the evaluators."""
        p, n = self.params.cellular, np.diff(told.ptr)
        rng_key = rng.key(self.seed, rng.Stream.UPLINK, told.step)
        length = np.where(n > 0, report_bytes(n) + cellular.HEADER_BYTES, 0)
        delay_s = transfer_delay_s(rng_key, key, p.uplink_loss_p, p.n_retries, p)
        taken = within_capacity(xy_m, length, rng.keys(rng_key, key), p.cell_up_bytes_per_s * self.interval_s, p.cell_m)
        out = np.full(len(n), bool(self.params.is_out(time_s)))
        return self._send(told, time_s + delay_s, ~taken & ~out, out, int(length.sum()))

    def send_rsu(self, told: Told, message: Int[ndarray, "m"], uplink: Receptions, begin_s: float) -> LinkStats:
        """Receptions of roadside units in a round that began at `begin_s`; `message` is the row of each in `told`."""
        arrival = np.full(len(told.evaluator), np.inf)
        np.minimum.at(arrival, message, begin_s + uplink.received_s + self.params.backhaul_s)
        nothing = np.zeros(len(arrival), bool)
        return self._send(told, arrival, nothing, nothing, 0)

    def _send(self, told: Told, arrival_s: ndarray, refused: ndarray, out: ndarray, n_bytes: int) -> LinkStats:
        sends = np.diff(told.ptr) > 0
        out = out | self.params.is_out(arrival_s)
        arrives = sends & ~refused & ~out & np.isfinite(arrival_s)
        n = [int(np.sum(x)) for x in (sends, arrives, sends & refused, sends & ~refused & out)]
        if arrives.any():
            self._under_way.append((arrival_s[arrives], messages_of(told, arrives)))
        return LinkStats(n[0], n[1], n[0] - n[1] - n[2] - n[3], n[2], n[3], n_bytes)

    def arrived(self, time_s: float) -> list[Told]:
        """Reports that have reached the server by `time_s`, older steps first; each is returned once."""
        here, later = [], []
        for arrival, told in self._under_way:
            due = arrival <= time_s
            if due.any():
                here.append(messages_of(told, due))
            if not due.all():
                later.append((arrival[~due], messages_of(told, ~due)))
        self._under_way = later
        return here


def messages_of(told: Told, chosen: Bool[ndarray, "v"]) -> Told:
    """The messages of the chosen evaluators."""
    rows, _ = expand(told.ptr[:-1][chosen], told.ptr[1:][chosen])
    ptr = np.concatenate([[0], np.cumsum(np.diff(told.ptr)[chosen])])
    return Told(told.step, told.evaluator[chosen], ptr, told.sender[rows], told.k[rows], told.e[rows], told.phi[rows])


@dataclass(frozen=True, slots=True)
class TrustBroadcast:
    """Trust values of all subjects as the server computed them at one time."""

    time_s: float
    subject: Int[ndarray, "n"]  # ascending
    trust: Float[ndarray, "n"]


@dataclass(slots=True)
class Downlink:
    """The last broadcast of trust values that each vehicle has received, however old."""

    params: ServerParams
    seed: int
    _broadcasts: dict[int, TrustBroadcast] = field(default_factory=dict)
    _last: Int[ndarray, "capacity"] = field(default_factory=lambda: np.full(1024, -1))
    """Number of the last broadcast received, by vehicle; negative for none."""
    _under_way: list[tuple[Float[ndarray, "r"], Int[ndarray, "r"], int]] = field(default_factory=list)
    """Arrival, receiver and number of broadcasts not yet received."""
    _pending: tuple[float, int] | None = None
    """When the roadside units have the newest broadcast, and its number, until they have transmitted it."""
    _transmitted: int = -1
    """Number of the broadcast that the roadside units transmitted last."""

    def publish(
        self, broadcast: TrustBroadcast, step: int, receiver: Int[ndarray, "r"], key: UInt64[ndarray, "r"]
    ) -> BroadcastStats:
        """Send a broadcast to all equipped vehicles by cellular, or to the roadside units, which transmit it later."""
        p = self.params.cellular
        self._broadcasts[step] = broadcast
        if self.params.uplink == "rsu":
            self._pending = broadcast.time_s + self.params.backhaul_s, step
            return BroadcastStats()
        delay_s = transfer_delay_s(rng.key(self.seed, rng.Stream.DOWNLINK, step), key, p.downlink_loss_p, 0, p)
        if trust_broadcast_bytes(len(broadcast.subject)) + cellular.HEADER_BYTES > p.cell_down_bytes_per_s:
            delay_s = np.full(len(receiver), np.inf)  # one copy per cell does not fit into a second
        return self._send(broadcast.time_s + delay_s, receiver, step)

    def pending_rsu_broadcast(self, time_s: float) -> TrustBroadcast | None:
        """The broadcast that the roadside units transmit in a round that begins at `time_s`; each once."""
        if self._pending is None or self._pending[0] > time_s:
            return None
        arrival, self._transmitted = self._pending
        self._pending = None
        return None if self.params.is_out(arrival) else self._broadcasts.get(self._transmitted)

    def receive_from_rsu(
        self, receiver: Int[ndarray, "m"], downlink: Receptions, present: Int[ndarray, "r"], begin_s: float
    ) -> BroadcastStats:
        """Receptions of vehicles `receiver` from roadside units in a round that began at `begin_s`."""
        first = np.full(len(present), np.inf)
        np.minimum.at(first, np.searchsorted(present, receiver), begin_s + downlink.received_s)
        return self._send(first, present, self._transmitted)

    def _send(self, arrival_s: ndarray, receiver: ndarray, number: int) -> BroadcastStats:
        arrives = np.isfinite(arrival_s)
        if self.params.uplink == "cellular":
            arrives &= ~self.params.is_out(arrival_s)
        self._under_way.append((arrival_s[arrives], receiver[arrives], number))
        return BroadcastStats(len(receiver), int(arrives.sum()))

    def lookup(
        self, receiver: Int[ndarray, "n"], subject: Int[ndarray, "n"], time_s: float
    ) -> tuple[Float[ndarray, "n"], Bool[ndarray, "n"], Float[ndarray, "n"]]:
        """Trust of each subject as its receiver knows it at `time_s`; changes nothing.

        Returns
        -------
        Trust, whether it is known at all, and its age since the server computed it [s]; row by row.
        """
        value, age_s = np.zeros(len(receiver)), np.zeros(len(receiver))
        is_known = np.zeros(len(receiver), bool)
        number_of = self._received(int(receiver.max(initial=-1)) + 1, time_s)[receiver]
        for number, broadcast in self._broadcasts.items():
            rows = np.flatnonzero(number_of == number)
            at = np.searchsorted(broadcast.subject, subject[rows])
            at[at == len(broadcast.subject)] = 0
            found = broadcast.subject[at] == subject[rows] if len(broadcast.subject) else np.zeros(len(rows), bool)
            rows, at = rows[found], at[found]
            value[rows], is_known[rows], age_s[rows] = broadcast.trust[at], True, time_s - broadcast.time_s
        return value, is_known, age_s

    def expire(self, present: Int[ndarray, "m"], time_s: float) -> None:
        """Drop the broadcasts that no vehicle in `present` (ascending) uses from `time_s` on."""
        self._last = self._received(int(present.max(initial=-1)) + 1, time_s)
        self._under_way = [
            (arrival[later], receiver[later], number) for arrival, receiver, number in self._under_way
            if (later := arrival > time_s).any()
        ]  # fmt: skip
        in_use = set(np.unique(self._last[present])) | {number for _, _, number in self._under_way}
        if self._pending is not None:
            in_use.add(self._pending[1])
        self._broadcasts = {n: b for n, b in self._broadcasts.items() if n in in_use}

    def _received(self, n: int, time_s: float) -> Int[ndarray, "capacity"]:
        """Number of the last broadcast received by `time_s`, for at least `n` vehicles."""
        under_way = [arrival <= time_s for arrival, _, _ in self._under_way]
        n = max([n, *(int(who.max(initial=-1)) + 1 for _, who, _ in self._under_way)])
        capacity = len(self._last)
        while capacity < n:
            capacity *= 2
        last = np.concatenate([self._last, np.full(capacity - len(self._last), -1)])
        for due, (_, receiver, number) in zip(under_way, self._under_way, strict=True):
            last[receiver[due]] = np.maximum(last[receiver[due]], number)
        return last
