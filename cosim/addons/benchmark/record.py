"""Records the evidence set of the benchmark: every world is simulated once, with all attacks beside each other."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.benchmark.evidence import (
    HONEST,
    MOST_PSEUDONYMS,
    EvidencePlace,
    EvidenceRules,
    EvidenceSet,
    EvidenceStream,
    Rows,
    assembled,
    joined,
    merged,
    taken,
)
from cosim.config.config import Config, resolve_data
from cosim.runs import run as running
from cosim.runs.check import check
from cosim.runs.drive import Advance, warm_up
from cosim.step.cycle import step
from cosim.step.parts import Parts
from cosim.step.perception import BoxAnswers, BoxQuestions, Observed, Perception
from cosim.step.result import Sensed
from cosim.step.state import State
from cosim.step.stopwatch import Stopwatch
from cosim.world import World
from sensors.boxes import Boxes
from sensors.evidence import AreaParams
from sensors.lidar import RangeImages
from trust.params import TrustParams, eta_of
from trust.tables import ReceivedEvaluations, TrustScores

VERSION = "6"
"""Raise it with every change of the content of the shipped set."""
ATTACKS = (
    "ghost_insertion",
    "approaching_ghost",
    "sybil",
    "replay",
    "offset",
    "mirror",
    "removal",
    "speed",
    "bad_mouthing",
    "ballot_stuffing",
    "collusion",
    "random_evaluations",
    "trust_flip",
)
"""The attacks of the study `attacks`, with their default parameters."""
CITIES = ("helsinki", "koenigs-wusterhausen", "adlershof")
SEEDS = (1001, 1002)
"""Beyond those of all studies."""
PLACES = tuple(
    EvidencePlace(city, penetration_p, seed) for city in CITIES for penetration_p in (0.15, 0.3) for seed in SEEDS
)
"""Worlds of the shipped set."""
SHARE_P = 0.1
"""Share of attackers among the equipped vehicles."""
_TRUST = TrustParams(freshness_s=30.0)
RULES = EvidenceRules(
    dt_s=0.2,
    n_steps=400,
    start_step=100,
    server_period_s=_TRUST.server_period_s,
    eta=eta_of(_TRUST),
    freshness_s=30.0,
    cases=(HONEST, *ATTACKS),
)
"""Rules of the shipped set: times, window and shares are those of the study `attacks`, and 10 % attack."""


class Tape:
    """A trust model that keeps what it is given, and has no scores."""

    def __init__(self, params: Any, dt_s: float) -> None:
        self.step = -1
        self.arrived: list[Rows] = []
        """Evaluations that arrived: step of arrival and of the detections, evaluator and observer."""
        self.opened: list[Rows] = []
        """By step: what was transmitted."""
        self.present: list[ndarray] = []
        """By step: the pseudonyms that may evaluate it, as `_present`."""

    def open_step(
        self, step: int, pseudonyms: ndarray, observer_row: ndarray, detection_index: ndarray, score: ndarray
    ) -> None:
        """Keep what was transmitted."""
        self.step = step
        self.present.append(_present(step, pseudonyms))
        self.opened.append(
            {
                "step": np.full(len(score), step),
                "observer": pseudonyms[observer_row],
                "detection_index": detection_index,
                "score": _percent(score),
            }
        )

    def add_evaluations(self, received: ReceivedEvaluations) -> None:
        """Keep who evaluated. The server processes messages before the step begins."""
        messages = received.messages.taken(received.message_row)
        n = len(messages.observer)
        self.arrived.append(
            {
                "arrival_step": np.full(n, self.step + 1),
                "detection_step": np.full(n, messages.step),
                "evaluator": np.repeat(messages.evaluator, np.diff(messages.ptr)),
                "observer": messages.observer,
            }
        )

    def scores(self, now_step: int | None = None) -> TrustScores:
        """No scores."""
        none = np.zeros(0, np.int64)
        return TrustScores.of(now_step or 0, none, none, none.astype(float), newest_step=none)


class _Harmless:
    """An attack that changes nothing."""

    def detections(self, listed: Any, context: Any) -> Any:
        """The unchanged lists."""
        return listed


@dataclass(slots=True)
class _Shared:
    """Perception that all cases of a world share: the last step's result is kept."""

    behind: Perception
    _step: int = -1
    _found: Observed | None = None

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """As in `Perceives`; computed once per step."""
        if self._found is None or self._step != world.step:
            self._step, self._found = world.step, self.behind(world, observers, watch)
        return self._found

    def answers(self, sweeps: RangeImages, asked: BoxQuestions) -> BoxAnswers:
        """As in `Perceives`."""
        return self.behind.answers(sweeps, asked)

    def in_area(
        self, sweeps: RangeImages, o: ndarray, boxes: Boxes, area: AreaParams, b: ndarray, label: ndarray, own: Boxes
    ) -> ndarray:
        """As in `Perceives`."""
        return self.behind.in_area(sweeps, o, boxes, area, b, label, own)


@dataclass(slots=True)
class Case:
    """The recording of one case."""

    parts: Parts
    state: State
    rows: dict[str, list[Rows]] = field(default_factory=dict)

    def record(self, world: World) -> None:
        """Simulate a step and keep its rows."""
        self.state, result = step(world, self.state, self.parts)
        if result.sensed is not None:
            broadcast = self.state.trust.hosts[0].downlink.last
            for name, rows in _rows(result.sensed, world, broadcast).items():
                self.rows.setdefault(name, []).append(rows)

    def tables(self) -> dict[str, Rows]:
        """All rows of the case, with pseudonyms as in the simulation."""
        tape = self.state.trust.hosts[0].model
        assert isinstance(tape, Tape)
        parts = {**self.rows, "detections": tape.opened}
        found = {name: joined(of) for name, of in parts.items()}
        pseudonyms = found["pseudonyms"]
        _, first = np.unique(pseudonyms["pseudonym"], return_index=True)
        found["pseudonyms"] = taken(pseudonyms, first)
        reports, said = found["reports"], found["evaluations"]
        counts = np.isin(_present(said["detection_step"], said["evaluator"]), np.concatenate(tape.present))
        found["evaluations"] = taken(said, counts)
        found["reports"] = {**reports, "arrival_step": _arrivals(reports, found["evaluations"], tape)}
        return found


def _present(step: Any, pseudonym: ndarray) -> Int[ndarray, "n"]:
    """A pseudonym in a step as one number. Trust models reject evaluations of detections that are older than it."""
    return np.int64(step) << 32 | pseudonym.astype(np.int64)


def _arrivals(reports: Rows, evaluations: Rows, tape: Tape) -> Int[ndarray, "m"]:
    """Step at whose beginning the server has each message; -1 if it is lost, or nothing of it was kept.

    A vehicle evaluates a message of another once, so the message that brought an evaluation is known by its content.
    """
    arrived = joined(tape.arrived)
    names = ("evaluator", "observer")
    pseudonyms = [rows[name] for rows in (arrived, evaluations) for name in names]
    known = np.unique(np.concatenate(pseudonyms))
    n = len(known)

    def about(rows: Rows) -> Int[ndarray, "n"]:
        by, of = (np.searchsorted(known, rows[name]) for name in names)
        step = rows["detection_step"].astype(np.int64)
        return (step * n + by) * n + of

    def message_of(rows: Rows) -> Int[ndarray, "n"]:
        return rows["step"].astype(np.int64) << 32 | rows["evaluator"]

    code, first = np.unique(about(arrived), return_index=True)
    asked = about(evaluations)
    at = np.minimum(np.searchsorted(code, asked), len(code) - 1)
    there = np.flatnonzero(code[at] == asked)
    message, of_row = message_of(reports), message_of(evaluations)
    by_message = np.argsort(message)
    found = np.full(len(message), -1)
    row = by_message[np.searchsorted(message[by_message], of_row[there])]
    found[row] = arrived["arrival_step"][first[at[there]]]
    return found


def _rows(sensed: Sensed, world: World, broadcast: Int[ndarray, "capacity"]) -> dict[str, Rows]:
    """The rows of a step. `broadcast` is the newest broadcast of each vehicle, by actor number."""
    senders, sent, used = sensed.senders, sensed.evaluated.sent, sensed.looked_up.messages
    says = np.flatnonzero(sent.visibility > 0)
    by = np.repeat(sent.evaluator, np.diff(sent.ptr))[says]
    if sent.detection_step is None:
        of = np.full(len(says), world.step)
    else:
        of = sent.detection_step[says]
    receiver = sensed.sensing.actor[used.receiver]
    vehicle = sensed.vehicles.actor[senders.vehicle]
    attack = np.zeros(int(world.actor.max()) + 1, bool)
    attack[world.actor] = world.attack > 0
    found = {
        "reports": {"evaluator": np.unique(by)},
        "evaluations": {
            "evaluator": by,
            "detection_step": of,
            "observer": sent.observer[says],
            "detection_index": sent.detection_index[says],
            "evaluation": _percent(sent.evaluation[says]),
            "visibility": np.maximum(_percent(sent.visibility[says]), 1),
        },
        "lookups": {
            "receiver": receiver,
            "sender": sensed.known.pseudonym[used.message],
            "message_step": sensed.known.step[used.message],
            "broadcast_step": broadcast[receiver],
        },
    }
    for name, rows in found.items():
        n = len(next(iter(rows.values())))
        found[name] = {"step": np.full(n, world.step), **rows}
    attacks = attack[vehicle].astype(np.int64)
    return found | {"pseudonyms": {"pseudonym": senders.pseudonym, "vehicle": vehicle, "attacks": attacks}}


def _percent(values: Float[ndarray, "n"]) -> Int[ndarray, "n"]:
    return np.rint(100 * values).astype(np.int64)


def numbered(tables: list[dict[str, Rows]]) -> list[EvidenceStream]:
    """The cases of a world with pseudonyms numbered from 0 in ascending order: one numbering for all cases."""
    known = np.unique(np.concatenate([of["pseudonyms"]["pseudonym"] for of in tables]))
    if len(known) > MOST_PSEUDONYMS:
        raise ValueError(f"{len(known)} pseudonyms in one world: a set holds at most {MOST_PSEUDONYMS}.")
    names = {"observer", "evaluator", "receiver", "sender", "pseudonym", "vehicle"}
    streams = []
    for of in tables:
        merged_rows = {}
        for name, rows in of.items():
            pseudonyms = {c: np.searchsorted(known, rows[c]) for c in rows if c in names}
            merged_rows[name] = merged(name, {**rows, **pseudonyms})
        streams.append(EvidenceStream(**merged_rows))
    return streams


def config_of(place: EvidencePlace, rules: EvidenceRules, attack: str) -> Config:
    """The config of a case of a world."""
    section = {"attack": attack, "share_p": SHARE_P, "start_s": rules.start_step * rules.dt_s}
    return resolve_data(
        {
            "preset": "modern",
            "seed": place.seed,
            "traffic": {
                "scenario": place.city,
                "seed": place.seed,
                "step_s": rules.dt_s,
                "duration_s": rules.n_steps * rules.dt_s,
            },
            "fleet": {"penetration_p": place.penetration_p},
            "encounters": [{}],
            "attacks": [section],
            "trust": {
                "model": f"{__name__}:Tape",
                "freshness_s": rules.freshness_s,
                "server_period_s": rules.server_period_s,
            },
        },
        "the benchmark",
        None,
    )


def simulated(configs: Sequence[Config], label: str, advance: Advance) -> list[Case]:
    """A world without attack and with the attacks of each config, beside each other.

    Parameters
    ----------
    configs
        They differ in their attacks only, and each has a `Tape` as its trust model.
    label
        Name of the world for `advance`.
    advance
        Called with progress.
    """
    config = configs[0]
    scenario = check(config)
    n_steps = round(config.traffic.duration_s / config.traffic.step_s)
    base, _, traffic = running.load_parts(config, scenario)
    assert isinstance(base.perception, Perception)
    shared = _Shared(base.perception)
    harmless: Any = (_Harmless(),)  # an attack may leave any hook out
    parts = [replace(base, adversary=replace(base.adversary, attacks=harmless))]
    parts += [base.under(one) for one in configs]
    cases = []
    for one in parts:
        of_case = replace(one, perception=shared)
        cases.append(Case(of_case, State.start(of_case)))
    try:
        warm_up(scenario.warmup_of(config.traffic), traffic, base.watch, lambda *_: None)
        for number in range(n_steps):
            world = traffic.advance()
            for case in cases:
                case.record(world)
            advance(label, number + 1, n_steps, "steps")
    finally:
        traffic.close()
    return cases


def recorded(place: EvidencePlace, rules: EvidenceRules, advance: Advance) -> list[EvidenceStream]:
    """The evidence of all cases of a world, simulated beside each other over the same traffic and sweeps."""
    configs = [config_of(place, rules, attack) for attack in rules.cases[1:]]
    label = f"{place.city}, {place.penetration_p:g}, seed {place.seed}"
    return numbered([case.tables() for case in simulated(configs, label, advance)])


def make(
    advance: Advance, places: tuple[EvidencePlace, ...] = PLACES, rules: EvidenceRules = RULES, version: str = VERSION
) -> EvidenceSet:
    """Record a set.

    Parameters
    ----------
    advance
        Called with progress.
    places, rules, version
        Those of the shipped set by default.
    """

    def streams() -> Iterator[tuple[int, int, EvidenceStream]]:
        for world, place in enumerate(places):
            for case, stream in enumerate(recorded(place, rules, advance)):
                yield world, case, stream

    return assembled(version, rules, places, streams())
