"""Predicts freshness of trust for a config: replays its traffic, adds up chances of evaluation, and applies the law."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim import rng
from cosim.config.config import Config
from cosim.execution import run as running
from cosim.execution.check import check
from cosim.execution.drive import Advance, warm_up
from cosim.mobility.source import TrafficEnded
from cosim.predict import law
from cosim.predict.delivery import Delivery, Load, arrival_p
from cosim.predict.opportunities import Sensing, chances
from cosim.radio.medium import Medium
from cosim.radio.message_round import RoundKind
from cosim.step.parts import Parts
from cosim.step.trackers.encounters import update_encounters
from cosim.v2x.messages import cpm_bytes, evaluation_bytes
from cosim.world import World
from results.codes import BASE_VARIANT
from results.encounters import EncounterTracker
from results.metrics.intervals import around
from sensors.line_of_sight import LosOfPlaces
from sensors.scene import Shape
from trust.params import TrustParams, open_window_steps, window_of

LEVEL_TEXT = "95 %"
_ARRIVED = 1e-4
"""Evidence counts as arrived when its chance to arrive later is below this."""
_MOST_LAGS = 20
_LEAST_P = 1e-6
"""Chances below this are left out."""


class Server(NamedTuple):
    """A trust variant whose freshness is predicted."""

    name: str
    period_s: float
    window_s: float
    """Evidence of this age or older does not count [s]; inf if it never expires."""
    window_steps: int
    """The same in sensing steps."""
    zero: bool
    """Whether detections that no other vehicle could see are evidence (`trust.unseen = "zero"`)."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Freshness of one trust variant, as metrics of a run define it."""

    variant: str
    period_s: float
    window_s: float
    age_s: Float[ndarray, "a"]
    """Ages that lookups can find [s]."""
    newest: Float[ndarray, "a"]
    """Expected lookups by the age of the newest evaluation."""
    oldest: Float[ndarray, "a"]
    value: Float[ndarray, "a"]
    metrics: dict[str, float]
    """Values by the identifier of the metric of a run (`cosim measure`), with the state after a colon."""
    low: dict[str, float] = field(default_factory=dict)
    """Lower end of the interval for a run with another fleet; empty if no other fleet was drawn."""
    high: dict[str, float] = field(default_factory=dict)
    closed: dict[str, float] = field(default_factory=dict)
    """Median and 90th percentile by the closed form."""


METRICS = {
    "freshness.newest_evaluation_age.median_s": "newest evaluation at lookup, median age [s]",
    "freshness.newest_evaluation_age.p90_s": "newest evaluation at lookup, 90th percentile [s]",
    "freshness.newest_evaluation_age.mean_s": "newest evaluation at lookup, mean age [s]",
    "freshness.oldest_evaluation_age.median_s": "oldest evaluation at lookup, median age [s]",
    "freshness.value_age.median_s": "value at lookup, median age [s]",
    "freshness.lookup_state.share:evaluated": "lookups: evaluated",
    "freshness.lookup_state.share:stale": "lookups: stale",
    "freshness.lookup_state.share:unevaluated": "lookups: unevaluated",
    "freshness.lookup_state.share:no value": "lookups: no value",
    "freshness.evaluators.mean": "evaluators behind a value, mean",
    "freshness.evaluations.mean": "evaluations behind a value, mean",
    "freshness.encounters_without_trust.share": "encounters over before trust was known",
}
"""Predicted metrics and their labels."""


def predict(config: Config, advance: Advance, n_fleets: int = 4) -> tuple[list[Prediction], dict[str, float]]:
    """Predict freshness for every trust variant of a config.

    Parameters
    ----------
    config
        The experiment. It is not run: only its traffic is.
    advance
        Called with progress.
    n_fleets
        Number of further fleets, drawn with other seeds from the same traffic, for the intervals.

    Returns
    -------
    A prediction per trust variant, and measured inputs of the law by name.

    Raises
    ------
    ValueError
        In one line, if the config cannot run, or if the law does not cover it.
    """
    scenario = check(config)
    servers = servers_of(config)
    parts, _, traffic = running.load_parts(config, scenario)
    try:
        return _predict(config, parts, servers, _worlds(config, parts, scenario, traffic, advance), n_fleets)
    finally:
        traffic.close()


def _worlds(config: Config, parts: Parts, scenario: Any, traffic: Any, advance: Advance) -> Iterator[World]:
    """The worlds of the recorded steps."""
    warm_up(running.warmup_of(config, scenario), traffic, parts.watch, advance)
    for number in range(config.n_steps):
        try:
            world = traffic.advance()
        except TrafficEnded:
            return
        yield world
        advance("predict", number + 1, config.n_steps, f"steps, {len(world)} actors")


def _predict(
    config: Config, parts: Parts, servers: list[Server], worlds: Iterator[World], n_fleets: int
) -> tuple[list[Prediction], dict[str, float]]:
    walls = parts.near_pairs.walls  # type: ignore[attr-defined]  # of `PairSearch`
    sensing = Sensing.of(config, parts.perception.detector, walls)  # type: ignore[attr-defined]  # of `Perception`
    delivery = Delivery.of(config, LosOfPlaces(walls))
    fleets = [Fleet.of(config, servers, parts.medium, number) for number in range(1 + n_fleets)]
    for world in worlds:
        for fleet in fleets:
            fleet.add(world, config, parts, sensing, delivery)
    found = [fleet.predictions(config) for fleet in fleets]
    own = [_with_intervals(of[0], of[1:]) for of in zip(*(predictions for predictions, _ in found), strict=True)]
    return own, found[0][1]


def _with_intervals(own: Prediction, others: Sequence[Prediction]) -> Prediction:
    """Intervals that a run with another fleet falls into with 95 %, from the spread over fleets."""
    if not others:
        return own
    low, high = {}, {}
    for name, value in own.metrics.items():
        values = np.array([value, *(other.metrics[name] for other in others)])
        values = values[np.isfinite(values)]
        if len(values) < 2 or not np.isfinite(value):
            continue
        error = float(np.std(values, ddof=1) * np.sqrt(1 + 1 / len(values)))
        bounds = (0.0, 1.0) if ".share" in name else (0.0, np.inf)
        given = around(float(values.mean()), error, len(values) - 1, bounds)
        low[name], high[name] = given.low, given.high
    return replace(own, low=low, high=high)


def servers_of(config: Config) -> list[Server]:
    """The trust variants of a config.

    Raises
    ------
    ValueError
        In one line, if the law does not cover the config.
    """
    for key, value, allowed in (
        ("sensing", config.sensing, (True,)),
        ("driver.model", config.driver.model, ("none",)),
        ("radio.evaluations", config.radio.evaluations, ("alone",)),
        ("radio.cpm_rules", config.radio.cpm_rules, ("all",)),
        ("radio.relay.max_hops", config.radio.relay.max_hops, (1,)),
        ("server.uplink", config.server.uplink, ("cellular",)),
        ("server.outages", config.server.outages, ((),)),
        ("pseudonyms.policy", config.pseudonyms.policy, ("none",)),
        ("pseudonyms.revocation", config.pseudonyms.revocation, ("none",)),
    ):
        if value not in allowed:
            raise ValueError(
                f"{key} = {value!r}: the law of freshness covers {key} = {allowed[0]!r} only (cosim/docs/pages/models/"
                "freshness-law.md says what it covers). Change it, or simulate."
            )
    variants = [(BASE_VARIANT, config.trust), *((v.name, v.trust) for v in config.trust_variant)]
    return [_server(name, trust, config) for name, trust in variants]


def _server(name: str, trust: TrustParams, config: Config) -> Server:
    where = "trust" if name == BASE_VARIANT else f'trust_variant "{name}"'
    if trust.host != "central":
        raise ValueError(
            f'{where}.host = "{trust.host}": the law of freshness covers host = "central" only. Change it, or simulate.'
        )
    if trust.model != "trupercept":
        raise ValueError(
            f'{where}.model = "{trust.model}": the law of freshness covers model = "trupercept" only. Change it, or '
            "simulate."
        )
    every = config.sense_every_steps
    if trust.freshness_s == "off":
        return Server(name, trust.server_period_s, np.inf, 2**31, trust.unseen == "zero")
    steps = -(-open_window_steps(trust, config.traffic.step_s) // every)
    return Server(name, trust.server_period_s, window_of(trust), steps, trust.unseen == "zero")


def left_out(config: Config) -> list[str]:
    """What the config has that the law neglects, one sentence each."""
    found = []
    if config.attacks:
        found.append("attacks: the law takes all vehicles for honest; ghosts and lies add evaluations.")
    if config.gnss.std_m > 0:
        found.append("gnss: the law takes positions for exact.")
    if config.meshes or config.vehicle_meshes:
        found.append("meshes: the law sees the prisms of buildings and vehicles only.")
    return found


@dataclass(slots=True)
class Fleet:
    """Equipped vehicles of one draw, and what the replay has found about them so far."""

    number: int
    """0 for the fleet of the run itself."""
    servers: list[Server]
    load: Load
    gates: dict[float, law.Gate]
    trackers: tuple[EncounterTracker, ...]
    arrived_p: Float[ndarray, "m"]
    """Probability that a report is at the server after 1, 2, ... m sensing steps."""
    n_followed: int
    since: dict[int, int] = field(default_factory=dict)
    """Sensing step in which each equipped vehicle came on the road, by actor."""
    evidence: list[tuple[Int[ndarray, "v"], Float[ndarray, "m v"]]] = field(default_factory=list)
    """Per sensing step: subjects, and logarithms of the probability that they are not evaluated."""
    pairs: list[tuple[ndarray, ...]] = field(default_factory=list)
    """Per sensing step: subject, evaluator, logarithm as above, expected evaluations."""
    looks: dict[float, list[tuple[ndarray, ...]]] = field(default_factory=dict)
    """Per period and sensing step: subject, publications, lookups that find them, lookups that find none."""
    heard: list[tuple[ndarray, ...]] = field(default_factory=list)
    """Per sensing step: pairs near each other (holder and subject), step, logarithm of the probability that the holder
    does not look the subject up."""
    met: list[dict[str, ndarray]] = field(default_factory=list)
    step: int = 0
    """Number of sensing steps so far."""
    last_step: int = -1
    inputs: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def of(config: Config, servers: list[Server], medium: Medium, number: int) -> "Fleet":
        """A fleet before the first step."""
        n_steps = -(-config.n_steps // config.sense_every_steps)
        interval_s, server = config.sensing_interval_s, config.server.cellular
        lags_s = interval_s * np.arange(1, _MOST_LAGS + 1) - config.timeout_s
        arrived_p = arrival_p(lags_s, server.uplink_loss_p, server.n_retries, server)
        m = 1 + int(np.argmax(arrived_p >= arrived_p[-1] - _ARRIVED))
        return Fleet(
            number, servers, Load(medium, medium.start()), {s.period_s: law.Gate.of(s.period_s, interval_s, n_steps) for s in servers},
            tuple(EncounterTracker(p, config.traffic.step_s) for p in config.encounters),
            np.append(arrived_p[: m - 1], arrived_p[-1]), law.n_followed(server.downlink_loss_p),
        )  # fmt: skip

    def add(self, world: World, config: Config, parts: Parts, sensing: Sensing, delivery: Delivery) -> None:
        """Add one step of traffic."""
        world = self._equipped(world, config)
        closed, _, _ = update_encounters(self.trackers, world.step, parts.near_pairs(world))
        self.met += closed[:1]
        self.last_step = world.step
        if world.step % config.sense_every_steps:
            return
        row = np.flatnonzero(world.equipped)
        actor = world.actor[row]
        for one in actor.tolist():
            self.since.setdefault(one, self.step)
        if len(row):
            self._sense(world, row, config, sensing, delivery)
        else:
            self.evidence.append((actor, np.zeros((len(self.arrived_p), 0))))
            self.pairs.append((actor, actor, np.zeros(0), np.zeros(0)))
            self.heard.append((np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)))
        self.step += 1

    def _equipped(self, world: World, config: Config) -> World:
        """The world with the equipped vehicles of this fleet."""
        if self.number == 0:
            return world
        classes = {name.upper() for name in config.fleet.equipped_kinds}
        can = np.array([shape.name in classes for shape in Shape])[world.shape]
        draw = rng.uniforms(rng.key(config.seed + self.number, rng.Stream.EQUIPPED), world.name_key)[:, 0]
        return replace(world, equipped=can & (draw < config.fleet.penetration_p))

    def _sense(self, world: World, row: ndarray, config: Config, sensing: Sensing, delivery: Delivery) -> None:
        actor, n = world.actor[row], len(row)
        views, links = sensing.views(world, row), delivery.links(world, row)
        n_self = int(config.trust.self_reports)
        begin_s = self.step * config.sensing_interval_s
        told_p = self.load.delivered_p(
            RoundKind.CPM, self.step, begin_s, links, cpm_bytes(n_self + views.n_listed)  # type: ignore[arg-type]
        )
        found = chances(views, links.sender, links.receiver, config.trust.self_reports)
        evaluated_p = told_p * (1.0 - found.none_p)
        n_evaluations = n_self + views.n_listed + np.bincount(links.receiver, told_p * found.n_listed, n)
        heard_p = self.load.delivered_p(
            RoundKind.EVALUATION, self.step, begin_s + config.timeout_s, links,
            evaluation_bytes(n_evaluations),  # type: ignore[arg-type]  # expected lengths
        )  # fmt: skip
        log_none = np.array([
            np.bincount(links.sender, np.log1p(-np.minimum(evaluated_p * p, 1 - 1e-12)), n) for p in self.arrived_p
        ])  # fmt: skip
        self.evidence.append((actor, log_none))
        kept = np.flatnonzero(evaluated_p > _LEAST_P)
        self.pairs.append((
            actor[links.sender[kept]], actor[links.receiver[kept]],
            np.log1p(-np.minimum(evaluated_p[kept] * self.arrived_p[-1], 1 - 1e-12)),
            told_p[kept] * found.n[kept] * self.arrived_p[-1],
        ))  # fmt: skip
        xy_m = world.boxes.xyz_m[row, :2]
        apart_m = np.hypot(*(xy_m[links.sender] - xy_m[links.receiver]).T)
        near = np.flatnonzero(apart_m <= 1.5 * config.encounters[0].radius_m)
        pair = actor[links.receiver[near]].astype(np.int64) << 32 | actor[links.sender[near]]
        log_missed = np.log1p(-np.minimum(heard_p[near], 1 - 1e-12))
        self.heard.append((pair, np.full(len(near), self.step), log_missed))
        since = np.array([self.since[one] for one in actor.tolist()], np.int64)[links.receiver]
        server, at_s = config.server.cellular, 2 * config.timeout_s
        for period_s, gate in self.gates.items():
            publications = gate.before(self.step, self.n_followed)
            ages_s = (self.step - publications) * config.sensing_interval_s + at_s
            received_p = arrival_p(ages_s, server.downlink_loss_p, 0, server)
            looks, none = law.looks_at(links.sender, since, heard_p, n, publications, received_p)
            self.looks.setdefault(period_s, []).append((np.full(n, self.step), actor, publications, looks, none))
        self._count(told_p, heard_p, evaluated_p, log_none[-1], np.bincount(links.sender, heard_p, n), n)

    def _count(
        self, told_p: ndarray, heard_p: ndarray, evaluated_p: ndarray, log_none: ndarray, weight: ndarray, n: int
    ) -> None:
        """Add up measured inputs of the law."""
        for name, value in (
            ("equipped", n), ("links", len(told_p)), ("delivered", told_p.sum()), ("lookups", heard_p.sum()),
            ("evaluators", evaluated_p.sum()), ("evaluated", float(-np.expm1(log_none).sum())),
            ("looked_up_evaluated", float(-np.expm1(log_none) @ weight)),
        ):  # fmt: skip
            self.inputs[name] = self.inputs.get(name, 0.0) + float(value)

    def predictions(self, config: Config) -> tuple[list[Prediction], dict[str, float]]:
        """The predictions for all servers, and measured inputs by name."""
        actors = np.array(sorted(self.since), np.int64)
        n_steps = max(self.step, 1)
        log_none = np.zeros((len(self.arrived_p), len(actors), n_steps))
        for step, (actor, values) in enumerate(self.evidence):
            log_none[:, np.searchsorted(actors, actor), step] = values
        evidence = law.Evidence(log_none)
        pair_steps, pair_subject = self._pair_steps(actors)
        meetings = self._meetings(actors, config)
        inputs = self._inputs()
        looks = {period_s: self._looks_of(rows, actors) for period_s, rows in self.looks.items()}
        made = [
            _prediction(
                server, config, evidence, looks.get(server.period_s), pair_steps, pair_subject, meetings,
                self.gates[server.period_s], self.first_lag, inputs["evaluated_p"],
            )  # fmt: skip
            for server in self.servers
        ]
        return made, inputs

    @property
    def first_lag(self) -> int:
        """Age in sensing steps from which on most reports are at the server."""
        return 1 + int(np.argmax(self.arrived_p >= 0.5 * self.arrived_p[-1]))

    def _inputs(self) -> dict[str, float]:
        got, n = self.inputs, max(self.step, 1)
        subject_steps, links = max(got.get("equipped", 0.0), 1e-12), max(got.get("links", 0.0), 1e-12)
        return {
            "equipped.mean": got.get("equipped", 0.0) / n,
            "links_per_vehicle.mean": got.get("links", 0.0) / subject_steps,
            "delivery.mean": got.get("delivered", 0.0) / links,
            "evaluators_per_step.mean": got.get("evaluators", 0.0) / subject_steps,
            "evaluated_p": got.get("looked_up_evaluated", 0.0) / max(got.get("lookups", 0.0), 1e-12),
            "evaluated_p.unweighted": got.get("evaluated", 0.0) / subject_steps,
            "lookups": got.get("lookups", 0.0),
        }

    def _looks_of(self, rows: list[tuple[ndarray, ...]], actors: ndarray) -> law.Looks:
        step, actor, publications, n, none = zip(*rows, strict=True)
        repeated = [np.tile(p, (len(a), 1)) for p, a in zip(publications, actor, strict=True)]
        subject = np.searchsorted(actors, np.concatenate(actor))
        return law.Looks(
            subject, np.concatenate(step), np.concatenate(repeated), np.concatenate(n), np.concatenate(none)
        )

    def _pair_steps(self, actors: ndarray) -> tuple[law.PairSteps, Int[ndarray, "k"]]:
        subject, evaluator, log_none, n = (np.concatenate(c) for c in zip(*self.pairs, strict=True))
        step = np.repeat(np.arange(len(self.pairs)), [len(rows[0]) for rows in self.pairs])
        keys, pair = np.unique(subject.astype(np.int64) << 32 | evaluator, return_inverse=True)
        subjects = np.searchsorted(actors, keys >> 32)
        return law.PairSteps(step, subjects[pair], pair.reshape(-1), log_none, n), subjects

    def _meetings(self, actors: ndarray, config: Config) -> law.Meetings:
        """Encounters by the first definition of the config, those that are still open included."""
        rows = self.met + [tracker.close(self.last_step + 1) for tracker in self.trackers[:1]]
        a, b, start, end, departed = (
            np.concatenate([np.zeros(0, np.int64), *(one[name] for one in rows)]).astype(np.int64)
            for name in ("a", "b", "start_step", "end_step", "departed")
        )
        # Until the break has become too long, lookups count: the encounter may go on.
        patience = max(1, int(np.ceil(config.encounters[0].hysteresis_s / config.traffic.step_s - 1e-9)))
        end = np.minimum(np.where(departed, end, end + patience - 1), self.last_step + 1)
        both = np.isin(a, actors) & np.isin(b, actors)
        a, b = a[both], b[both]
        start, end = (np.tile(-(-x[both] // config.sense_every_steps), 2) for x in (start, end))
        holder, other = np.concatenate([a, b]), np.concatenate([b, a])
        since = np.array([self.since[one] for one in holder.tolist()], np.int64)
        keys, steps, log_missed = (np.concatenate(c) for c in zip(*self.heard, strict=True))
        order = np.lexsort((steps, keys))
        first, stop = (np.searchsorted(keys[order], holder << 32 | other, side) for side in ("left", "right"))
        return law.Meetings(
            since, np.searchsorted(actors, other), start, end, first, stop, steps[order], log_missed[order]
        )


def _prediction(
    server: Server, config: Config, evidence: law.Evidence, looks: law.Looks | None, pair_steps: law.PairSteps,
    pair_subject: ndarray, meetings: law.Meetings, gate: law.Gate, first_lag: int, evaluated_p: float,
) -> Prediction:  # fmt: skip
    """The prediction for one server."""
    n_steps = evidence.log_none.shape[2]
    interval_s, at_s, loss_p = config.sensing_interval_s, 2 * config.timeout_s, config.server.cellular.downlink_loss_p
    age_s = at_s + interval_s * np.arange(n_steps + 1)
    if looks is None:
        none = np.zeros(n_steps + 1)
        counts, total, evaluators, evaluations = law.AgeCounts(none, none, none, 0.0), 0.0, 0.0, 0.0
    else:
        counts, total = law.ages(evidence, looks, server.window_steps), looks.total
        evaluators, evaluations = law.behind(pair_steps, pair_subject, looks, server.window_steps, first_lag)
    known, fresh = counts.newest.sum(), counts.newest[age_s < server.window_s].sum()
    unevaluated = counts.n_unknown if server.zero else 0.0

    def share(n: float) -> float:
        return n / total if total > 0 else float("nan")

    metrics = {
        "freshness.newest_evaluation_age.median_s": law.quantile(age_s, counts.newest, 0.5),
        "freshness.newest_evaluation_age.p90_s": law.quantile(age_s, counts.newest, 0.9),
        "freshness.newest_evaluation_age.mean_s": float(counts.newest @ age_s / known) if known > 0 else float("nan"),
        "freshness.oldest_evaluation_age.median_s": law.quantile(age_s, counts.oldest, 0.5),
        "freshness.value_age.median_s": law.quantile(age_s, counts.value, 0.5),
        "freshness.lookup_state.share:evaluated": share(fresh),
        "freshness.lookup_state.share:stale": share(known - fresh),
        "freshness.lookup_state.share:unevaluated": share(unevaluated),
        "freshness.lookup_state.share:no value": share(total - known - unevaluated),
        "freshness.evaluators.mean": evaluators / known if known > 0 else float("nan"),
        "freshness.evaluations.mean": evaluations / known if known > 0 else float("nan"),
        "freshness.encounters_without_trust.share": law.without_trust(
            evidence, meetings, gate, server.window_steps, loss_p, first_lag
        ),
    }
    window = min(server.window_steps, n_steps)
    period = int(gate.steps[1] - gate.steps[0]) if len(gate.steps) > 1 else n_steps
    closed = law.closed_form(evaluated_p, period, window, loss_p, at_s / 2, interval_s, n_steps + 1)
    names = list(METRICS)[:2]
    return Prediction(
        variant=server.name, period_s=server.period_s, window_s=server.window_s, age_s=age_s, newest=counts.newest,
        oldest=counts.oldest, value=counts.value, metrics=metrics,
        closed={name: law.quantile(age_s, closed, share) for name, share in zip(names, (0.5, 0.9), strict=True)},
    )  # fmt: skip


