"""The stages of a step, in the order of `cosim.step.cycle.step`.

Stages are functions of arrays and components. A stage that changes a part of the state takes it as an argument and
returns its new value before the result.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.attacks.adversary import Active
from cosim.attacks.disguise import shuffled
from cosim.base.ragged import ptr_of
from cosim.base.threads import threads_for
from cosim.config.config import Config
from cosim.messages.content import (
    FABRICATED,
    SELF,
    SENSED,
    Detections,
    cpm_bytes,
    encoded_cpm_bytes,
    evaluation_bytes,
    piggyback_bytes,
    trust_broadcast_bytes,
    velocities,
    with_motion,
)
from cosim.messages.cpm_generation import CpmContent, CpmState, Generators, generate
from cosim.messages.pseudonyms import PseudonymState, PseudonymUse
from cosim.messages.redundancy import ReportedObjects
from cosim.messages.trust_server import TrustBroadcast
from cosim.radio.medium import gap_s
from cosim.radio.message_round import LinkReceptions, MessageRound, Messages, RoundKind
from cosim.step import object_lists
from cosim.step.accuracy import pose_variance, sensors_of, stated
from cosim.step.comparing import ROWS_PER_BOX, Compared, Fuses, KnownObjects, compare, distance_m
from cosim.step.exchange import Exchange, OnAir, Senders, Times, Vehicles, lists_of_identities
from cosim.step.ground_truth import GroundTruth, ground_truth_of, lies_in_detections, lies_in_evaluations
from cosim.step.known import Known, Pairs, Uses
from cosim.step.late import LateMessages
from cosim.step.object_lists import messages_of, subset
from cosim.step.parts import Parts
from cosim.step.perception import Observed
from cosim.step.positioning import as_believed, as_estimated, believed_world
from cosim.step.precomputed import Precomputed
from cosim.traffic.driver import Beliefs
from cosim.traffic.position_errors import PositionErrors
from cosim.world import World
from sensors.association import Gate, bounded, pairs_across, pairs_within
from sensors.box_fusion import StatedAccuracy, boxes_of_columns
from sensors.boxes import Boxes, overlapping_pairs, pairs_between
from sensors.tracking import Found, ObjectStates, Observers, TrackMemory, track
from trust import tables
from trust.claims import DETECTION, answers, claim_number
from trust.fusion import Fused
from trust.params import KINDS, TrustParams
from trust.tables import EvaluationMessages, Evaluations, ObjectLists


def identify(
    world: World, pseudonyms: PseudonymState, own_trust: Float[ndarray, "n"] | None, now: Times, parts: Parts
) -> tuple[PseudonymState, Vehicles, PseudonymUse]:
    """Issue pseudonyms to the equipped vehicles on the road.

    A vehicle gets a pseudonym, and changes it, only in steps in which it senses.

    Parameters
    ----------
    world
        All actors.
    pseudonyms
        State of the pseudonyms.
    own_trust
        Trust in each actor, as the actor itself last learned it; None if no attack reads it.
    now
        Times of the step.
    parts
        Components of the run.

    Returns
    -------
    The new state of the pseudonyms, the vehicles with their pseudonyms, and the pseudonyms that have ended.
    """
    row, sensing = np.flatnonzero(world.equipped), parts.sensing(world)
    actor, names, ended = world.actor[row], world.name_key[row], PseudonymUse.none()
    if len(sensing):
        wants = None
        if parts.adversary.renews:
            age_s = (world.step - pseudonyms.begun(world.actor, world.step)) * parts.config.traffic.step_s
            wants = parts.adversary.renewals(world, now.begin_s, own_trust, age_s)[sensing]
        pseudonyms, _, ended = parts.pseudonyms.issue(pseudonyms, world, sensing, wants)
    return pseudonyms, Vehicles(row, actor, names, pseudonyms.of(actor), np.searchsorted(row, sensing)), ended


def perceive(world: World, vehicles: Vehicles, precomputed: Precomputed, parts: Parts) -> Observed:
    """What the vehicles perceive that sense in this step."""
    if precomputed.observed is None:
        return parts.perception(world, vehicles.row[vehicles.senses], parts.watch)
    with parts.watch("wait for sensing"):
        return precomputed.observed()


@dataclass(frozen=True, slots=True)
class Positioned:
    """What vehicles perceive, at their estimated positions."""

    observed: Observed
    world: World
    """The world with every vehicle at its estimated pose; the true world without `[gnss]`."""
    error: Float[ndarray, "e 3"] | None
    """Errors of each vehicle, estimated minus true: east [m], north [m], heading [rad]; None without `[gnss]`."""
    objects: ObjectStates | None = None
    """What tracking says about the detector's reports, in the order of the detections; None without tracking."""


def position(
    world: World, vehicles: Vehicles, observed: Observed, errors: PositionErrors, config: Config
) -> tuple[PositionErrors, Positioned]:
    """Apply position errors to what vehicles perceive; return the new state of the errors and the result."""
    c = config
    if c.gnss.is_exact:
        return errors, Positioned(observed, world, None)
    errors, error = errors.next(world.step, vehicles.actor, vehicles.name_key, c.gnss, c.traffic.step_s, c.seed)
    if c.roadside:  # where a unit stands is known
        error = np.where(world.is_roadside[vehicles.row, None], 0.0, error)
    observed = as_believed(observed, world, vehicles.row[vehicles.senses], error[vehicles.senses])
    return errors, Positioned(observed, believed_world(world, vehicles.row, error), error)


def senders_among(world: World, vehicles: Vehicles) -> Bool[ndarray, "n"] | None:
    """Actors that send messages in this step, by row of the world; None if all equipped vehicles do."""
    if len(vehicles.senses) == len(vehicles):
        return None
    sends = np.zeros(len(world), bool)
    sends[vehicles.row[vehicles.senses]] = True
    return sends


def track_objects(
    world: World, vehicles: Vehicles, positioned: Positioned, memory: TrackMemory, now: Times, c: Config
) -> tuple[TrackMemory, Positioned]:
    """Give the objects that the detector reports velocities, numbers, ages and probabilities of existence.

    Parameters
    ----------
    world
        All actors at their true positions.
    vehicles
        Equipped vehicles. The tracks of those that do not sense in this step stay as they are.
    positioned
        What those perceive that sense.
    memory
        The tracks of all vehicles.
    now
        Times of the step.
    c
        The config.

    Returns
    -------
    The tracks after the step, and what vehicles perceive with the velocities of objects. Boxes and scores stay those of
    the detector.
    """
    if c.tracking.model == "none":
        return memory, positioned
    detections, rows = positioned.observed.detections, vehicles.row[vehicles.senses]
    sensed = np.flatnonzero(detections.origin == SENSED)
    boxes = detections.boxes.take(sensed)
    memory, objects = track(
        memory,
        Observers(world.actor[rows].astype(np.int64), np.full(len(rows), now.begin_s), world.speed_mps[rows]),
        Found(
            observer=world.actor[detections.observer[sensed]].astype(np.int64),
            label=detections.label[sensed],
            xy_m=boxes.xyz_m[:, :2],
            yaw_rad=boxes.yaw_rad,
            score=detections.score[sensed],
        ),
        c.tracking,
    )
    velocity_mps = detections.velocity_mps.copy()
    velocity_mps[sensed] = objects.velocity_mps
    observed = replace(positioned.observed, detections=replace(detections, velocity_mps=velocity_mps))
    return memory, replace(positioned, observed=observed, objects=objects)


def senders_of(
    world: World, vehicles: Vehicles, attacks: Active, pseudonyms: PseudonymState, parts: Parts
) -> tuple[PseudonymState, Senders]:
    """The messages of one round, one per vehicle that senses and identity, with their pseudonyms."""
    senders = Senders.of(vehicles, attacks.identities(len(world))[vehicles.row[vehicles.senses]])
    more = np.flatnonzero(senders.identity)
    if len(more):
        pseudonym = senders.pseudonym.copy()
        pseudonyms, pseudonym[more] = parts.pseudonyms.issue_extra(
            pseudonyms, vehicles.actor[senders.vehicle[more]], senders.identity[more], world.step
        )
        senders = replace(senders, pseudonym=pseudonym)
    is_valid, pseudonyms = parts.revocation.valid(pseudonyms, senders.pseudonym, world.step)
    return pseudonyms, replace(senders, is_valid=is_valid)


@dataclass(frozen=True, slots=True)
class Listed:
    """The detections that every vehicle lists, after attacks, whether it transmits them or not."""

    objects: Detections
    truth: GroundTruth
    detections: tables.SentDetections
    """The same detections in the form that `trust` uses, with the message as a row of `Senders`."""
    ptr: Int[ndarray, "m+1"]
    """Row at which the detections of each message begin."""
    withheld: Bool[ndarray, "d"]
    """Whether an attack withholds a detection that the detector made."""
    n_dropped: Int[ndarray, "f"]
    """Number of detections that cannot be sent, by `DetectionFault`."""
    tracks: ObjectStates | None
    """What tracking says about the sensed detections, in their order; None without tracking."""
    content: CpmContent
    """What each message contains."""


def list_objects(
    exchange: Exchange, positioned: Positioned, acceleration_mps2: Float[ndarray, "n"], cpm: CpmState,
    medium: object, parts: Parts,
) -> tuple[CpmState, Listed]:  # fmt: skip
    """Detections as each vehicle lists them, after attacks, generation rules and redundancy mitigation.

    Parameters
    ----------
    exchange
        Vehicles, senders and attacks of the step.
    positioned
        What vehicles perceive, at their estimated positions.
    acceleration_mps2
        Acceleration of every actor.
    cpm
        State of the detection messages.
    medium
        State of the medium. It is read only: its congestion control limits the rate of messages.
    parts
        Components of the run.

    Returns
    -------
    The new state of the detection messages, and the lists.
    """
    world, sensing, senders, attacks = exchange.world, exchange.sensing, exchange.senders, exchange.attacks
    observed, vehicles = positioned.observed, exchange.vehicles
    perceived = with_motion(observed.detections, world.speed_mps, acceleration_mps2)
    objects, n_dropped = attacks.detections(perceived)
    withheld = (objects.origin == SENSED) & ~objects.transmitted
    lied = lies_in_detections(perceived, objects, attacks.malicious(len(world)))
    message = senders.message_of(objects, sensing.row)
    generators = Generators(
        sender=exchange.sender,
        actor=vehicles.actor[senders.vehicle],
        xy_m=positioned.world.boxes.xyz_m[vehicles.row[senders.vehicle], :2],
        gap_s=_gaps_s(parts, medium, exchange)[senders.vehicle],
    )
    track = np.full(len(objects), -1)
    if positioned.objects is not None:
        track[objects.origin == SENSED] = positioned.objects.object_id
    cpm, content = generate(cpm, objects, message, generators, exchange.now.begin_s, parts.config.cpm, track)
    objects = replace(objects, transmitted=content.included)
    truth = ground_truth_of(
        objects, world, observed.observability, sensing.row, observed.is_real, observed.actor_row, lied
    )
    was_sensed = np.cumsum(objects.origin == SENSED) - 1
    objects, order = shuffled(objects, world.name_key, parts.config.seed, world.step)
    tracks = positioned.objects
    if tracks is not None:
        tracks = tracks.take(was_sensed[order[objects.origin == SENSED]])
    if parts.config.trust.matching == "gates":
        origin_m = sensors_of(objects.observer, sensing.row, observed.sweeps.poses.origin_m)
        own_mps = world.speed_mps[objects.observer]
        objects = stated(objects, tracks, origin_m, own_mps, parts.accuracy, parts.config)
    detections, ptr = object_lists.for_trust(objects, message, len(senders))
    return cpm, Listed(
        objects=objects,
        truth=truth.take(order),
        detections=detections,
        ptr=ptr,
        withheld=withheld[order],
        n_dropped=n_dropped,
        content=replace(content, inclusion=content.inclusion[order]),
        tracks=tracks,
    )


def _gaps_s(parts: Parts, medium: object, exchange: Exchange) -> Float[ndarray, "s"]:
    """Least time between two messages of each station by congestion control; 0 where no rule asks for it."""
    if parts.config.cpm.rules == "all":
        return np.zeros(len(exchange.stations))
    return gap_s(parts.medium, medium, exchange.stations)


@dataclass(frozen=True, slots=True)
class SentEvaluations:
    """Evaluation messages that were sent, or that wait for the next detection message."""

    messages: EvaluationMessages
    sender: Int[ndarray, "v"]
    """Actor number and identity of each message's sender, as in `Exchange.sender`; ascending."""

    def take(self, rows: Int[ndarray, "k"]) -> "SentEvaluations":
        """These messages."""
        return SentEvaluations(self.messages.taken(rows), self.sender[rows])

    def and_also(self, earlier: "SentEvaluations") -> "SentEvaluations":
        """These messages and those of other senders, which were made earlier."""
        sender = np.concatenate([self.sender, earlier.sender])
        both = self.messages.and_also(earlier.messages)
        order = np.argsort(sender, kind="stable")
        return SentEvaluations(both.taken(order), sender[order])


@dataclass(frozen=True, slots=True)
class Broadcast:
    """One round of messages."""

    round: MessageRound
    links: LinkReceptions
    """Receptions by kind of link."""
    accepted: LinkReceptions
    """Receptions without those from revoked senders."""
    length_bytes: Int[ndarray, "m"]
    """Length of each vehicle's message; 0 if it is not sent."""
    clouds: MessageRound | None = None
    """Point clouds that were sent in the same round, one per vehicle that senses; None if none are."""
    late: tuple[LateMessages, ...] = ()
    """Messages of earlier rounds that went on in this one."""


def broadcast_detections(
    exchange: Exchange, listed: Listed, piggybacked: SentEvaluations | None, cloud_bytes: Int[ndarray, "s"] | None,
    medium: object, parts: Parts,
) -> tuple[object, Broadcast]:  # fmt: skip
    """Broadcast detection messages, with piggybacked evaluations of the step before; return the medium's new state.

    Behind its detection message, a vehicle sends its point cloud, if `cloud_bytes` has the lengths.
    """
    lengths, envelopes = _cpm_lengths(exchange, listed, piggybacked, parts.config)
    on_air = OnAir.of(
        exchange.senders, lengths, len(exchange.vehicles), len(parts.rsus), sending=exchange.sending,
        envelope_bytes=envelopes,
    )  # fmt: skip
    return _broadcast(exchange, RoundKind.CPM, on_air, exchange.now.begin_s, lengths, medium, parts, cloud_bytes)


def broadcast_evaluations(
    exchange: Exchange, evaluated: "Evaluated", rsu_broadcast: TrustBroadcast | None, medium: object, parts: Parts
) -> tuple[object, Broadcast]:
    """Broadcast evaluation messages, unless they wait for the next detection message; return the medium's new state.

    In the same round, roadside units broadcast the trust that the server gave them.
    """
    alone = parts.config.radio.evaluations == "alone"
    lengths = evaluation_bytes(np.diff(evaluated.sent.ptr)) * alone
    rsu_bytes = 0 if rsu_broadcast is None else trust_broadcast_bytes(len(rsu_broadcast.scores.subject))
    on_air = OnAir.of(exchange.senders, lengths, len(exchange.vehicles), len(parts.rsus), rsu_bytes)
    return _broadcast(exchange, RoundKind.EVALUATION, on_air, exchange.now.evaluated_s, lengths, medium, parts)


def _broadcast(
    exchange: Exchange, kind: RoundKind, on_air: OnAir, begin_s: float, length_bytes: Int[ndarray, "m"],
    medium: object, parts: Parts, cloud_bytes: Int[ndarray, "s"] | None = None,
) -> tuple[object, Broadcast]:  # fmt: skip
    messages, clouds = on_air.without(exchange.refused).messages, None
    messages = replace(messages, name=_names(exchange)[on_air.message])
    if cloud_bytes is not None:
        messages, is_cloud = messages.followed_by(Messages(exchange.vehicles.senses, cloud_bytes))
    medium, found = parts.medium.broadcast(medium, kind, exchange.now.step, begin_s, exchange.stations, messages)
    if cloud_bytes is not None:
        found, clouds = found.only(~is_cloud), found.only(is_cloud)
    n_vehicles = len(exchange.vehicles)
    links = on_air.links(found, n_vehicles)
    late = tuple(LateMessages.of(earlier, n_vehicles) for earlier in found.earlier)
    return medium, Broadcast(found, links, _accepted(links, exchange.senders), length_bytes, clouds, late)


def _names(exchange: Exchange) -> Int[ndarray, "m"]:
    """The sender of each message, by which it is known if it arrives late; -1 for those that are not accepted.

    Messages of roadside units follow.
    """
    n_units = len(exchange.stations) - len(exchange.vehicles)
    accepted = np.where(exchange.senders.is_valid, exchange.sender, -1)
    return np.append(accepted, np.full(n_units, -1))


def _accepted(links: LinkReceptions, senders: Senders) -> LinkReceptions:
    """Receptions without those from revoked senders."""
    if senders.is_valid.all():
        return links
    return LinkReceptions(
        links.vehicles.take(senders.is_valid[links.vehicles.message]),
        links.uplink.take(senders.is_valid[links.uplink.message]),
        links.downlink,
    )


def _cpm_lengths(
    exchange: Exchange, listed: Listed, piggybacked: SentEvaluations | None, c: Config
) -> tuple[Int[ndarray, "m"], Int[ndarray, "m"] | None]:
    """Length of each detection message with the evaluations that it carries, and of its envelope [B].

    The length is 0 if nothing is sent. The envelope is None where it is that of all messages.
    """
    n_messages, chosen = len(exchange.senders), listed.objects.transmitted
    n_objects = np.bincount(listed.detections.message[chosen], minlength=n_messages)
    n_carried = np.zeros(n_messages, np.int64)
    if piggybacked is not None:
        _, there, row = np.intersect1d(piggybacked.sender, exchange.sender, assume_unique=True, return_indices=True)
        n_carried[row] = np.diff(piggybacked.messages.ptr)[there]
    envelope = None
    if c.cpm.length == "linear":
        length = cpm_bytes(n_objects)
    else:
        rows = np.flatnonzero(chosen)
        length, envelope = encoded_cpm_bytes(
            listed.objects.take(rows), listed.detections.message[rows], listed.content.has_sensors
        )
    length = length + np.where(n_carried > 0, piggyback_bytes(n_carried), 0)
    if c.cpm.rules != "all":
        length = np.where((n_objects > 0) | (n_carried > 0), length, 0)
    return length, envelope


def hear(
    cpm: CpmState, exchange: Exchange, positioned: Positioned, listed: Listed, cpms: Broadcast, c: Config
) -> CpmState:
    """Note the objects that vehicles received, if they leave out objects that others report."""
    if c.cpm.redundancy == "none":
        return cpm
    vehicles, senders, objects, begin_s = exchange.vehicles, exchange.senders, listed.objects, exchange.now.begin_s
    rows = np.flatnonzero(objects.transmitted)
    sent = objects.take(rows)
    reports = ReportedObjects(
        time_s=np.full(len(senders), begin_s),
        sender=exchange.sender,
        sender_xy_m=positioned.world.boxes.xyz_m[vehicles.row[senders.vehicle], :2],
        message=listed.detections.message[rows],
        label=sent.label.astype(np.int64),
        xy_m=sent.boxes.xyz_m[:, :2],
        velocity_mps=velocities(sent),
        is_self=sent.origin == SELF,
    )
    got = cpms.accepted.vehicles
    heard = cpm.heard.next(
        reports, vehicles.actor[got.receiver], got.message, begin_s + got.received_s, c.cpm.redundancy_window_s
    )
    return replace(cpm, heard=heard)


@dataclass(frozen=True, slots=True)
class Matched:
    """What later stages need of the comparison."""

    objects: Fuses
    """The groups of detections that each vehicle knows."""
    pairs: Pairs
    """Detections that may be of one object, as rows of `Known`."""
    from_own_m: Float[ndarray, "d"]
    """Distance of each detection from the sensor of the vehicle that sends it. With `trust.matching = "gates"`:
    standard deviation of its position."""


def compare_objects(
    exchange: Exchange, messages: Known, positioned: Positioned, parts: Parts
) -> tuple[Compared, Matched]:
    """Group the detections that each vehicle knows, ask its own sweep about them, and evaluate them.

    Sweeps are not read again in this step.
    """
    objects, senders, sweeps, c = messages.objects, exchange.senders, positioned.observed.sweeps, parts.config
    n_now, received = int(messages.ptr[len(senders)]), messages.received
    with parts.watch("match"):
        pairs = _pairs(messages, n_now, c.trust)
    further = np.flatnonzero(senders.identity)
    if len(further):
        sources, rows = (senders.source[further], received.receiver), (further, received.message)
        received = Uses(np.concatenate(sources), np.concatenate(rows))
    variance_m2 = None
    if c.trust.matching == "gates":  # of a box beside the evaluator's own sweep
        variance_m2 = objects.variance_m2 + c.gnss.std_m**2 * np.array([1.0, 0.0, 1.0])
    known = KnownObjects(
        detections=messages.detections, boxes=objects.boxes, transmitted=objects.transmitted, ptr=messages.ptr,
        traced=objects.origin == FABRICATED, pairs=pairs, own=senders.own, received=received,
        bodies=positioned.world.boxes.take(exchange.sensing.row),
        variance_m2=variance_m2, accuracy=_accuracy(exchange, messages, positioned, parts),
    )  # fmt: skip
    compared, grouped = compare(parts.perception, sweeps, known, c.area, c.trust, parts.recall, parts.watch)
    observer = senders.source[messages.detections.message[:n_now]]
    from_own_m = distance_m(objects.boxes.xyz_m, np.arange(n_now), sweeps.poses.origin_m, observer)
    from_own_m = np.concatenate([from_own_m, messages.earlier_m])
    if c.trust.matching == "gates":  # the most accurate detection of an object gives its box
        from_own_m = np.sqrt(0.5 * objects.variance_m2[:, [0, 2]].sum(axis=1))
    return compared, Matched(grouped, pairs, from_own_m)


def _accuracy(exchange: Exchange, messages: Known, positioned: Positioned, parts: Parts) -> StatedAccuracy | None:
    """What vehicles state of the accuracy of the detections; None if no variant fuses boxes by it."""
    c, objects = parts.config, messages.objects
    wanted = {variant.trust.fused_boxes for variant in parts.trust.variants if variant.fused}
    if c.trust.matching != "gates" or wanted <= {"best"}:
        return None
    place_m = positioned.world.boxes.xyz_m[exchange.vehicles.row[messages.vehicle], :2]
    selves = np.flatnonzero(messages.detections.is_self)
    place_m[messages.detections.message[selves]] = objects.boxes.xyz_m[selves, :2]  # where the message says
    return StatedAccuracy(
        variance_m2=objects.relative_m2,
        heading_variance=objects.heading_variance,
        size_variance=objects.size_variance,
        origin_m=place_m,
        pose_variance=np.tile(pose_variance(c), (len(place_m), 1)),
    )


def _pairs(messages: Known, n_now: int, params: TrustParams) -> Pairs:
    """Detections that may be of one object; `n_now` of them are of this step. Pairs of earlier ones are known."""
    boxes, label, message = messages.objects.boxes, messages.objects.label, messages.detections.message
    now, earlier, variance_m2 = slice(0, n_now), slice(n_now, None), bounded(messages.objects.variance_m2)
    gate = None if params.matching == "iou" else Gate(1.0 - params.gate_p, params.tau)
    with threads_for(ROWS_PER_BOX * n_now):
        if gate is None:
            pairs = overlapping_pairs(boxes.take(now), label[now], message[now])
        else:
            pairs = pairs_within(boxes.take(now), label[now], variance_m2[now], message[now], gate)
        if n_now == len(boxes):
            return pairs
        if gate is None:
            i, j, iou = pairs_between(boxes.take(now), label[now], boxes.take(earlier), label[earlier])
        else:
            i, j, iou = pairs_across(
                boxes.take(now), label[now], variance_m2[now],
                boxes.take(earlier), label[earlier], variance_m2[earlier], gate,
            )  # fmt: skip
    columns = zip(pairs, (i, n_now + j, iou), messages.earlier_pairs, strict=True)
    one, other, overlap = (np.concatenate(column) for column in columns)
    return one, other, overlap


@dataclass(frozen=True, slots=True)
class Claims:
    """What vehicles find about C claims of the messages in their lists, sorted by list, member and number."""

    list: Int[ndarray, "c"]
    """Row of the vehicles that sense."""
    member: Int[ndarray, "c"]
    """Detection that makes the claim, a row of `Known`; the self report claims that the message withholds nothing."""
    number: Int[ndarray, "c"]
    """As `trust.claims.claim_number` gives it."""
    support: Float[ndarray, "c"]
    """Expected evaluation, in [-1, 1]."""


@dataclass(frozen=True, slots=True)
class Evaluated:
    """Evaluations of detections by every vehicle's own sweep; `v` is the number of members of `lists`.

    Where there are claims, `lists` has a member for each of them too, after the detections of the list.

    All identities of a vehicle evaluate the same detections.
    """

    lists: ObjectLists
    """What is evaluated under each identity; the list of `Compared` itself if no vehicle has a second identity."""
    n_points: Int[ndarray, "v"]
    """Number of returns of the vehicle's own sweep inside the box."""
    plausible: Bool[ndarray, "v"]
    """Whether an object can stand there by the vehicle's own sweep; tested if it did not detect the object itself."""
    matched: Bool[ndarray, "v"]
    """Whether the vehicle detected the object itself."""
    own: Evaluations
    """Evaluations as each vehicle makes them."""
    reported: Evaluations
    """Evaluations as each vehicle transmits them; `own` itself if no attack changed any."""
    lied: Bool[ndarray, "v"]
    """Whether the reported evaluation differs from the own one by more than noise."""
    own_messages: EvaluationMessages
    """The own evaluations, one message per vehicle."""
    sent: EvaluationMessages
    """The reported evaluations, one message per row of `Senders`."""
    kept_messages: EvaluationMessages
    """The own evaluations in the rows of `sent`."""
    number: Int[ndarray, "v"] | None = None
    """Number of what each evaluation is about (`trust.claims.claim_number`); None if all are about detections."""

    def of_detections(self) -> tuple[ObjectLists, Evaluations, Evaluations]:
        """`lists`, `own` and `reported` without what is not about detections."""
        if self.number is None:
            return self.lists, self.own, self.reported
        is_detection = self.number % len(KINDS) == DETECTION
        at = np.flatnonzero(is_detection)
        own, reported = (Evaluations(e.evaluation[at], e.visibility[at]) for e in (self.own, self.reported))
        return subset(self.lists, is_detection), own, reported


def evaluate_objects(
    exchange: Exchange, messages: Known, compared: Compared, claims: Claims | None, config: Config
) -> Evaluated:
    """Add evaluations of the claims of messages to those of detections, and make the evaluation messages.

    A message contains the evaluations of the detections that are new since the vehicle last sensed.
    """
    lists, own, senders = compared.lists, compared.own, exchange.senders
    n_points, plausible, ego_detected = compared.n_points, compared.plausible, compared.groups.ego_detected
    number = None
    if claims is not None:
        of = np.concatenate([lists.of_member(), claims.list])
        order, n = np.argsort(of, kind="stable"), len(claims.list)
        found = answers(claims.support, config.trust)

        def with_claims(of_detections: ndarray, of_claims: ndarray | int) -> ndarray:
            return np.concatenate([of_detections, np.full(n, of_claims, of_detections.dtype)])[order]

        lists = ObjectLists(ptr_of(of[order], len(lists.owner)), with_claims(lists.member, claims.member), lists.owner)
        own = Evaluations(with_claims(own.evaluation, found.evaluation), with_claims(own.visibility, found.visibility))
        n_points, plausible, ego_detected = (with_claims(a, 0) for a in (n_points, plausible, ego_detected))
        index = messages.detections.detection_index[compared.lists.member]
        number = with_claims(claim_number(index, DETECTION), claims.number)
    reported = object_lists.as_reported(exchange.attacks, own, lists, messages.objects, exchange.sensing.row, number)
    lied = lies_in_evaluations(own, reported)
    sendable = messages.objects.transmitted[lists.member]
    is_new = messages.is_new(lists.of_member(), lists.member)
    sendable &= is_new

    def carried(by: ObjectLists, values: Evaluations, sendable: Bool[ndarray, "v"]) -> EvaluationMessages:
        return messages_of(exchange.now.step, messages, by, values, sendable, number)

    own_messages = carried(lists, own, sendable)
    lists, at = lists_of_identities(lists, senders)
    if at is not None:
        n_points, plausible, ego_detected, lied = n_points[at], plausible[at], ego_detected[at], lied[at]
        own, reported = (Evaluations(e.evaluation[at], e.visibility[at]) for e in (own, reported))
        sendable, number = sendable[at], None if number is None else number[at]
    return Evaluated(
        lists=lists,
        n_points=n_points,
        plausible=plausible,
        matched=ego_detected,
        own=own,
        reported=reported,
        lied=lied,
        own_messages=own_messages,
        sent=carried(lists, reported, sendable),
        kept_messages=own_messages if at is None else carried(lists, own, sendable),
        number=number,
    )


def boxes_of(fused: Fused, objects: Detections) -> Boxes:
    """Boxes of fused objects; `objects` are the detections that the vehicles know."""
    if fused.box is not None:
        return boxes_of_columns(fused.box)
    boxes, pose = objects.boxes.take(fused.seed), objects.boxes.take(fused.pose)
    return replace(boxes, xyz_m=pose.xyz_m, yaw_rad=pose.yaw_rad)


def beliefs_of(
    fused: Fused | None, exchange: Exchange, messages: Known, world: World, error: Float[ndarray, "e 3"] | None
) -> Beliefs:
    """Fused objects for the drivers, moved from the estimated to the true poses of the vehicles.

    Parameters
    ----------
    fused
        Fused objects of the acting variant.
    exchange, messages
        Vehicles of the step, and the detections that they know.
    world
        All actors at their true positions.
    error
        As `Positioned.error`.
    """
    assert fused is not None, "the acting variant is always fused"
    driven = ~exchange.world.is_roadside[exchange.sensing.row[fused.ego]]
    if not driven.all():  # roadside units do not drive
        fused = fused.take(np.flatnonzero(driven))
    objects, message = messages.objects, messages.detections.message[fused.seed]
    boxes = boxes_of(fused, objects)
    if error is not None:
        of = exchange.vehicles.senses
        boxes = as_estimated(boxes, fused.ego, world.boxes.xyz_m[exchange.vehicles.row[of]], error[of], back=True)
    return Beliefs(
        known_s=exchange.now.fused_s,
        ego=exchange.sensing.row[fused.ego],
        label=objects.label[fused.seed],
        boxes=boxes,
        score=fused.score,
        ego_detected=fused.ego_detected,
        source=messages.pseudonym[message],
        source_step=messages.step[message],
        source_index=objects.detection_index[fused.seed],
    )
