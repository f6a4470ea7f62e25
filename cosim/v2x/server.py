"""The way to the trust server and back: verdicts up, trust values down, each with delay, loss and outages."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.v2x import cellular
from cosim.v2x.cellular import CellularParams, journey_s, within_capacity
from cosim.v2x.exchange import Heard
from cosim.v2x.messages import expand, report_bytes, trust_bytes
from trust.tables import EvaluationMessages


@dataclass(frozen=True, kw_only=True, slots=True)
class ServerParams:
    """How the trust server is reached, and when it is not."""

    uplink: Literal["cellular", "rsu"] = "cellular"
    """Way of verdicts to the server, and of trust values back: cellular, or through the roadside units in reach."""
    backhaul_s: Annotated[float, Ge(0)] = 0.01
    """Delay between a roadside unit and the server, either way [s]."""
    outages: tuple[tuple[float, float], ...] = ()
    """Recorded times [start, end) in which the server is not there: nothing goes up or down [s]."""
    cellular: CellularParams = field(default_factory=CellularParams)

    def __post_init__(self) -> None:
        for i, (start, end) in enumerate(self.outages):
            if not 0 <= start < end:
                raise ValueError(
                    f"server.outages[{i}] = [{start:g}, {end:g}] s is no span of time. "
                    "Give [start, end] in recorded seconds, 0 <= start < end."
                )

    def is_out(self, time_s: Float[ndarray, "..."] | float) -> Bool[ndarray, "..."]:
        """Whether the server is away at these times."""
        time_s = np.asarray(time_s)
        out = np.zeros(time_s.shape, bool)
        for start, end in self.outages:
            out |= (time_s >= start) & (time_s < end)
        return out


@dataclass(frozen=True, slots=True)
class Traffic:
    """What became of one turn's messages between vehicles and server."""

    n_reports: int = 0
    """Reports with at least one verdict."""
    n_reached: int = 0
    """Of these, those that reach the server, now or later."""
    n_lost: int = 0
    """Of these, those lost on the way, or that no roadside unit hears."""
    n_over_capacity: int = 0
    n_outage: int = 0
    up_bytes: int = 0
    """Of all reports, where they go by cellular."""


@dataclass(slots=True)
class Uplink:
    """Reports of verdicts under way to the server."""

    params: ServerParams
    seed: int
    interval_s: float
    """Time between two turns [s]."""
    last: Traffic = field(default_factory=Traffic)
    """Of the last turn that sent."""
    _under_way: list[tuple[Float[ndarray, "v"], EvaluationMessages]] = field(default_factory=list)

    def by_cellular(
        self, told: EvaluationMessages, name_key: UInt64[ndarray, "v"], xy_m: Float[ndarray, "v 2"], time_s: float
    ) -> None:
        """Each evaluator's report leaves at `time_s`; the other arguments are aligned with the evaluators."""
        p, n = self.params.cellular, np.diff(told.ptr)
        chance = rng.key(self.seed, rng.Stream.UPLINK, told.step)
        length = np.where(n > 0, report_bytes(n) + cellular.HEADER_BYTES, 0)
        journey = journey_s(chance, name_key, p.uplink_loss_p, p.n_retries, p)
        taken = within_capacity(
            xy_m, length, rng.keys(chance, name_key), p.cell_up_bytes_per_s * self.interval_s, p.cell_m
        )
        out = np.full(len(n), bool(self.params.is_out(time_s)))
        self._send(told, time_s + journey, ~taken & ~out, out, int(length.sum()))

    def by_roadside(self, told: EvaluationMessages, message: Int[ndarray, "m"], up: Heard, begin_s: float) -> None:
        """Messages that roadside units heard in a round that began at `begin_s`; `message` names those of `up`."""
        arrival = np.full(len(told.evaluator), np.inf)
        np.minimum.at(arrival, message, begin_s + up.received_s + self.params.backhaul_s)
        nothing = np.zeros(len(arrival), bool)
        self._send(told, arrival, nothing, nothing, 0)

    def _send(
        self, told: EvaluationMessages, arrival_s: ndarray, refused: ndarray, out: ndarray, up_bytes: int
    ) -> None:
        says = np.diff(told.ptr) > 0
        out = out | self.params.is_out(arrival_s)
        arrives = says & ~refused & ~out & np.isfinite(arrival_s)
        n = [int(np.sum(x)) for x in (says, arrives, says & refused, says & ~refused & out)]
        self.last = Traffic(n[0], n[1], n[0] - n[1] - n[2] - n[3], n[2], n[3], up_bytes)
        if arrives.any():
            self._under_way.append((arrival_s[arrives], messages_of(told, arrives)))

    def arrived(self, time_s: float) -> list[EvaluationMessages]:
        """Reports that have reached the server by `time_s`, older steps first."""
        here, later = [], []
        for arrival, told in self._under_way:
            due = arrival <= time_s
            if due.any():
                here.append(messages_of(told, due))
            if not due.all():
                later.append((arrival[~due], messages_of(told, ~due)))
        self._under_way = later
        return here


def messages_of(told: EvaluationMessages, chosen: Bool[ndarray, "v"]) -> EvaluationMessages:
    """Only the chosen evaluators' messages."""
    rows, _ = expand(told.ptr[:-1][chosen], told.ptr[1:][chosen])
    ptr = np.concatenate([[0], np.cumsum(np.diff(told.ptr)[chosen])])
    return EvaluationMessages(
        told.step, told.evaluator[chosen], ptr,
        told.observer[rows], told.detection_index[rows], told.evaluation[rows], told.visibility[rows],
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Edition:
    """One broadcast of the server: what it thought of whom, and when."""

    time_s: float
    subject: Int[ndarray, "n"]  # ascending
    trust: Float[ndarray, "n"]


@dataclass(slots=True)
class Downlink:
    """Trust as each vehicle last heard it from the server, however old."""

    params: ServerParams
    seed: int
    n_addressed: int = 0
    """Vehicles that the last turn's broadcast was meant for; 0 where there was none."""
    n_informed: int = 0
    """Of these, those that it reaches, now or later."""
    _editions: dict[int, Edition] = field(default_factory=dict)
    _last: Int[ndarray, "capacity"] = field(default_factory=lambda: np.full(1024, -1))
    _coming: list[tuple[Float[ndarray, "r"], Int[ndarray, "r"], int]] = field(default_factory=list)
    _on_masts: tuple[float, int] | None = None
    """When the roadside units have the newest edition, and its number, while they have not broadcast it."""
    _on_air: int = -1
    """Number of the edition that the roadside units broadcast last."""

    def publish(self, edition: Edition, step: int, receiver: Int[ndarray, "r"], name_key: UInt64[ndarray, "r"]) -> None:
        """Send an edition to all equipped vehicles: by cellular it is on its way, by roadside units it is to come."""
        p = self.params.cellular
        self._editions[step] = edition
        if self.params.uplink == "rsu":
            self._on_masts = edition.time_s + self.params.backhaul_s, step
            return
        journey = journey_s(rng.key(self.seed, rng.Stream.DOWNLINK, step), name_key, p.downlink_loss_p, 0, p)
        if trust_bytes(len(edition.subject)) + cellular.HEADER_BYTES > p.cell_down_bytes_per_s:
            journey = np.full(len(receiver), np.inf)  # one copy per cell, and not even that fits into a second
        self._send(edition.time_s + journey, receiver, step)

    def on_masts(self, time_s: float) -> Edition | None:
        """What the roadside units have to broadcast in a round that begins at `time_s`, once."""
        if self._on_masts is None or self._on_masts[0] > time_s:
            return None
        arrival, self._on_air = self._on_masts
        self._on_masts = None
        return None if self.params.is_out(arrival) else self._editions.get(self._on_air)

    def overheard(self, receiver: Int[ndarray, "m"], down: Heard, present: Int[ndarray, "r"], begin_s: float) -> None:
        """Vehicles `receiver` heard roadside units in a round that began at `begin_s`; rows of `down`."""
        first = np.full(len(present), np.inf)
        np.minimum.at(first, np.searchsorted(present, receiver), begin_s + down.received_s)
        self._send(first, present, self._on_air)

    def _send(self, arrival_s: ndarray, receiver: ndarray, number: int) -> None:
        heard = np.isfinite(arrival_s)
        if self.params.uplink == "cellular":
            heard &= ~self.params.is_out(arrival_s)
        self.n_addressed, self.n_informed = len(receiver), int(heard.sum())
        self._coming.append((arrival_s[heard], receiver[heard], number))

    def known(
        self, receiver: Int[ndarray, "n"], subject: Int[ndarray, "n"], present: Int[ndarray, "m"], time_s: float
    ) -> tuple[Float[ndarray, "n"], Bool[ndarray, "n"], Float[ndarray, "n"]]:
        """What each receiver knows about each subject at `time_s`.

        Parameters
        ----------
        present
            Equipped vehicles on the road; the others' memory is of no more use and is dropped.

        Returns
        -------
        Trust, whether it is known at all, and its age since the server computed it [s]; row by row.
        """
        self._take_in(present, time_s)
        value, age_s = np.zeros(len(receiver)), np.zeros(len(receiver))
        is_known = np.zeros(len(receiver), bool)
        edition_of = self._last[receiver]
        for number, edition in self._editions.items():
            rows = np.flatnonzero(edition_of == number)
            at = np.searchsorted(edition.subject, subject[rows])
            at[at == len(edition.subject)] = 0
            found = edition.subject[at] == subject[rows] if len(edition.subject) else np.zeros(len(rows), bool)
            rows, at = rows[found], at[found]
            value[rows], is_known[rows], age_s[rows] = edition.trust[at], True, time_s - edition.time_s
        return value, is_known, age_s

    def _take_in(self, present: Int[ndarray, "m"], time_s: float) -> None:
        while len(present) and present[-1] >= len(self._last):
            self._last = np.concatenate([self._last, np.full(len(self._last), -1)])
        waiting = []
        for arrival, receiver, number in self._coming:
            here = arrival <= time_s
            self._last[receiver[here]] = np.maximum(self._last[receiver[here]], number)
            if not here.all():
                waiting.append((arrival[~here], receiver[~here], number))
        self._coming = waiting
        in_use = set(np.unique(self._last[present])) | {number for _, _, number in waiting}
        if self._on_masts is not None:
            in_use.add(self._on_masts[1])
        self._editions = {n: e for n, e in self._editions.items() if n in in_use}
