"""The two rounds of messages: detections, and evaluations.

A stage that changes a part of the state takes it as an argument and returns its new value before the result.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.config.config import Config
from cosim.messages.content import (
    SELF,
    cpm_bytes,
    encoded_cpm_bytes,
    evaluation_bytes,
    piggyback_bytes,
    trust_broadcast_bytes,
    velocities,
)
from cosim.messages.cpm_generation import CpmState
from cosim.messages.redundancy import ReportedObjects
from cosim.messages.trust_server import TrustBroadcast
from cosim.radio.message_round import LinkReceptions, MessageRound, Messages, RoundKind
from cosim.step.evaluate import Evaluated
from cosim.step.exchange import Exchange, OnAir, Senders
from cosim.step.late import LateMessages, not_accepted
from cosim.step.listing import Listed
from cosim.step.parts import Parts
from cosim.step.sense import Positioned
from trust.tables import EvaluationMessages


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
    cbr: Float[ndarray, "n"] | None = None
    """Share of half the time between two steps in which vehicles can sense, in which each station sensed the channel
    busy: the mean of a step's two rounds is the share of the time. None where the medium does not model it."""
    late: tuple[LateMessages, ...] = ()
    """Messages of earlier rounds that went on in this one."""
    late_clouds: tuple[LateMessages, ...] = ()
    """Clouds of earlier rounds that went on in this one."""


def broadcast_detections(
    exchange: Exchange,
    listed: Listed,
    piggybacked: SentEvaluations | None,
    cloud_bytes: Int[ndarray, "s"] | None,
    medium: object,
    parts: Parts,
) -> tuple[object, Broadcast]:
    """Broadcast detection messages, with piggybacked evaluations of the step before; return the medium's new state.

    Behind its detection message, a vehicle sends its point cloud, if `cloud_bytes` has the lengths.
    """
    lengths, envelopes = _cpm_lengths(exchange, listed, piggybacked, parts.config)
    on_air = OnAir.of(exchange, lengths, sending=exchange.sending, envelope_bytes=envelopes)
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
    on_air = OnAir.of(exchange, lengths, rsu_bytes)
    return _broadcast(exchange, RoundKind.EVALUATION, on_air, exchange.now.evaluated_s, lengths, medium, parts)


def _broadcast(
    exchange: Exchange,
    kind: RoundKind,
    on_air: OnAir,
    begin_s: float,
    length_bytes: Int[ndarray, "m"],
    medium: object,
    parts: Parts,
    cloud_bytes: Int[ndarray, "s"] | None = None,
) -> tuple[object, Broadcast]:
    messages, clouds = on_air.without(exchange.refused).messages, None
    messages = replace(messages, name=_names(exchange)[on_air.message])
    if cloud_bytes is not None:
        names = _names(exchange)[exchange.senders.own]
        messages, is_cloud = messages.followed_by(Messages(exchange.vehicles.senses, cloud_bytes, name=names))
    step, stations = exchange.now.step, exchange.stations
    medium, found = parts.medium.broadcast(medium, kind, step, begin_s, stations, messages)
    if cloud_bytes is not None:
        found, clouds = found.only(~is_cloud), found.only(is_cloud)
    n_vehicles = len(exchange.vehicles)
    links = on_air.links(found, n_vehicles)
    late, late_clouds = (
        tuple(LateMessages.of(earlier, n_vehicles) for earlier in found.earlier if earlier.is_background == is_cloud)
        for is_cloud in (False, True)
    )
    accepted = _accepted(links, exchange.senders)
    cbr = found.frames.cbr
    if cbr is not None:
        cbr = cbr * (parts.config.round_s / (0.5 * parts.config.schedule.exchange_interval_s))
    return medium, Broadcast(found, links, accepted, length_bytes, clouds, cbr, late, late_clouds)


def _names(exchange: Exchange) -> Int[ndarray, "m"]:
    """The sender of each message, by which it is known if it arrives late.

    Messages of roadside units follow; they are -1.
    """
    name = np.where(exchange.senders.is_valid, exchange.sender, not_accepted(exchange.sender))
    return np.append(name, np.full(exchange.n_rsus, -1))


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
    vehicles = exchange.vehicles
    senders = exchange.senders
    objects = listed.objects
    begin_s = exchange.now.begin_s
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
