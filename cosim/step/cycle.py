"""One step: equipped vehicles perceive, broadcast, evaluate each other's detections, update trust, and fuse.

Reads as the detection and decision cycle of TruPercept (section "Summary"), for all vehicles at once.

Within a step that begins at time t: sweeps and detections at t; detection messages are on the air from t and count
until t + timeout; evaluation messages are on the air from then on and count until t + 2 timeout (`radio.timeout_s`),
when every vehicle fuses with the trust known by then. The trust server uses what has reached it by t, and broadcasts at
t; roadside units pass the broadcast on beside the evaluations. Piggybacked evaluations wait for the detection messages
of the next step: too late for fusion, in which each vehicle then uses its own alone, and in time for trust.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.adversary.attack import Sending
from cosim.config.config import Config
from cosim.driver.driver import Beliefs, SpeedCommands
from cosim.radio.message_round import LinkReceptions, MessageRound, Receptions, RoundKind, Stations
from cosim.step import stages
from cosim.step.attack_outcomes import attack_outcomes
from cosim.step.parts import Parts
from cosim.step.perception import Observed
from cosim.step.positioning import as_believed, believed_world
from cosim.step.reactions import Reactions
from cosim.step.result import Sensed, StepResult
from cosim.step.senders import OnAir, Senders, Vehicles, sending_of
from cosim.step.stages import Evaluated, Listed, Matched, Piggybacked
from cosim.step.state import State
from cosim.step.tracking import count_in_encounters, pairs_in_range, track_receptions
from cosim.v2x.messages import evaluation_bytes, trust_broadcast_bytes
from cosim.v2x.pseudonyms import PseudonymUse
from cosim.v2x.relinking import fallen_back, noted, update_senders
from cosim.v2x.trust_hosts import Lookups
from cosim.v2x.trust_server import LinkStats
from cosim.world import World
from results.codes import TrustSource
from results.encounters import Rows
from trust.tables import TrustScores


def step(world: World, state: State, parts: Parts) -> tuple[State, StepResult]:
    """The cycle, once. The state is consumed; everything else stays as it was."""
    s, c, watch, now = state.consume(), parts.config, parts.watch, Times.of(world.step, parts.config)
    own_trust = _own_trust(world, s, parts, now.begin_s)
    vehicles, ended = _identify(world, s, parts, own_trust, now.begin_s)
    accelerations = s.accelerations.update(world.step, world.actor, world.speed_mps, c.traffic.step_s)
    with watch("encounters"):
        closed = _update_encounters(world, s, parts, vehicles, now.begin_s)
    if not parts.senses(world.step) or not len(vehicles):
        commands, reactions = _drive(world, s, parts, None)
        return s, StepResult(world, closed, ended, None, commands, reactions)
    with watch("server"):
        published, informed = _publish(world, s, parts, vehicles, now.begin_s)
    observed = parts.perception(world, vehicles.row, watch)
    observed, believed, error_m = _as_positioned(world, s, parts, vehicles, observed)
    with watch("attack"):
        active = parts.adversary.active(s.attacks, world, now.begin_s, own_trust)
        senders = _senders(world, s, parts, vehicles, active.identities(len(world)))
        sending = sending_of(active.sending(len(world)), vehicles)
        listed, s.included = stages.list_objects(
            observed, senders, s.included, world, accelerations, active, vehicles, c, now.begin_s
        )
    with watch("radio"):
        stations = stages.stations_of(world, vehicles.row, sending, parts)
        cpms = _broadcast_detections(world, s, parts, listed, senders, vehicles, stations, sending, now)
    with watch("match"):
        matched = stages.match_objects(listed, cpms.accepted.vehicles, observed, senders, vehicles, believed, c)
    with watch("evaluate"):
        evaluated = stages.evaluate_objects(matched, listed, observed, senders, vehicles, world.step, active, parts)
    with watch("radio"):
        reports, carrier = _broadcast_evaluations(
            world, s, parts, evaluated, cpms, senders, vehicles, stations, informed, now
        )
    with watch("trust"):
        up = _update_trust(world, s, parts, listed, evaluated, carrier, senders, vehicles, sending, now)
        used = carrier.receptions.vehicles
        lookups = _look_up(s, parts, listed, cpms, used, senders, vehicles, now)
    with watch("fuse"):
        fused = stages.fuse_objects(matched, evaluated, listed, observed, senders, used, lookups, s.trust, parts)
    assert fused[0] is not None, "the acting variant is always fused"
    beliefs = None
    if c.driver.model != "none":
        beliefs = stages.beliefs_of(fused[0], listed, senders, vehicles, error_m, now.fused_s)
    commands, reactions = _drive(world, s, parts, beliefs, listed, senders)
    with watch("track"):
        _note_attacks(world, s, listed, evaluated, senders, vehicles, sending)
        in_range, inter_reception = _track(world, s, listed, (cpms, reports), used, lookups, matched, vehicles, senders)
        outcomes = attack_outcomes(believed, listed, cpms.links.vehicles, matched, fused, senders, vehicles)
    return s, StepResult(world, closed, ended, Sensed(
        vehicles, senders, observed, listed.objects, listed.truth, listed.withheld, listed.detections,
        (cpms.happened, reports.happened), (cpms.links, reports.links), evaluated.lists, evaluated.reported,
        (evaluated.sent, evaluated.kept_messages), evaluated.n_points, evaluated.plausible, evaluated.matched,
        evaluated.lied, used, lookups, fused, _published(published, s, parts),
        _per_variant(parts.trust.traffic(up, informed), parts), in_range, inter_reception, listed.n_dropped, outcomes,
        error_m,
    ), commands, reactions)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Times:
    """When things happen in a step [s]."""

    begin_s: float
    evaluated_s: float
    """Detection messages are in, and evaluation messages are sent."""
    fused_s: float
    """Evaluation messages are in, and vehicles fuse."""

    @staticmethod
    def of(step: int, config: Config) -> "Times":
        """Of the step with this number."""
        begin_s = step * config.traffic.step_s
        return Times(begin_s, begin_s + config.timeout_s, begin_s + 2 * config.timeout_s)


@dataclass(frozen=True, slots=True)
class Broadcast:
    """One round of messages."""

    happened: MessageRound
    links: LinkReceptions
    accepted: LinkReceptions
    """Without those of revoked senders."""


@dataclass(frozen=True, slots=True)
class Carrier:
    """The messages that evaluations came with, for trust."""

    evaluations: Piggybacked | None
    receptions: LinkReceptions
    begin_s: float
    """When they were sent."""


def _own_trust(world: World, s: State, parts: Parts, time_s: float) -> Float[ndarray, "n"] | None:
    """Trust in each actor as it last learned it itself, by row of the world; None where no attack reads it."""
    if not parts.adversary.reads_trust:
        return None
    row = np.flatnonzero(world.equipped)
    actor = world.actor[row]
    subject = parts.linkage.subjects(s.pseudonyms, s.pseudonyms.of(actor))
    found = parts.trust.lookup(s.trust, actor, subject, time_s)[parts.trust.host_of[0]]
    own_trust = np.full(len(world), parts.config.trust.default_trust)
    own_trust[row] = found.trust
    return own_trust


def _identify(
    world: World, s: State, parts: Parts, own_trust: Float[ndarray, "n"] | None, time_s: float
) -> tuple[Vehicles, PseudonymUse]:
    """Equipped vehicles on the road under their present pseudonyms; in steps with messages some change."""
    row = np.flatnonzero(world.equipped)
    actor, names = world.actor[row], world.name_key[row]
    if not parts.senses(world.step):
        return Vehicles(row, actor, names, s.pseudonyms.of(actor)), PseudonymUse.none()
    wants = None
    if parts.adversary.renews:
        age_s = (world.step - s.pseudonyms.begun(world.actor, world.step)) * parts.config.traffic.step_s
        wants = parts.adversary.renewals(world, time_s, own_trust, age_s)[row]
    s.pseudonyms, pseudonym, ended = parts.pseudonyms.issue(s.pseudonyms, world, row, wants)
    return Vehicles(row, actor, names, pseudonym), ended


def _publish(
    world: World, s: State, parts: Parts, vehicles: Vehicles, time_s: float
) -> tuple[list[TrustScores | None], list]:
    """What trust servers compute and broadcast, and whom they accuse; per host, scores and who is informed."""
    s.trust, published, informed = parts.trust.publish(s.trust, world.step, time_s, vehicles.actor, vehicles.name_key)
    s.pseudonyms = parts.linkage.accused(s.pseudonyms, s.trust.arrived)
    acting = published[parts.trust.host_of[0]]
    s.pseudonyms = parts.revocation.decided(s.pseudonyms, acting, world.step, parts.config.traffic.step_s)
    return published, informed


def _published(published: list[TrustScores | None], s: State, parts: Parts) -> list[TrustScores | None]:
    """The same under the pseudonyms of now, per trust variant."""
    named = [None if scores is None else parts.linkage.scores(s.pseudonyms, scores) for scores in published]
    return _per_variant(named, parts)


def _as_positioned(
    world: World, s: State, parts: Parts, vehicles: Vehicles, observed: Observed
) -> tuple[Observed, World, Float[ndarray, "v 2"] | None]:
    """What vehicles observe and where they take themselves to be, with the errors of their own positions."""
    c = parts.config
    if c.gnss.std_m <= 0:
        return observed, world, None
    error_m = s.position_errors.update(world.step, vehicles.actor, vehicles.name_key, c.gnss, c.traffic.step_s, c.seed)
    return as_believed(observed, vehicles.row, error_m), believed_world(world, vehicles.row, error_m), error_m


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


def _broadcast_detections(
    world: World, s: State, parts: Parts, listed: Listed, senders: Senders, vehicles: Vehicles, stations: Stations,
    sending: Sending | None, now: Times,
) -> Broadcast:  # fmt: skip
    """Detection messages, with evaluations of the step before where these are piggybacked."""
    s.n_dropped = s.n_dropped + listed.n_dropped
    sender = senders.by_actor(vehicles.actor)
    lengths = stages.cpm_lengths(listed, senders, sender, s.piggybacked, parts.config)
    on_air = OnAir.of(senders, lengths, len(parts.rsus), sending=sending)
    return _broadcast(world, s, parts, RoundKind.CPM, on_air, now.begin_s, senders, vehicles, stations)


def _broadcast_evaluations(
    world: World, s: State, parts: Parts, evaluated: Evaluated, cpms: Broadcast, senders: Senders, vehicles: Vehicles,
    stations: Stations, informed: list, now: Times,
) -> tuple[Broadcast, Carrier]:  # fmt: skip
    """Evaluation messages, unless evaluations wait for the next detection message; roadside units pass on beside them
    what the trust server broadcasts, and vehicles that receive it are informed."""
    alone = parts.config.radio.evaluations == "alone"
    sent = Piggybacked(evaluated.sent, senders.by_actor(vehicles.actor))
    s.trust, pending = parts.trust.pending_rsu_broadcast(s.trust, now.evaluated_s)
    rsu_bytes = 0 if pending is None else trust_broadcast_bytes(len(pending.scores.subject))
    lengths = evaluation_bytes(np.diff(sent.messages.ptr)) * alone
    on_air = OnAir.of(senders, lengths, len(parts.rsus), rsu_bytes)
    reports = _broadcast(world, s, parts, RoundKind.EVALUATION, on_air, now.evaluated_s, senders, vehicles, stations)
    if pending is not None:
        down = reports.links.downlink
        s.trust, informed[parts.trust.host_of[0]] = parts.trust.receive_from_rsu(
            s.trust, vehicles.actor, down.receiver, now.evaluated_s + down.received_s
        )
    carried, s.piggybacked = (sent, None) if alone else (s.piggybacked, sent)
    if alone:
        return reports, Carrier(carried, reports.accepted, now.evaluated_s)
    return reports, Carrier(carried, cpms.accepted, now.begin_s)


def _broadcast(
    world: World, s: State, parts: Parts, kind: RoundKind, on_air: OnAir, begin_s: float, senders: Senders,
    vehicles: Vehicles, stations: Stations,
) -> Broadcast:  # fmt: skip
    s.medium, happened = parts.medium.broadcast(s.medium, kind, world.step, begin_s, stations, on_air.messages)
    links = on_air.links(happened, len(vehicles))
    return Broadcast(happened, links, _accepted(links, senders))


def _update_trust(
    world: World, s: State, parts: Parts, listed: Listed, evaluated: Evaluated, carrier: Carrier, senders: Senders,
    vehicles: Vehicles, sending: Sending | None, now: Times,
) -> LinkStats:  # fmt: skip
    """Evaluations reach those who keep trust; what became of reports to the server."""
    sender = senders.by_actor(vehicles.actor)
    s.trust, up = stages.update_trust(
        s.trust, world.step, listed, evaluated.own_messages, carrier.evaluations, carrier.receptions, carrier.begin_s,
        senders, sender, vehicles, s.pseudonyms, parts,
    )  # fmt: skip
    if parts.config.server.uplink == "cellular":
        s.trust, up = parts.trust.report_by_cellular(
            s.trust, parts.linkage.messages(s.pseudonyms, evaluated.sent), senders.key,
            world.boxes.xyz_m[vehicles.row[senders.vehicle], :2], now.evaluated_s, senders.is_valid,
            None if sending is None else sending.n_reports[senders.vehicle],
        )  # fmt: skip
    return up


def _look_up(
    s: State, parts: Parts, listed: Listed, cpms: Broadcast, used: Receptions, senders: Senders, vehicles: Vehicles,
    now: Times,
) -> list[Lookups]:  # fmt: skip
    """Trust of the senders of what each vehicle uses, as it knows it when it fuses; per trust variant."""
    s.trust = parts.trust.receive(s.trust, vehicles.actor, now.fused_s)
    subject = parts.linkage.subjects(s.pseudonyms, senders.pseudonym)[used.message]
    found = parts.trust.lookup(s.trust, vehicles.actor[used.receiver], subject, now.fused_s)
    if parts.config.pseudonyms.linkage == "own":
        found = _relinked(s, parts, listed, senders, vehicles, cpms.accepted.vehicles, used, found, now)
    return _per_variant(found, parts)


def _drive(
    world: World, s: State, parts: Parts, beliefs: Beliefs | None, listed: Listed | None = None,
    senders: Senders | None = None,
) -> tuple[SpeedCommands, Reactions | None]:  # fmt: skip
    """What drivers do next, and what they react to."""
    dt_s = parts.config.traffic.step_s
    with parts.watch("driver"):
        s.driver, commands = parts.driver.commands(s.driver, world, beliefs, dt_s)
        if listed is not None and senders is not None and parts.config.driver.model != "none":
            observer = senders.pseudonym[listed.detections.message]
            s.reaction_truth.add(world, listed.objects, listed.truth, observer, dt_s)
        return commands, s.reaction_truth.of(commands, world, dt_s)


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
    used: Receptions, found: list[Lookups], now: Times,
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
    known = update_senders(
        s.known_senders, vehicles.actor[received.receiver], pseudonym, objects.boxes.xyz_m[row, :2], velocity,
        now.begin_s, owners(s.pseudonyms, pseudonym)[0], owners(s.pseudonyms, s.known_senders.pseudonym)[0],
        parts.config.pseudonyms,
    )  # fmt: skip
    holder, asked = vehicles.actor[used.receiver], senders.pseudonym[used.message]
    there, old = np.zeros(len(asked), bool), np.full(len(asked), -1)
    if len(known.receiver):
        at = np.minimum(known.rows_of(holder, asked), len(known.receiver) - 1)
        there = (known.receiver[at] == holder) & (known.pseudonym[at] == asked)
        base = found[parts.trust.host_of[0]].source != TrustSource.DEFAULT
        known = noted(known, at[there], base[there])
        old[there] = known.linked[at[there]]
    s.known_senders = known
    results = []
    for h, one in enumerate(found):
        rows = np.flatnonzero((one.source == TrustSource.DEFAULT) & (old >= 0))
        if len(rows):
            one = fallen_back(one, rows, parts.trust.lookup(s.trust, holder[rows], old[rows], now.fused_s)[h])
        results.append(one)
    return results


def _update_encounters(world: World, s: State, parts: Parts, vehicles: Vehicles, time_s: float) -> list[Rows]:
    """Who is near whom, and what they know of each other when they meet; rows of encounters that are over."""
    closed, holder, other = s.encounters.update(world.step, parts.near_pairs(world))
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
        attacker.append(vehicles.actor[sending.attacks()])
    s.attack_start.update(world.step, np.concatenate(attacker))


def _track(
    world: World, s: State, listed: Listed, rounds: tuple[Broadcast, Broadcast], used: Receptions,
    lookups: list[Lookups], matched: Matched, vehicles: Vehicles, senders: Senders,
) -> tuple[list[tuple[ndarray, ndarray]], list[Rows]]:  # fmt: skip
    """Inter-reception times and encounters go on; pairs in range and rows of reception per round."""
    between = (rounds[0].links.vehicles, rounds[1].links.vehicles)
    in_range = [pairs_in_range(one.happened, len(vehicles)) for one in rounds]
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
