"""One turn: every equipped vehicle sees, says, hears, judges, is judged, and makes up its mind.

Reads as the detection and decision cycle of TruPercept (section "Summary"), for all vehicles at once.

Within a step that begins at time t: sweeps and detections at t; detections are on the air from t and count
until t + timeout; verdicts are on the air from then on and count until t + 2 timeout (`radio.timeout_s`), when
everybody fuses with the trust known by then. The trust server sees what has reached it by t, and broadcasts at t;
roadside units pass the broadcast on beside the verdicts. Piggybacked verdicts wait for the detections of the next
turn: too late for fusion, in which each vehicle then judges alone, and in time for trust.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim import rng
from cosim.config import Config
from cosim.ground_truth import GroundTruth, ground_truth_of
from cosim.manifest import Stopwatch
from cosim.v2x.adversary import self_reports, tamper
from cosim.v2x.exchange import Exchange, Heard
from cosim.v2x.generation import Memory, included
from cosim.v2x.messages import (
    FABRICATED,
    SELF,
    SENSED,
    Detections,
    detections_bytes,
    expand,
    is_sound,
    ptr_of,
    riding_bytes,
    trust_bytes,
    verdicts_bytes,
)
from cosim.v2x.radio import Radio, Round
from cosim.v2x.roadside import NOWHERE, Sites
from cosim.v2x.server import Downlink, Edition, Traffic, Uplink
from cosim.world import World
from sensors import detector, evidence, lidar
from sensors.boxes import Boxes, overlapping_pairs
from sensors.reports import DetectorDraws
from sensors.scene import Scene
from trust import evaluation, fusion, matching, tables
from trust.models.trupercept import TruPercept
from trust.params import eta_of
from trust.step_evidence import RejectReason
from trust.tables import SERVER, EvaluationMessages, Evaluations, ObjectLists, ReceivedEvaluations, TrustScores
from trust.tables import Detections as Claims

SOURCES = ("server", "own", "default")
"""Where a trust value that is used comes from, by code."""

FROM_SERVER, FROM_OWN, FROM_NOWHERE = range(3)


@dataclass(slots=True)
class State:
    """All that survives a step."""

    radio: Radio
    ledger: TruPercept
    uplink: Uplink
    downlink: Downlink
    included: Memory = field(default_factory=Memory)
    riding: EvaluationMessages | None = None
    """Evaluations of the last turn, waiting for the next message."""
    last_edition_s: float = -np.inf
    n_malformed: int = 0
    """Detections dropped so far because they cannot be: no finite pose, no size, no score."""
    sweeps: lidar.Sweeps | None = None
    """Memory of the last sweeps, written over by the next."""

    @staticmethod
    def start(config: Config, city: Scene, sites: Sites = NOWHERE) -> "State":
        return State(
            radio=Radio.start(config.radio, config.sensing_interval_s, config.seed, city, sites),
            ledger=TruPercept(config.trust, config.traffic.step_s),
            uplink=Uplink(config.server, config.seed, config.sensing_interval_s),
            downlink=Downlink(config.server, config.seed),
        )

    def refusals(self) -> dict[str, int]:
        """Evaluations that the ledgers refused, by cause."""
        return {cause.name.lower(): int(n) for cause, n in zip(RejectReason, self.ledger.rejected, strict=True) if n}


@dataclass(frozen=True, slots=True)
class Known:
    """Trust of some subjects as some receivers know it here and now; rows as asked."""

    trust: Float[ndarray, "n"]
    source: UInt8[ndarray, "n"]  # code of `SOURCES`
    age_s: Float[ndarray, "n"]  # of the value; read only where it is no default


Perceived = tuple[evidence.Observability, Detections, Bool[ndarray, "s"], Int[ndarray, "s"]]
"""Observability; self reports and detections; and for the sensed ones, in order: whether a real actor, and its row."""

Perceive = Callable[[World, Int[ndarray, "e"], lidar.Sweeps, Config], Perceived]


@dataclass(frozen=True, slots=True)
class ToServer:
    """A turn's messages between vehicles and trust server."""

    up: Traffic
    n_addressed: int
    """Vehicles that a broadcast of trust values was meant for."""
    n_informed: int
    """Of these, those that it reaches."""


@dataclass(frozen=True, slots=True)
class Turn:
    """Everything that happened in one turn; `e` counts equipped vehicles, rows of `observers`."""

    world: World
    observers: Int[ndarray, "e"]  # rows of the world
    sights: evidence.Observability
    said: Detections
    truth: GroundTruth
    exchanges: tuple[Exchange, Exchange]  # of detections, and of verdicts
    views: ObjectLists  # what each vehicle judged
    verdicts: Evaluations
    n_points: Int[ndarray, "m"]
    plausible: Bool[ndarray, "m"]
    matched: Bool[ndarray, "m"]
    met: Heard  # whose trust each vehicle looks up
    known: Known  # goes with `met`
    fused: fusion.Fused
    standing: TrustScores | None  # what the server just computed
    to_server: ToServer | None


def turn(
    world: World, city: Scene, state: State, config: Config, watch: Stopwatch, perceive: Perceive | None = None
) -> Turn:
    """The cycle, once; `perceive` stands in for the detectors where a scenario says what is detected."""
    seed, step, time_s = config.seed, world.step, world.step * config.traffic.step_s
    observers = np.flatnonzero(world.equipped)
    names = world.name_key[observers]
    ids = world.actor[observers]

    with watch("server"):
        standing = _serve(state, config, world, ids, names, time_s)

    with watch("sweep"):
        sweep_keys = rng.keys(rng.key(seed, rng.Stream.SWEEP, step), names)
        sweeps = state.sweeps = lidar.scan(
            world.boxes, world.shape, observers, city, config.lidar, sweep_keys, state.sweeps
        )
    with watch("detect"):
        sights, seen, is_real, source = (perceive or _perceive)(world, observers, sweeps, config)
    with watch("tamper"):
        said = tamper(seen, world, time_s, seed, config.adversary)
        sound = is_sound(said)
        if not sound.all():  # nobody takes in what cannot be
            assert (said.origin[~sound] == FABRICATED).all()
            state.n_malformed += int((~sound).sum())
            said = said.take(np.flatnonzero(sound))
        if config.radio.cpm_rules == "etsi":
            chosen, state.included = included(state.included, said, world.actor[said.observer], time_s)
            said = replace(said, said=chosen)
        truth = ground_truth_of(said, world, sights, observers, is_real, source)
        claims, ptr = _claims(said, observers)

    with watch("radio"):
        riding = state.riding
        length_bytes = _lengths(claims, said.said, ids, riding, config)
        first = state.radio.exchange(Round.DETECTIONS, world, observers, length_bytes, time_s)
    with watch("match"):
        pairs = overlapping_pairs(said.boxes, said.label, said.observer)
        everything = _views(first.heard, ptr, said.said, len(observers))
        inside = evidence.in_evaluation_area(
            sweeps, everything.of_member(), said.boxes, config.area, everything.member, said.label,
            world.boxes.take(observers),
        )  # fmt: skip
        views = _subset(everything, inside)
        groups_all, groups = (matching.match(v, claims, pairs, config.trust) for v in (everything, views))
    with watch("judge"):
        foreign = np.zeros(len(inside), bool)  # those of which a vehicle asks its own sweep whether they can be there
        foreign[groups_all.seeds()] = True
        foreign &= ~groups_all.ego_detected
        foreign[np.flatnonzero(inside)[~groups.ego_detected]] = True
        n_points_all, plausible_all = _look(sweeps, everything, inside, foreign, said.boxes, claims, config)
        n_points, plausible = n_points_all[inside], plausible_all[inside]
        verdicts = evaluation.evaluate(views, groups, claims, n_points, plausible, config.trust)
        _certify(verdicts, views, claims, said)

    told = _told(step, ids, views, claims, verdicts, said.said)
    judged_s = time_s + state.radio.timeout_s
    alone = config.radio.verdicts == "alone"
    with watch("radio"):
        edition = state.downlink.on_masts(judged_s)
        second = state.radio.exchange(
            Round.VERDICTS, world, observers, verdicts_bytes(np.diff(told.ptr)) * alone, judged_s,
            0 if edition is None else trust_bytes(len(edition.subject)),
        )  # fmt: skip
    with watch("trust"):
        state.riding = None if alone else told
        spoken, carrier, begin_s = (told, second, judged_s) if alone else (riding, first, time_s)
        _book(state, config, told, claims, said.said, ids)
        if spoken is not None:
            _hear(state, config, spoken, carrier, ids, begin_s)
        if config.trust.host == "central":
            if config.server.uplink == "cellular":
                state.uplink.by_cellular(told, names, world.boxes.xyz_m[observers, :2], judged_s)
            if edition is not None:
                state.downlink.overheard(ids[second.down.receiver], second.down, ids, judged_s)
        met = (second if alone else first).heard
        known = knowledge(state, config, ids[met.receiver], ids[met.sender], ids, judged_s + state.radio.timeout_s)

    with watch("fuse"):
        seeds = groups_all.seeds()
        away_m = np.linalg.norm(
            said.boxes.xyz_m[everything.member[seeds]] - sweeps.poses.origin_m[everything.of_member()[seeds]], axis=1
        )
        sight = fusion.SensorEvidence(n_points_all[seeds], plausible_all[seeds], away_m < config.area.range_m)
        judged = np.full(len(met.sender), alone)
        heard = fusion.SenderTrust(ptr_of(met.receiver, len(observers)), met.sender, known.trust, judged)
        distance_m = np.linalg.norm(said.boxes.xyz_m - sweeps.poses.origin_m[claims.message], axis=1)
        fused = fusion.fuse(
            everything, groups_all, claims, views, verdicts, verdicts, heard, sight, distance_m, config.trust
        )
        fused = fused.take(fused.score >= config.trust.min_score)

    to_server = None
    if config.trust.host == "central":
        to_server = ToServer(state.uplink.last, state.downlink.n_addressed, state.downlink.n_informed)
    return Turn(
        world, observers, sights, said, truth, (first, second),
        views, verdicts, n_points, plausible, groups.ego_detected, met, known, fused, standing, to_server,
    )  # fmt: skip


def knowledge(
    state: State,
    config: Config,
    receiver: Int[ndarray, "n"],
    subject: Int[ndarray, "n"],
    present: Int[ndarray, "e"],
    time_s: float,
) -> Known:
    """Trust of each subject as its receiver knows it at `time_s`, wherever trust lives; actor ids."""
    value = np.full(len(receiver), config.trust.default_trust)
    source = np.full(len(receiver), FROM_NOWHERE, np.uint8)
    age_s = np.zeros(len(receiver))
    if config.trust.host == "central":
        heard, known, age = state.downlink.known(receiver, subject, present, time_s)
        value[known], source[known], age_s[known] = heard[known], FROM_SERVER, age[known]
    elif config.trust.host == "local":
        standing = state.ledger.scores()
        at, known = standing.rows_of(receiver, subject)
        at = at[known]
        value[known], source[known] = standing.trust[at], FROM_OWN
        age_s[known] = time_s - standing.newest_step[at] * config.traffic.step_s
    return Known(value, source, age_s)


def _serve(
    state: State, config: Config, world: World, ids: ndarray, names: ndarray, time_s: float
) -> TrustScores | None:
    """Reports come in; when it is time, the server computes everybody's trust and broadcasts it."""
    if config.trust.host != "central":
        return None
    for told in state.uplink.arrived(time_s):
        n = len(told.evaluator)
        state.ledger.add_evaluations(ReceivedEvaluations(told, np.full(n, SERVER), np.arange(n), eta_of(config.trust)))
    state.uplink.last, state.downlink.n_addressed, state.downlink.n_informed = Traffic(), 0, 0
    if config.server.is_out(time_s) or time_s - state.last_edition_s < config.trust.server_period_s - 1e-9:
        return None
    state.last_edition_s = time_s
    standing = state.ledger.scores(world.step)
    state.downlink.publish(Edition(time_s, standing.subject, standing.trust), world.step, ids, names)
    return standing


def _perceive(world: World, observers: Int[ndarray, "e"], sweeps: lidar.Sweeps, config: Config) -> Perceived:
    """Self reports and what the detectors make of the sweeps; the truth's name is dropped here."""
    sights = evidence.observability(sweeps, world.boxes, world.shape)
    model = detector.DETECTORS[config.detector.model](config.detector)
    draws = detector_draws(world, observers, config)
    found = detector.detect(model, sweeps, sights, world.boxes, world.label, draws)
    n = len(found.observer)
    sensed = Detections(
        observer=observers[found.observer],
        k=1 + np.arange(n) - np.searchsorted(found.observer, found.observer),
        label=found.label,
        boxes=found.boxes,
        score=found.score,
        n_points=found.n_points,
        origin=np.full(n, SENSED, np.uint8),
        said=np.ones(n, bool),
    )
    parts = [self_reports(world, observers), sensed] if config.trust.self_reports else [sensed]
    return sights, Detections.concat(parts), ~found.is_false_positive, found.actor


def detector_draws(world: World, observers: Int[ndarray, "e"], config: Config) -> DetectorDraws:
    """Keys of the detectors' noise draws in this step."""
    seed, names = config.seed, world.name_key
    site = rng.key(seed, rng.Stream.CLUTTER_MEMORY)
    return DetectorDraws(
        time_s=world.step * config.traffic.step_s,
        actor=names,
        observer_step=rng.keys(rng.key(seed, rng.Stream.DETECTION, world.step), names[observers]),
        observer=rng.keys(rng.key(seed, rng.Stream.DETECTION_MEMORY), names[observers]),
        site=site,
        site_step=rng.keys(rng.key(seed, rng.Stream.CLUTTER, world.step), names[observers]),
        site_observer=rng.keys(site, names[observers]),
    )


def _claims(said: Detections, observers: Int[ndarray, "e"]) -> tuple[Claims, Int[ndarray, "e+1"]]:
    """The detections as trust sees them, and where each equipped vehicle's begin."""
    sender = np.searchsorted(observers, said.observer)
    claims = Claims(sender, said.k, said.label, said.score, said.origin == SELF)
    return claims, ptr_of(sender, len(observers))


def _views(heard: Heard, ptr: Int[ndarray, "e+1"], said: Bool[ndarray, "d"], n: int) -> ObjectLists:
    """What each vehicle has before it: all its own detections, then what it heard, by (sender, k)."""
    everyone = np.arange(n)
    receiver = np.concatenate([everyone, heard.receiver])
    sender = np.concatenate([everyone, heard.sender])
    order = np.lexsort((sender, receiver != sender, receiver))
    receiver, sender = receiver[order], sender[order]
    member, which = expand(ptr[sender], ptr[sender + 1])
    view, own = receiver[which], (receiver == sender)[which]
    keep = own | said[member]
    return ObjectLists(ptr_of(view[keep], n), member[keep], everyone)


def _subset(views: ObjectLists, keep: Bool[ndarray, "m"]) -> ObjectLists:
    return ObjectLists(ptr_of(views.of_member()[keep], len(views.owner)), views.member[keep], views.owner)


def _certify(evaluations: Evaluations, views: ObjectLists, claims: Claims, said: Detections) -> None:
    """A malicious vehicle evaluates its own fabricated detections with e = Phi = 1."""
    own = claims.message[views.member] == views.owner[views.of_member()]
    certified = own & (said.origin[views.member] == FABRICATED)
    evaluations.evaluation[certified] = evaluations.visibility[certified] = 1.0


def _told(
    step: int,
    ids: Int[ndarray, "e"],
    views: ObjectLists,
    claims: Claims,
    verdicts: Evaluations,
    said: Bool[ndarray, "d"],
) -> EvaluationMessages:
    """The verdicts as messages: one per evaluator, on everything that was said."""
    keep = said[views.member]
    return tables.as_messages(
        step, ids, _subset(views, keep), claims, Evaluations(verdicts.evaluation[keep], verdicts.visibility[keep])
    )


def _lengths(
    claims: Claims, said: Bool[ndarray, "d"], ids: ndarray, riding: EvaluationMessages | None, config: Config
) -> Int[ndarray, "e"]:
    """Length of each vehicle's detection message, with the verdicts that ride on it; 0 for none [B]."""
    n_said = np.bincount(claims.message[said], minlength=len(ids))
    n_riding = np.zeros(len(ids), np.int64)
    if riding is not None:
        _, there, row = np.intersect1d(riding.evaluator, ids, assume_unique=True, return_indices=True)
        n_riding[row] = np.diff(riding.ptr)[there]
    length = detections_bytes(n_said) + np.where(n_riding > 0, riding_bytes(n_riding), 0)
    return length if config.radio.cpm_rules == "all" else np.where((n_said > 0) | (n_riding > 0), length, 0)


def _book(
    state: State,
    config: Config,
    told: EvaluationMessages,
    claims: Claims,
    said: Bool[ndarray, "d"],
    ids: Int[ndarray, "e"],
) -> None:
    """Open the step in the ledgers; where every vehicle keeps its own, enter what it thinks itself."""
    if config.trust.host == "none":
        return
    state.ledger.open_step(told.step, ids, claims.message[said], claims.detection_index[said], claims.score[said])
    if config.trust.host == "local":
        state.ledger.add_evaluations(ReceivedEvaluations(told, ids, np.arange(len(ids)), eta_of(config.trust)))


def _hear(
    state: State, config: Config, told: EvaluationMessages, carrier: Exchange, ids: Int[ndarray, "e"], begin_s: float
) -> None:
    """Evaluations reach other vehicles and, where that is their way to the server, roadside units."""
    message = np.full(len(ids), -1)  # of each vehicle on the road
    _, which, row = np.intersect1d(told.evaluator, ids, assume_unique=True, return_indices=True)
    message[row] = which
    if config.trust.host == "local" and config.trust.local_evidence == "received":
        heard = carrier.heard
        rows = np.flatnonzero(message[heard.sender] >= 0)
        state.ledger.add_evaluations(
            ReceivedEvaluations(told, ids[heard.receiver[rows]], message[heard.sender[rows]], eta_of(config.trust))
        )
    if config.trust.host == "central" and config.server.uplink == "rsu":
        up = carrier.up.take(message[carrier.up.sender] >= 0)
        state.uplink.by_roadside(told, message[up.sender], up, begin_s)


def _look(
    sweeps: lidar.Sweeps,
    views: ObjectLists,
    inside: Bool[ndarray, "m"],
    foreign: Bool[ndarray, "m"],
    boxes: Boxes,
    claims: Claims,
    config: Config,
) -> tuple[Int[ndarray, "m"], Bool[ndarray, "m"]]:
    """What each vehicle's own sweep says of the boxes before it: returns within, and whether free space allows them.

    Asked of all that it judges and of what is foreign; else 0 and True. Nobody has returns from himself.
    """
    o, b = views.of_member(), views.member
    n_points, plausible = np.zeros(len(b), np.int32), np.ones(len(b), bool)
    asked = np.flatnonzero((inside | foreign) & ~(claims.is_self[b] & (claims.message[b] == o)))
    n_points[asked] = evidence.points_in_boxes(sweeps, o[asked], boxes, b[asked])
    asked = np.flatnonzero(foreign)
    plausible[asked] = evidence.plausible(sweeps, o[asked], boxes, b[asked], config.area)
    return n_points, plausible
