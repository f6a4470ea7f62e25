"""Trust servers publish; vehicles look up trust.

A stage that changes a part of the state takes it as an argument and returns its new value before the result.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.codes import TrustSource
from cosim.base.ragged import expand, ptr_of
from cosim.door.guard import refuse
from cosim.messages.pseudonyms import PseudonymState
from cosim.messages.relinking import KnownSenders, ReceivedSenders, fallen_back, noted, update_senders
from cosim.messages.trust_hosts import NOBODY, Informed, Lookups, TrustState
from cosim.messages.trust_server import TrustBroadcast
from cosim.radio.link_budget import neighbours
from cosim.radio.message_round import Receptions, RoundKind
from cosim.step.broadcast import Broadcast
from cosim.step.exchange import Exchange, Times, Vehicles
from cosim.step.known import Known, Uses, without
from cosim.step.listing import Listed
from cosim.step.parts import Parts
from cosim.step.trackers.encounters import Encounters, NearPairs, update_encounters
from cosim.world import World
from results.encounters import Rows
from trust.models import TrustModel
from trust.tables import SERVER, TrustScores


def own_trust_of(
    world: World, trust: TrustState, pseudonyms: PseudonymState, now: Times, parts: Parts
) -> Float[ndarray, "n"] | None:
    """Trust in each actor as the actor itself last learned it, by row of the world; None if no attack reads it.

    It is NaN where no broadcast has a value of its pseudonym: the default trust was never broadcast, and a new
    pseudonym has it again.
    """
    if not parts.adversary.reads_trust:
        return None
    row = np.flatnonzero(world.equipped)
    actor = world.actor[row]
    subject = parts.linkage.subjects(pseudonyms, pseudonyms.of(actor))
    found = parts.trust.lookup(trust, actor, subject, now.begin_s)
    of_acting = found[parts.trust.host_of[0]]
    own_trust = np.full(len(world), np.nan)
    own_trust[row] = np.where(of_acting.is_default, np.nan, of_acting.trust)
    return own_trust


def follow_encounters(
    encounters: Encounters,
    near: NearPairs,
    trust: TrustState,
    pseudonyms: PseudonymState,
    vehicles: Vehicles,
    now: Times,
    parts: Parts,
) -> tuple[Encounters, TrustState, list[Rows]]:
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
    actor, name_key = vehicles.actor, vehicles.name_key
    trust, scores, informed = hosts.publish(trust, now.step, now.begin_s, actor, name_key)
    for h, of_host in enumerate(scores):
        if of_host is not None and hosts.models[h].guard is not None:
            owner, _ = parts.pseudonyms.owners(pseudonyms, of_host.subject)
            _check_names(hosts.model_of(trust, h), of_host, owner)
    pseudonyms = parts.linkage.accused(pseudonyms, trust.arrived)
    of_acting = scores[hosts.host_of[0]]
    pseudonyms = parts.revocation.decided(pseudonyms, of_acting, now.step, c.traffic.step_s)
    named = [None if of_host is None else parts.linkage.scores(pseudonyms, of_host) for of_host in scores]
    return trust, pseudonyms, Published(hosts.per_variant(named), informed)


def _check_names(model: TrustModel, scores: TrustScores, owner: Int[ndarray, "n"]) -> None:
    """Raise `ExtensionError` if the server's model, which is a user's own, has scores of nobody or for nobody."""
    if (nobody := scores.subject[owner < 0]).size:
        refuse(model, "scores", f"returned a score of subject {nobody[0]}, but no vehicle has this pseudonym")
    if (strange := scores.holder[scores.holder != SERVER]).size:
        refuse(model, "scores", f"returned a score for holder {strange[0]}, but SERVER, {SERVER}, is expected")


def receive_from_rsus(
    trust: TrustState,
    exchange: Exchange,
    sent: TrustBroadcast | None,
    rounds: tuple[Broadcast, Broadcast],
    informed: list[Informed],
    parts: Parts,
) -> tuple[TrustState, list[Informed]]:
    """Vehicles receive the trust that roadside units broadcast in the round of evaluations of this step or earlier.

    Returns
    -------
    The state of trust, and per host the vehicles that it has informed by now.
    """
    late = [messages for one in rounds for messages in one.late if messages.kind == RoundKind.EVALUATION]
    received = [messages.links.downlink for messages in late]
    sent_step = [messages.step[messages.links.downlink.message] for messages in late]
    if sent is not None:
        received.append(rounds[1].links.downlink)
        sent_step.append(np.full(len(received[-1].message), exchange.now.step))
    vehicle, n_informed = exchange.vehicles.actor, 0
    if any(map(len, sent_step)):
        all_received = Receptions.concat(received)
        trust, n_informed = parts.trust.receive_from_rsu(
            trust, vehicle, all_received.receiver, np.concatenate(sent_step), all_received.received_s
        )
    acting = parts.trust.host_of[0]
    by_rsus = Informed(0 if sent is None else len(vehicle), n_informed)
    if by_rsus == NOBODY:
        return trust, informed
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
    xy_m = exchange.stations.xyz_m[: len(vehicles), :2]
    source, near, _ = neighbours(xy_m, reach_m)
    ptr = ptr_of(source, len(vehicles))
    at, message = expand(ptr[senders.vehicle], ptr[senders.vehicle + 1])
    station, begin_s = near[at], exchange.now.begin_s
    holder, asked = vehicles.actor[station], senders.pseudonym
    found = _trust_in(trust, holder, asked, message, begin_s, exchange, pseudonyms, parts)
    if parts.config.pseudonyms.linkage == "own":
        _, found = _of_old_pseudonyms(trust, known_senders, holder, asked[message], begin_s, found, parts)
    refuses = found[parts.trust.host_of[0]].trust < relay.min_trust
    refuses &= ~exchange.attacks.malicious()[vehicles.row[station]]
    return replace(exchange, refused=(message[refuses], station[refuses]))


def _trust_in(
    trust: TrustState,
    holder: Int[ndarray, "n"],
    pseudonym: Int[ndarray, "m"],
    message: Int[ndarray, "n"],
    time_s: float,
    exchange: Exchange,
    pseudonyms: PseudonymState,
    parts: Parts,
) -> list[Lookups]:
    """For each host, the trust of vehicles (actor numbers) in the senders of messages at `time_s`."""
    subject = parts.linkage.subjects(pseudonyms, pseudonym)[message]
    found = parts.trust.lookup(trust, holder, subject, time_s)
    if len(parts.certified):
        units = exchange.vehicles.pseudonym[np.isin(exchange.vehicles.name_key, parts.certified)]
        is_unit = np.isin(pseudonym[message], units)
        found = [replace(of_host, trust=np.where(is_unit, 1.0, of_host.trust)) for of_host in found]
    return found


@dataclass(frozen=True, slots=True)
class LookedUp:
    """Trust in the senders of the messages that each vehicle uses in fusion."""

    messages: Uses
    """The messages with evaluations."""
    lookups: list[Lookups]
    """Answers per trust variant, aligned with `messages`."""
    further: Uses
    """The messages with detections without their sender's evaluations, which are lost, late or not sent."""
    of_further: list[Float[ndarray, "f"]]
    """Trust in their senders per trust variant, aligned with `further`."""
    own: list[Float[ndarray, "e"]] | None
    """Trust of each vehicle that senses in itself, per trust variant; None if no variant asks for it."""


def follow_senders(
    known_senders: KnownSenders,
    exchange: Exchange,
    listed: Listed,
    cpms: Broadcast,
    pseudonyms: PseudonymState,
    parts: Parts,
) -> KnownSenders:
    """Receivers that link pseudonyms themselves learn where the senders of the step's detection messages are."""
    config = parts.config
    if config.pseudonyms.linkage != "own":
        return known_senders
    return update_senders(
        known_senders,
        _received_senders(exchange, listed, cpms.accepted.vehicles),
        exchange.now.begin_s,
        config.cpm.longest_gap_s(parts.schedule.longest_steps * config.traffic.step_s),
        lambda pseudonym: parts.pseudonyms.owners(pseudonyms, pseudonym)[0],
        config.pseudonyms,
    )


def look_up(
    trust: TrustState,
    known_senders: KnownSenders,
    exchange: Exchange,
    messages: Known,
    used: Uses,
    pseudonyms: PseudonymState,
    parts: Parts,
) -> tuple[TrustState, KnownSenders, LookedUp]:
    """Every vehicle that senses looks up its trust in the senders of the messages that it uses.

    Parameters
    ----------
    trust, known_senders, pseudonyms
        Parts of the state.
    exchange
        Vehicles of the step.
    messages
        Messages of the step and earlier ones.
    used
        Those that carried the evaluations, and the vehicles that use them. Only these look-ups are recorded.
    parts
        Components of the run.
    """
    now, sensing = exchange.now, exchange.sensing
    holder = sensing.actor[used.receiver]
    asked = messages.pseudonym
    trust = parts.trust.receive(trust, exchange.vehicles.actor, now.fused_s)
    found = _trust_in(trust, holder, asked, used.message, now.fused_s, exchange, pseudonyms, parts)
    further = without(messages.received, used)
    others = sensing.actor[further.receiver]
    of_further = _trust_in(trust, others, asked, further.message, now.fused_s, exchange, pseudonyms, parts)
    if parts.config.pseudonyms.linkage == "own":
        known_senders, found = _of_old_pseudonyms(
            trust, known_senders, holder, asked[used.message], now.fused_s, found, parts
        )
        _, of_further = _of_old_pseudonyms(
            trust, known_senders, others, asked[further.message], now.fused_s, of_further, parts
        )
    own = None
    if any(variant.trust.fixed_ego_trust is None for variant in parts.trust.variants):
        subject = parts.linkage.subjects(pseudonyms, pseudonyms.of(sensing.actor))
        own = [of_host.trust for of_host in parts.trust.lookup(trust, sensing.actor, subject, now.fused_s)]
    looked_up = LookedUp(
        messages=used,
        lookups=parts.trust.per_variant(found),
        further=further,
        of_further=parts.trust.per_variant([of_host.trust for of_host in of_further]),
        own=None if own is None else parts.trust.per_variant(own),
    )
    return trust, known_senders, looked_up


def _received_senders(exchange: Exchange, listed: Listed, received: Receptions) -> ReceivedSenders:
    """Position and velocity of senders as their receivers know them, from self-reports in their messages."""
    objects, senders = listed.objects, exchange.senders
    report = np.full(len(senders), -1)  # per message, the row of its self-report
    selves = np.flatnonzero(listed.detections.is_self & objects.transmitted)
    report[listed.detections.message[selves]] = selves
    received = received.take(report[received.message] >= 0)
    row = report[received.message]
    yaw = objects.boxes.yaw_rad[row]
    speed = np.nan_to_num(objects.speed_mps[row])
    heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
    return ReceivedSenders(
        receiver=exchange.vehicles.actor[received.receiver],
        pseudonym=senders.pseudonym[received.message],
        xy_m=objects.boxes.xyz_m[row, :2],
        velocity_mps=speed[:, None] * heading,
    )


def _of_old_pseudonyms(
    trust: TrustState,
    known: KnownSenders,
    holder: Int[ndarray, "n"],
    asked: Int[ndarray, "n"],
    time_s: float,
    found: list[Lookups],
    parts: Parts,
) -> tuple[KnownSenders, list[Lookups]]:
    """Look-ups of receivers that link pseudonyms themselves.

    If a receiver has no trust value for the new pseudonym, it uses that of the old one.
    """
    old = np.full(len(asked), -1)
    at, there = known.rows_of(holder, asked)
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
