"""The links between vehicles and the trust server: evaluations up, trust values down, with delay, loss and outages."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.ragged import offsets
from cosim.v2x import cellular
from cosim.v2x.cellular import CellularParams, transfer_delay_s, within_capacity
from cosim.v2x.lookup_kernels import rows_heard
from cosim.v2x.messages import report_bytes, trust_broadcast_bytes
from trust.tables import EvaluationMessages, TrustScores


@dataclass(frozen=True, kw_only=True, slots=True)
class ServerParams:
    """How the trust server is reached, and when it is not."""

    uplink: Literal["cellular", "rsu"] = "cellular"
    """Way of evaluations to the server, and of trust values back: cellular, or through roadside units in range."""
    backhaul_s: Annotated[float, Ge(0), Le(1e6)] = 0.01
    """Delay between a roadside unit and the server, either way [s]."""
    outages: tuple[tuple[float, float], ...] = ()
    """Recorded times [start, end) in which the server is unreachable: nothing goes up or down [s]."""
    cellular: CellularParams = field(default_factory=CellularParams)

    def __post_init__(self) -> None:
        for i, (start, end) in enumerate(self.outages):
            if not 0 <= start < end <= 1e9:
                raise ValueError(
                    f"server.outages[{i}] = [{start:g}, {end:g}] s is no span of time. "
                    "Give [start, end] in recorded seconds, 0 <= start < end."
                )

    def is_out(self, time_s: Float[ndarray, "..."] | float) -> Bool[ndarray, "..."]:
        """Whether the server is unreachable at these times."""
        time_s = np.asarray(time_s)
        out = np.zeros(time_s.shape, bool)
        for start, end in self.outages:
            out |= (time_s >= start) & (time_s < end)
        return out


@dataclass(frozen=True, slots=True)
class LinkStats:
    """What became of one step's reports to the server."""

    n_reports: int = 0
    """Reports with at least one evaluation."""
    n_reached: int = 0
    """Of these, those that reach the server, now or later."""
    n_lost: int = 0
    """Of these, those lost on the way, or received by no roadside unit."""
    n_over_capacity: int = 0
    n_outage: int = 0
    uplink_bytes: int = 0
    """Of all reports, where they go by cellular."""


@dataclass(frozen=True, slots=True)
class UplinkState:
    """Reports under way to the server."""

    under_way: tuple[tuple[Float[ndarray, "v"], EvaluationMessages], ...] = ()
    """Arrival of each message [s], and the messages."""


@dataclass(frozen=True, slots=True)
class Uplink:
    """From vehicles to the server."""

    params: ServerParams
    seed: int
    interval_s: float
    """Time between two steps in which vehicles sense [s]."""

    def by_cellular(
        self, state: UplinkState, messages: EvaluationMessages, name_key: UInt64[ndarray, "v"],
        xy_m: Float[ndarray, "v 2"], time_s: float, is_valid: Bool[ndarray, "v"] | None = None,
        n_copies: Int[ndarray, "v"] | None = None,
    ) -> tuple[UplinkState, LinkStats]:  # fmt: skip
        """Each evaluator's report leaves at `time_s`; the other arguments are aligned with the messages.

        Reports that are not valid do not arrive; further copies of a report take capacity of the cell, and no more.
        """
        p, n = self.params.cellular, np.diff(messages.ptr)
        key = rng.key(self.seed, rng.Stream.UPLINK, messages.step)
        length = np.where(n > 0, report_bytes(n) + cellular.HEADER_BYTES, 0)
        delay_s = transfer_delay_s(key, name_key, p.uplink_loss_p, p.n_retries, p)
        if is_valid is not None:
            delay_s[~is_valid] = np.inf
        keys, sent, place = rng.keys(key, name_key), length, xy_m
        if n_copies is not None and n_copies.any():
            of = np.repeat(np.arange(len(n)), np.where(length > 0, n_copies, 0))
            number = np.arange(len(of)) - np.searchsorted(of, of)
            keys = np.concatenate([keys, rng.keys(key, name_key[of], 1 + number)])
            sent, place = np.concatenate([length, length[of]]), np.concatenate([xy_m, xy_m[of]])
        taken = within_capacity(place, sent, keys, p.cell_up_bytes_per_s * self.interval_s, p.cell_m)[: len(n)]
        out = np.full(len(n), bool(self.params.is_out(time_s)))
        return self._send(state, messages, time_s + delay_s, ~taken & ~out, out, int(sent.sum()))

    def by_rsu(
        self, state: UplinkState, messages: EvaluationMessages, message: Int[ndarray, "m"],
        received_s: Float[ndarray, "m"],
    ) -> tuple[UplinkState, LinkStats]:  # fmt: skip
        """Roadside units received these messages, rows of `messages`, at these times, and pass them on."""
        arrival = np.full(len(messages.evaluator), np.inf)
        np.minimum.at(arrival, message, received_s + self.params.backhaul_s)
        nothing = np.zeros(len(arrival), bool)
        return self._send(state, messages, arrival, nothing, nothing, 0)

    def _send(
        self, state: UplinkState, messages: EvaluationMessages, arrival_s: ndarray, refused: ndarray, out: ndarray,
        uplink_bytes: int,
    ) -> tuple[UplinkState, LinkStats]:  # fmt: skip
        says = np.diff(messages.ptr) > 0
        out = out | self.params.is_out(arrival_s)
        arrives = says & ~refused & ~out & np.isfinite(arrival_s)
        n = [int(np.sum(x)) for x in (says, arrives, says & refused, says & ~refused & out)]
        stats = LinkStats(n[0], n[1], n[0] - n[1] - n[2] - n[3], n[2], n[3], uplink_bytes)
        if not arrives.any():
            return state, stats
        return UplinkState((*state.under_way, (arrival_s[arrives], chosen_messages(messages, arrives)))), stats

    def arrived(self, state: UplinkState, time_s: float) -> tuple[UplinkState, list[EvaluationMessages]]:
        """Reports that have reached the server by `time_s`, older steps first."""
        here, later = [], []
        for arrival, messages in state.under_way:
            due = arrival <= time_s
            if due.any():
                here.append(chosen_messages(messages, due))
            if not due.all():
                later.append((arrival[~due], chosen_messages(messages, ~due)))
        return UplinkState(tuple(later)), here


def chosen_messages(messages: EvaluationMessages, chosen: Bool[ndarray, "v"]) -> EvaluationMessages:
    """Only the chosen evaluators' messages."""
    if chosen.all():
        return messages
    n = np.diff(messages.ptr)
    rows = np.flatnonzero(np.repeat(chosen, n))
    ptr = offsets(n[chosen])
    return EvaluationMessages(
        messages.step, messages.evaluator[chosen], ptr, messages.observer[rows], messages.detection_index[rows],
        messages.evaluation[rows], messages.visibility[rows],
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class TrustBroadcast:
    """Trust values as the server sent them at one time."""

    time_s: float
    """When the server computed them [s]."""
    scores: TrustScores
    """By subject, a pseudonym."""


@dataclass(frozen=True, slots=True)
class DownlinkState:
    """Which broadcast each vehicle received last, and what is under way."""

    broadcasts: dict[int, TrustBroadcast] = field(default_factory=dict)
    """By number: the step in which it was computed; those that somebody has or will have."""
    last: Int[ndarray, "capacity"] = field(default_factory=lambda: np.full(0, -1))
    """Number of the newest broadcast that each vehicle has received, by actor number; -1 for none."""
    under_way: tuple[tuple[Float[ndarray, "r"], Int[ndarray, "r"], int], ...] = ()
    """Arrival, vehicle and number."""
    pending_rsu: tuple[float, int] | None = None
    """When the roadside units have the newest broadcast, and its number, while they have not sent it."""
    on_air: int = -1
    """Number of the broadcast that the roadside units sent last."""


@dataclass(frozen=True, slots=True)
class Downlink:
    """From the server to vehicles."""

    params: ServerParams
    seed: int

    def publish(
        self, state: DownlinkState, broadcast: TrustBroadcast, step: int, vehicle: Int[ndarray, "r"],
        delay_s: Float[ndarray, "r"],
    ) -> tuple[DownlinkState, int]:  # fmt: skip
        """Send to all equipped vehicles: by cellular at once, by roadside units in one of their next rounds.

        `delay_s`: by cellular, as `delays_s`.

        Returns
        -------
        The state, and how many vehicles it will reach by cellular.
        """
        p = self.params.cellular
        broadcasts = state.broadcasts | {step: broadcast}
        if self.params.uplink == "rsu":
            pending = broadcast.time_s + self.params.backhaul_s, step
            return DownlinkState(broadcasts, state.last, state.under_way, pending, state.on_air), 0
        if trust_broadcast_bytes(len(broadcast.scores.subject)) + cellular.HEADER_BYTES > p.cell_down_bytes_per_s:
            delay_s = np.full(len(vehicle), np.inf)  # one copy per cell, and not even that fits into a second
        arrival_s = broadcast.time_s + delay_s
        arrives = np.isfinite(arrival_s) & ~self.params.is_out(arrival_s)
        coming = (*state.under_way, (arrival_s[arrives], vehicle[arrives], step))
        return DownlinkState(broadcasts, state.last, coming, state.pending_rsu, state.on_air), int(arrives.sum())

    def delays_s(self, step: int, name_key: UInt64[ndarray, "r"]) -> Float[ndarray, "r"]:
        """What a cellular broadcast of this step takes to each vehicle [s]; inf where it is lost."""
        p = self.params.cellular
        return transfer_delay_s(rng.key(self.seed, rng.Stream.DOWNLINK, step), name_key, p.downlink_loss_p, 0, p)

    def pending_rsu_broadcast(self, state: DownlinkState, time_s: float) -> tuple[DownlinkState, TrustBroadcast | None]:
        """What roadside units send in a round that begins at `time_s`, once."""
        if state.pending_rsu is None or state.pending_rsu[0] > time_s:
            return state, None
        arrival, number = state.pending_rsu
        state = DownlinkState(state.broadcasts, state.last, state.under_way, None, number)
        return state, None if self.params.is_out(arrival) else state.broadcasts.get(number)

    def receive_from_rsu(
        self, state: DownlinkState, vehicle: Int[ndarray, "r"], receiver: Int[ndarray, "m"],
        received_s: Float[ndarray, "m"],
    ) -> tuple[DownlinkState, int]:  # fmt: skip
        """Vehicles received roadside units' broadcast: rows of `vehicle`, and when; and how many vehicles did."""
        first = np.full(len(vehicle), np.inf)
        np.minimum.at(first, receiver, received_s)
        got = np.isfinite(first)
        coming = (*state.under_way, (first[got], vehicle[got], state.on_air))
        return DownlinkState(state.broadcasts, state.last, coming, state.pending_rsu, state.on_air), int(got.sum())

    def receive(self, state: DownlinkState, present: Int[ndarray, "m"], time_s: float) -> DownlinkState:
        """What arrived by `time_s` is received; broadcasts that no vehicle on the road has are dropped with the next
        arrival. `present` is ascending."""
        last = state.last
        size = int(present[-1]) + 1 if len(present) else 0
        if not state.under_way and size <= len(last):
            return state
        if size > len(last):
            last = np.concatenate([last, np.full(max(size, 2 * len(last), 64) - len(last), -1)])
        else:
            last = last.copy()
        waiting = []
        for arrival, vehicle, number in state.under_way:
            here = arrival <= time_s
            last[vehicle[here]] = np.maximum(last[vehicle[here]], number)
            if not here.all():
                waiting.append((arrival[~here], vehicle[~here], number))
        in_use = set(last[present].tolist()) | {number for _, _, number in waiting}
        if state.pending_rsu is not None:
            in_use.add(state.pending_rsu[1])
        broadcasts = {n: b for n, b in state.broadcasts.items() if n in in_use}
        return DownlinkState(broadcasts, last, tuple(waiting), state.pending_rsu, state.on_air)

    def lookup(
        self, state: DownlinkState, vehicle: Int[ndarray, "n"], subject: Int[ndarray, "n"]
    ) -> Iterator[tuple[TrustBroadcast, Int[ndarray, "n"]]]:
        """What each vehicle knows about each subject: per broadcast, the row that answers; -1: none."""
        for number, broadcast in state.broadcasts.items():
            yield broadcast, rows_heard(state.last, vehicle, number, subject, broadcast.scores.subject)
