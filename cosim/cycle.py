"""One step: equipped vehicles perceive, broadcast, evaluate each other's detections, update trust, and fuse.

Reads as the detection and decision cycle of TruPercept (section "Summary"), for all vehicles at once.

Within a step that begins at time t: sweeps and detections at t; detection messages are on the air from t and count
until t + timeout; evaluation messages are on the air from then on and count until t + 2 timeout (`radio.timeout_s`),
when every vehicle fuses with the trust known by then. The trust server uses what has reached it by t, and broadcasts at
t; roadside units pass the broadcast on beside the evaluations. Piggybacked evaluations wait for the detection messages
of the next step: too late for fusion, in which each vehicle then uses its own alone, and in time for trust.
"""

import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim import object_lists
from cosim.driver.driver import Beliefs, SpeedCommands
from cosim.ground_truth import GroundTruth, ground_truth_of
from cosim.object_lists import messages_of, received_lists, subset, sweep_evidence
from cosim.parts import Parts
from cosim.perception import Observed
from cosim.radio.message_round import LinkReceptions, MessageRound, Messages, Receptions, RoundKind, Stations, by_link
from cosim.ragged import ptr_of
from cosim.trackers.attack_start import AttackStartTracker
from cosim.trackers.encounters import EncounterTrackers
from cosim.trackers.inter_reception import InterReceptionTracker
from cosim.tracking import count_in_encounters, pairs_in_range, track_receptions
from cosim.v2x.cpm_generation import InclusionMemory, select_objects
from cosim.v2x.messages import (
    FABRICATED,
    Detections,
    cpm_bytes,
    evaluation_bytes,
    is_sound,
    piggyback_bytes,
    trust_broadcast_bytes,
)
from cosim.v2x.pseudonyms import PseudonymState, PseudonymUse
from cosim.v2x.trust_hosts import Lookups, ObjectScorer, ServerTraffic, TrustState
from cosim.v2x.trust_server import LinkStats
from cosim.world import World
from results.encounters import Rows
from sensors.boxes import overlapping_pairs
from sensors.evidence import in_evaluation_area
from trust import tables
from trust.evaluation import evaluate
from trust.fusion import Fused, SenderTrust, SensorEvidence, fuse
from trust.matching import match
from trust.tables import EvaluationMessages, Evaluations, ObjectLists, TrustScores


@dataclass(frozen=True, slots=True)
class Piggybacked:
    """Evaluations of the last step, waiting for the next detection message."""

    messages: EvaluationMessages
    vehicle: Int[ndarray, "v"]
    """Actor number of each message's sender."""


@dataclass(slots=True)
class State:
    """All that survives a step. A step consumes the state that it is given, because large buffers are used again: to go
    on twice from one state, `copy` it first."""

    medium: Any
    trust: TrustState
    encounters: EncounterTrackers
    driver: object = None
    pseudonyms: PseudonymState = field(default_factory=PseudonymState)
    included: InclusionMemory = field(default_factory=InclusionMemory)
    piggybacked: Piggybacked | None = None
    inter_reception: tuple[InterReceptionTracker, InterReceptionTracker] = field(
        default_factory=lambda: (InterReceptionTracker(), InterReceptionTracker())
    )
    """Of detection and of evaluation messages."""
    attack_start: AttackStartTracker = field(default_factory=AttackStartTracker)
    n_malformed: int = 0
    """Detections dropped so far because they cannot be: no finite pose, no size, no score."""
    is_consumed: bool = False

    @staticmethod
    def start(parts: Parts) -> "State":
        """Before the first step."""
        c = parts.config
        encounters = EncounterTrackers(c.encounters, c.traffic.step_s, c.lidar.mount_above_roof_m)
        return State(parts.medium.start(), parts.trust.start(), encounters)

    def copy(self) -> "State":
        """A state that shares nothing with this one."""
        return copy.deepcopy(self)

    def consume(self) -> "State":
        """The state to go on with; RuntimeError where another step went on from this one already."""
        if self.is_consumed:
            raise RuntimeError("this state was consumed by an earlier step; go on from a copy made before: state.copy()")
        self.is_consumed = True
        return replace(self, is_consumed=False)


@dataclass(frozen=True, slots=True)
class Vehicles:
    """Equipped vehicles on the road, by actor number."""

    row: Int[ndarray, "e"]
    """Row of the world."""
    actor: Int[ndarray, "e"]
    name_key: UInt64[ndarray, "e"]
    pseudonym: Int[ndarray, "e"]

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True, slots=True)
class Sensed:
    """What happened in a step in which vehicles sense and talk."""

    vehicles: Vehicles
    observed: Observed
    listed: Detections
    """Detections as each vehicle lists and transmits them, attacks included."""
    truth: GroundTruth
    detections: tables.Detections
    """The same as trust sees them: sender as a row of `vehicles`."""
    rounds: tuple[MessageRound, MessageRound]
    """Of detection messages, and of evaluation messages."""
    links: tuple[LinkReceptions, LinkReceptions]
    """Their receptions by kind of link."""
    lists: ObjectLists
    """What each vehicle evaluates."""
    reported: Evaluations
    """Evaluations as transmitted."""
    n_points: Int[ndarray, "m"]
    plausible: Bool[ndarray, "m"]
    matched: Bool[ndarray, "m"]
    """The vehicle detected the object itself."""
    used: Receptions
    """Messages whose senders' trust each vehicle looks up."""
    lookups: list[Lookups]
    """Per trust variant; rows as in `used`."""
    fused: list[Fused | None]
    """Per trust variant; None where it was not asked for."""
    published: list[TrustScores | None]
    """Per trust variant: what its server computed in this step."""
    server: ServerTraffic | None
    """None where the acting trust does not live on a server."""
    in_range: list[tuple[Int[ndarray, "p"], Int[ndarray, "p"]]]
    """Per round: senders and the vehicles within range of them; rows of `vehicles`."""
    inter_reception: list[Rows]
    """Per round: columns of the table `packet_inter_reception`."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """What happened in a step."""

    world: World
    encounters: list[Rows]
    """Encounters that are over, per definition."""
    ended_pseudonyms: PseudonymUse
    sensed: Sensed | None
    """None in steps between two sweeps, and without equipped vehicles."""
    commands: SpeedCommands
    """What drivers do next."""


def step(world: World, state: State, parts: Parts) -> tuple[State, StepResult]:
    """The cycle, once. The state is consumed; everything else stays as it was."""
    c, watch, time_s = parts.config, parts.watch, world.step * parts.config.traffic.step_s
    s = state.consume()
    s.pseudonyms, vehicles, ended = _vehicles(world, s, parts)
    with watch("encounters"):
        closed = _encounters(world, s, parts, vehicles, time_s)
    if not parts.senses(world.step) or not len(vehicles):
        return s, StepResult(world, closed, ended, None, SpeedCommands.none())

    with watch("server"):
        s.trust, published, informed = parts.trust.publish(
            s.trust, world.step, time_s, vehicles.actor, vehicles.name_key
        )
    with watch("sweep"):
        sweeps = parts.perception.sweep(world, vehicles.row)
    with watch("detect"):
        observed = parts.perception.detect(world, vehicles.row, sweeps)
    with watch("attack"):
        listed = _listed(parts.adversary.detections(observed.detections, world, time_s), world, s, c, time_s)
        truth = ground_truth_of(listed, world, observed.observability, vehicles.row, observed.is_real, observed.actor_row)
        detections, ptr = object_lists.for_trust(listed, vehicles.row)

    with watch("radio"):
        stations, lengths = _stations(world, vehicles, parts), _lengths(detections, listed, vehicles, s, c)
        s.medium, round_1 = parts.medium.broadcast(
            s.medium, RoundKind.CPM, world.step, time_s, stations, _messages(lengths, parts)
        )
        links_1 = by_link(round_1, len(vehicles))
    with watch("match"):
        pairs = overlapping_pairs(listed.boxes, listed.label, listed.observer)
        known = received_lists(links_1.vehicles, ptr, listed.transmitted, len(vehicles))
        inside = in_evaluation_area(
            sweeps, known.of_member(), listed.boxes, c.area, known.member, listed.label, world.boxes.take(vehicles.row)
        )
        lists = subset(known, inside)
        groups_known, groups = (match(x, detections, pairs, c.trust) for x in (known, lists))
    with watch("evaluate"):
        foreign = np.zeros(len(inside), bool)  # members of which a vehicle asks its own sweep whether they can be there
        foreign[groups_known.seeds()] = True
        foreign &= ~groups_known.ego_detected
        foreign[np.flatnonzero(inside)[~groups.ego_detected]] = True
        points, possible = sweep_evidence(sweeps, known, inside, foreign, listed.boxes, detections, c.area)
        n_points, plausible = points[inside], possible[inside]
        evaluated = evaluate(lists, groups, detections, n_points, plausible, c.trust)
        reported = object_lists.as_reported(parts.adversary, evaluated, lists, listed, vehicles.row, world, time_s)
        own, sent = (
            messages_of(world.step, vehicles.pseudonym, lists, detections, e, listed.transmitted)
            for e in (evaluated, reported)
        )

    evaluated_s = time_s + c.timeout_s
    alone = c.radio.evaluations == "alone"
    with watch("radio"):
        s.trust, broadcast = parts.trust.pending_rsu_broadcast(s.trust, evaluated_s)
        lengths = evaluation_bytes(np.diff(sent.ptr)) * alone
        rsu_bytes = 0 if broadcast is None else trust_broadcast_bytes(len(broadcast.scores.subject))
        s.medium, round_2 = parts.medium.broadcast(
            s.medium, RoundKind.EVALUATION, world.step, evaluated_s, stations, _messages(lengths, parts, rsu_bytes)
        )
        links_2 = by_link(round_2, len(vehicles))
    with watch("trust"):
        carried = Piggybacked(sent, vehicles.actor) if alone else s.piggybacked
        s.piggybacked = None if alone else Piggybacked(sent, vehicles.actor)
        links, begin_s = (links_2, evaluated_s) if alone else (links_1, time_s)
        _open_step(world.step, s, parts, vehicles, detections, listed, own)
        up = _deliver(carried, links, begin_s, s, parts, vehicles)
        if c.server.uplink == "cellular":
            xy_m = world.boxes.xyz_m[vehicles.row, :2]
            s.trust, up = parts.trust.report_by_cellular(s.trust, sent, vehicles.name_key, xy_m, evaluated_s)
        if broadcast is not None:
            down = links_2.downlink
            s.trust, informed = parts.trust.receive_from_rsu(
                s.trust, vehicles.actor, down.receiver, evaluated_s + down.received_s
            )
        used, now_s = links.vehicles, evaluated_s + c.timeout_s
        s.trust = parts.trust.receive(s.trust, vehicles.actor, now_s)
        lookups = parts.trust.lookup(s.trust, vehicles.actor[used.receiver], vehicles.pseudonym[used.message], now_s)
    with watch("fuse"):
        seeds = groups_known.seeds()
        away_m = _distance_m(listed, known.member[seeds], observed, known.of_member()[seeds])
        evidence = SensorEvidence(points[seeds], possible[seeds], away_m < c.area.range_m)
        from_own_m = _distance_m(listed, np.arange(len(listed)), observed, detections.message)
        fused = [
            _fuse(known, groups_known, detections, lists, evaluated, reported, used, look_up, alone, evidence,
                  from_own_m, variant.trust, scorer) if variant.fused else None
            for variant, look_up, scorer in zip(
                parts.trust.variants, _per_variant(lookups, parts), _per_variant(parts.trust.scorers(s.trust), parts),
                strict=True,
            )
        ]  # fmt: skip
    with watch("driver"):
        assert fused[0] is not None
        s.driver, commands = parts.driver.commands(
            s.driver, world, _beliefs(fused[0], listed, vehicles), c.traffic.step_s
        )
    with watch("track"):
        s.attack_start.update(world.step, world.actor[listed.observer[listed.origin == FABRICATED]])
        rounds, between = (round_1, round_2), (links_1.vehicles, links_2.vehicles)
        in_range = [pairs_in_range(happened, len(vehicles)) for happened in rounds]
        inter_reception = [
            track_receptions(tracker, world.step, happened, received, pairs, vehicles.actor)
            for tracker, happened, received, pairs in zip(s.inter_reception, rounds, between, in_range, strict=True)
        ]
        base = lookups[parts.trust.host_of[0]]
        count_in_encounters(
            s.encounters, rounds, between, used, base.source, lists, detections.message, vehicles.actor
        )
    server = ServerTraffic(up, *informed) if c.trust.host == "central" else None
    return s, StepResult(world, closed, ended, Sensed(
        vehicles, observed, listed, truth, detections, rounds, (links_1, links_2), lists, reported, n_points,
        plausible, groups.ego_detected, used, _per_variant(lookups, parts), fused, _per_variant(published, parts),
        server, in_range, inter_reception,
    ), commands)  # fmt: skip


def _vehicles(world: World, s: State, parts: Parts) -> tuple[PseudonymState, Vehicles, PseudonymUse]:
    """Equipped vehicles on the road, under their present pseudonyms; in steps with messages some change."""
    row = np.flatnonzero(world.equipped)
    actor, names = world.actor[row], world.name_key[row]
    if not parts.senses(world.step):
        return s.pseudonyms, Vehicles(row, actor, names, s.pseudonyms.of(actor)), PseudonymUse.none()
    pseudonyms, pseudonym, ended = parts.pseudonyms.issue(s.pseudonyms, world, row)
    return pseudonyms, Vehicles(row, actor, names, pseudonym), ended


def _encounters(world: World, s: State, parts: Parts, vehicles: Vehicles, time_s: float) -> list[Rows]:
    """Who is near whom, and what they know of each other when they meet."""
    closed, holder, other = s.encounters.update(world, parts.walls)
    s.trust = parts.trust.receive(s.trust, vehicles.actor, time_s)
    known = parts.trust.lookup(s.trust, holder, s.pseudonyms.of(other), time_s)[parts.trust.host_of[0]]
    s.encounters.first_contact(holder, other, known.trust, known.source, known.age_s)
    return closed


def _listed(listed: Detections, world: World, s: State, c: Any, time_s: float) -> Detections:
    """What is left of the lists once impossible boxes are dropped and generation rules are applied."""
    sound = is_sound(listed)
    if not sound.all():
        assert (listed.origin[~sound] == FABRICATED).all()
        s.n_malformed += int((~sound).sum())
        listed = listed.take(np.flatnonzero(sound))
    if c.radio.cpm_rules == "etsi":
        chosen, s.included = select_objects(s.included, listed, world.actor[listed.observer], time_s)
        listed = replace(listed, transmitted=chosen)
    return listed


def _stations(world: World, vehicles: Vehicles, parts: Parts) -> Stations:
    """Antennas of vehicles and roadside units."""
    key = np.concatenate([vehicles.name_key, parts.rsus.key])
    xyz_m = np.concatenate([world.boxes.xyz_m[vehicles.row], parts.rsus.xyz_m])
    xyz_m[: len(vehicles), 2] += world.boxes.lwh_m[vehicles.row, 2] / 2 + parts.config.radio.antenna_above_roof_m
    return Stations(key, xyz_m, len(vehicles))


def _messages(length_bytes: Int[ndarray, "e"], parts: Parts, rsu_bytes: int = 0) -> Messages:
    """One message per station, roadside units included."""
    return Messages.one_each(np.concatenate([length_bytes, np.full(len(parts.rsus), rsu_bytes)]))


def _lengths(
    detections: tables.Detections, listed: Detections, vehicles: Vehicles, s: State, c: Any
) -> Int[ndarray, "e"]:
    """Length of each vehicle's detection message, with the evaluations that it carries; 0 for none [B]."""
    n_objects = np.bincount(detections.message[listed.transmitted], minlength=len(vehicles))
    n_carried = np.zeros(len(vehicles), np.int64)
    if s.piggybacked is not None:
        _, there, row = np.intersect1d(s.piggybacked.vehicle, vehicles.actor, assume_unique=True, return_indices=True)
        n_carried[row] = np.diff(s.piggybacked.messages.ptr)[there]
    length = cpm_bytes(n_objects) + np.where(n_carried > 0, piggyback_bytes(n_carried), 0)
    return length if c.radio.cpm_rules == "all" else np.where((n_objects > 0) | (n_carried > 0), length, 0)


def _open_step(
    step: int, s: State, parts: Parts, vehicles: Vehicles, detections: tables.Detections, listed: Detections,
    own: EvaluationMessages,
) -> None:  # fmt: skip
    """Trust learns what was transmitted; vehicles that keep trust themselves learn what they think themselves."""
    sent = listed.transmitted
    s.trust = parts.trust.open_step(
        s.trust, step, vehicles.pseudonym, detections.message[sent], detections.detection_index[sent],
        detections.score[sent],
    )  # fmt: skip
    s.trust = parts.trust.add_own(s.trust, own, vehicles.actor)


def _deliver(
    carried: Piggybacked | None, links: LinkReceptions, begin_s: float, s: State, parts: Parts, vehicles: Vehicles
) -> LinkStats:
    """Evaluations reach other vehicles and, where that is their way to the server, roadside units."""
    if carried is None:
        return LinkStats()
    row = np.full(len(vehicles), -1)  # of each vehicle's message
    _, which, at = np.intersect1d(carried.vehicle, vehicles.actor, assume_unique=True, return_indices=True)
    row[at] = which
    got = links.vehicles.take(row[links.vehicles.message] >= 0)
    s.trust = parts.trust.add_received(s.trust, carried.messages, vehicles.actor[got.receiver], row[got.message])
    up = links.uplink.take(row[links.uplink.message] >= 0)
    s.trust, stats = parts.trust.report_by_rsu(s.trust, carried.messages, row[up.message], begin_s + up.received_s)
    return stats


def _per_variant(of_host: list, parts: Parts) -> list:
    """The same per trust variant."""
    return [of_host[h] for h in parts.trust.host_of]


def _distance_m(
    listed: Detections, detection: Int[ndarray, "n"], observed: Observed, vehicle: Int[ndarray, "n"]
) -> Float[ndarray, "n"]:
    """From vehicles' sensors to the centres of detections."""
    return np.linalg.norm(listed.boxes.xyz_m[detection] - observed.sweeps.poses.origin_m[vehicle], axis=1)


def _fuse(
    known: ObjectLists, groups: tables.Groups, detections: tables.Detections, lists: ObjectLists,
    evaluated: Evaluations, reported: Evaluations, used: Receptions, look_up: Lookups, alone: bool,
    evidence: SensorEvidence, from_own_m: Float[ndarray, "d"], params: Any, scorer: ObjectScorer | None,
) -> Fused:  # fmt: skip
    """Every vehicle's final objects with the trust of one variant."""
    trust = SenderTrust(
        ptr_of(used.receiver, len(known.owner)), used.message, look_up.trust, np.full(len(used.message), alone)
    )
    fused = fuse(known, groups, detections, lists, evaluated, reported, trust, evidence, from_own_m, params, scorer)
    return fused.take(fused.score >= params.min_score)


def _beliefs(fused: Fused, listed: Detections, vehicles: Vehicles) -> Beliefs:
    """Fused objects as drivers see them."""
    boxes = listed.boxes.take(fused.seed)
    pose = listed.boxes.take(fused.pose)
    boxes = replace(boxes, xyz_m=pose.xyz_m, yaw_rad=pose.yaw_rad)
    return Beliefs(vehicles.row[fused.ego], listed.label[fused.seed], boxes, fused.score, fused.ego_detected)
