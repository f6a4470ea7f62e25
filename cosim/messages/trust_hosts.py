"""Hosts of trust: a server that broadcasts it, every vehicle, or none, for any number of trust variants at once.

All variants get the same evaluations at the same times. Each has its own evidence and broadcast schedule. What variants
have in common is stored once: the evidence of one model with several windows, and reports on their way to the server.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.base.codes import LookupState, TrustSource
from cosim.base.rows import Rows
from cosim.messages.trust_server import (
    Downlink,
    DownlinkState,
    LinkStats,
    SentReports,
    ServerParams,
    TrustBroadcast,
    Uplink,
    UplinkState,
)
from trust.models import TrustModel
from trust.models.stepwise import share_logs
from trust.object_reports import ObjectReports
from trust.open_steps import RejectReason
from trust.params import EVIDENCE_KEYS, TrustParams, eta_of, window_of
from trust.tables import SERVER, EvaluationMessages, ReceivedEvaluations, TrustScores

T = TypeVar("T")

FUSION_KEYS = frozenset(
    {
        "method",
        "plausibility_in_fusion",
        "blind_points",
        "self_report_poses",
        "min_score",
        "code_parity",
        "code_aggregate",
        "ego_trust",
        "ego_trust_from",
    }
)
"""Keys of [trust] about the use of trust. Variants that differ only in these keys share one host."""


_EVALUATED, _UNEVALUATED = int(LookupState.EVALUATED), int(LookupState.UNEVALUATED)
_STALE, _NO_VALUE = int(LookupState.STALE), int(LookupState.NO_VALUE)
_DEFAULT, _SERVER = int(TrustSource.DEFAULT), int(TrustSource.SERVER)
_OWN = int(TrustSource.OWN)
"""Plain integers, because NumPy is ten times slower with members of enums."""

ObjectScorer = Callable[[ObjectReports], Float[ndarray, "g"]]
"""Scores of groups of detections by a trust model that scores objects."""


@dataclass(frozen=True, slots=True)
class Lookups(Rows):
    """Trust of subjects as vehicles know it at the time of the look-up, one row per look-up."""

    trust: Float[ndarray, "n"]
    source: UInt8[ndarray, "n"]
    """As `TrustSource`."""
    state: UInt8[ndarray, "n"]
    """As `LookupState`."""
    age_s: Float[ndarray, "n"]
    """Age of the value since it was computed. Own values are computed at the look-up. A default has no age."""
    newest_evaluation_age_s: Float[ndarray, "n"]
    """Age of the newest evaluation that the value is based on. Only evaluations by other vehicles with visibility above
    0 count. It has no meaning unless `is_known`."""
    oldest_evaluation_age_s: Float[ndarray, "n"]
    n_evaluations: Int[ndarray, "n"]
    n_evaluators: Int[ndarray, "n"] | None
    """Number of different evaluators; None if the trust model does not count them."""

    @property
    def is_known(self) -> Bool[ndarray, "n"]:
        """Whether each value is based on at least one evaluation, however old."""
        return (self.state == _EVALUATED) | (self.state == _STALE)

    @property
    def is_default(self) -> Bool[ndarray, "n"]:
        """Whether each value is the default, because neither the server nor the vehicle has one."""
        return self.source == _DEFAULT


@dataclass(frozen=True, slots=True)
class Variant:
    """A trust variant of the config."""

    name: str
    trust: TrustParams
    model: type
    """Class of the trust model."""
    own: Any = None
    """The model's own parameters, if they are not those of [trust]."""
    fused: bool = True
    """Whether its fused objects are computed."""
    make: Callable[[Any, float], Any] | None = None
    """Builds an instance of the model. None if the class does."""
    guard: Callable[..., Any] | None = None
    """Adds checks to an instance: `guard(model, latest_step=...)`. None for an included model."""


@dataclass(slots=True)
class HostState:
    """Evidence and broadcasts of one host."""

    model: TrustModel | None
    downlink: DownlinkState = field(default_factory=DownlinkState)
    last_broadcast_s: float = -np.inf


@dataclass(slots=True)
class TrustState:
    """State of all hosts, and of the reports to the server."""

    hosts: list[HostState]
    uplink: UplinkState = field(default_factory=UplinkState)
    arrived: list[EvaluationMessages] = field(default_factory=list)
    """Reports that reached the server in the last `publish`."""


class Informed(NamedTuple):
    """Number of vehicles that a broadcast of trust values reaches."""

    n_addressed: int
    """Number of vehicles that it is sent to."""
    n_informed: int
    """Number of these that it reaches, now or later."""


NOBODY = Informed(0, 0)
"""Nothing was broadcast."""


@dataclass(frozen=True, slots=True)
class ServerTraffic:
    """One step's messages between vehicles and a trust server."""

    up: LinkStats
    down: Informed


@dataclass(frozen=True, slots=True)
class TrustHosts:
    """The hosts of all trust variants. Vehicles act on the trust of the first variant."""

    variants: tuple[Variant, ...]
    host_of: tuple[int, ...]
    """For each variant, the number of its host."""
    params: tuple[TrustParams, ...]
    """Parameters of each host."""
    models: tuple[Variant, ...]
    """For each host, its first variant, which defines its model."""
    uplink: Uplink
    downlink: Downlink
    server: ServerParams
    dt_s: float
    eta: float
    """Evaluation of an unmatched detection, the same for all variants."""

    @staticmethod
    def of(
        variants: Sequence[Variant],
        server: ServerParams,
        seed: int,
        interval_s: float,
        dt_s: float,
        late_s: float = 0.0,
    ) -> "TrustHosts":
        """Build the hosts of these variants. Vehicles act on the trust of the first one.

        A broadcast of roadside units may arrive up to `late_s` after its round began.
        """
        keys: list[tuple] = []
        host_of: list[int] = []
        for variant in variants:
            key = host_key(variant)
            if key not in keys:
                keys.append(key)
            host_of.append(keys.index(key))
        first = [variants[host_of.index(h)] for h in range(len(keys))]
        for variant in first[1:]:
            if server.uplink == "rsu" and variant.trust.host == "central":
                raise ValueError(
                    f'trust_variant "{variant.name}" would broadcast other trust values than [trust], and with '
                    'server.uplink = "rsu" every broadcast loads the channel that all share. Make it a run of its own, '
                    'or set server.uplink = "cellular".'
                )
        return TrustHosts(
            tuple(variants),
            tuple(host_of),
            tuple(v.trust for v in first),
            tuple(first),
            Uplink(server, seed, interval_s),
            Downlink(server, seed, late_s),
            server,
            dt_s,
            eta_of(first[0].trust),
        )

    def start(self) -> TrustState:
        """The state before the first step, without evidence."""
        models: list[TrustModel | None] = [None] * len(self.params)
        for group in _shared(self.params, self.models):
            variant = self.models[group[0]]
            own = []
            for h in group:
                of_user = self.models[h].own
                own.append(self.params[h] if of_user is None else of_user)
            make: Callable[[Any, float], TrustModel] = variant.make or variant.model
            build = getattr(variant.model, "build_shared", None) if variant.make is None else None
            built = build(own, self.dt_s) if build else [make(p, self.dt_s) for p in own]
            for h, made in zip(group, built, strict=True):
                models[h] = made
        kinds = [_kind(params) for params in self.params]
        for kind in set(kinds):
            share_logs([model for model, its in zip(models, kinds, strict=True) if its == kind])
        return TrustState([HostState(m) for m in models])

    def publish(
        self, state: TrustState, step: int, time_s: float, vehicle: Int[ndarray, "e"], name_key: UInt64[ndarray, "e"]
    ) -> tuple[TrustState, list[TrustScores | None], list[Informed]]:
        """Deliver reports to the server. If a broadcast is due, the server computes trust and broadcasts it.

        A period thus ends with the first call after it.

        Parameters
        ----------
        vehicle
            Actor numbers of the equipped vehicles.
        name_key
            Keys of their names, for random draws.

        Returns
        -------
        The new state; for each host the scores that its server computed in this step, or None; and for each host the
        numbers of vehicles addressed and reached.
        """
        published: list[TrustScores | None] = [None] * len(self.params)
        counts = [NOBODY] * len(self.params)
        if not self._hosts("central"):
            return state, published, counts
        uplink, arrived = self.uplink.arrived(state.uplink, time_s)
        state = TrustState(list(state.hosts), uplink, arrived)
        for messages in arrived:
            n = len(messages.evaluator)
            received = ReceivedEvaluations(messages, np.full(n, SERVER), np.arange(n), self.eta)
            self._add(state, self._hosts("central"), received)
        if self.server.is_out(time_s):
            return state, published, counts
        delay_s: Float[ndarray, "e"] | None = None
        for h in self._hosts("central"):
            host = state.hosts[h]
            if time_s - host.last_broadcast_s < self.params[h].server_period_s - 1e-9:
                continue
            scores = published[h] = self.model_of(state, h).scores(step)
            if delay_s is None:
                delay_s = self.downlink.delays_s(step, name_key)
            downlink, n_informed = self.downlink.publish(
                host.downlink, TrustBroadcast(time_s, scores), step, vehicle, delay_s
            )
            state.hosts[h] = HostState(host.model, downlink, time_s)
            if self.server.uplink == "cellular":
                counts[h] = Informed(len(vehicle), n_informed)
        return state, published, counts

    def per_variant(self, of_host: Sequence[T]) -> list[T]:
        """Values per trust variant from values per host."""
        return [of_host[h] for h in self.host_of]

    def traffic(self, up: LinkStats, informed: Sequence[Informed]) -> list[ServerTraffic | None]:
        """Messages to and from the server of each trust variant. None if the variant has no server."""
        return self.per_variant(
            [
                ServerTraffic(up, down) if params.host == "central" else None
                for params, down in zip(self.params, informed, strict=True)
            ]
        )

    def pending_rsu_broadcast(
        self, state: TrustState, step: int, time_s: float
    ) -> tuple[TrustState, TrustBroadcast | None]:
        """The broadcast that roadside units send in a round, as `Downlink.pending_rsu_broadcast`."""
        h = self.host_of[0]
        if self.server.uplink != "rsu" or self.params[h].host != "central":
            return state, None
        host = state.hosts[h]
        downlink, broadcast = self.downlink.pending_rsu_broadcast(host.downlink, step, time_s)
        hosts = list(state.hosts)
        hosts[h] = replace(host, downlink=downlink)
        return TrustState(hosts, state.uplink), broadcast

    def receive_from_rsu(
        self,
        state: TrustState,
        vehicle: Int[ndarray, "e"],
        receiver: Int[ndarray, "m"],
        sent_step: Int[ndarray, "m"],
        received_s: Float[ndarray, "m"],
    ) -> tuple[TrustState, int]:
        """Record which vehicles received broadcasts of roadside units, as `Downlink.receive_from_rsu`."""
        h = self.host_of[0]
        downlink, n_informed = self.downlink.receive_from_rsu(
            state.hosts[h].downlink, vehicle, receiver, sent_step, received_s
        )
        hosts = list(state.hosts)
        hosts[h] = replace(hosts[h], downlink=downlink)
        return TrustState(hosts, state.uplink), n_informed

    def open_step(
        self,
        state: TrustState,
        step: int,
        pseudonym: Int[ndarray, "p"],
        message: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"],
        score: Float[ndarray, "d"],
    ) -> TrustState:
        """Tell every host what was transmitted in this step.

        Parameters
        ----------
        pseudonym
            Pseudonym of each of P messages.
        message
            Row of `pseudonym` for each of D transmitted detections.
        detection_index, score
            Index and score of each detection.
        """
        order = np.argsort(pseudonym, kind="stable")
        if (order[1:] < order[:-1]).any():
            rank = np.empty(len(order), np.int64)
            rank[order] = np.arange(len(order))
            pseudonym, message = pseudonym[order], rank[message]
        for h in (*self._hosts("central"), *self._hosts("local")):
            self.model_of(state, h).open_step(step, pseudonym, message, detection_index, score)
        return state

    def add_local(
        self,
        state: TrustState,
        messages: EvaluationMessages,
        vehicle: Int[ndarray, "m"],
        message: Int[ndarray, "m"],
        of_others: bool = True,
    ) -> TrustState:
        """Add evaluations to the evidence of vehicles.

        Parameters
        ----------
        vehicle, message
            Actor number of each vehicle, and the row of the message that it received or made.
        of_others
            Whether the messages were received. If not, they are the vehicle's own.

        Returns
        -------
        The state with the new evidence.
        """
        received = ReceivedEvaluations(messages, vehicle, message, self.eta, is_own=not of_others)
        hosts = self._hosts("local")
        if of_others:
            hosts = [h for h in hosts if self.params[h].local_evidence == "received"]
        self._add(state, hosts, received)
        return state

    def report_by_cellular(
        self,
        state: TrustState,
        reports: SentReports,
        key: ndarray,
        xy_m: ndarray,
        time_s: float,
        is_valid: Bool[ndarray, "m"],
        n_copies: Int[ndarray, "m"] | None,
    ) -> tuple[TrustState, LinkStats]:
        """Send reports to the server over the cellular network. All arrays are aligned with the reports.

        Parameters
        ----------
        key
            Random key of each report.
        xy_m
            Positions of the senders.
        is_valid
            Whether the server accepts the report.
        n_copies
            Further copies, which use capacity and have no other effect. None if there are none.
        """
        if self.server.uplink != "cellular" or not self._hosts("central"):
            return state, LinkStats()
        uplink, stats = self.uplink.by_cellular(state.uplink, reports, key, xy_m, time_s, is_valid, n_copies)
        return TrustState(state.hosts, uplink), stats

    def report_by_rsu(
        self, state: TrustState, reports: SentReports, message: ndarray, received_s: ndarray
    ) -> tuple[TrustState, LinkStats]:
        """Forward the reports that roadside units received to the server; arguments as in `Uplink.by_rsu`."""
        if self.server.uplink != "rsu" or not self._hosts("central"):
            return state, LinkStats()
        uplink, stats = self.uplink.by_rsu(state.uplink, reports, message, received_s)
        return TrustState(state.hosts, uplink), stats

    def receive(self, state: TrustState, present: Int[ndarray, "e"], time_s: float) -> TrustState:
        """Deliver broadcasts that have arrived by `time_s` to the vehicles on the road, `present` (ascending)."""
        hosts = list(state.hosts)
        for number, params in enumerate(self.params):
            if params.host == "central":
                downlink = self.downlink.receive(hosts[number].downlink, present, time_s)
                hosts[number] = replace(hosts[number], downlink=downlink)
        return TrustState(hosts, state.uplink)

    def lookup(
        self, state: TrustState, vehicle: Int[ndarray, "n"], subject: Int[ndarray, "n"], time_s: float
    ) -> list[Lookups]:
        """For each host, the trust in subjects as vehicles know it at `time_s`.

        Parameters
        ----------
        vehicle
            Actor number of the vehicle that looks up each subject.
        subject
            Subject of trust (`Linkage.subjects`) of each look-up.
        """
        return [self._lookup(state, h, vehicle, subject, time_s) for h in range(len(self.params))]

    def _lookup(
        self, state: TrustState, h: int, vehicle: Int[ndarray, "n"], subject: Int[ndarray, "n"], time_s: float
    ) -> Lookups:
        n, params = len(vehicle), self.params[h]
        ages_s = np.zeros((3, n))
        counts = np.zeros((2, n), np.int64)
        found = Lookups(
            np.full(n, params.default_trust),
            np.full(n, _DEFAULT, np.uint8),
            np.full(n, _NO_VALUE, np.uint8),
            ages_s[0],
            ages_s[1],
            ages_s[2],
            counts[0],
            counts[1],
        )
        counted = True
        if not n:
            return found
        if params.host == "central":
            for broadcast, rows, at in self.downlink.lookup(state.hosts[h].downlink, vehicle, subject):
                age_s = time_s - broadcast.time_s
                counted &= self._fill(found, broadcast.scores, rows, at, h, time_s, age_s)
        elif params.host == "local":
            scores = self.model_of(state, h, int(time_s / self.dt_s + 1e-6)).scores(None)
            at, known = scores.rows_of(vehicle, subject)
            rows = np.flatnonzero(known)
            counted &= self._fill(found, scores, rows, at[rows], h, time_s, 0.0)
        return found if counted else replace(found, n_evaluators=None)

    def _fill(
        self,
        found: Lookups,
        scores: TrustScores,
        rows: Int[ndarray, "k"],
        at: Int[ndarray, "k"],
        h: int,
        time_s: float,
        age_s: float,
    ) -> bool:
        """Write the values of a host, of age `age_s`, into some rows of the look-ups; `at` are rows of the scores.

        Returns whether the model counts evaluators.
        """
        params = self.params[h]
        window_s = window_of(params) if _has_window(self.models[h].model) else np.inf
        if not len(rows):
            return True
        evaluated = scores.is_evaluated[at]
        valued = evaluated if params.unevaluated == "default" else np.ones(len(at), bool)
        found.trust[rows[valued]] = scores.trust[at[valued]]
        found.source[rows[valued]] = _SERVER if params.host == "central" else _OWN
        newest_age_s = time_s - scores.newest_evaluation_step[at] * self.dt_s
        found.age_s[rows], found.newest_evaluation_age_s[rows] = age_s, newest_age_s
        oldest = scores.oldest_evaluation_step[at]
        oldest_age_s = np.where(oldest < 0, np.nan, time_s - oldest * self.dt_s)
        found.oldest_evaluation_age_s[rows] = oldest_age_s
        of_evaluated = np.where(newest_age_s < window_s, _EVALUATED, _STALE)
        found.state[rows] = np.where(evaluated, of_evaluated, _UNEVALUATED)
        found.n_evaluations[rows] = scores.n_evaluations[at]
        if scores.n_evaluators is None:
            return False
        assert found.n_evaluators is not None
        found.n_evaluators[rows] = scores.n_evaluators[at]
        return True

    def rejected(self, state: TrustState) -> dict[str, int]:
        """Number of evaluations that the acting model has rejected, by cause. Empty if it does not count them."""
        counts = getattr(state.hosts[self.host_of[0]].model, "rejected", None)
        if not isinstance(counts, ndarray):
            return {}
        n_of = dict(zip(RejectReason, counts.tolist(), strict=False))
        return {cause.name.lower(): n for cause, n in n_of.items() if n}

    def scorers(self, state: TrustState) -> list[ObjectScorer | None]:
        """For each variant, the method of its model that scores objects, or None if it has none."""
        return [
            None if state.hosts[h].model is None else getattr(self.model_of(state, h), "score_objects", None)
            for h in self.host_of
        ]

    def _add(self, state: TrustState, hosts: Sequence[int], received: ReceivedEvaluations) -> None:
        """Add evaluations to the evidence of hosts. A model gets those of the detections of one step at a time."""
        for messages in received.messages.of_one_step() if hosts else ():
            of_step = replace(received, messages=messages)
            for h in hosts:
                self.model_of(state, h).add_evaluations(of_step)

    def model_of(self, state: TrustState, h: int, latest_step: int | None = None) -> TrustModel:
        """The model of a host, guarded if it is a user's own. `latest_step` is the step of a call without that
        argument."""
        model, guard = state.hosts[h].model, self.models[h].guard
        assert model is not None
        return model if guard is None else guard(model, latest_step=latest_step)

    def _hosts(self, host: str) -> list[int]:
        return [h for h, params in enumerate(self.params) if params.host == host]


@cache
def _has_window(model: type) -> bool:
    params = getattr(model, "Params", None)
    return params is not None and "freshness_s" in {f.name for f in fields(params)}


def host_key(variant: Variant) -> tuple:
    """Everything that a host depends on. Variants with the same key share a host."""
    shared = {"model", *FUSION_KEYS, *EVIDENCE_KEYS}
    kept = [of.name for of in fields(TrustParams) if of.name not in shared]
    values = [getattr(variant.trust, name) for name in sorted(kept)]
    return variant.model, repr(variant.own), *values


def _kind(params: TrustParams) -> tuple[str, str]:
    """The kind of a host. Hosts of one kind receive the same evaluations."""
    return params.host, params.local_evidence


def _shared(params: Sequence[TrustParams], models: Sequence[Variant]) -> list[list[int]]:
    """Groups of hosts with models of the same class that receive the same evaluations."""
    groups: dict[tuple, list[int]] = {}
    for h, (p, variant) in enumerate(zip(params, models, strict=True)):
        if p.host != "none":
            groups.setdefault((variant.model, *_kind(p)), []).append(h)
    return list(groups.values())
