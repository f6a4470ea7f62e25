"""Where trust lives: on a server that broadcasts it, in every vehicle, or nowhere; for any number of variants at once.

All variants see the same evaluations at the same moments. Each keeps evidence and a broadcast schedule of its own;
what variants have in common (the evidence store of one model with several windows, the reports on their way to the
server) is kept once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.v2x import lookup_kernels
from cosim.v2x.trust_server import (
    Downlink,
    DownlinkState,
    LinkStats,
    ServerParams,
    TrustBroadcast,
    Uplink,
    UplinkState,
)
from results.codes import LookupState, TrustSource
from trust.models import TrustModel
from trust.models.stepwise import share_logs
from trust.object_reports import ObjectReports
from trust.open_steps import RejectReason
from trust.params import EVIDENCE_KEYS, TrustParams, eta_of, window_of
from trust.tables import SERVER, EvaluationMessages, ReceivedEvaluations, TrustScores

T = TypeVar("T")

FUSION_KEYS = frozenset({
    "method", "plausibility_in_fusion", "blind_points", "self_report_poses", "min_score", "code_parity",
    "code_aggregate", "ego_trust", "ego_trust_from",
})  # fmt: skip
"""Keys of [trust] that say what trust is used for: variants that differ in these alone share one host."""


_JUDGED, _STALE, _NO_VALUE, _DEFAULT = (
    int(c) for c in (LookupState.JUDGED, LookupState.STALE, LookupState.DEFAULT, TrustSource.DEFAULT)
)
"""NumPy takes ten times as long with the members themselves."""

ObjectScorer = Callable[[ObjectReports], Float[ndarray, "g"]]
"""Scores of groups of detections by a trust model that scores objects."""


@dataclass(frozen=True, slots=True)
class Lookups:
    """Trust of some subjects as some vehicles know it here and now; rows as asked."""

    trust: Float[ndarray, "n"]
    source: UInt8[ndarray, "n"]
    """As `TrustSource`."""
    state: UInt8[ndarray, "n"]
    """As `LookupState`."""
    age_s: Float[ndarray, "n"]
    """Of the value, since it was computed (own values are computed when they are looked up); read only where it is no
    default."""
    newest_evaluation_age_s: Float[ndarray, "n"]
    """Of the evaluations, by other vehicles than the subject that could see, that the value rests on; read only where
    `is_known`."""
    oldest_evaluation_age_s: Float[ndarray, "n"]
    n_evaluations: Int[ndarray, "n"]
    n_evaluators: Int[ndarray, "n"] | None
    """Different vehicles that made them; None where the trust model does not count them."""

    def take(self, rows: Int[ndarray, "k"]) -> "Lookups":
        """These rows."""
        columns: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: column[rows] for name, column in columns.items() if column is not None})

    @property
    def is_known(self) -> Bool[ndarray, "n"]:
        """Values that rest on at least one evaluation, however old: what counts as knowledge."""
        return (self.state == _JUDGED) | (self.state == _STALE)

    @property
    def is_default(self) -> Bool[ndarray, "n"]:
        """No value of the server's or of the vehicle's own."""
        return self.source == _DEFAULT


@dataclass(frozen=True, slots=True)
class Variant:
    """One way of trusting, as the config names it."""

    name: str
    trust: TrustParams
    model: type
    """Class of the trust model."""
    own: Any = None
    """The model's own parameters where they are not those of [trust]."""
    fused: bool = True
    """Whether its fused objects are computed."""
    make: Callable[[Any, float], Any] | None = None
    """Makes an instance of the model, if not its class alone."""
    guard: Callable[..., Any] | None = None
    """Puts an instance behind checks, `guard(model, latest_step=...)`; None for a model that ships."""


@dataclass(slots=True)
class HostState:
    """Evidence and broadcasts of one host."""

    model: TrustModel | None
    downlink: DownlinkState = field(default_factory=DownlinkState)
    last_broadcast_s: float = -np.inf


@dataclass(slots=True)
class TrustState:
    """Everything that is known about trustworthiness, anywhere."""

    hosts: list[HostState]
    uplink: UplinkState = field(default_factory=UplinkState)
    arrived: list[EvaluationMessages] = field(default_factory=list)
    """Reports that reached the server in the last `publish`."""


class Informed(NamedTuple):
    """How many vehicles a broadcast of trust values is about to inform."""

    n_addressed: int
    """Vehicles that it was meant for."""
    n_informed: int
    """Of these, those that it reaches, now or later."""


NOBODY = Informed(0, 0)
"""Nothing was broadcast."""


@dataclass(frozen=True, slots=True)
class ServerTraffic:
    """A step's messages between vehicles and a trust server."""

    up: LinkStats
    down: Informed


@dataclass(frozen=True, slots=True)
class TrustHosts:
    """Trust of all variants; the first one acts."""

    variants: tuple[Variant, ...]
    host_of: tuple[int, ...]
    """Of each variant: which host it asks."""
    params: tuple[TrustParams, ...]
    """Of each host."""
    models: tuple[Variant, ...]
    """Of each host: the first variant that asks it, which says what its model is."""
    uplink: Uplink
    downlink: Downlink
    server: ServerParams
    dt_s: float
    eta: float
    """Evaluation of an unmatched detection, the same for all."""

    @staticmethod
    def of(
        variants: Sequence[Variant], server: ServerParams, seed: int, interval_s: float, dt_s: float
    ) -> "TrustHosts":
        """Hosts for these variants; the first one acts."""
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
            tuple(variants), tuple(host_of), tuple(v.trust for v in first), tuple(first),
            Uplink(server, seed, interval_s), Downlink(server, seed), server, dt_s, eta_of(first[0].trust),
        )  # fmt: skip

    def start(self) -> TrustState:
        """No evidence about anyone."""
        models: list[TrustModel | None] = [None] * len(self.params)
        for group in _shared(self.params, self.models):
            variant = self.models[group[0]]
            own = [self.params[h] if self.models[h].own is None else self.models[h].own for h in group]
            make: Callable[[Any, float], TrustModel] = variant.make or variant.model
            build = getattr(variant.model, "build_shared", None) if variant.make is None else None
            built = build(own, self.dt_s) if build else [make(p, self.dt_s) for p in own]
            for h, made in zip(group, built, strict=True):
                models[h] = made
        for kind in {_kind(p) for p in self.params}:
            share_logs([m for m, p in zip(models, self.params, strict=True) if m is not None and _kind(p) == kind])
        return TrustState([HostState(m) for m in models])

    def publish(
        self, state: TrustState, step: int, time_s: float, vehicle: Int[ndarray, "e"], name_key: UInt64[ndarray, "e"]
    ) -> tuple[TrustState, list[TrustScores | None], list[Informed]]:
        """Reports reach the server; where it is time, it computes trust and broadcasts it.

        Returns
        -------
        The state; per host, what its server computed now, and the vehicles addressed and informed.
        """
        published: list[TrustScores | None] = [None] * len(self.params)
        counts = [NOBODY] * len(self.params)
        if not self._any("central"):
            return state, published, counts
        uplink, arrived = self.uplink.arrived(state.uplink, time_s)
        state = TrustState(list(state.hosts), uplink, arrived)
        for messages in arrived:
            n = len(messages.evaluator)
            received = ReceivedEvaluations(messages, np.full(n, SERVER), np.arange(n), self.eta)
            for h in self._hosts("central"):
                self._model(state, h).add_evaluations(received)
        if self.server.is_out(time_s):
            return state, published, counts
        delay_s: Float[ndarray, "e"] | None = None
        for h in self._hosts("central"):
            host = state.hosts[h]
            if time_s - host.last_broadcast_s < self.params[h].server_period_s - 1e-9:
                continue
            scores = published[h] = self._model(state, h).scores(step)
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
        """What there is per host, per trust variant."""
        return [of_host[h] for h in self.host_of]

    def traffic(self, up: LinkStats, informed: Sequence[Informed]) -> list[ServerTraffic | None]:
        """Messages to and from the server of each trust variant, given whom each host informed."""
        return self.per_variant(
            [
                ServerTraffic(up, down) if params.host == "central" else None
                for params, down in zip(self.params, informed, strict=True)
            ]
        )

    def pending_rsu_broadcast(self, state: TrustState, time_s: float) -> tuple[TrustState, TrustBroadcast | None]:
        """What roadside units have to send in a round that begins at `time_s`, once."""
        h = self.host_of[0]
        if self.server.uplink != "rsu" or self.params[h].host != "central":
            return state, None
        host = state.hosts[h]
        downlink, broadcast = self.downlink.pending_rsu_broadcast(host.downlink, time_s)
        hosts = list(state.hosts)
        hosts[h] = replace(host, downlink=downlink)
        return TrustState(hosts, state.uplink), broadcast

    def receive_from_rsu(
        self,
        state: TrustState,
        vehicle: Int[ndarray, "e"],
        receiver: Int[ndarray, "m"],
        received_s: Float[ndarray, "m"],
    ) -> tuple[TrustState, Informed]:
        """Vehicles received the roadside units' broadcast; whom it informs."""
        h = self.host_of[0]
        downlink, n_informed = self.downlink.receive_from_rsu(state.hosts[h].downlink, vehicle, receiver, received_s)
        hosts = list(state.hosts)
        hosts[h] = replace(hosts[h], downlink=downlink)
        return TrustState(hosts, state.uplink), Informed(len(vehicle), n_informed)

    def open_step(
        self, state: TrustState, step: int, pseudonym: Int[ndarray, "p"], message: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"], score: Float[ndarray, "d"],
    ) -> TrustState:  # fmt: skip
        """Tell every host what was transmitted in this step: detections by message, and the messages' pseudonyms."""
        order = np.argsort(pseudonym, kind="stable")
        if (order[1:] < order[:-1]).any():
            rank = np.empty(len(order), np.int64)
            rank[order] = np.arange(len(order))
            pseudonym, message = pseudonym[order], rank[message]
        for h in (*self._hosts("central"), *self._hosts("local")):
            self._model(state, h).open_step(step, pseudonym, message, detection_index, score)
        return state

    def add_own(self, state: TrustState, messages: EvaluationMessages, vehicle: Int[ndarray, "v"]) -> TrustState:
        """Evaluations reach their own evaluators: vehicles, aligned with the messages."""
        self._add_local(
            state, ReceivedEvaluations(messages, vehicle, np.arange(len(vehicle)), self.eta), of_others=False
        )
        return state

    def add_received(
        self, state: TrustState, messages: EvaluationMessages, vehicle: Int[ndarray, "m"], message: Int[ndarray, "m"]
    ) -> TrustState:
        """Evaluations of others reach vehicles: message `message[i]` reached `vehicle[i]`."""
        self._add_local(state, ReceivedEvaluations(messages, vehicle, message, self.eta), of_others=True)
        return state

    def _add_local(self, state: TrustState, received: ReceivedEvaluations, of_others: bool) -> None:
        for h in self._hosts("local"):
            if not of_others or self.params[h].local_evidence == "received":
                self._model(state, h).add_evaluations(received)

    def report_by_cellular(
        self, state: TrustState, messages: EvaluationMessages, key: ndarray, xy_m: ndarray, time_s: float,
        is_valid: Bool[ndarray, "m"] | None = None, n_copies: Int[ndarray, "m"] | None = None,
    ) -> tuple[TrustState, LinkStats]:  # fmt: skip
        """Reports leave for the server through the cellular network; all arguments go with the messages.

        Parameters
        ----------
        key
            Of each message's draws.
        is_valid
            Whether the server takes it; all if not given.
        n_copies
            Further copies, which take capacity and add nothing; none if not given.
        """
        if self.server.uplink != "cellular" or not self._any("central"):
            return state, LinkStats()
        uplink, stats = self.uplink.by_cellular(state.uplink, messages, key, xy_m, time_s, is_valid, n_copies)
        return TrustState(state.hosts, uplink), stats

    def report_by_rsu(
        self, state: TrustState, messages: EvaluationMessages, message: ndarray, received_s: ndarray
    ) -> tuple[TrustState, LinkStats]:
        """Reports that roadside units received leave for the server."""
        if self.server.uplink != "rsu" or not self._any("central"):
            return state, LinkStats()
        uplink, stats = self.uplink.by_rsu(state.uplink, messages, message, received_s)
        return TrustState(state.hosts, uplink), stats

    def receive(self, state: TrustState, present: Int[ndarray, "e"], time_s: float) -> TrustState:
        """Broadcasts that have arrived by `time_s` are received; `present` vehicles are on the road, ascending."""
        hosts = [
            replace(host, downlink=self.downlink.receive(host.downlink, present, time_s))
            if params.host == "central" else host
            for host, params in zip(state.hosts, self.params, strict=True)
        ]  # fmt: skip
        return TrustState(hosts, state.uplink)

    def lookup(
        self, state: TrustState, vehicle: Int[ndarray, "n"], subject: Int[ndarray, "n"], time_s: float
    ) -> list[Lookups]:
        """Trust of each subject (a pseudonym) as its vehicle knows it at `time_s`: per host. Changes nothing."""
        return [self._lookup(state, h, vehicle, subject, time_s) for h in range(len(self.params))]

    def _lookup(
        self, state: TrustState, h: int, vehicle: Int[ndarray, "n"], subject: Int[ndarray, "n"], time_s: float
    ) -> Lookups:
        n, params = len(vehicle), self.params[h]
        ages_s, counts = np.zeros((3, n)), np.zeros((2, n), np.int64)
        found = Lookups(
            np.full(n, params.default_trust), np.full(n, _DEFAULT, np.uint8), np.full(n, _NO_VALUE, np.uint8),
            ages_s[0], ages_s[1], ages_s[2], counts[0], counts[1],
        )  # fmt: skip
        counted = True
        if not n:
            return found
        if params.host == "central":
            for broadcast, at in self.downlink.lookup(state.hosts[h].downlink, vehicle, subject):
                counted &= self._fill(found, broadcast.scores, at, h, time_s, time_s - broadcast.time_s)
        elif params.host == "local":
            scores = self._model(state, h, int(time_s / self.dt_s + 1e-6)).scores(None)
            at, known = scores.rows_of(vehicle, subject)
            counted &= self._fill(found, scores, np.where(known, at, -1), h, time_s, 0.0)
        return found if counted else replace(found, n_evaluators=None)

    def _fill(
        self, found: Lookups, scores: TrustScores, at: Int[ndarray, "n"], h: int, time_s: float, age_s: float
    ) -> bool:
        """Write down values of a host that are `age_s` old, where `at` is a row of them; whether its model counts
        evaluators."""
        params = self.params[h]
        window_s = window_of(params) if _has_window(self.models[h].model) else np.inf
        source = TrustSource.SERVER if params.host == "central" else TrustSource.OWN
        n_evaluators = scores.n_evaluations if scores.n_evaluators is None else scores.n_evaluators
        columns = (getattr(found, name) for name in lookup_kernels.LookupColumns._fields)
        lookup_kernels.fill(
            lookup_kernels.LookupColumns(*columns),
            lookup_kernels.ScoreColumns(
                trust=scores.trust,
                is_judged=scores.is_judged,
                newest_step=np.ascontiguousarray(scores.newest_evaluation_step),
                oldest_step=np.ascontiguousarray(scores.oldest_evaluation_step),
                n_evaluations=scores.n_evaluations,
                n_evaluators=n_evaluators,
            ),
            at,
            lookup_kernels.LookupRules(
                source=int(source),
                value_age_s=age_s,
                time_s=time_s,
                dt_s=self.dt_s,
                window_s=window_s,
                unevaluated_is_used=params.unjudged != "default",
            ),
        )
        return scores.n_evaluators is not None or not (at >= 0).any()

    def rejected(self, state: TrustState) -> dict[str, int]:
        """Evaluations that the acting model rejected so far, by cause, where it counts them."""
        counts = getattr(state.hosts[self.host_of[0]].model, "rejected", None)
        if not isinstance(counts, ndarray):
            return {}
        return {cause.name.lower(): int(n) for cause, n in zip(RejectReason, counts, strict=False) if n}

    def scorers(self, state: TrustState) -> list[ObjectScorer | None]:
        """Per variant: the scores that its model gives to objects, None where it gives none."""
        return [
            None if state.hosts[h].model is None else getattr(self._model(state, h), "score_objects", None)
            for h in self.host_of
        ]

    def _model(self, state: TrustState, h: int, latest_step: int | None = None) -> TrustModel:
        """The model of a host, guarded if it is a user's own; `latest_step` is that of the call, where no argument
        says it."""
        model, guard = state.hosts[h].model, self.models[h].guard
        assert model is not None
        return model if guard is None else guard(model, latest_step=latest_step)

    def _hosts(self, host: str) -> list[int]:
        return [h for h, params in enumerate(self.params) if params.host == host]

    def _any(self, host: str) -> bool:
        return any(params.host == host for params in self.params)


@cache
def _has_window(model: type) -> bool:
    params = getattr(model, "Params", None)
    return params is not None and "freshness_s" in {f.name for f in fields(params)}


def host_key(variant: Variant) -> tuple:
    """What a host depends on; variants of one key share it."""
    kept = {f.name for f in fields(TrustParams)} - FUSION_KEYS - set(EVIDENCE_KEYS) - {"model"}
    return variant.model, repr(variant.own), *(getattr(variant.trust, name) for name in sorted(kept))


def _kind(params: TrustParams) -> tuple[str, str]:
    """Hosts of one kind hear the same evaluations."""
    return params.host, params.local_evidence


def _shared(params: Sequence[TrustParams], models: Sequence[Variant]) -> list[list[int]]:
    """Hosts whose models hear the same evaluations: of one class, at one kind of host."""
    groups: dict[tuple, list[int]] = {}
    for h, (p, variant) in enumerate(zip(params, models, strict=True)):
        if p.host != "none":
            groups.setdefault((variant.model, *_kind(p)), []).append(h)
    return list(groups.values())
