"""Evaluations on their way to those who keep trust.

A stage that changes a part of the state takes it as an argument and returns its new value before the result.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.base.ragged import rows_of
from cosim.config.config import Config
from cosim.messages.pseudonyms import PseudonymState
from cosim.messages.trust_hosts import TrustState
from cosim.messages.trust_server import LinkStats, SentReports
from cosim.radio.message_round import LinkReceptions, Receptions
from cosim.step.broadcast import Broadcast, SentEvaluations
from cosim.step.evaluate import Evaluated
from cosim.step.exchange import Exchange, Times
from cosim.step.late import LateMessages
from cosim.step.listing import Listed
from cosim.step.parts import Parts
from trust.certified import upheld
from trust.claims import claims_of_messages
from trust.tables import EvaluationMessages


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
    heard: Bool[ndarray, "v"]
    """Whether roadside units have received each of the evaluations. It is updated in place."""


def carrier_of(
    exchange: Exchange,
    evaluated: Evaluated,
    waiting: SentEvaluations | None,
    rounds: tuple[Broadcast, Broadcast],
    parts: Parts,
) -> tuple[SentEvaluations | None, EvaluationCarriers]:
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
    carried = sent if alone else waiting
    carrier = EvaluationCarriers(
        step=now.step,
        sender=exchange.sender,
        pseudonym=exchange.senders.pseudonym,
        evaluations=carried,
        receptions=(reports if alone else cpms).accepted,
        begin_s=now.evaluated_s if alone else now.begin_s,
        heard=np.zeros(0 if carried is None else len(carried.sender), bool),
    )
    if alone:
        return None, carrier
    if waiting is None:
        return sent, carrier
    is_there = np.isin(waiting.sender >> 16, exchange.vehicles.actor)
    is_replaced = np.isin(waiting.sender, sent.sender)
    still_waiting = waiting.take(np.flatnonzero(is_there & ~is_replaced))
    return sent.and_also(still_waiting), carrier


def update_trust(
    trust: TrustState,
    exchange: Exchange,
    listed: Listed,
    evaluated: Evaluated,
    carrier: EvaluationCarriers,
    pseudonyms: PseudonymState,
    parts: Parts,
) -> tuple[TrustState, LinkStats]:
    """Give the trust hosts the transmitted detections, the vehicles' own evaluations and those that arrived.

    Returns
    -------
    The state of trust, and counts of the reports to the server.
    """
    hosts, linkage, senders = parts.trust, parts.linkage, exchange.senders
    trust = _open_step(trust, exchange, listed, pseudonyms, parts)
    own, vehicle = linkage.messages(pseudonyms, evaluated.own_messages), exchange.sensing.actor
    trust = hosts.add_local(trust, own, vehicle, np.arange(len(vehicle)), of_others=False)
    up = LinkStats()
    if carrier.evaluations is not None:
        trust, up = _deliver(trust, exchange, carrier.evaluations, carrier, pseudonyms, parts)
    if parts.config.server.uplink == "cellular":
        xy_m = exchange.world.boxes.xyz_m[exchange.vehicles.row[senders.vehicle], :2]
        n_copies = None if exchange.sending is None else exchange.sending.n_reports[senders.vehicle]
        reports = _reports(evaluated.sent, exchange.sender, exchange, pseudonyms, parts)
        trust, up = hosts.report_by_cellular(
            trust, reports, senders.key, xy_m, exchange.now.evaluated_s, senders.is_valid, n_copies
        )
    return trust, up


def _reports(
    sent: EvaluationMessages,
    sender: Int[ndarray, "v"],
    exchange: Exchange,
    pseudonyms: PseudonymState,
    parts: Parts,
) -> SentReports:
    """Reports of evaluations to the server, each with its `Exchange.sender`.

    Roadside units are at the server's wire: it knows what they saw before it uses what others say of the same step.
    """
    used = sent
    if len(parts.certified):
        units = np.isin(exchange.vehicles.name_key, parts.certified)
        is_certified = np.isin(sender >> 16, exchange.vehicles.actor[units])
        are_claims = len(parts.config.trust.evidence) > 1
        used = upheld(sent, is_certified, exchange.vehicles.pseudonym[units], are_claims)
    return SentReports(parts.linkage.messages(pseudonyms, used), np.diff(sent.ptr))


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
        subject, row = np.unique(subject, return_inverse=True)
        message = row[message]
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
    row[at] = np.arange(len(which))
    carried = carried.take(which)  # the others wait for a message of their sender
    sent = parts.linkage.messages(pseudonyms, carried.messages)
    got = links.vehicles.take(row[links.vehicles.message] >= 0)
    holder = vehicles.actor[got.receiver]
    trust = parts.trust.add_local(trust, sent, holder, row[got.message])
    up = links.uplink.take(row[links.uplink.message] >= 0)
    carrier.heard[which[row[up.message]]] = True
    reports = _reports(carried.messages, carried.sender, exchange, pseudonyms, parts)
    return parts.trust.report_by_rsu(trust, reports, row[up.message], carrier.begin_s + up.received_s)


def deliver_late(
    trust: TrustState,
    exchange: Exchange,
    carried: Sequence[EvaluationCarriers],
    late: Sequence[LateMessages],
    pseudonyms: PseudonymState,
    parts: Parts,
) -> tuple[TrustState, LinkStats]:
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
            if not is_there.any():
                continue
            links = messages.links
            got = links.vehicles.take(is_there[links.vehicles.message])
            named = parts.linkage.messages(pseudonyms, sent.messages)
            holder = exchange.vehicles.actor[got.receiver]
            trust = parts.trust.add_local(trust, named, holder, row[got.message])
            up = links.uplink.take(is_there[links.uplink.message])
            if not len(up.message):
                continue
            reports = _reports(sent.messages, sent.sender, exchange, pseudonyms, parts)
            of, received_s = row[up.message], carrier.begin_s + up.received_s
            again = carrier.heard[of]  # counted before; the first copy may have been lost in an outage
            new = ~again
            trust, now = parts.trust.report_by_rsu(trust, reports, of[new], received_s[new])
            stats = replace(stats, n_reached=stats.n_reached + now.n_reached)
            trust, _ = parts.trust.report_by_rsu(trust, reports, of[again], received_s[again])
            carrier.heard[of] = True
    return trust, stats


def late_pseudonyms(late: LateMessages, carried: Sequence[EvaluationCarriers]) -> Int[ndarray, "m"]:
    """Pseudonym that each of these messages carries; -1 for those of roadside units."""
    pseudonym = np.full(len(late.author), -1)
    for carrier in carried:
        row, is_there = rows_of(late.author, carrier.sender)
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
