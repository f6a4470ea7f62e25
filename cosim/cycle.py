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
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim import stages
from cosim.driver.driver import SpeedCommands
from cosim.ground_truth import GroundTruth
from cosim.parts import Parts
from cosim.perception import Observed
from cosim.radio.message_round import LinkReceptions, MessageRound, Receptions, RoundKind, by_link
from cosim.stages import Listed, Matched, Piggybacked, Vehicles
from cosim.trackers.attack_start import AttackStartTracker
from cosim.trackers.encounters import EncounterTrackers
from cosim.trackers.inter_reception import InterReceptionTracker
from cosim.tracking import count_in_encounters, pairs_in_range, track_receptions
from cosim.v2x.cpm_generation import InclusionMemory
from cosim.v2x.messages import FABRICATED, Detections, evaluation_bytes, trust_broadcast_bytes
from cosim.v2x.pseudonyms import PseudonymState, PseudonymUse
from cosim.v2x.trust_hosts import Lookups, ServerTraffic, TrustState
from cosim.world import World
from results.encounters import Rows
from trust import tables
from trust.fusion import Fused
from trust.tables import Evaluations, ObjectLists, TrustScores


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
        encounters = EncounterTrackers(
            c.encounters, c.traffic.step_s, c.lidar.mount_above_roof_m, len(parts.trust.variants)
        )
        return State(parts.medium.start(), parts.trust.start(), encounters)

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
    server: list[ServerTraffic | None]
    """Per trust variant; None where its trust does not live on a server."""
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
    s, c, watch = state.consume(), parts.config, parts.watch
    time_s = world.step * c.traffic.step_s
    evaluated_s, fused_s = time_s + c.timeout_s, time_s + 2 * c.timeout_s
    vehicles, ended = _identify(world, s, parts)
    with watch("encounters"):
        closed = _meet(world, s, parts, vehicles, time_s)
    if not parts.senses(world.step) or not len(vehicles):
        return s, StepResult(world, closed, ended, None, SpeedCommands.none())

    with watch("server"):
        s.trust, published, informed = parts.trust.publish(
            s.trust, world.step, time_s, vehicles.actor, vehicles.name_key
        )
    observed = parts.perception(world, vehicles.row, watch)
    with watch("attack"):
        listed, s.included = stages.list_objects(observed, vehicles, s.included, world, parts, time_s)
        s.n_malformed += listed.n_malformed
    with watch("radio"):  # detections are broadcast
        stations = stages.stations_of(world, vehicles, parts)
        cpms = stages.messages(stages.cpm_lengths(listed, vehicles, s.piggybacked, c), parts)
        s.medium, round_1 = parts.medium.broadcast(s.medium, RoundKind.CPM, world.step, time_s, stations, cpms)
        links_1 = by_link(round_1, len(vehicles))
    with watch("match"):
        matched = stages.match_objects(listed, links_1.vehicles, observed, vehicles, world, c)
    with watch("evaluate"):
        evaluated = stages.evaluate_objects(matched, listed, observed, vehicles, world, parts, time_s)
    with watch("radio"):  # evaluations are broadcast, unless they wait for the next detection message
        alone, sent = c.radio.evaluations == "alone", Piggybacked(evaluated.sent, vehicles.actor)
        s.trust, pending = parts.trust.pending_rsu_broadcast(s.trust, evaluated_s)
        rsu_bytes = 0 if pending is None else trust_broadcast_bytes(len(pending.scores.subject))
        reports = stages.messages(evaluation_bytes(np.diff(sent.messages.ptr)) * alone, parts, rsu_bytes)
        s.medium, round_2 = parts.medium.broadcast(
            s.medium, RoundKind.EVALUATION, world.step, evaluated_s, stations, reports
        )
        links_2 = by_link(round_2, len(vehicles))
        carried, s.piggybacked = (sent, None) if alone else (s.piggybacked, sent)
        links, begin_s = (links_2, evaluated_s) if alone else (links_1, time_s)
    with watch("trust"):
        s.trust, up = stages.update_trust(
            s.trust, world.step, listed, evaluated.own_messages, carried, links, begin_s, vehicles, parts
        )
        if c.server.uplink == "cellular":
            xy_m = world.boxes.xyz_m[vehicles.row, :2]
            s.trust, up = parts.trust.report_by_cellular(s.trust, sent.messages, vehicles.name_key, xy_m, evaluated_s)
        if pending is not None:
            arrival_s = evaluated_s + links_2.downlink.received_s
            s.trust, informed[parts.trust.host_of[0]] = parts.trust.receive_from_rsu(
                s.trust, vehicles.actor, links_2.downlink.receiver, arrival_s
            )
        used = links.vehicles
        s.trust = parts.trust.receive(s.trust, vehicles.actor, fused_s)
        lookups = _per_variant(
            parts.trust.lookup(s.trust, vehicles.actor[used.receiver], vehicles.pseudonym[used.message], fused_s), parts
        )
    with watch("fuse"):
        fused = stages.fuse_objects(matched, evaluated, listed, observed, used, lookups, parts)
    with watch("driver"):
        assert fused[0] is not None, "the acting variant is always fused"
        beliefs = stages.beliefs_of(fused[0], listed, vehicles)
        s.driver, commands = parts.driver.commands(s.driver, world, beliefs, c.traffic.step_s)
    with watch("track"):
        rounds, all_links = (round_1, round_2), (links_1, links_2)
        in_range, inter_reception = _track(world, s, listed, rounds, all_links, used, lookups, matched, vehicles)
    server = parts.trust.traffic(up, informed)
    return s, StepResult(world, closed, ended, Sensed(
        vehicles, observed, listed.objects, listed.truth, listed.detections, rounds, all_links, matched.lists,
        evaluated.reported, evaluated.n_points, evaluated.plausible, matched.lists_groups.ego_detected, used, lookups,
        fused, _per_variant(published, parts), _per_variant(server, parts), in_range, inter_reception,
    ), commands)  # fmt: skip


def _identify(world: World, s: State, parts: Parts) -> tuple[Vehicles, PseudonymUse]:
    """Equipped vehicles on the road under their present pseudonyms; in steps with messages some change."""
    row = np.flatnonzero(world.equipped)
    actor, names = world.actor[row], world.name_key[row]
    if not parts.senses(world.step):
        return Vehicles(row, actor, names, s.pseudonyms.of(actor)), PseudonymUse.none()
    s.pseudonyms, pseudonym, ended = parts.pseudonyms.issue(s.pseudonyms, world, row)
    return Vehicles(row, actor, names, pseudonym), ended


def _meet(world: World, s: State, parts: Parts, vehicles: Vehicles, time_s: float) -> list[Rows]:
    """Who is near whom, and what they know of each other when they meet; rows of encounters that are over."""
    closed, holder, other = s.encounters.update(world, parts.walls)
    s.trust = parts.trust.receive(s.trust, vehicles.actor, time_s)
    known = _per_variant(parts.trust.lookup(s.trust, holder, s.pseudonyms.of(other), time_s), parts)
    columns = ([getattr(found, name) for found in known] for name in ("trust", "source", "age_s"))
    s.encounters.first_contact(holder, other, *(np.stack(column, axis=1) for column in columns))
    return closed


def _track(
    world: World, s: State, listed: Listed, rounds: tuple[MessageRound, MessageRound],
    links: tuple[LinkReceptions, LinkReceptions], used: Receptions, lookups: list[Lookups], matched: Matched,
    vehicles: Vehicles,
) -> tuple[list[tuple[ndarray, ndarray]], list[Rows]]:  # fmt: skip
    """Attack starts, inter-reception times and encounters go on; pairs in range and rows of reception per round."""
    objects, between = listed.objects, (links[0].vehicles, links[1].vehicles)
    s.attack_start.update(world.step, world.actor[objects.observer[objects.origin == FABRICATED]])
    in_range = [pairs_in_range(happened, len(vehicles)) for happened in rounds]
    inter_reception = [
        track_receptions(tracker, world.step, happened, received, pairs, vehicles.actor)
        for tracker, happened, received, pairs in zip(s.inter_reception, rounds, between, in_range, strict=True)
    ]
    sources = np.stack([found.source for found in lookups], axis=1)
    count_in_encounters(
        s.encounters, rounds, between, used, sources, matched.lists, listed.detections.message, vehicles.actor
    )
    return in_range, inter_reception


def _per_variant(of_host: list, parts: Parts) -> list:
    """What stands per host, per trust variant."""
    return [of_host[h] for h in parts.trust.host_of]
