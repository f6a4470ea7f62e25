"""The stages of a step that use the trust hosts, in the order of `cosim.step.cycle.step`.

As in `cosim.step.stages`, a stage returns the parts of the state that it changes before its result.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.codes import TrustSource
from cosim.base.ragged import expand, ptr_of, rows_of
from cosim.config.config import Config
from cosim.door.guard import refuse
from cosim.messages.pseudonyms import PseudonymState
from cosim.messages.relinking import KnownSenders, ReceivedSenders, fallen_back, noted, update_senders
from cosim.messages.trust_hosts import Informed, Lookups, TrustState
from cosim.messages.trust_server import LinkStats, TrustBroadcast
from cosim.radio.link_budget import neighbours
from cosim.radio.message_round import LinkReceptions, Receptions
from cosim.step.comparing import FusionOf, Used
from cosim.step.exchange import Exchange, Times, Vehicles, distinct
from cosim.step.known import Known, Uses
from cosim.step.late import LateMessages
from cosim.step.parts import Parts
from cosim.step.stages import Broadcast, Evaluated, Listed, Matched, SentEvaluations
from cosim.step.trackers.encounters import Encounters, NearPairs, update_encounters
from cosim.world import World
from results.encounters import Rows
from trust.certified import upheld
from trust.claims import claims_of_messages
from trust.fusion import Fused
from trust.models import TrustModel
from trust.tables import SERVER, EvaluationMessages, Evaluations, ObjectLists, TrustScores


def own_trust_of(
    world: World, trust: TrustState, pseudonyms: PseudonymState, now: Times, parts: Parts
) -> Float[ndarray, "n"] | None:
    """Trust in each actor as the actor itself last learned it, by row of the world; None if no attack reads it.

    Actors that are not equipped have the default trust.
    """
    if not parts.adversary.reads_trust:
        return None
    row = np.flatnonzero(world.equipped)
    actor = world.actor[row]
    subject = parts.linkage.subjects(pseudonyms, pseudonyms.of(actor))
    found = parts.trust.lookup(trust, actor, subject, now.begin_s)[parts.trust.host_of[0]]
    own_trust = np.full(len(world), parts.config.trust.default_trust)
    own_trust[row] = found.trust
    return own_trust


def follow_encounters(
    encounters: Encounters, near: NearPairs, trust: TrustState, pseudonyms: PseudonymState, vehicles: Vehicles,
    now: Times, parts: Parts,
) -> tuple[Encounters, TrustState, list[Rows]]:  # fmt: skip
    """Update encounters with the near pairs, and note the trust of both vehicles when an encounter begins.

    Returns
    -------
    The encounters, the state of trust, and the rows of encounters that have ended.
    """
    closed, holder, other = update_encounters(encounters, now.step, near)
    trust = parts.trust.receive(trust, vehicles.actor, now.begin_s)
    subject = parts.linkage.subjects(pseudonyms, pseudonyms.of(other))
    known = parts.trust.per_variant(parts.trust.lookup(trust, holder, subject, now.begin_s))
    names = ("trust", "source", "state", "age_s")
    columns = [np.stack([getattr(found, name) for found in known], axis=1) for name in names]
    for tracker in encounters:
        tracker.first_contact(holder, other, *columns)
    return encounters, trust, closed


@dataclass(frozen=True, slots=True)
class Published:
    """What trust servers computed in a step, and the vehicles that they informed."""

    scores: list[TrustScores | None]
    """Trust values per trust variant, by current pseudonym; None if none were computed."""
    informed: list[Informed]
    """Per host, the number of vehicles that a broadcast addressed, and that it reached."""


def publish(
    trust: TrustState, pseudonyms: PseudonymState, vehicles: Vehicles, now: Times, parts: Parts
) -> tuple[TrustState, PseudonymState, Published]:
    """Trust servers process arrived evaluations, compute and broadcast trust, and accuse and revoke vehicles."""
    c, hosts = parts.config, parts.trust
    trust, scores, informed = hosts.publish(trust, now.step, now.begin_s, vehicles.actor, vehicles.name_key)
    for h, of_host in enumerate(scores):
        if of_host is not None and hosts.models[h].guard is not None:
            _check_names(hosts.model_of(trust, h), of_host, parts.pseudonyms.owners(pseudonyms, of_host.subject)[0])
    pseudonyms = parts.linkage.accused(pseudonyms, trust.arrived)
    pseudonyms = parts.revocation.decided(pseudonyms, scores[hosts.host_of[0]], now.step, c.traffic.step_s)
    named = [None if of_host is None else parts.linkage.scores(pseudonyms, of_host) for of_host in scores]
    return trust, pseudonyms, Published(hosts.per_variant(named), informed)


def _check_names(model: TrustModel, scores: TrustScores, owner: Int[ndarray, "n"]) -> None:
    """Raise `ExtensionError` if the server's model, which is a user's own, has scores of nobody or for nobody."""
    if (nobody := scores.subject[owner < 0]).size:
        refuse(model, "scores", f"returned a score of subject {nobody[0]}, but no vehicle has this pseudonym")
    if (strange := scores.holder[scores.holder != SERVER]).size:
        refuse(model, "scores", f"returned a score for holder {strange[0]}, but SERVER, {SERVER}, is expected")


def receive_from_rsus(
    trust: TrustState, exchange: Exchange, sent: TrustBroadcast | None, reports: Broadcast, informed: list[Informed],
    parts: Parts,
) -> tuple[TrustState, list[Informed]]:  # fmt: skip
    """Vehicles receive the trust that roadside units broadcast in the round of evaluations.

    Returns
    -------
    The state of trust, and per host the vehicles that it has informed by now.
    """
    if sent is None:
        for messages in reports.late:  # the broadcast before this step may still arrive
            down = messages.links.downlink
            if len(down.receiver):
                arrived_s = np.full(len(down.receiver), exchange.now.fused_s)
                trust, _ = parts.trust.receive_from_rsu(trust, exchange.vehicles.actor, down.receiver, arrived_s)
        return trust, informed
    down = reports.links.downlink
    trust, by_rsus = parts.trust.receive_from_rsu(
        trust, exchange.vehicles.actor, down.receiver, exchange.now.evaluated_s + down.received_s
    )
    acting = parts.trust.host_of[0]
    return trust, [by_rsus if host == acting else found for host, found in enumerate(informed)]


def control_relays(
    trust: TrustState, known_senders: KnownSenders, exchange: Exchange, pseudonyms: PseudonymState, parts: Parts
) -> Exchange:
    """The exchange with the messages that vehicles will not forward: those of senders whom they trust too little.

    A vehicle uses the trust that it has when the step begins. Vehicles that attack forward everything, and so do
    roadside units without a sensor, which hold no trust.
    """
    relay, vehicles, senders = parts.config.radio.relay, exchange.vehicles, exchange.senders
    if relay.min_trust == 0 or relay.max_hops == 1:
        return exchange
    reach_m = min(relay.forward_range_m, (relay.max_hops - 1) * parts.config.radio.range_m) + 1.0  # a little too far
    source, near, _ = neighbours(exchange.stations.xyz_m[: len(vehicles), :2], reach_m)
    ptr = ptr_of(source, len(vehicles))
    at, message = expand(ptr[senders.vehicle], ptr[senders.vehicle + 1])
    station, begin_s = near[at], exchange.now.begin_s
    holder, asked = vehicles.actor[station], senders.pseudonym
    found = _trust_in(trust, holder, asked, message, begin_s, exchange, pseudonyms, parts)
    if parts.config.pseudonyms.linkage == "own":
        _, found = _of_old_pseudonyms(trust, known_senders, holder, asked[message], begin_s, found, parts)
    refuses = found[parts.trust.host_of[0]].trust < relay.min_trust
    refuses &= ~exchange.attacks.malicious(len(exchange.world))[vehicles.row[station]]
    return replace(exchange, refused=(message[refuses], station[refuses]))


def _trust_in(
    trust: TrustState, holder: Int[ndarray, "n"], pseudonym: Int[ndarray, "m"], message: Int[ndarray, "n"],
    time_s: float, exchange: Exchange, pseudonyms: PseudonymState, parts: Parts,
) -> list[Lookups]:  # fmt: skip
    """For each host, the trust of vehicles (actor numbers) in the senders of messages at `time_s`."""
    subject = parts.linkage.subjects(pseudonyms, pseudonym)[message]
    found = parts.trust.lookup(trust, holder, subject, time_s)
    if len(parts.certified):
        units = exchange.vehicles.pseudonym[np.isin(exchange.vehicles.name_key, parts.certified)]
        is_unit = np.isin(pseudonym[message], units)
        found = [replace(of_host, trust=np.where(is_unit, 1.0, of_host.trust)) for of_host in found]
    return found


@dataclass(frozen=True, slots=True)
class EvaluationCarriers:
    """The messages that carried evaluations in a step."""

    step: int
    sender: Int[ndarray, "m"]
    """As `Exchange.sender`."""
    pseudonym: Int[ndarray, "m"]
    """Pseudonym that each message carried."""
    evaluations: SentEvaluations | None
    """None if there were no evaluations to carry."""
    receptions: LinkReceptions
    begin_s: float
    """When the messages were sent [s]."""


def carrier_of(
    exchange: Exchange, evaluated: Evaluated, waiting: SentEvaluations | None, rounds: tuple[Broadcast, Broadcast],
    parts: Parts,
) -> tuple[SentEvaluations | None, EvaluationCarriers]:  # fmt: skip
    """Evaluations that wait for the next detection message, and the messages that carried evaluations in this step.

    Parameters
    ----------
    exchange
        Vehicles and senders of the step.
    evaluated
        Evaluations of this step.
    waiting
        Evaluations of the step before, which this step's detection messages carried.
    rounds
        The rounds of detection messages and of evaluation messages.
    parts
        Components of the run.
    """
    cpms, reports = rounds
    sent = SentEvaluations(evaluated.sent, exchange.sender)
    alone, now = parts.config.radio.evaluations == "alone", exchange.now
    carrier = EvaluationCarriers(
        step=now.step,
        sender=exchange.sender,
        pseudonym=exchange.senders.pseudonym,
        evaluations=sent if alone else waiting,
        receptions=(reports if alone else cpms).accepted,
        begin_s=now.evaluated_s if alone else now.begin_s,
    )
    if alone:
        return None, carrier
    if waiting is None:
        return sent, carrier
    is_there = np.isin(waiting.sender >> 16, exchange.vehicles.actor)
    return sent.and_also(waiting.take(np.flatnonzero(is_there & ~np.isin(waiting.sender, sent.sender)))), carrier


def update_trust(
    trust: TrustState, exchange: Exchange, listed: Listed, evaluated: Evaluated, carrier: EvaluationCarriers,
    pseudonyms: PseudonymState, parts: Parts,
) -> tuple[TrustState, LinkStats]:  # fmt: skip
    """Give the trust hosts the transmitted detections, the vehicles' own evaluations and those that arrived.

    Returns
    -------
    The state of trust, and counts of the reports to the server.
    """
    hosts, linkage, senders = parts.trust, parts.linkage, exchange.senders
    to_server = _upheld(evaluated.sent, exchange.sender, exchange, parts)
    trust = _open_step(trust, exchange, listed, pseudonyms, parts)
    own, vehicle = linkage.messages(pseudonyms, evaluated.own_messages), exchange.sensing.actor
    trust = hosts.add_local(trust, own, vehicle, np.arange(len(vehicle)), of_others=False)
    up = LinkStats()
    if carrier.evaluations is not None:
        trust, up = _deliver(trust, exchange, carrier.evaluations, carrier, pseudonyms, parts)
    if parts.config.server.uplink == "cellular":
        xy_m = exchange.world.boxes.xyz_m[exchange.vehicles.row[senders.vehicle], :2]
        n_copies = None if exchange.sending is None else exchange.sending.n_reports[senders.vehicle]
        sent = linkage.messages(pseudonyms, to_server)
        trust, up = hosts.report_by_cellular(
            trust, sent, senders.key, xy_m, exchange.now.evaluated_s, senders.is_valid, n_copies
        )
    return trust, up


def _upheld(
    messages: EvaluationMessages, sender: Int[ndarray, "v"], exchange: Exchange, parts: Parts
) -> EvaluationMessages:
    """What the server uses of these evaluations, each message with its `Exchange.sender`.

    Roadside units are at the server's wire: it knows what they saw before it uses what others say of the same step.
    """
    if not len(parts.certified):
        return messages
    units = np.isin(exchange.vehicles.name_key, parts.certified)
    is_certified = np.isin(sender >> 16, exchange.vehicles.actor[units])
    return upheld(messages, is_certified, exchange.vehicles.pseudonym[units])


def _open_step(
    trust: TrustState, exchange: Exchange, listed: Listed, pseudonyms: PseudonymState, parts: Parts
) -> TrustState:
    """Give the hosts the transmitted detections, by subject of trust, and the claims that they make.

    Vehicles that only listen in this step can evaluate its detections later, so the hosts get their pseudonyms too.
    """
    transmitted, detections, linkage = listed.objects.transmitted, listed.detections, parts.linkage
    pseudonym, vehicles = exchange.senders.pseudonym, exchange.vehicles
    listens = np.setdiff1d(np.append(vehicles.pseudonym, pseudonyms.further(vehicles.actor)), pseudonym)
    pseudonym = np.concatenate([pseudonym, listens[listens >= 0]])
    message, index = detections.message[transmitted], detections.detection_index[transmitted]
    score = detections.score[transmitted]
    if len(parts.config.trust.evidence) > 1:
        message, index, score = claims_of_messages(message, index, score)
    subject = linkage.subjects(pseudonyms, pseudonym)
    _, index = linkage.keys(pseudonyms, pseudonym[message], index)
    if linkage.renames:
        subject, message = distinct(subject, message)
    return parts.trust.open_step(trust, exchange.now.step, subject, message, index, score)


def _deliver(
    trust: TrustState,
    exchange: Exchange,
    carried: SentEvaluations,
    carrier: EvaluationCarriers,
    pseudonyms: PseudonymState,
    parts: Parts,
) -> tuple[TrustState, LinkStats]:
    """Deliver evaluation messages to other vehicles, and through roadside units to the server."""
    links, vehicles = carrier.receptions, exchange.vehicles
    row = np.full(len(exchange.senders), -1)  # per message of this step, the row of the evaluations that it carries
    _, which, at = np.intersect1d(carried.sender, exchange.sender, assume_unique=True, return_indices=True)
    row[at] = which
    sent = parts.linkage.messages(pseudonyms, carried.messages)
    got = links.vehicles.take(row[links.vehicles.message] >= 0)
    trust = parts.trust.add_local(trust, sent, vehicles.actor[got.receiver], row[got.message])
    up = links.uplink.take(row[links.uplink.message] >= 0)
    sent = parts.linkage.messages(pseudonyms, _upheld(carried.messages, carried.sender, exchange, parts))
    return parts.trust.report_by_rsu(trust, sent, row[up.message], carrier.begin_s + up.received_s)


def deliver_late(
    trust: TrustState, exchange: Exchange, carried: Sequence[EvaluationCarriers], late: Sequence[LateMessages],
    pseudonyms: PseudonymState, parts: Parts,
) -> tuple[TrustState, LinkStats]:  # fmt: skip
    """Deliver the evaluations of messages that arrived later than the round in which they were sent.

    Returns
    -------
    The state of trust, and counts of the reports that have now reached the server.
    """
    stats = LinkStats()
    for messages in late:
        for carrier in carried:
            sent = carrier.evaluations
            if sent is None:
                continue
            row, is_there = rows_of(messages.sender, sent.sender)
            is_there &= (messages.step == carrier.step) & (messages.sender >= 0)
            links = messages.links
            got = links.vehicles.take(is_there[links.vehicles.message])
            named = parts.linkage.messages(pseudonyms, sent.messages)
            trust = parts.trust.add_local(trust, named, exchange.vehicles.actor[got.receiver], row[got.message])
            up = links.uplink.take(is_there[links.uplink.message])
            if len(up.message):
                named = parts.linkage.messages(pseudonyms, _upheld(sent.messages, sent.sender, exchange, parts))
                trust, now = parts.trust.report_by_rsu(trust, named, row[up.message], carrier.begin_s + up.received_s)
                stats = replace(stats, n_reached=stats.n_reached + now.n_reached)
    return trust, stats


def late_pseudonyms(late: LateMessages, carried: Sequence[EvaluationCarriers]) -> Int[ndarray, "m"]:
    """Pseudonym that each of these messages carries; -1 for those of roadside units and of senders not accepted."""
    pseudonym = np.full(len(late.sender), -1)
    for carrier in carried:
        row, is_there = rows_of(late.sender, carrier.sender)
        is_there &= late.step == carrier.step
        pseudonym[is_there] = carrier.pseudonym[row[is_there]]
    return pseudonym


def next_carried(
    carried: tuple[EvaluationCarriers, ...], carrier: EvaluationCarriers, now: Times, config: Config
) -> tuple[EvaluationCarriers, ...]:
    """The evaluations whose messages may still arrive after this step."""
    if config.round_s >= config.message_lifetime_s:  # no message outlasts its round
        return ()
    oldest_s = now.begin_s - 2 * config.message_lifetime_s
    nothing = LinkReceptions(Receptions.none(), Receptions.none(), Receptions.none())
    return (*(one for one in carried if one.begin_s > oldest_s), replace(carrier, receptions=nothing))


@dataclass(frozen=True, slots=True)
class LookedUp:
    """Trust in the senders of the evaluations that each vehicle uses in fusion."""

    messages: Uses
    """The messages whose senders' trust is looked up."""
    lookups: list[Lookups]
    """Answers per trust variant, aligned with `messages`."""


def look_up(
    trust: TrustState, known_senders: KnownSenders, exchange: Exchange, listed: Listed, messages: Known, used: Uses,
    cpms: Broadcast, pseudonyms: PseudonymState, parts: Parts,
) -> tuple[TrustState, KnownSenders, LookedUp]:  # fmt: skip
    """Every vehicle that senses looks up its trust in the senders of the evaluations that it uses.

    Parameters
    ----------
    trust, known_senders, pseudonyms
        Parts of the state.
    exchange, listed
        Vehicles of the step and their detections.
    messages
        Messages of the step and earlier ones.
    used
        Those that carried the evaluations, and the vehicles that use them.
    cpms
        The round of detection messages.
    parts
        Components of the run.
    """
    now, holder, asked = exchange.now, exchange.sensing.actor[used.receiver], messages.pseudonym
    trust = parts.trust.receive(trust, exchange.vehicles.actor, now.fused_s)
    found = _trust_in(trust, holder, asked, used.message, now.fused_s, exchange, pseudonyms, parts)
    if parts.config.pseudonyms.linkage == "own":
        received = _received_senders(exchange, listed, cpms.accepted.vehicles)
        known_senders = update_senders(
            known_senders, received, now.begin_s,
            lambda pseudonym: parts.pseudonyms.owners(pseudonyms, pseudonym)[0], parts.config.pseudonyms,
        )  # fmt: skip
        known_senders, found = _of_old_pseudonyms(
            trust, known_senders, holder, asked[used.message], now.fused_s, found, parts
        )
    return trust, known_senders, LookedUp(used, parts.trust.per_variant(found))


def _received_senders(exchange: Exchange, listed: Listed, received: Receptions) -> ReceivedSenders:
    """Position and velocity of senders as their receivers know them, from self-reports in their messages."""
    objects, senders = listed.objects, exchange.senders
    report = np.full(len(senders), -1)  # per message, the row of its self-report
    selves = np.flatnonzero(listed.detections.is_self & objects.transmitted)
    report[listed.detections.message[selves]] = selves
    received = received.take(report[received.message] >= 0)
    row = report[received.message]
    yaw, speed = objects.boxes.yaw_rad[row], np.nan_to_num(objects.speed_mps[row])
    return ReceivedSenders(
        receiver=exchange.vehicles.actor[received.receiver],
        pseudonym=senders.pseudonym[received.message],
        xy_m=objects.boxes.xyz_m[row, :2],
        velocity_mps=speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)]),
    )


def _of_old_pseudonyms(
    trust: TrustState, known: KnownSenders, holder: Int[ndarray, "n"], asked: Int[ndarray, "n"], time_s: float,
    found: list[Lookups], parts: Parts,
) -> tuple[KnownSenders, list[Lookups]]:  # fmt: skip
    """Look-ups of receivers that link pseudonyms themselves.

    If a receiver has no trust value for the new pseudonym, it uses that of the old one.
    """
    old = np.full(len(asked), -1)
    if len(known.receiver):
        at = np.minimum(known.rows_of(holder, asked), len(known.receiver) - 1)
        there = (known.receiver[at] == holder) & (known.pseudonym[at] == asked)
        base = found[parts.trust.host_of[0]].source != TrustSource.DEFAULT
        known = noted(known, at[there], base[there])
        old[there] = known.linked[at[there]]
    results = []
    for host, one in enumerate(found):
        rows = np.flatnonzero((one.source == TrustSource.DEFAULT) & (old >= 0))
        if len(rows):
            of_old = parts.trust.lookup(trust, holder[rows], old[rows], time_s)[host]
            one = fallen_back(one, rows, of_old)
        results.append(one)
    return known, results


def fuse_objects(
    trust: TrustState, matched: Matched, evaluations: tuple[ObjectLists, Evaluations, Evaluations],
    looked_up: LookedUp, parts: Parts,
) -> list[Fused | None]:  # fmt: skip
    """Fused objects of every vehicle that senses, per trust variant; None if they are not requested.

    `evaluations` are those that the vehicles can use, as `Inbox.evaluations_used` returns them.
    """
    hosts, in_time = parts.trust, parts.config.radio.evaluations == "alone"
    variants = {
        number: FusionOf(found.trust, variant.trust, scorer)
        for number, (variant, found, scorer) in enumerate(
            zip(hosts.variants, looked_up.lookups, hosts.scorers(trust), strict=True)
        ) if variant.fused
    }  # fmt: skip
    used = Used(looked_up.messages, in_time, *evaluations, matched.from_own_m)
    found = dict(zip(variants, matched.objects.fuse(used, list(variants.values())), strict=True))
    return [found.get(number) for number in range(len(hosts.variants))]
