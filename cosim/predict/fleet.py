"""The equipped vehicles of one draw: what a replay of the traffic finds about them, step by step."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim import rng
from cosim.config.config import Config
from cosim.predict import law
from cosim.predict.delivery import Delivery, Load, arrival_p
from cosim.predict.opportunities import Sensing, chances
from cosim.predict.prediction import Found, Prediction, predicted
from cosim.predict.scope import Server
from cosim.radio.message_round import RoundKind
from cosim.step.parts import Parts
from cosim.step.trackers.encounters import update_encounters
from cosim.v2x.messages import cpm_bytes, evaluation_bytes
from cosim.world import World
from results.encounters import EncounterTracker
from sensors.line_of_sight import LosOfPlaces
from sensors.scene import Shape

_ARRIVED = 1e-4
"""Evidence counts as arrived when its chance to arrive later is below this."""
_MOST_LAGS = 20
_LEAST_P = 1e-6
"""Chances below this are left out."""
_MEETING = 1.5
"""Lookups between two vehicles count for their encounter up to this part of its radius: a break ends none at once."""


@dataclass(slots=True)
class Fleet:
    """Equipped vehicles of one draw, and what the replay has found about them so far."""

    config: Config
    parts: Parts
    sensing: Sensing
    delivery: Delivery
    number: int
    """0 for the fleet of the run itself."""
    servers: tuple[Server, ...]
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
    def of(config: Config, servers: tuple[Server, ...], parts: Parts, number: int) -> "Fleet":
        """A fleet before the first step.

        Parameters
        ----------
        config
            The experiment.
        servers
            Trust servers that are asked about.
        parts
            Components of the experiment. Detector and medium are read; nothing is sensed.
        number
            0 for the fleet of the run itself; others are drawn with other seeds.
        """
        walls = parts.near_pairs.walls  # type: ignore[attr-defined]  # of `PairSearch`
        detector = parts.perception.detector  # type: ignore[attr-defined]  # of `Perception`
        interval_s, server = config.sensing_interval_s, config.server.cellular
        lags_s = interval_s * np.arange(1, _MOST_LAGS + 1) - config.timeout_s
        arrived_p = arrival_p(lags_s, server.uplink_loss_p, server.n_retries, server)
        m = 1 + int(np.argmax(arrived_p >= arrived_p[-1] - _ARRIVED))
        return Fleet(
            config=config,
            parts=parts,
            sensing=Sensing.of(config, detector, walls),
            delivery=Delivery.of(config, LosOfPlaces(walls)),
            number=number,
            servers=servers,
            load=Load(parts.medium, parts.medium.start()),
            gates={s.period_s: law.Gate(law.period_steps(s.period_s, interval_s)) for s in servers},
            trackers=tuple(EncounterTracker(p, config.traffic.step_s) for p in config.encounters),
            arrived_p=np.append(arrived_p[: m - 1], arrived_p[-1]),
            n_followed=law.n_followed(server.downlink_loss_p),
        )

    def add(self, world: World) -> None:
        """Add one step of traffic."""
        config, parts = self.config, self.parts
        world = self._equipped(world)
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
            self._sense(world, row)
        else:
            self.evidence.append((actor, np.zeros((len(self.arrived_p), 0))))
            self.pairs.append((actor, actor, np.zeros(0), np.zeros(0)))
            self.heard.append((np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)))
        self.step += 1

    def _equipped(self, world: World) -> World:
        """The world with the equipped vehicles of this fleet, drawn as `ActorRegistry` does."""
        config = self.config
        classes = {name.upper() for name in config.fleet.equipped_kinds}
        can = np.array([shape.name in classes for shape in Shape])[world.shape]
        draw = rng.uniforms(rng.key(config.seed + self.number, rng.Stream.EQUIPPED), world.name_key)[:, 0]
        return replace(world, equipped=can & (draw < config.fleet.penetration_p))

    def _sense(self, world: World, row: Int[ndarray, "v"]) -> None:
        """Add a step in which vehicles sense."""
        config, actor, n = self.config, world.actor[row], len(row)
        views, links = self.sensing.views(world, row), self.delivery.links(world, row)
        n_self = int(config.trust.self_reports)
        begin_s = self.step * config.sensing_interval_s
        length_bytes = cpm_bytes(n_self + views.n_listed)  # type: ignore[arg-type]  # expected lengths
        told_p = self.load.delivered_p(RoundKind.CPM, self.step, begin_s, links, length_bytes)
        found = chances(views, links.sender, links.receiver, config.trust.self_reports)
        evaluated_p = told_p * (1.0 - found.none_p)
        n_evaluations = n_self + views.n_listed + np.bincount(links.receiver, told_p * found.n_listed, n)
        length_bytes = evaluation_bytes(n_evaluations)  # type: ignore[arg-type]  # expected lengths
        begin_s += config.timeout_s
        heard_p = self.load.delivered_p(RoundKind.EVALUATION, self.step, begin_s, links, length_bytes)
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
        near = np.flatnonzero(apart_m <= _MEETING * max((p.radius_m for p in config.encounters[:1]), default=0.0))
        pair = actor[links.receiver[near]].astype(np.int64) << 32 | actor[links.sender[near]]
        log_missed = np.log1p(-np.minimum(heard_p[near], 1 - 1e-12))
        self.heard.append((pair, np.full(len(near), self.step), log_missed))
        since = np.array([self.since[one] for one in actor.tolist()], np.int64)[links.receiver]
        server, at_s = config.server.cellular, 2 * config.timeout_s
        for period_s, gate in self.gates.items():
            gate.open(self.step)
            publications = gate.before(self.step, self.n_followed)
            ages_s = (self.step - publications) * config.sensing_interval_s + at_s
            received_p = arrival_p(ages_s, server.downlink_loss_p, 0, server)
            looks, none = law.expected_lookups(links.sender, since, heard_p, n, publications, received_p)
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

    def predictions(self) -> tuple[list[Prediction], dict[str, float]]:
        """The predictions for all servers, and measured inputs by name.

        Raises
        ------
        ValueError
            If there was no traffic, or no equipped vehicle.
        """
        if not self.step:
            raise ValueError(
                f"traffic.scenario = {self.config.traffic.scenario}: the traffic ended before the first step, so there "
                "is nothing to predict. Shorten traffic.warmup_s."
            )
        if not self.inputs.get("equipped"):
            raise ValueError(
                f"fleet.penetration_p = {self.config.fleet.penetration_p:g}: no equipped vehicle was on the road, so "
                "there is nothing to predict. Raise it, or traffic.duration_s."
            )
        actors = np.array(sorted(self.since), np.int64)
        n_steps = max(self.step, 1)
        log_none = np.zeros((len(self.arrived_p), len(actors), n_steps))
        for step, (actor, values) in enumerate(self.evidence):
            log_none[:, np.searchsorted(actors, actor), step] = values
        evidence = law.Evidence(log_none)
        pair_steps, pair_subject = self._pair_steps(actors)
        meetings = self._meetings(actors)
        inputs = self._inputs()
        looks = {period_s: self._looks_of(rows, actors) for period_s, rows in self.looks.items()}
        since = np.array([self.since[one] for one in actors.tolist()], np.int64)
        found = Found(evidence, since, pair_steps, pair_subject, meetings, self.first_lag, inputs["evaluated_p"])
        made = [
            predicted(server, self.config, found, self.gates[server.period_s], looks.get(server.period_s))
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

    def _looks_of(self, rows: list[tuple[ndarray, ...]], actors: ndarray) -> law.ExpectedLookups:
        step, actor, publications, n, none = zip(*rows, strict=True)
        repeated = [np.tile(p, (len(a), 1)) for p, a in zip(publications, actor, strict=True)]
        subject = np.searchsorted(actors, np.concatenate(actor))
        return law.ExpectedLookups(
            subject, np.concatenate(step), np.concatenate(repeated), np.concatenate(n), np.concatenate(none)
        )

    def _pair_steps(self, actors: ndarray) -> tuple[law.PairSteps, Int[ndarray, "k"]]:
        subject, evaluator, log_none, n = (np.concatenate(c) for c in zip(*self.pairs, strict=True))
        step = np.repeat(np.arange(len(self.pairs)), [len(rows[0]) for rows in self.pairs])
        keys, pair = np.unique(subject.astype(np.int64) << 32 | evaluator, return_inverse=True)
        subjects = np.searchsorted(actors, keys >> 32)
        return law.PairSteps(step, subjects[pair], pair.reshape(-1), log_none, n), subjects

    def _meetings(self, actors: ndarray) -> law.Encounters:
        """Encounters by the first definition of the config, those that are still open included."""
        config = self.config
        if not self.trackers:
            none = np.zeros(0, np.int64)
            return law.Encounters(none, none, none, none, none, none, none, np.zeros(0))
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
        return law.Encounters(
            since, np.searchsorted(actors, other), start, end, first, stop, steps[order], log_missed[order]
        )
