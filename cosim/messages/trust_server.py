"""Links between vehicles and the trust server: uplink of evaluations and downlink of trust values."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim.base import rng
from cosim.base.ragged import owner_of_rows, place_in_group
from cosim.messages import cellular
from cosim.messages.cellular import CellularParams, transfer_delay_s, within_capacity
from cosim.messages.content import report_bytes, trust_broadcast_bytes
from trust.tables import SERVER, EvaluationMessages, TrustScores

KEPT_S = 60.0
"""A vehicle that is off the road for longer has forgotten the trust values that it had received [s]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ServerParams:
    """Links to the trust server, and its outages."""

    uplink: Literal["cellular", "rsu"] = "cellular"
    """Link for evaluations to the server and for trust values back: `cellular`, or `rsu` for roadside units in
    range."""
    backhaul_s: Annotated[float, Ge(0), Le(1e6)] = 0.01
    """Delay between a roadside unit and the server, either way [s]."""
    outages: tuple[tuple[float, float], ...] = ()
    """Recorded times [start, end) in which the server is unreachable [s]. No messages are sent to or from it.
    A broadcast that is due follows at the end, and the next one `trust.server_period_s` later."""
    cellular: CellularParams = field(default_factory=CellularParams)

    def __post_init__(self) -> None:
        for i, (start, end) in enumerate(self.outages):
            if not 0 <= start < end <= 1e9:
                raise ValueError(
                    f"server.outages[{i}] = [{start:g}, {end:g}] s is no span of time. "
                    "Give [start, end] in recorded seconds, 0 <= start < end."
                )

    def is_out(self, time_s: Float[ndarray, "..."] | float) -> Bool[ndarray, "..."]:
        """Whether the server is unreachable at these recorded times."""
        time_s = np.asarray(time_s)
        out = np.zeros(time_s.shape, bool)
        for start, end in self.outages:
            out |= (time_s >= start - 1e-9) & (time_s < end - 1e-9)  # 3 * 0.3 is below 0.9
        return out


@dataclass(frozen=True, slots=True)
class LinkStats:
    """Counts of one step's reports to the server."""

    n_reports: int = 0
    """Reports with at least one evaluation."""
    n_reached: int = 0
    """Number of these that reach the server, now or later."""
    n_lost: int = 0
    """Number of these that were lost on the way, or that no roadside unit received in this step."""
    n_late: int = 0
    """Reports of earlier steps, which counted as lost there, that reach the server now."""
    n_over_capacity: int = 0
    n_outage: int = 0
    uplink_bytes: int = 0
    """Bytes of all reports on the cellular link."""

    def plus_late(self, late: "LinkStats") -> "LinkStats":
        """With reports that reach the server only now; the step in which they were sent counted them as lost."""
        return replace(self, n_late=late.n_reached)


class SentReports(NamedTuple):
    """Reports of V evaluators to the server."""

    used: EvaluationMessages
    """What the server uses of each report."""
    n_sent: Int[ndarray, "v"]
    """Evaluations in each report."""


class ReportsUnderWay(NamedTuple):
    """Reports to the server that were sent at one time."""

    arrival_s: Float[ndarray, "v"]
    """When each arrives."""
    messages: EvaluationMessages


@dataclass(frozen=True, slots=True)
class UplinkState:
    """Reports that are on their way to the server."""

    under_way: tuple[ReportsUnderWay, ...] = ()


@dataclass(frozen=True, slots=True)
class Uplink:
    """The link from vehicles to the server."""

    params: ServerParams
    seed: int
    interval_s: float
    """Time between two steps in which vehicles sense [s]."""

    def by_cellular(
        self,
        state: UplinkState,
        reports: SentReports,
        name_key: UInt64[ndarray, "v"],
        xy_m: Float[ndarray, "v 2"],
        time_s: float,
        is_valid: Bool[ndarray, "v"] | None = None,
        n_copies: Int[ndarray, "v"] | None = None,
    ) -> tuple[UplinkState, LinkStats]:
        """Send each evaluator's report over the cellular network.

        Parameters
        ----------
        reports
            The reports. The other arrays are aligned with them.
        name_key
            Keys of the evaluators for random draws, as `Senders.key`.
        xy_m
            Their positions.
        time_s
            Time at which the reports are sent.
        is_valid
            Reports that are not valid do not arrive. All are valid if it is not given.
        n_copies
            Further copies of each report. They use capacity of the cell and have no other effect.

        Returns
        -------
        The new state, and counts of the reports.
        """
        p, n = self.params.cellular, reports.n_sent
        key = rng.key(self.seed, rng.Stream.UPLINK, reports.used.step)
        length = np.where(n > 0, report_bytes(n) + cellular.HEADER_BYTES, 0)
        delay_s = transfer_delay_s(key, name_key, p.uplink_loss_p, p.n_retries, p)
        if is_valid is not None:
            delay_s[~is_valid] = np.inf
        keys, sent, place = rng.keys(key, name_key), length, xy_m
        if n_copies is not None and n_copies.any():
            of = owner_of_rows(np.where(length > 0, n_copies, 0))
            of_copies = rng.keys(key, name_key[of], 1 + place_in_group(of))
            keys = np.concatenate([keys, of_copies])
            sent = np.concatenate([length, length[of]])
            place = np.concatenate([xy_m, xy_m[of]])
        budget_bytes = p.cell_up_bytes_per_s * self.interval_s
        taken = within_capacity(place, sent, keys, budget_bytes, p.cell_m)[: len(n)]
        out = np.full(len(n), bool(self.params.is_out(time_s)))
        refused = ~taken & ~out
        return self._send(state, reports, time_s + delay_s, refused, out, int(sent.sum()))

    def by_rsu(
        self,
        state: UplinkState,
        reports: SentReports,
        message: Int[ndarray, "m"],
        received_s: Float[ndarray, "m"],
    ) -> tuple[UplinkState, LinkStats]:
        """Forward messages that roadside units received.

        Parameters
        ----------
        message
            Row of `reports` for each reception.
        received_s
            Time of each reception.
        """
        arrival = np.full(len(reports.n_sent), np.inf)
        np.minimum.at(arrival, message, received_s + self.params.backhaul_s)
        nothing = np.zeros(len(arrival), bool)
        return self._send(state, reports, arrival, nothing, nothing, 0)

    def _send(
        self,
        state: UplinkState,
        reports: SentReports,
        arrival_s: ndarray,
        refused: ndarray,
        out: ndarray,
        uplink_bytes: int,
    ) -> tuple[UplinkState, LinkStats]:
        says = reports.n_sent > 0
        out = out | self.params.is_out(arrival_s)
        arrives = says & ~refused & ~out & np.isfinite(arrival_s)
        n_says, n_arrives = int(says.sum()), int(arrives.sum())
        n_refused = int((says & refused).sum())
        n_out = int((says & ~refused & out).sum())
        n_lost = n_says - n_arrives - n_refused - n_out
        stats = LinkStats(n_says, n_arrives, n_lost, 0, n_refused, n_out, uplink_bytes)
        if not arrives.any():
            return state, stats
        sent = ReportsUnderWay(arrival_s[arrives], chosen_messages(reports.used, arrives))
        return UplinkState((*state.under_way, sent)), stats

    def arrived(self, state: UplinkState, time_s: float) -> tuple[UplinkState, list[EvaluationMessages]]:
        """The new state, and the reports that have reached the server by `time_s`, older steps first."""
        here, later = [], []
        for sent in state.under_way:
            due = sent.arrival_s <= time_s
            if due.any():
                here.append(chosen_messages(sent.messages, due))
            if not due.all():  # only these are kept: a slow report would keep those of a whole city
                later.append(ReportsUnderWay(sent.arrival_s[~due], chosen_messages(sent.messages, ~due)))
        return UplinkState(tuple(later)), here


def chosen_messages(messages: EvaluationMessages, chosen: Bool[ndarray, "v"]) -> EvaluationMessages:
    """The messages of the chosen evaluators."""
    return messages if chosen.all() else messages.taken(np.flatnonzero(chosen))


@dataclass(frozen=True, slots=True)
class TrustBroadcast:
    """Trust values that the server sent at one time."""

    time_s: float
    """When the server computed them [s]."""
    scores: TrustScores
    """By subject of trust (`Linkage.subjects`)."""


class BroadcastUnderWay(NamedTuple):
    """A broadcast on its way to vehicles."""

    arrival_s: Float[ndarray, "r"]
    """When it reaches each."""
    vehicle: Int[ndarray, "r"]
    """Actor numbers."""
    number: int
    """Number of the broadcast."""


@dataclass(frozen=True, slots=True)
class DownlinkState:
    """The last broadcast that each vehicle received, and broadcasts that are on their way."""

    broadcasts: dict[int, TrustBroadcast] = field(default_factory=dict)
    """Broadcasts by number, the step in which they were computed. Only those that a vehicle has or will get are
    kept."""
    last: Int[ndarray, "capacity"] = field(default_factory=lambda: np.full(0, -1))
    """Number of the newest broadcast that each vehicle has received, by actor number; -1 for none."""
    seen_s: Float[ndarray, "capacity"] = field(default_factory=lambda: np.full(0, -np.inf))
    """When each vehicle was last on the road [s], by actor number."""
    under_way: tuple[BroadcastUnderWay, ...] = ()
    pending_rsu: tuple[tuple[float, int], ...] = ()
    """Broadcasts that the roadside units have not sent: when they get each of them, and its number."""
    on_air: tuple["AiredBroadcast", ...] = ()
    """The latest broadcasts that the roadside units sent, newest last. Others do not arrive any more."""


class AiredBroadcast(NamedTuple):
    """A broadcast that roadside units sent."""

    step: int
    """When they sent it."""
    begin_s: float
    """Begin of the round in which they sent it [s]."""
    number: int
    """Number of the broadcast."""


@dataclass(frozen=True, slots=True)
class Downlink:
    """The link from the server to vehicles."""

    params: ServerParams
    seed: int
    late_s: float = 0.0
    """How long after the begin of its round a broadcast of roadside units may still arrive [s]."""

    def publish(
        self,
        state: DownlinkState,
        broadcast: TrustBroadcast,
        step: int,
        vehicle: Int[ndarray, "r"],
        delay_s: Float[ndarray, "r"],
    ) -> tuple[DownlinkState, int]:
        """Send a broadcast to all equipped vehicles.

        The cellular network sends it at once. Roadside units send it in one of their next rounds.

        Parameters
        ----------
        vehicle
            Actor numbers of the equipped vehicles.
        delay_s
            Delay to each vehicle in the cellular network, from `delays_s`.

        Returns
        -------
        The new state, and the number of vehicles that it will reach by cellular.
        """
        p = self.params.cellular
        broadcasts = state.broadcasts | {step: broadcast}
        if self.params.uplink == "rsu":
            pending = (*state.pending_rsu, (broadcast.time_s + self.params.backhaul_s, step))
            return replace(state, broadcasts=broadcasts, pending_rsu=pending), 0
        if trust_broadcast_bytes(len(broadcast.scores.subject)) + cellular.HEADER_BYTES > p.cell_down_bytes_per_s:
            delay_s = np.full(len(vehicle), np.inf)  # one copy per cell exceeds the capacity of a second
        arrival_s = broadcast.time_s + delay_s
        arrives = np.isfinite(arrival_s) & ~self.params.is_out(arrival_s)
        coming = (*state.under_way, BroadcastUnderWay(arrival_s[arrives], vehicle[arrives], step))
        return replace(state, broadcasts=broadcasts, under_way=coming), int(arrives.sum())

    def delays_s(self, step: int, name_key: UInt64[ndarray, "r"]) -> Float[ndarray, "r"]:
        """Delay of this step's cellular broadcast to each vehicle [s], by the key of its name; inf if it is lost."""
        p = self.params.cellular
        return transfer_delay_s(rng.key(self.seed, rng.Stream.DOWNLINK, step), name_key, p.downlink_loss_p, 0, p)

    def pending_rsu_broadcast(
        self, state: DownlinkState, step: int, time_s: float
    ) -> tuple[DownlinkState, TrustBroadcast | None]:
        """The broadcast that roadside units send in the round of a step that begins at `time_s`: the newest they have.

        Each is returned once. Those that reach the units while the server is unreachable are lost.
        """
        due = [one for one in state.pending_rsu if one[0] <= time_s]
        if not due:
            return state, None
        later = state.pending_rsu[len(due) :]  # in the order of their times
        had = [number for arrival_s, number in due if not self.params.is_out(arrival_s)]
        if not had:
            return replace(state, pending_rsu=later), None
        number = max(had)
        oldest_s = time_s - self.late_s
        before = [one for one in state.on_air if one.begin_s >= oldest_s]
        on_air = (*before, AiredBroadcast(step, time_s, number))
        return replace(state, pending_rsu=later, on_air=on_air), state.broadcasts[number]

    def receive_from_rsu(
        self,
        state: DownlinkState,
        vehicle: Int[ndarray, "r"],
        receiver: Int[ndarray, "m"],
        sent_step: Int[ndarray, "m"],
        received_s: Float[ndarray, "m"],
    ) -> tuple[DownlinkState, int]:
        """Record which vehicles received broadcasts of roadside units.

        Parameters
        ----------
        vehicle
            Actor numbers of the equipped vehicles.
        receiver
            Row of `vehicle` for each reception.
        sent_step
            Step in which the units sent what was received.
        received_s
            Time of each reception, from the begin of that round.

        Returns
        -------
        The new state, and the number of vehicles that received a broadcast and had neither it nor a newer one.
        """
        coming, n_informed = list(state.under_way), 0
        for sent in state.on_air:
            of_this = sent_step == sent.step
            first_s = np.full(len(vehicle), np.inf)
            np.minimum.at(first_s, receiver[of_this], sent.begin_s + received_s[of_this])
            got = np.isfinite(first_s) & ~_informed(state, vehicle, sent.number)
            n_informed += int(got.sum())
            coming.append(BroadcastUnderWay(first_s[got], vehicle[got], sent.number))
        return replace(state, under_way=tuple(coming)), n_informed

    def receive(self, state: DownlinkState, present: Int[ndarray, "m"], time_s: float) -> DownlinkState:
        """Deliver the broadcasts that have arrived by `time_s`, and drop those that no vehicle keeps.

        Parameters
        ----------
        present
            Actor numbers of the equipped vehicles on the road, ascending.

        Notes
        -----
        A vehicle that leaves the road and returns keeps what it had received, for up to `KEPT_S`.
        """
        size = int(present[-1]) + 1 if len(present) else 0
        last = _grown(state.last, size, -1)
        seen_s = _grown(state.seen_s, size, -np.inf)
        last[time_s - seen_s > KEPT_S] = -1
        seen_s[present] = time_s
        waiting = []
        for sent in state.under_way:
            here = sent.arrival_s <= time_s
            informed = sent.vehicle[here]
            last[informed] = np.maximum(last[informed], sent.number)
            if not here.all():
                waiting.append(BroadcastUnderWay(sent.arrival_s[~here], sent.vehicle[~here], sent.number))
        in_use = set(last[last >= 0].tolist())
        in_use.update(sent.number for sent in waiting)
        in_use.update(number for _, number in state.pending_rsu)
        in_use.update(sent.number for sent in state.on_air)
        broadcasts = {n: b for n, b in state.broadcasts.items() if n in in_use}
        return replace(state, broadcasts=broadcasts, last=last, seen_s=seen_s, under_way=tuple(waiting))

    def lookup(
        self, state: DownlinkState, vehicle: Int[ndarray, "n"], subject: Int[ndarray, "n"]
    ) -> Iterator[tuple[TrustBroadcast, Int[ndarray, "k"], Int[ndarray, "k"]]]:
        """Trust values about subjects in the newest broadcast that each vehicle has received.

        Parameters
        ----------
        vehicle
            Actor number of the vehicle that looks up each subject.
        subject
            Subject of trust (`Linkage.subjects`) of each look-up.

        Yields
        ------
        Every broadcast in use; the look-ups that it answers, because it is the vehicle's newest one and has a value of
        the subject; and the row of its scores for each of them.
        """
        newest = np.full(len(vehicle), -1)
        listens = vehicle < len(state.last)
        newest[listens] = state.last[vehicle[listens]]
        for number, broadcast in state.broadcasts.items():
            rows = np.flatnonzero(newest == number)
            holder = np.full(len(rows), SERVER)
            at, known = broadcast.scores.rows_of(holder, subject[rows])
            yield broadcast, rows[known], at[known]


def _grown(values: ndarray, size: int, empty: float) -> ndarray:
    """A copy of an array by actor number, with room for `size` of them."""
    if size <= len(values):
        return values.copy()
    more = max(size, 2 * len(values), 64) - len(values)
    return np.concatenate([values, np.full(more, empty, values.dtype)])


def _informed(state: DownlinkState, vehicle: Int[ndarray, "r"], number: int) -> Bool[ndarray, "r"]:
    """Whether this broadcast or a newer one has reached each vehicle, or is on its way to it."""
    known = vehicle < len(state.last)
    found = np.zeros(len(vehicle), bool)
    found[known] = state.last[vehicle[known]] >= number
    for sent in state.under_way:
        if sent.number >= number:
            found |= np.isin(vehicle, sent.vehicle)
    return found
