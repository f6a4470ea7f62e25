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
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim import stages
from cosim.adversary.adversary import AttackState
from cosim.adversary.attack import Sending
from cosim.attack_outcomes import attack_outcomes
from cosim.driver.driver import SpeedCommands
from cosim.ground_truth import GroundTruth
from cosim.parts import Parts
from cosim.perception import Observed
from cosim.positioning import PositionErrors, as_believed, believed_world
from cosim.radio.message_round import LinkReceptions, MessageRound, Receptions, RoundKind
from cosim.reactions import Reactions, ReactionTruth
from cosim.senders import OnAir, Senders, Vehicles, sending_of
from cosim.stages import Evaluated, Listed, Matched, Piggybacked
from cosim.trackers.attack_start import AttackStartTracker
from cosim.trackers.encounters import EncounterTrackers
from cosim.trackers.inter_reception import InterReceptionTracker
from cosim.trackers.motion import AccelerationTracker
from cosim.tracking import count_in_encounters, pairs_in_range, track_receptions
from cosim.v2x.cpm_generation import InclusionMemory
from cosim.v2x.messages import Detections, evaluation_bytes, trust_broadcast_bytes
from cosim.v2x.pseudonyms import PseudonymState, PseudonymUse
from cosim.v2x.relinking import HeardSenders, fallen_back, heard, noted
from cosim.v2x.trust_hosts import Lookups, ServerTraffic, TrustState
from cosim.world import World
from results.codes import DetectionFault, TrustSource
from results.encounters import Rows
from trust import tables
from trust.fusion import Fused
from trust.tables import EvaluationMessages, Evaluations, ObjectLists, TrustScores


@dataclass(slots=True)
class State:
    """All that survives a step. A step consumes the state that it is given, because large buffers are used again: to go
    on twice from one state, `copy` it first."""

    medium: Any
    trust: TrustState
    encounters: EncounterTrackers
    attacks: AttackState
    driver: object = None
    reaction_truth: ReactionTruth = field(default_factory=ReactionTruth)
    """For the table of reactions alone."""
    pseudonyms: PseudonymState = field(default_factory=PseudonymState)
    included: InclusionMemory = field(default_factory=InclusionMemory)
    piggybacked: Piggybacked | None = None
    inter_reception: tuple[InterReceptionTracker, InterReceptionTracker] = field(
        default_factory=lambda: (InterReceptionTracker(), InterReceptionTracker())
    )
    """Of detection and of evaluation messages."""
    attack_start: AttackStartTracker = field(default_factory=AttackStartTracker)
    heard: HeardSenders = field(default_factory=HeardSenders)
    """With pseudonyms.linkage = "own" alone."""
    accelerations: AccelerationTracker = field(default_factory=AccelerationTracker)
    position_errors: PositionErrors = field(default_factory=PositionErrors)
    n_dropped: Int[ndarray, "f"] = field(default_factory=lambda: np.zeros(len(DetectionFault), np.int64))
    """Detections dropped so far because they cannot be sent, by `DetectionFault`."""
    is_consumed: bool = False

    @staticmethod
    def start(parts: Parts) -> "State":
        """Before the first step."""
        c = parts.config
        encounters = EncounterTrackers(
            c.encounters, c.traffic.step_s, c.lidar.mount_above_roof_m, len(parts.trust.variants)
        )
        return State(parts.medium.start(), parts.trust.start(), encounters, parts.adversary.start())

    def copy(self) -> "State":
        """A state that shares nothing with this one."""
        return copy.deepcopy(self)

    def consume(self) -> "State":
        """The state to go on with; RuntimeError where another step went on from this one already."""
        if self.is_consumed:
            raise RuntimeError("this state was consumed by an earlier step: go on from a copy made before")
        self.is_consumed = True
        return replace(self, is_consumed=False)


@dataclass(frozen=True, slots=True)
class Sensed:
    """What happened in a step in which vehicles sense and talk."""

    vehicles: Vehicles
    senders: Senders
    """Messages of either kind, by vehicle and identity."""
    observed: Observed
    listed: Detections
    """Detections as each vehicle lists and transmits them, attacks included."""
    truth: GroundTruth
    withheld: Bool[ndarray, "d"]
    """Kept from others by an attack."""
    detections: tables.Detections
    """The same as trust sees them: message as a row of `senders`."""
    rounds: tuple[MessageRound, MessageRound]
    """Of detection messages, and of evaluation messages."""
    links: tuple[LinkReceptions, LinkReceptions]
    """Their receptions by kind of link."""
    lists: ObjectLists
    """What is evaluated under each identity of each vehicle."""
    reported: Evaluations
    """Evaluations as transmitted."""
    messages: tuple[EvaluationMessages, EvaluationMessages]
    """Evaluations of what was transmitted: as transmitted, and as evaluators keep them; the same rows."""
    n_points: Int[ndarray, "m"]
    plausible: Bool[ndarray, "m"]
    matched: Bool[ndarray, "m"]
    """The vehicle detected the object itself."""
    lied: Bool[ndarray, "m"]
    """Transmitted otherwise than made."""
    used: Receptions
    """Messages whose senders' trust each vehicle looks up."""
    lookups: list[Lookups]
    """Per trust variant; rows as in `used`."""
    fused: list[Fused | None]
    """Per trust variant; None where it was not asked for."""
    published: list[TrustScores | None]
    """Per trust variant: what its server computed in this step."""
    server: list[ServerTraffic | None]
    """Per trust variant; None where its trust does not live on a server."""
    in_range: list[tuple[Int[ndarray, "p"], Int[ndarray, "p"]]]
    """Per round: senders and the vehicles within range of them; rows of `vehicles`."""
    inter_reception: list[Rows]
    """Per round: columns of the table `packet_inter_reception`."""
    n_dropped: Int[ndarray, "f"]
    """Detections that could not be sent, by `DetectionFault`."""
    attack_outcomes: list[Rows]
    """Per trust variant that fuses: columns of the table `attack_outcomes`."""
    position_error_m: Float[ndarray, "e 2"] | None
    """Where vehicles believe to be less where they are, east and north; None without `[gnss]`."""


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
    reactions: Reactions | None
    """The same with what they react to; None where the driver gives no reasons."""


def step(world: World, state: State, parts: Parts) -> tuple[State, StepResult]:
    """The cycle, once. The state is consumed; everything else stays as it was."""
    s, c, watch = state.consume(), parts.config, parts.watch
    time_s = world.step * c.traffic.step_s
    evaluated_s, fused_s = time_s + c.timeout_s, time_s + 2 * c.timeout_s
    accelerations = s.accelerations.update(world.step, world.actor, world.speed_mps, c.traffic.step_s)
    told = _own_trust(world, s, parts, time_s)
    vehicles, ended = _identify(world, s, parts, told, time_s)
    with watch("encounters"):
        closed = _meet(world, s, parts, vehicles, time_s)
    if not parts.senses(world.step) or not len(vehicles):
        with watch("driver"):
            s.driver, commands = parts.driver.commands(s.driver, world, None, c.traffic.step_s)
            reactions = s.reaction_truth.of(commands, world, c.traffic.step_s)
        return s, StepResult(world, closed, ended, None, commands, reactions)

    with watch("server"):
        s.trust, published, informed = parts.trust.publish(
            s.trust, world.step, time_s, vehicles.actor, vehicles.name_key
        )
        s.pseudonyms = parts.linkage.accused(s.pseudonyms, s.trust.arrived)
        s.pseudonyms = parts.revocation.decided(
            s.pseudonyms, published[parts.trust.host_of[0]], world.step, c.traffic.step_s
        )
    observed = parts.perception(world, vehicles.row, watch)
    believed, position_error_m = world, None
    if c.gnss.std_m > 0:
        position_error_m = s.position_errors.update(
            world.step, vehicles.actor, vehicles.name_key, c.gnss, c.traffic.step_s, c.seed
        )
        observed = as_believed(observed, vehicles.row, position_error_m)
        believed = believed_world(world, vehicles.row, position_error_m)
    with watch("attack"):
        active = parts.adversary.active(s.attacks, world, time_s, told)
        senders = _senders(world, s, parts, vehicles, active.identities(len(world)))
        sender = senders.by_actor(vehicles.actor)
        sending = sending_of(active.sending(len(world)), vehicles)
        listed, s.included = stages.list_objects(
            observed, senders, s.included, world, accelerations, active, vehicles, c, time_s
        )
        s.n_dropped = s.n_dropped + listed.n_dropped
    with watch("radio"):  # detections are broadcast
        stations = stages.stations_of(world, vehicles, parts)
        lengths = stages.cpm_lengths(listed, senders, sender, s.piggybacked, c)
        cpms = OnAir.of(senders, lengths, len(parts.rsus), sending=sending)
        s.medium, round_1 = parts.medium.broadcast(s.medium, RoundKind.CPM, world.step, time_s, stations, cpms.messages)
        links_1 = cpms.links(round_1, len(vehicles))
        accepted_1 = _accepted(links_1, senders)
    with watch("match"):
        matched = stages.match_objects(listed, accepted_1.vehicles, observed, senders, vehicles, believed, c)
    with watch("evaluate"):
        evaluated = stages.evaluate_objects(matched, listed, observed, senders, vehicles, world.step, active, c)
    with watch("radio"):  # evaluations are broadcast, unless they wait for the next detection message
        alone, sent = c.radio.evaluations == "alone", Piggybacked(evaluated.sent, sender)
        s.trust, pending = parts.trust.pending_rsu_broadcast(s.trust, evaluated_s)
        rsu_bytes = 0 if pending is None else trust_broadcast_bytes(len(pending.scores.subject))
        lengths = evaluation_bytes(np.diff(sent.messages.ptr)) * alone
        reports = OnAir.of(senders, lengths, len(parts.rsus), rsu_bytes)
        s.medium, round_2 = parts.medium.broadcast(
            s.medium, RoundKind.EVALUATION, world.step, evaluated_s, stations, reports.messages
        )
        links_2 = reports.links(round_2, len(vehicles))
        carried, s.piggybacked = (sent, None) if alone else (s.piggybacked, sent)
        links, begin_s = (_accepted(links_2, senders), evaluated_s) if alone else (accepted_1, time_s)
    with watch("trust"):
        s.trust, up = stages.update_trust(
            s.trust, world.step, listed, evaluated.own_messages, carried, links, begin_s, senders, sender, vehicles,
            s.pseudonyms, parts,
        )  # fmt: skip
        if c.server.uplink == "cellular":
            s.trust, up = parts.trust.report_by_cellular(
                s.trust, parts.linkage.messages(s.pseudonyms, sent.messages), senders.key,
                world.boxes.xyz_m[vehicles.row[senders.vehicle], :2], evaluated_s, senders.is_valid,
                None if sending is None else sending.n_reports[senders.vehicle],
            )  # fmt: skip
        if pending is not None:
            arrival_s = evaluated_s + links_2.downlink.received_s
            s.trust, informed[parts.trust.host_of[0]] = parts.trust.receive_from_rsu(
                s.trust, vehicles.actor, links_2.downlink.receiver, arrival_s
            )
        used = links.vehicles
        s.trust = parts.trust.receive(s.trust, vehicles.actor, fused_s)
        subject = parts.linkage.subjects(s.pseudonyms, senders.pseudonym)[used.message]
        found = parts.trust.lookup(s.trust, vehicles.actor[used.receiver], subject, fused_s)
        if c.pseudonyms.linkage == "own":
            found = _relinked(s, parts, listed, senders, vehicles, accepted_1.vehicles, used, found, time_s, fused_s)
        lookups = _per_variant(found, parts)
    with watch("fuse"):
        fused = stages.fuse_objects(matched, evaluated, listed, observed, senders, used, lookups, s.trust, parts)
    with watch("driver"):
        assert fused[0] is not None, "the acting variant is always fused"
        beliefs = stages.beliefs_of(fused[0], listed, senders, vehicles, position_error_m, fused_s)
        s.driver, commands = parts.driver.commands(s.driver, world, beliefs, c.traffic.step_s)
        if c.driver.model != "none":
            observer = senders.pseudonym[listed.detections.message]
            s.reaction_truth.add(world, listed.objects, listed.truth, observer, c.traffic.step_s)
        reactions = s.reaction_truth.of(commands, world, c.traffic.step_s)
    with watch("track"):
        rounds, all_links = (round_1, round_2), (links_1, links_2)
        _note_attacks(world, s, listed, evaluated, senders, vehicles, sending)
        in_range, inter_reception = _track(
            world, s, listed, rounds, all_links, used, lookups, matched, vehicles, senders
        )
        outcomes = attack_outcomes(believed, listed, links_1.vehicles, matched, fused, senders, vehicles)
    server = parts.trust.traffic(up, informed)
    named = [None if scores is None else parts.linkage.scores(s.pseudonyms, scores) for scores in published]
    return s, StepResult(world, closed, ended, Sensed(
        vehicles, senders, observed, listed.objects, listed.truth, listed.withheld, listed.detections, rounds,
        all_links, evaluated.lists, evaluated.reported, (evaluated.sent, evaluated.kept_messages),
        evaluated.n_points, evaluated.plausible, evaluated.matched, evaluated.lied, used, lookups, fused,
        _per_variant(named, parts), _per_variant(server, parts), in_range, inter_reception,
        listed.n_dropped, outcomes, position_error_m,
    ), commands, reactions)  # fmt: skip


def _own_trust(world: World, s: State, parts: Parts, time_s: float) -> Float[ndarray, "n"] | None:
    """Trust in each actor as it was last told itself, by row of the world; None where no attack reads it."""
    if not parts.adversary.reads_trust:
        return None
    row = np.flatnonzero(world.equipped)
    actor = world.actor[row]
    subject = parts.linkage.subjects(s.pseudonyms, s.pseudonyms.of(actor))
    found = parts.trust.lookup(s.trust, actor, subject, time_s)[parts.trust.host_of[0]]
    told = np.full(len(world), parts.config.trust.default_trust)
    told[row] = found.trust
    return told


def _identify(
    world: World, s: State, parts: Parts, told: Float[ndarray, "n"] | None, time_s: float
) -> tuple[Vehicles, PseudonymUse]:
    """Equipped vehicles on the road under their present pseudonyms; in steps with messages some change."""
    row = np.flatnonzero(world.equipped)
    actor, names = world.actor[row], world.name_key[row]
    if not parts.senses(world.step):
        return Vehicles(row, actor, names, s.pseudonyms.of(actor)), PseudonymUse.none()
    wants = None
    if parts.adversary.renews:
        age_s = (world.step - s.pseudonyms.begun(world.actor, world.step)) * parts.config.traffic.step_s
        wants = parts.adversary.renewals(world, time_s, told, age_s)[row]
    s.pseudonyms, pseudonym, ended = parts.pseudonyms.issue(s.pseudonyms, world, row, wants)
    return Vehicles(row, actor, names, pseudonym), ended


def _senders(world: World, s: State, parts: Parts, vehicles: Vehicles, n_extra: Int[ndarray, "n"]) -> Senders:
    """Messages of this step, with their pseudonyms; `n_extra` further identities by row of the world."""
    senders = Senders.of(vehicles, n_extra[vehicles.row])
    more = np.flatnonzero(senders.identity)
    if len(more):
        pseudonym = senders.pseudonym.copy()
        s.pseudonyms, pseudonym[more] = parts.pseudonyms.issue_extra(
            s.pseudonyms, vehicles.actor[senders.vehicle[more]], senders.identity[more], world.step
        )
        senders = replace(senders, pseudonym=pseudonym)
    is_valid, s.pseudonyms = parts.revocation.valid(s.pseudonyms, senders.pseudonym, world.step)
    return replace(senders, is_valid=is_valid)


def _accepted(links: LinkReceptions, senders: Senders) -> LinkReceptions:
    """Receptions without those of revoked senders."""
    if senders.is_valid.all():
        return links
    return LinkReceptions(
        links.vehicles.take(senders.is_valid[links.vehicles.message]),
        links.uplink.take(senders.is_valid[links.uplink.message]),
        links.downlink,
    )


def _relinked(
    s: State, parts: Parts, listed: Listed, senders: Senders, vehicles: Vehicles, received: Receptions,
    used: Receptions, found: list[Lookups], time_s: float, now_s: float,
) -> list[Lookups]:  # fmt: skip
    """Look-ups of receivers that link pseudonyms themselves; what they remember of senders goes on."""
    objects, owners = listed.objects, parts.pseudonyms.owners
    report = np.full(len(senders), -1)  # of each message: the sender's report of itself
    selves = np.flatnonzero(listed.detections.is_self & objects.transmitted)
    report[listed.detections.message[selves]] = selves
    received = received.take(report[received.message] >= 0)
    row = report[received.message]
    yaw, speed = objects.boxes.yaw_rad[row], np.nan_to_num(objects.speed_mps[row])
    velocity = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    pseudonym = senders.pseudonym[received.message]
    s.heard = heard(
        s.heard, vehicles.actor[received.receiver], pseudonym, objects.boxes.xyz_m[row, :2], velocity, time_s,
        owners(s.pseudonyms, pseudonym)[0], owners(s.pseudonyms, s.heard.pseudonym)[0], parts.config.pseudonyms,
    )  # fmt: skip
    holder, asked = vehicles.actor[used.receiver], senders.pseudonym[used.message]
    at = np.minimum(s.heard.rows_of(holder, asked), max(len(s.heard.receiver) - 1, 0))
    there = np.zeros(len(asked), bool)
    if len(s.heard.receiver):
        there = (s.heard.receiver[at] == holder) & (s.heard.pseudonym[at] == asked)
    base = found[parts.trust.host_of[0]].source != TrustSource.DEFAULT
    s.heard = noted(s.heard, at[there], base[there])
    results = []
    old = np.where(there, s.heard.linked[at] if len(s.heard.receiver) else -1, -1)
    for h, one in enumerate(found):
        rows = np.flatnonzero((one.source == TrustSource.DEFAULT) & (old >= 0))
        if len(rows):
            one = fallen_back(one, rows, parts.trust.lookup(s.trust, holder[rows], old[rows], now_s)[h])
        results.append(one)
    return results


def _meet(world: World, s: State, parts: Parts, vehicles: Vehicles, time_s: float) -> list[Rows]:
    """Who is near whom, and what they know of each other when they meet; rows of encounters that are over."""
    closed, holder, other = s.encounters.update(world, parts.walls)
    s.trust = parts.trust.receive(s.trust, vehicles.actor, time_s)
    subject = parts.linkage.subjects(s.pseudonyms, s.pseudonyms.of(other))
    known = _per_variant(parts.trust.lookup(s.trust, holder, subject, time_s), parts)
    columns = ([getattr(found, name) for found in known] for name in ("trust", "source", "state", "age_s"))
    s.encounters.first_contact(holder, other, *(np.stack(column, axis=1) for column in columns))
    return closed


def _note_attacks(
    world: World, s: State, listed: Listed, evaluated: Evaluated, senders: Senders, vehicles: Vehicles,
    sending: Sending | None,
) -> None:  # fmt: skip
    """Who attacks in this step."""
    attacker = [world.actor[listed.objects.observer[listed.truth.lied]]]
    if evaluated.lied.any():
        by = evaluated.lists.owner[evaluated.lists.of_member()[evaluated.lied]]
        attacker.append(vehicles.actor[senders.vehicle[by]])
    if sending is not None:
        attacker.append(vehicles.actor[(sending.delay_s > 0) | (sending.n_copies > 0) | (sending.n_reports > 0)])
    s.attack_start.update(world.step, np.concatenate(attacker))


def _track(
    world: World, s: State, listed: Listed, rounds: tuple[MessageRound, MessageRound],
    links: tuple[LinkReceptions, LinkReceptions], used: Receptions, lookups: list[Lookups], matched: Matched,
    vehicles: Vehicles, senders: Senders,
) -> tuple[list[tuple[ndarray, ndarray]], list[Rows]]:  # fmt: skip
    """Inter-reception times and encounters go on; pairs in range and rows of reception per round."""
    between = (links[0].vehicles, links[1].vehicles)
    in_range = [pairs_in_range(happened, len(vehicles)) for happened in rounds]
    inter_reception = [
        track_receptions(tracker, world.step, received, pairs, vehicles.actor, senders.vehicle)
        for tracker, received, pairs in zip(s.inter_reception, between, in_range, strict=True)
    ]
    known = np.stack([found.is_known for found in lookups], axis=1)
    count_in_encounters(
        s.encounters, between, used, known, matched.lists, listed.detections.message, vehicles.actor, senders.vehicle
    )
    return in_range, inter_reception


def _per_variant(of_host: list, parts: Parts) -> list:
    """What stands per host, per trust variant."""
    return [of_host[h] for h in parts.trust.host_of]
