"""The way to the trust server and back: verdicts up, trust values down, each with delay and loss."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray
from scipy.special import gammaincinv

from cosim import rng
from cosim.v2x.messages import expand
from trust.tables import Told


@dataclass(frozen=True, kw_only=True, slots=True)
class ServerParams:
    """Cellular way to the trust server and back; defaults as Eclipse MOSAIC's LTE cell (Tiergarten)."""

    delay_min_s: Annotated[float, Ge(0)] = 0.05
    """Shortest delay of one message, either way [s]."""
    delay_mean_s: Annotated[float, Ge(0)] = 0.15
    """Mean delay of one message, either way [s]; what exceeds the shortest is Gamma distributed, shape 2."""
    uplink_loss_p: Annotated[float, Ge(0), Le(1)] = 0.01
    """Probability that a vehicle's report never reaches the server."""
    downlink_loss_p: Annotated[float, Ge(0), Le(1)] = 0.01
    """Probability that a vehicle misses a broadcast of trust values."""

    def __post_init__(self) -> None:
        if self.delay_mean_s < self.delay_min_s:
            raise ValueError(
                f"server.delay_mean_s = {self.delay_mean_s:g} s is below server.delay_min_s = "
                f"{self.delay_min_s:g} s. Set a mean that is at least the minimum."
            )


def delay_s(u: Float[ndarray, "n"], params: ServerParams) -> Float[ndarray, "n"]:
    """Delays from uniforms: delay_min + Gamma(shape 2) of mean delay_mean - delay_min [s]."""
    return params.delay_min_s + gammaincinv(2.0, u) * (params.delay_mean_s - params.delay_min_s) / 2


@dataclass(slots=True)
class Uplink:
    """Reports of verdicts under way to the server."""

    params: ServerParams
    seed: int
    _under_way: list[tuple[Float[ndarray, "v"], Told]] = field(default_factory=list)

    def send(self, told: Told, name_key: UInt64[ndarray, "v"], time_s: float) -> None:
        """Each evaluator's report of one step leaves at `time_s`; `name_key` is aligned with the evaluators."""
        draws = rng.uniforms(rng.key(self.seed, rng.Stream.UPLINK, told.step), name_key, n=2)
        arrival = time_s + delay_s(draws[:, 1], self.params)
        arrival[draws[:, 0] < self.params.uplink_loss_p] = np.inf
        self._under_way.append((arrival, told))

    def arrived(self, time_s: float) -> list[Told]:
        """Reports that have reached the server by `time_s`, older steps first."""
        here, later = [], []
        for arrival, told in self._under_way:
            due = arrival <= time_s
            if due.any():
                here.append(messages_of(told, due))
            waits = np.isfinite(arrival) & ~due
            if waits.any():
                later.append((arrival[waits], messages_of(told, waits)))
        self._under_way = later
        return here


def messages_of(told: Told, chosen: Bool[ndarray, "v"]) -> Told:
    """Only the chosen evaluators' messages."""
    rows, _ = expand(told.ptr[:-1][chosen], told.ptr[1:][chosen])
    ptr = np.concatenate([[0], np.cumsum(np.diff(told.ptr)[chosen])])
    return Told(told.step, told.evaluator[chosen], ptr, told.sender[rows], told.k[rows], told.e[rows], told.phi[rows])


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
    _editions: dict[int, Edition] = field(default_factory=dict)
    _last: Int[ndarray, "capacity"] = field(default_factory=lambda: np.full(1024, -1))
    _coming: list[tuple[Float[ndarray, "r"], Int[ndarray, "r"], int]] = field(default_factory=list)

    def broadcast(
        self, edition: Edition, step: int, receiver: Int[ndarray, "r"], name_key: UInt64[ndarray, "r"]
    ) -> None:
        """Send an edition to all equipped vehicles; each hears it after its own delay, or not at all."""
        draws = rng.uniforms(rng.key(self.seed, rng.Stream.DOWNLINK, step), name_key, n=2)
        heard = draws[:, 0] >= self.params.downlink_loss_p
        arrival = edition.time_s + delay_s(draws[heard, 1], self.params)
        self._editions[step] = edition
        self._coming.append((arrival, receiver[heard], step))

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
        self._editions = {n: e for n, e in self._editions.items() if n in in_use}
