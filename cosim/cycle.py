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
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim import rng
from cosim.config import Config
from cosim.manifest import Stopwatch
from cosim.radio.medium import MEDIA, Medium
from cosim.radio.message_round import LinkReceptions, MessageRound, Messages, Receptions, RoundKind, Stations, by_link
from cosim.radio.rsu import NO_RSUS, RsuAntennas
from cosim.ragged import expand, ptr_of
from cosim.truth import Truth, truth_of
from cosim.v2x.adversary import tamper
from cosim.v2x.cpm_generation import InclusionMemory, select_objects
from cosim.v2x.messages import (
    FABRICATED,
    SELF,
    SENSED,
    Detections,
    cpm_bytes,
    evaluation_bytes,
    is_sound,
    piggyback_bytes,
    self_reports,
    trust_broadcast_bytes,
)
from cosim.v2x.trust_server import BroadcastStats, Downlink, LinkStats, TrustBroadcast, Uplink
from cosim.world import World
from sensors import detector, evidence, lidar
from sensors.boxes import Boxes, overlapping_pairs
from sensors.clutter import ClutterLuck
from sensors.line_of_sight import LosCache, WallIndex
from sensors.scene import Scene
from trust import evaluation, fusion, matching, tables
from trust.ledger import SERVER, Ledger, Standing
from trust.page import Refusal
from trust.tables import Detections as Claims
from trust.tables import Told, Verdicts, Views

SOURCES = ("server", "own", "default")
"""Where a trust value that is used comes from, by code."""

FROM_SERVER, FROM_OWN, FROM_NOWHERE = range(3)


@dataclass(slots=True)
class State:
    """All that survives a step."""

    medium: Medium
    rsus: RsuAntennas
    los: LosCache
    round_s: float
    radio: Any
    ledger: Ledger
    uplink: Uplink
    downlink: Downlink
    included: InclusionMemory = field(default_factory=InclusionMemory)
    riding: Told | None = None
    """Verdicts of the last turn, waiting for the next message."""
    last_edition_s: float = -np.inf
    last_uplink: LinkStats = field(default_factory=LinkStats)
    last_broadcast: BroadcastStats = field(default_factory=BroadcastStats)
    n_malformed: int = 0
    """Detections dropped so far because they cannot be: no finite pose, no size, no score."""
    sweeps: lidar.Sweeps | None = None
    """Memory of the last sweeps, written over by the next."""

    @staticmethod
    def start(config: Config, city: Scene, sites: RsuAntennas = NO_RSUS) -> "State":
        los = LosCache.of(WallIndex.of(city.buildings))
        round_s = config.radio.round_s(config.sensing_interval_s)
        medium = MEDIA[config.radio.model](config.radio, round_s, config.seed, los)
        return State(
            medium,
            sites,
            los,
            round_s,
            medium.start(),
            ledger=Ledger(config.trust, config.traffic.step_s),
            uplink=Uplink(config.server, config.seed, config.sensing_interval_s),
            downlink=Downlink(config.server, config.seed),
        )

    def refusals(self) -> dict[str, int]:
        """Verdicts that the ledgers refused, by cause."""
        return {cause.name.lower(): int(n) for cause, n in zip(Refusal, self.ledger.refused, strict=True) if n}


@dataclass(frozen=True, slots=True)
class Known:
    """Trust of some subjects as some receivers know it here and now; rows as asked."""

    trust: Float[ndarray, "n"]
    source: UInt8[ndarray, "n"]  # code of `SOURCES`
    age_s: Float[ndarray, "n"]  # of the value; read only where it is no default


Perceived = tuple[evidence.Sightings, Detections, Bool[ndarray, "s"], Int[ndarray, "s"]]
"""Sightings; self reports and detections; and for the sensed ones, in order: whether a real actor, and its row."""

Perceive = Callable[[World, Int[ndarray, "e"], lidar.Sweeps, Config], Perceived]


@dataclass(frozen=True, slots=True)
class ToServer:
    """A turn's messages between vehicles and trust server."""

    up: LinkStats
    n_addressed: int
    """Vehicles that a broadcast of trust values was meant for."""
    n_informed: int
    """Of these, those that it reaches."""


@dataclass(frozen=True, slots=True)
class Turn:
    """Everything that happened in one turn; `e` counts equipped vehicles, rows of `observers`."""

    world: World
    observers: Int[ndarray, "e"]  # rows of the world
    sights: evidence.Sightings
    said: Detections
    truth: Truth
    rounds: tuple[MessageRound, MessageRound]  # of detections, and of evaluations
    links: tuple[LinkReceptions, LinkReceptions]  # the same by kind of link
    views: Views  # what each vehicle judged
    verdicts: Verdicts
    n_points: Int[ndarray, "m"]
    plausible: Bool[ndarray, "m"]
    matched: Bool[ndarray, "m"]
    met: Receptions  # whose trust each vehicle looks up
    known: Known  # goes with `met`
    fused: fusion.Fused
    standing: Standing | None  # what the server just computed
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
            chosen, state.included = select_objects(state.included, said, world.actor[said.observer], time_s)
            said = replace(said, said=chosen)
        truth = truth_of(said, world, sights, observers, is_real, source)
        claims, ptr = _claims(said, observers)

    with watch("radio"):
        riding = state.riding
        length_bytes = _lengths(claims, said.said, ids, riding, config)
        round_1, first = _broadcast(state, config, RoundKind.CPM, world, observers, length_bytes, time_s)
    with watch("match"):
        pairs = overlapping_pairs(said.boxes, said.label, said.observer)
        everything = _views(first.vehicles, ptr, said.said, len(observers))
        inside = evidence.in_area(
            sweeps, everything.of_member(), said.boxes, config.area, everything.member, said.label,
            world.boxes.take(observers),
        )  # fmt: skip
        views = _subset(everything, inside)
        groups_all, groups = (matching.match(v, claims, pairs, config.trust) for v in (everything, views))
    with watch("judge"):
        foreign = np.zeros(len(inside), bool)  # those of which a vehicle asks its own sweep whether they can be there
        foreign[groups_all.seeds()] = True
        foreign &= ~groups_all.local
        foreign[np.flatnonzero(inside)[~groups.local]] = True
        n_points_all, plausible_all = _look(sweeps, everything, inside, foreign, said.boxes, claims, config)
        n_points, plausible = n_points_all[inside], plausible_all[inside]
        verdicts = evaluation.evaluate(views, groups, claims, n_points, plausible, config.trust)

    told = _told(step, ids, views, claims, verdicts, said.said)
    judged_s = time_s + state.round_s
    alone = config.radio.evaluations == "alone"
    with watch("radio"):
        edition = state.downlink.pending_rsu_broadcast(judged_s)
        round_2, second = _broadcast(
            state, config, RoundKind.EVALUATION, world, observers,
            evaluation_bytes(np.diff(told.ptr)) * alone, judged_s,
            0 if edition is None else trust_broadcast_bytes(len(edition.subject)),
        )  # fmt: skip
    with watch("trust"):
        state.riding = None if alone else told
        spoken, carrier, begin_s = (told, second, judged_s) if alone else (riding, first, time_s)
        _book(state, config, told, claims, said.said, ids)
        if spoken is not None:
            _hear(state, config, spoken, carrier, ids, begin_s)
        if config.trust.where == "central":
            if config.server.uplink == "cellular":
                state.last_uplink = state.uplink.send_cellular(told, names, world.boxes.xyz_m[observers, :2], judged_s)
            if edition is not None:
                down = second.downlink
                state.last_broadcast = state.downlink.receive_from_rsu(ids[down.receiver], down, ids, judged_s)
        met = (second if alone else first).vehicles
        known = knowledge(state, config, ids[met.receiver], ids[met.message], ids, judged_s + state.round_s)

    with watch("fuse"):
        seeds = groups_all.seeds()
        away_m = np.linalg.norm(
            said.boxes.xyz_m[everything.member[seeds]] - sweeps.poses.origin_m[everything.of_member()[seeds]], axis=1
        )
        sight = fusion.Sight(n_points_all[seeds], plausible_all[seeds], away_m < config.area.range_m)
        judged = np.full(len(met.message), alone)
        heard = fusion.Heard(ptr_of(met.receiver, len(observers)), met.message, known.trust, judged)
        distance_m = np.linalg.norm(said.boxes.xyz_m - sweeps.poses.origin_m[claims.sender], axis=1)
        fused = fusion.fuse(everything, groups_all, claims, views, verdicts, heard, sight, distance_m, config.trust)
        fused = fused.take(fused.score >= config.trust.min_score)

    to_server = None
    if config.trust.where == "central":
        to_server = ToServer(state.last_uplink, state.last_broadcast.n_addressed, state.last_broadcast.n_informed)
    return Turn(
        world, observers, sights, said, truth, (round_1, round_2), (first, second),
        views, verdicts, n_points, plausible, groups.local, met, known, fused, standing, to_server,
    )  # fmt: skip


def _broadcast(
    state: State, config: Config, kind: RoundKind, world: World, observers: Int[ndarray, "e"],
    length_bytes: Int[ndarray, "e"], begin_s: float, rsu_bytes: int = 0,
) -> tuple[MessageRound, LinkReceptions]:  # fmt: skip
    """One round with a message of every vehicle and roadside unit that has something to send."""
    n, rsus = len(observers), state.rsus
    xyz_m = np.concatenate([world.boxes.xyz_m[observers], rsus.xyz_m])
    xyz_m[:n, 2] += world.boxes.lwh_m[observers, 2] / 2 + config.radio.antenna_above_roof_m
    stations = Stations(np.concatenate([world.name_key[observers], rsus.key]), xyz_m, n)
    messages = Messages.one_each(np.concatenate([length_bytes, np.full(len(rsus), rsu_bytes)]))
    state.radio, happened = state.medium.broadcast(state.radio, kind, world.step, begin_s, stations, messages)
    return happened, by_link(happened, n)


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
    if config.trust.where == "central":
        heard, known, age = state.downlink.lookup(receiver, subject, time_s)
        value[known], source[known], age_s[known] = heard[known], FROM_SERVER, age[known]
    elif config.trust.where == "local":
        standing = state.ledger.standing()
        at, known = standing.rows_of(receiver, subject)
        at = at[known]
        value[known], source[known] = standing.trust[at], FROM_OWN
        age_s[known] = time_s - standing.newest_step[at] * config.traffic.step_s
    return Known(value, source, age_s)


def _serve(state: State, config: Config, world: World, ids: ndarray, names: ndarray, time_s: float) -> Standing | None:
    """Reports come in; when it is time, the server computes everybody's trust and broadcasts it."""
    if config.trust.where != "central":
        return None
    state.downlink.expire(ids, time_s)
    for told in state.uplink.arrived(time_s):
        state.ledger.enter(told, np.full(len(told.evaluator), SERVER), np.arange(len(told.evaluator)))
    state.last_uplink, state.last_broadcast = LinkStats(), BroadcastStats()
    if config.server.is_out(time_s) or time_s - state.last_edition_s < config.trust.server_period_s - 1e-9:
        return None
    state.last_edition_s = time_s
    standing = state.ledger.standing(world.step)
    values = TrustBroadcast(time_s, standing.subject, standing.trust)
    state.last_broadcast = state.downlink.publish(values, world.step, ids, names)
    return standing


def _perceive(world: World, observers: Int[ndarray, "e"], sweeps: lidar.Sweeps, config: Config) -> Perceived:
    """Self reports and what the detectors make of the sweeps; the truth's name is dropped here."""
    step, names = world.step, world.name_key
    sights = evidence.sightings(sweeps, world.boxes, world.shape)
    draws = detector.DetectorDraws(
        luck(names[observers[sights.o]], names[sights.actor], step, config),
        clutter_luck(world, observers, config),
    )
    found = detector.detect(sweeps, sights, world.boxes, world.label, draws, config.detector)
    n = len(found.o)
    sensed = Detections(
        observer=observers[found.o],
        k=1 + np.arange(n) - np.searchsorted(found.o, found.o),
        label=found.label,
        boxes=found.boxes,
        score=found.score,
        n_points=found.n_points,
        origin=np.full(n, SENSED, np.uint8),
        said=np.ones(n, bool),
    )
    parts = [self_reports(world, observers), sensed] if config.trust.self_reports else [sensed]
    return sights, Detections.concat(parts), ~found.is_clutter, found.actor


def luck(
    observer: UInt64[ndarray, "s"], actor: UInt64[ndarray, "s"], step: int, config: Config
) -> Float[ndarray, "s n"]:
    """The detectors' luck with every actor, both given by name: in part new in this step, in part lasting."""
    model, n = detector.resolved(config.detector), detector.N_SIGHTING_DRAWS
    fresh = rng.normals(rng.key(config.seed, rng.Stream.DETECTION, step), observer, actor, n=n)
    lasting = rng.persistent(
        rng.key(config.seed, rng.Stream.DETECTION_MEMORY), observer, actor,
        time_s=step * config.traffic.step_s, memory_s=model.memory_s, n=n,
    )  # fmt: skip
    return np.sqrt(1.0 - model.memory_share) * fresh + np.sqrt(model.memory_share) * lasting


def clutter_luck(world: World, observers: Int[ndarray, "e"], config: Config) -> ClutterLuck:
    """The detectors' luck with places that look like something, by observer and by step."""
    names, place = world.name_key, rng.key(config.seed, rng.Stream.CLUTTER_MEMORY)
    fresh = rng.keys(rng.key(config.seed, rng.Stream.CLUTTER, world.step), names[observers])
    own = rng.keys(place, names[observers])
    return ClutterLuck(place, own, fresh, names, world.step * config.traffic.step_s)


def _claims(said: Detections, observers: Int[ndarray, "e"]) -> tuple[Claims, Int[ndarray, "e+1"]]:
    """The detections as trust sees them, and where each equipped vehicle's begin."""
    sender = np.searchsorted(observers, said.observer)
    claims = Claims(sender, said.k, said.label, said.score, said.origin == SELF, said.origin == FABRICATED)
    return claims, ptr_of(sender, len(observers))


def _views(heard: Receptions, ptr: Int[ndarray, "e+1"], said: Bool[ndarray, "d"], n: int) -> Views:
    """What each vehicle has before it: all its own detections, then what it heard, by (sender, k)."""
    everyone = np.arange(n)
    receiver = np.concatenate([everyone, heard.receiver])
    sender = np.concatenate([everyone, heard.message])
    order = np.lexsort((sender, receiver != sender, receiver))
    receiver, sender = receiver[order], sender[order]
    member, which = expand(ptr[sender], ptr[sender + 1])
    view, own = receiver[which], (receiver == sender)[which]
    keep = own | said[member]
    return Views(ptr_of(view[keep], n), member[keep], everyone)


def _subset(views: Views, keep: Bool[ndarray, "m"]) -> Views:
    return Views(ptr_of(views.of_member()[keep], len(views.owner)), views.member[keep], views.owner)


def _told(
    step: int, ids: Int[ndarray, "e"], views: Views, claims: Claims, verdicts: Verdicts, said: Bool[ndarray, "d"]
) -> Told:
    """The verdicts as messages: one per evaluator, on everything that was said."""
    keep = said[views.member]
    return tables.told(step, ids, _subset(views, keep), claims, Verdicts(verdicts.e[keep], verdicts.phi[keep]))


def _lengths(
    claims: Claims, said: Bool[ndarray, "d"], ids: ndarray, riding: Told | None, config: Config
) -> Int[ndarray, "e"]:
    """Length of each vehicle's detection message, with the verdicts that ride on it; 0 for none [B]."""
    n_said = np.bincount(claims.sender[said], minlength=len(ids))
    n_riding = np.zeros(len(ids), np.int64)
    if riding is not None:
        _, there, row = np.intersect1d(riding.evaluator, ids, assume_unique=True, return_indices=True)
        n_riding[row] = np.diff(riding.ptr)[there]
    length = cpm_bytes(n_said) + np.where(n_riding > 0, piggyback_bytes(n_riding), 0)
    return length if config.radio.cpm_rules == "all" else np.where((n_said > 0) | (n_riding > 0), length, 0)


def _book(
    state: State, config: Config, told: Told, claims: Claims, said: Bool[ndarray, "d"], ids: Int[ndarray, "e"]
) -> None:
    """Open the step in the ledgers; where every vehicle keeps its own, enter what it thinks itself."""
    if config.trust.where == "none":
        return
    state.ledger.announce(told.step, ids, claims.sender[said], claims.k[said], claims.score[said])
    if config.trust.where == "local":
        state.ledger.enter(told, ids, np.arange(len(ids)))


def _hear(
    state: State, config: Config, told: Told, carrier: LinkReceptions, ids: Int[ndarray, "e"], begin_s: float
) -> None:
    """Verdicts reach other vehicles and, where that is their way to the server, roadside units."""
    message = np.full(len(ids), -1)  # of each vehicle on the road
    _, which, row = np.intersect1d(told.evaluator, ids, assume_unique=True, return_indices=True)
    message[row] = which
    if config.trust.where == "local" and config.trust.local_evidence == "heard":
        heard = carrier.vehicles
        rows = np.flatnonzero(message[heard.message] >= 0)
        state.ledger.enter(told, ids[heard.receiver[rows]], message[heard.message[rows]])
    if config.trust.where == "central" and config.server.uplink == "rsu":
        up = carrier.uplink.take(message[carrier.uplink.message] >= 0)
        state.last_uplink = state.uplink.send_rsu(told, message[up.message], up, begin_s)


def _look(
    sweeps: lidar.Sweeps,
    views: Views,
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
    asked = np.flatnonzero((inside | foreign) & ~(claims.is_self[b] & (claims.sender[b] == o)))
    n_points[asked] = evidence.points_in_boxes(sweeps, o[asked], boxes, b[asked])
    asked = np.flatnonzero(foreign)
    plausible[asked] = evidence.plausible(sweeps, o[asked], boxes, b[asked], config.area)
    return n_points, plausible
