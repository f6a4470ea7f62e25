"""The equipped vehicles of one draw: what a replay of the traffic finds about them, step by step."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.addons.law import law
from cosim.addons.law.closed_form import Company
from cosim.addons.law.delivery import Delivery, LinkPairs, Load, arrival_p, expected_cpm_bytes
from cosim.addons.law.draws import drawn
from cosim.addons.law.newest import NewestReceived, SweepTimes
from cosim.addons.law.opportunities import Sensing, chances
from cosim.addons.law.prediction import FleetFindings, Prediction, counted, predicted
from cosim.addons.law.scope import Server
from cosim.base import rng
from cosim.config.config import Config
from cosim.messages.content import evaluation_bytes
from cosim.messages.trust_server import KEPT_S
from cosim.radio.message_round import RoundKind
from cosim.step.parts import Parts
from cosim.step.trackers.encounters import update_encounters
from cosim.traffic.schedule import Schedule
from cosim.world import World
from results.encounters import EncounterTracker
from sensors.line_of_sight import LosOfPlaces
from sensors.scene import Shape

Values = dict[str, float]
"""Numbers by name."""

_ARRIVED = 1e-4
"""Evidence counts as arrived when its chance to arrive later is below this."""
_MOST_LAGS = 20
"""Sensing intervals within which a report arrives or is left out."""
_LEAST_P = 1e-6
"""Chances below this are left out."""
_MEETING = 1.5
"""Lookups between two vehicles count for their encounter up to this part of its radius: a break ends none at once."""


@dataclass(slots=True)
class Visits:
    """Visits of vehicles to the road. The visit of a vehicle goes on while it is away for up to `KEPT_S`."""

    seen_s: dict[int, float] = field(default_factory=dict)
    """When each vehicle was last on the road."""
    began: dict[int, int] = field(default_factory=dict)
    """First step of its visit."""

    def now(self, actors: list[int], step: int, begin_s: float, end_s: float) -> Int[ndarray, "v"]:
        """The visits of these vehicles, ascending: the actor number and, in the lower 32 bits, the first step.

        Parameters
        ----------
        actors
            Vehicles on the road, ascending.
        step
            The first step of a visit that begins now.
        begin_s, end_s
            When they come on the road, if they were away, and when they may leave it.
        """
        for actor in actors:
            if begin_s - self.seen_s.get(actor, -np.inf) > KEPT_S:
                self.began[actor] = step
            self.seen_s[actor] = end_s
        began = [self.began[actor] for actor in actors]
        return np.array(actors, np.int64) << 32 | np.array(began, np.int64)


@dataclass(slots=True)
class Fleet:
    """Equipped vehicles of one draw, and what the replay has found about them so far."""

    config: Config
    """The experiment, with the seed of this fleet."""
    parts: Parts
    schedule: Schedule
    sensing: Sensing
    delivery: Delivery
    servers: tuple[Server, ...]
    load: Load
    gates: dict[float, law.PublishingSteps]
    trackers: tuple[EncounterTracker, ...]
    arrived_p: Float[ndarray, "m"]
    """Probability that a report is at the server 1, 2, ... m steps after its sweep."""
    n_followed: int
    sweeps: SweepTimes = field(default_factory=SweepTimes.none)
    """The newest sweep of each vehicle. It is also when the vehicle sent its newest messages."""
    cpms: NewestReceived = field(default_factory=NewestReceived.none)
    reports: NewestReceived = field(default_factory=NewestReceived.none)
    """The newest detection message and the newest evaluation message of each vehicle."""
    visits: Visits = field(default_factory=Visits)
    on_road: list[Int[ndarray, "v"]] = field(default_factory=list)
    """Per step: visits of the equipped vehicles."""
    evidence: list[tuple[ndarray, ...]] = field(default_factory=list)
    """Per step: subjects, step of their detections, and by lag the logarithm of the probability that they are not
    evaluated."""
    pairs: list[tuple[ndarray, ...]] = field(default_factory=list)
    """Per step: subject, evaluator, step of the detections, step of the evaluation, logarithm as above."""
    asked: list[tuple[ndarray, ...]] = field(default_factory=list)
    """Per step: subjects, step of their newest detections, expected lookups."""
    looks: dict[float, list[tuple[ndarray, ...]]] = field(default_factory=dict)
    """Per period and step: subject, publications, lookups that find them, lookups that find none."""
    heard: list[tuple[ndarray, ...]] = field(default_factory=list)
    """Per step: pairs near each other (holder and subject), step, logarithm of the probability that the holder does not
    look the subject up."""
    met: list[dict[str, ndarray]] = field(default_factory=list)
    step: int = 0
    """Number of steps so far, of those in which any vehicle may sense."""
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
        config = replace(config, seed=config.seed + number)
        schedule, server = config.schedule, config.server.cellular
        interval_s = schedule.exchange_interval_s
        n_lags = _MOST_LAGS * schedule.longest_steps // schedule.exchange_every_steps
        lags_s = interval_s * np.arange(1, n_lags + 1) - config.round_s
        arrived_p = arrival_p(lags_s, server.uplink_loss_p, server.n_retries, server)
        m = 1 + int(np.argmax(arrived_p >= arrived_p[-1] - _ARRIVED))
        return Fleet(
            config=config,
            parts=parts,
            schedule=schedule,
            sensing=Sensing.of(config, detector, walls),
            delivery=Delivery.of(config, LosOfPlaces(walls)),
            servers=servers,
            load=Load(parts.medium, parts.medium.start(), _goes_on(config)),
            gates={s.period_s: law.PublishingSteps(law.period_steps(s.period_s, interval_s)) for s in servers},
            trackers=tuple(EncounterTracker(p, config.traffic.step_s) for p in config.encounters),
            arrived_p=np.append(arrived_p[: m - 1], arrived_p[-1]),
            n_followed=law.n_followed(server.downlink_loss_p),
        )

    def add(self, world: World) -> None:
        """Add one step of traffic."""
        parts = self.parts
        world = self._equipped(world)
        closed, _, _ = update_encounters(self.trackers, world.step, parts.near_pairs(world))
        self.met += closed[:1]
        self.last_step = world.step
        row = np.flatnonzero(world.equipped)
        exchanges = world.step % self.schedule.exchange_every_steps == 0
        begin_s = world.step * self.config.traffic.step_s
        end_s = begin_s + 2 * self.config.round_s * exchanges
        visits = self.visits.now(world.actor[row].tolist(), self.step, begin_s, end_s)
        if not exchanges:
            return
        self.on_road.append(visits)
        if len(row):
            self._sense(world, row)
        self.step += 1

    def _equipped(self, world: World) -> World:
        """The world with the equipped vehicles of this fleet, drawn as `ActorRegistry` does."""
        config = self.config
        classes = {name.upper() for name in config.fleet.equipped_kinds}
        can = np.array([shape.name in classes for shape in Shape])[world.shape]
        key = rng.key(config.seed, rng.Stream.EQUIPPED)
        draw = rng.uniforms(key, world.name_key)[:, 0]
        return replace(world, equipped=can & (draw < config.fleet.penetration_p))

    def _sense(self, world: World, row: Int[ndarray, "v"]) -> None:
        """Add a step with equipped vehicles: some of them, or all, sense, send, evaluate and look up."""
        config, step = self.config, self.step
        actor, n = world.actor[row], len(row)
        senses = self.schedule.senses(world.step, world.name_key[row])
        mine = np.flatnonzero(senses)
        sender = actor[mine]
        views = self.sensing.views(world, row[mine])
        links = self.delivery.links(world, row, senses)
        self.sweeps = self.sweeps.then(views, world.actor, step, actor)
        subjects, subject_step = self.sweeps.views.own, self.sweeps.step
        n_self = int(config.trust.self_reports)
        begin_s = step * self.schedule.exchange_interval_s
        length_bytes = np.zeros(n)
        length_bytes[mine] = expected_cpm_bytes(config.cpm, n_self + views.n_listed)
        interval, phase = self.schedule.of_vehicles(world.name_key[row])
        wait = (phase - world.step) % interval // self.schedule.exchange_every_steps
        told_p = self.load.delivered_p(RoundKind.CPM, step, begin_s, links, length_bytes, wait)
        newest = self._received(world, row, links, told_p)
        self.cpms = self.cpms.then(newest, sender, actor)
        told = self.cpms.by(sender)
        s = np.searchsorted(subjects, told.sender)
        v = np.searchsorted(subjects, told.receiver)
        found = chances(self.sweeps.views, s, v, config.trust.self_reports)
        evaluated_p = told.p * (1.0 - found.none_p)
        receiver = np.searchsorted(actor, told.receiver)
        n_received = np.bincount(receiver, told.p * found.n_listed, n)[mine]
        n_expected = n_self + views.n_listed + n_received
        length_bytes[mine] = evaluation_bytes(n_expected)  # type: ignore[arg-type]
        begin_s += config.round_s
        heard_p = self.load.delivered_p(RoundKind.EVALUATION, step, begin_s, links, length_bytes, wait)
        newest = self._received(world, row, links, heard_p)
        self.reports = self.reports.then(newest, sender, actor)
        self._evaluate(subjects, subject_step, s, told.receiver, evaluated_p)
        self._look_up(subjects, subject_step, self.reports.by(sender))
        counts = {
            "equipped": n,
            "sweeps": len(mine),
            "links": len(told_p),
            "delivered": told_p.sum(),
            "evaluators": evaluated_p.sum(),
        }
        for name, value in counts.items():
            self.inputs[name] = self.inputs.get(name, 0.0) + float(value)

    def _received(
        self, world: World, row: Int[ndarray, "v"], links: LinkPairs, p: Float[ndarray, "p"]
    ) -> NewestReceived:
        sender, receiver = row[links.sender], row[links.receiver]
        xy_m = world.boxes.xyz_m[:, :2]
        between_m = xy_m[sender] - xy_m[receiver]
        apart_m = np.hypot(*between_m.T)
        return NewestReceived(world.actor[sender], world.actor[receiver], p, apart_m)

    def _evaluate(
        self,
        subjects: Int[ndarray, "e"],
        subject_step: Int[ndarray, "e"],
        s: Int[ndarray, "p"],
        evaluator: Int[ndarray, "p"],
        evaluated_p: Float[ndarray, "p"],
    ) -> None:
        """Add the chances that vehicles evaluate subjects `s` in this step."""
        late = self.step - subject_step[s]  # the evaluation is as much later than the detections
        n_late = (self.schedule.longest_steps - 1) // self.schedule.exchange_every_steps
        at_last = np.full(n_late, self.arrived_p[-1])
        in_time_p = np.concatenate([np.zeros(n_late), self.arrived_p, at_last])
        log_none = np.zeros((len(self.arrived_p) + n_late, len(subjects)))
        for lag, row in enumerate(log_none):
            known_p = evaluated_p * in_time_p[n_late + lag - late]
            row += np.bincount(s, _log_not(known_p), len(subjects))
        self.evidence.append((subjects, subject_step, log_none))
        kept = np.flatnonzero(evaluated_p > _LEAST_P)
        of = s[kept]
        reported_p = evaluated_p[kept] * self.arrived_p[-1]
        made = np.full(len(kept), self.step)
        of_pair = subjects[of], evaluator[kept], subject_step[of]
        self.pairs.append((*of_pair, made, _log_not(reported_p)))

    def _look_up(self, subjects: Int[ndarray, "e"], subject_step: Int[ndarray, "e"], heard: NewestReceived) -> None:
        """Add the lookups of this step: by the receivers of these messages, about their senders."""
        config, step, n = self.config, self.step, len(subjects)
        subject = np.searchsorted(subjects, heard.sender)
        self.asked.append((subjects, subject_step, np.bincount(subject, heard.p, n)))
        radius_m = config.encounters[0].radius_m if config.encounters else 0.0
        near = np.flatnonzero(heard.apart_m <= _MEETING * radius_m)
        holder = heard.receiver[near].astype(np.int64)
        pair = holder << 32 | heard.sender[near]
        log_missed = _log_not(heard.p[near])
        self.heard.append((pair, np.full(len(near), step), log_missed))
        server, at_s = config.server.cellular, 2 * config.round_s
        for period_s, gate in self.gates.items():
            gate.open(step)
            publications, held = self._held(heard.receiver, gate)
            ages_s = (step - publications) * self.schedule.exchange_interval_s + at_s
            received_p = arrival_p(ages_s, server.downlink_loss_p, 0, server)
            looks, none = law.expected_lookups(subject, held, heard.p, n, publications, received_p)
            rows = self.looks.setdefault(period_s, [])
            now = np.full(n, step)
            for i in range(0, len(publications), self.n_followed):
                some = slice(i, i + self.n_followed)
                found_none = none if i == 0 else np.zeros_like(none)
                rows.append((now, subjects, publications[some], looks[:, some], found_none))

    def _held(
        self, holder: Int[ndarray, "p"], gate: law.PublishingSteps
    ) -> tuple[Int[ndarray, "i"], Bool[ndarray, "p i"]]:
        """Publications as of `PublishingSteps.before`, and which of them each holder was sent and has not forgotten.

        So many are followed that each holder has `n_followed` of them, or all of its visit.
        """
        here = self.on_road[-1]
        visit = here[np.searchsorted(here >> 32, holder)]
        n = self.n_followed
        while True:
            publications = gate.before(self.step, n)
            were_there = [self.on_road[publication] for publication in publications.tolist()]
            held = np.column_stack([np.isin(visit, visits) for visits in were_there])
            is_all = publications[-1] <= visit & 0xFFFFFFFF
            if (is_all | (held.sum(axis=1) >= self.n_followed)).all():
                return publications, held & (np.cumsum(held, axis=1) <= self.n_followed)
            n += self.n_followed

    def predictions(self, n_draws: int) -> tuple[list[Prediction], list[list[Values]], Values]:
        """The predictions for all servers, the metrics of runs drawn from them, and measured inputs by name.

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
        actors = np.unique(np.concatenate(self.on_road) >> 32)
        n_lags = len(self.evidence[0][2])
        log_none = np.zeros((n_lags, len(actors), self.step))
        sent, asked = np.zeros((2, len(actors), self.step))
        for actor, step, values in self.evidence:
            row = np.searchsorted(actors, actor)
            log_none[:, row, step] += values
            sent[row, step] = 1
        for actor, step, n in self.asked:
            asked[np.searchsorted(actors, actor), step] += n
        since = np.where(sent.any(axis=1), sent.argmax(axis=1), self.step)
        subject, step = np.nonzero(sent)
        evaluated_p = -np.expm1(log_none[-1, subject, step])
        company = Company.measured(evaluated_p, subject, asked[subject, step])
        evidence = law.EvidenceChances(log_none)
        pair_steps, pair_subject = self._pair_steps(actors)
        meetings = self._meetings(actors)
        inputs = self._inputs(company, float(asked.sum()))
        looks = {period_s: self._looks_of(rows, actors) for period_s, rows in self.looks.items()}
        found = FleetFindings(evidence, since, pair_steps, pair_subject, meetings, self.arrived_p, company)
        loss_p = self.config.server.cellular.downlink_loss_p
        servers = []
        for of in self.servers:
            servers.append((of, self.gates[of.period_s], looks.get(of.period_s)))
        made = [predicted(of, self.config, found, gate, looked) for of, gate, looked in servers]
        runs: list[list[Values]] = [[] for _ in servers]
        random = np.random.default_rng(self.config.seed)
        for _ in range(n_draws):
            run = drawn(found, random)
            for (of, gate, looked), p, rows in zip(servers, made, runs, strict=True):
                rows.append(counted(of, run, gate, looked, p.age_s, loss_p)[1])
        return made, runs, inputs

    def _inputs(self, company: Company, lookups: float) -> Values:
        got = self.inputs
        sweeps, links = max(got["sweeps"], 1e-12), max(got["links"], 1e-12)
        return {
            "equipped.mean": got["equipped"] / self.step,
            "links_per_vehicle.mean": got["links"] / sweeps,
            "delivery.mean": got["delivered"] / links,
            "evaluators_per_step.mean": got["evaluators"] / sweeps,
            "evaluated_p": company.mean_p,
            "in_company.share": company.looked_up,
            "in_company.evaluated_p": company.p[0],
            "in_company.ends_p": company.ends_p[0],
            "alone.evaluated_p": company.p[1],
            "alone.ends_p": company.ends_p[1],
            "lookups": lookups,
        }

    def _looks_of(self, rows: list[tuple[ndarray, ...]], actors: ndarray) -> law.ExpectedLookups:
        step, actor, publications, n, none = zip(*rows, strict=True)
        repeated = []
        for published, subjects in zip(publications, actor, strict=True):
            repeated.append(np.tile(published, (len(subjects), 1)))
        subject = np.searchsorted(actors, np.concatenate(actor))
        return law.ExpectedLookups(
            subject, np.concatenate(step), np.concatenate(repeated), np.concatenate(n), np.concatenate(none)
        )

    def _pair_steps(self, actors: ndarray) -> tuple[law.PairSteps, Int[ndarray, "k"]]:
        columns = map(np.concatenate, zip(*self.pairs, strict=True))
        subject, evaluator, step, made, log_none = columns
        keys, pair = np.unique(subject.astype(np.int64) << 32 | evaluator, return_inverse=True)
        subjects = np.searchsorted(actors, keys >> 32)
        return law.PairSteps(step, made, subjects[pair], pair.reshape(-1), log_none), subjects

    def _meetings(self, actors: ndarray) -> law.Encounters:
        """Encounters by the first definition of the config, those that are still open included."""
        none = np.zeros(0, np.int64)
        if not self.trackers:
            chances, on_road = np.zeros(0), np.zeros((0, 0), bool)
            return law.Encounters(*(none,) * 7, chances, none, on_road)
        still_open = self.trackers[0].close(self.last_step + 1)

        def column(name: str) -> Int[ndarray, "e"]:
            parts = [rows[name] for rows in (*self.met, still_open)]
            return np.concatenate([none, *parts]).astype(np.int64)

        a, b, start, end = map(column, ("a", "b", "start_step", "end_step"))
        both = np.isin(a, actors) & np.isin(b, actors)
        a, b = a[both], b[both]
        every = self.schedule.exchange_every_steps
        start = np.tile(-(-start[both] // every), 2)
        end = np.tile(-(-end[both] // every), 2)
        holder, other = np.append(a, b), np.append(b, a)
        visits = np.full((len(actors), self.step), -1)
        for k, there in enumerate(self.on_road):
            visits[np.searchsorted(actors, there >> 32), k] = there & 0xFFFFFFFF
        keys, steps, log_missed = map(np.concatenate, zip(*self.heard, strict=True))
        order = np.lexsort((steps, keys))
        pairs = holder << 32 | other
        first, stop = (np.searchsorted(keys[order], pairs, side) for side in ("left", "right"))
        by, subject = np.searchsorted(actors, holder), np.searchsorted(actors, other)
        latest = np.maximum.accumulate(visits, axis=1)
        began = latest[by, np.minimum(start, self.step - 1)]
        steps, log_missed = steps[order], log_missed[order]
        return law.Encounters(by, subject, start, end, first, stop, steps, log_missed, began, visits >= 0)


def _goes_on(config: Config) -> int:
    """In how many further exchanges the messages of one may arrive: those with evaluations last for two lifetimes."""
    if config.round_s >= config.message_lifetime_s:
        return 0
    return int(np.ceil(2 * config.message_lifetime_s / config.schedule.exchange_interval_s - 1e-9)) - 1


def _log_not(p: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Logarithms of the probabilities that something does not happen; finite where it is certain."""
    return np.log1p(-np.minimum(p, 1 - 1e-12))
