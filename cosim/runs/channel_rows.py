"""Rows of the tables about messages and the channel, as `cosim.runs.recording` appends them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.base.codes import MessageType
from cosim.base.ragged import stable_order
from cosim.messages.content import SELF
from cosim.messages.cpm_generation import Inclusion
from cosim.radio.message_round import FrameOutcomes, Outcome, Receptions, RoundKind
from cosim.runs.rows import Columns, TakesRows, without
from cosim.step.reports import late_pseudonyms
from cosim.step.result import Sensed
from cosim.step.trackers.channel_counts import (
    channel_busy_ratio,
    latency_histogram,
    pdr_by_distance,
    vehicle_channel,
)
from cosim.step.tracking import late_of
from cosim.world import World

OUTCOMES = {
    "n_delivered": Outcome.RECEIVED,
    "n_lost_propagation": Outcome.PROPAGATION,
    "n_lost_collision": Outcome.COLLISION,
    "n_lost_receiver_busy": Outcome.RECEIVER_BUSY,
    "n_lost_expired": Outcome.EXPIRED,
    "n_lost_late": Outcome.LATE,
}
"""The outcome that each column of the tables `radio` and `pdr_by_distance` counts."""

INCLUSIONS = {
    "n_included": Inclusion.INCLUDED,
    "n_waiting": Inclusion.WAITING,
    "n_not_due": Inclusion.NOT_DUE,
    "n_redundant": Inclusion.REDUNDANT,
    "n_over_limit": Inclusion.OVER_LIMIT,
}
"""The inclusion that each column of the table `cpm_content` counts."""


def cpm_content_rows(world: World, sensed: Sensed) -> Columns:
    """One row per cooperative perception message: which detections of the list it includes, and why not the others."""
    listed, content, n = sensed.listed, sensed.listed.content, len(sensed.senders)
    message, is_self = listed.detections.message, listed.objects.origin == SELF
    length_bytes = sensed.rounds[RoundKind.CPM].length_bytes
    cell = (message * len(Inclusion) + content.inclusion)[~is_self]  # of the table of messages by inclusions
    counts = np.bincount(cell, minlength=n * len(Inclusion)).reshape(n, len(Inclusion))
    rows = {
        "sender": sensed.senders.pseudonym,
        "length_bytes": length_bytes,
        "n_objects": counts.sum(axis=1) - counts[:, Inclusion.WITHHELD],
        **{column: counts[:, inclusion] for column, inclusion in INCLUSIONS.items()},
        "self_report": np.bincount(message[is_self & content.included], minlength=n) > 0,
        "sensors": content.has_sensors & (length_bytes > 0),
    }
    return without(world.is_roadside[sensed.vehicles.row[sensed.senders.vehicle]], rows)


def channel(recorder: TakesRows, world: World, sensed: Sensed) -> None:
    """Append what became of the frames of each type of message, and what each vehicle received and heard."""
    n, now_step = len(sensed.vehicles), world.step
    receivers = []  # of the receptions of each round
    cbr = channel_busy_ratio(n, [broadcast.cbr for broadcast in sensed.rounds])
    for message_type, kind, reach in zip(MessageType, RoundKind, sensed.reach, strict=True):
        broadcast, late = sensed.rounds[kind], late_of(sensed.rounds, kind)
        frames = [broadcast.round.frames, *(messages.round.frames for messages in late)]
        receptions = [broadcast.links.vehicles, *(messages.links.vehicles for messages in late)]
        receivers += [found.receiver for found in receptions]
        by_distance, total = pdr_by_distance(**_decided_frames(frames), columns=OUTCOMES)
        of_clouds = late_of(sensed.rounds, kind, clouds=True)
        sent_bytes = sum(one.sent_bytes for one in frames)
        sent_bytes += sum(messages.round.frames.sent_bytes for messages in of_clouds)
        totals = {
            "n_sent": np.array([sum(one.n_transmissions.sum() for one in frames)]),
            "n_relayed": np.array([sum(one.n_relayed for one in frames)]),
            "n_duplicate": np.array([sum(one.n_duplicate for one in frames)]),
            "sent_bytes": np.array([sent_bytes]),
            **total,
            "cbr": None if cbr is None else np.array([cbr.mean()]),
        }
        latency_s = np.concatenate([found.latency_s for found in receptions])
        recorder.append("radio", now_step, _of(message_type, totals))
        recorder.append("pdr_by_distance", now_step, _of(message_type, by_distance))
        recorder.append("latency_histogram", now_step, _of(message_type, latency_histogram(latency_s)))
        recorder.append("packet_inter_reception", now_step, _of(message_type, reach.inter_reception))
    n_in_range = [reach.n_in_range for reach in sensed.reach]
    rows = {"vehicle": sensed.vehicles.actor} | vehicle_channel(n, n_in_range, receivers, cbr)
    recorder.append("vehicle_channel", now_step, without(world.is_roadside[sensed.vehicles.row], rows))


def _of(message_type: MessageType, rows: Columns) -> Columns:
    """The rows with a column that says of which type of message they are."""
    n = next(len(values) for values in rows.values() if values is not None)
    return {"message_type": np.full(n, message_type), **rows}


def _decided_frames(parts: Sequence[FrameOutcomes]) -> dict[str, ndarray]:
    """Distance, line of sight and outcome of the frames of several rounds, without the frames that still wait.

    A frame counts in the step in which it is sent or expires.
    """
    names = ("distance_m", "los_state", "outcome")
    if len(parts) == 1:
        columns = {name: getattr(parts[0], name) for name in names}
    else:
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    is_decided = columns["outcome"] != Outcome.WAITING
    if is_decided.all():
        return columns
    rows = np.flatnonzero(is_decided)
    return {name: column.take(rows) for name, column in columns.items()}


def receptions(recorder: TakesRows, now_step: int, sensed: Sensed) -> None:
    """Append the receptions of each type of message, those of messages of earlier steps that arrive now included."""
    for message_type, kind in zip(MessageType, RoundKind, strict=True):
        found = sensed.rounds[kind].links.vehicles
        senders = [sensed.senders.pseudonym[found.message]]
        steps, parts = [np.full(len(found.message), now_step)], [found]
        for late in late_of(sensed.rounds, kind):
            pseudonym = late_pseudonyms(late, sensed.carried)
            known = late.links.vehicles.take(pseudonym[late.links.vehicles.message] >= 0)
            senders.append(pseudonym[known.message])
            steps.append(late.step[known.message])
            parts.append(known)
        found = Receptions.concat(parts)
        sender = np.concatenate(senders)
        step = np.concatenate(steps)
        if len(parts) > 1:
            first = _first_copies(sender, step, found)
            found, sender, step = found.take(first), sender[first], step[first]
        rows = {
            "sender": sender,
            "receiver": sensed.vehicles.actor[found.receiver],
            "message_step": step,
            "hops": found.hops,
            "generation_offset_s": found.generation_offset_s,
            "access_delay_s": found.access_delay_s,
            "latency_s": found.latency_s,
            "distance_m": found.distance_m,
        }
        recorder.append("receptions", now_step, _of(message_type, rows))


def _first_copies(
    sender: Int[ndarray, "n"],
    step: Int[ndarray, "n"],
    found: Receptions,
) -> Int[ndarray, "k"]:
    """Rows of the first reception of each message at each receiver: a sender may send copies, and they may be late."""
    order = np.argsort(found.latency_s, kind="stable")
    for key in (found.receiver, step, sender):  # in the end by sender, step, receiver, latency
        order = order.take(stable_order(key.take(order)))
    is_copy = np.zeros(len(order), bool)  # of the row before it in this order
    is_copy[1:] = True
    for key in (found.receiver, step, sender):
        is_copy[1:] &= np.diff(key.take(order)) == 0
    is_first = np.ones(len(order), bool)
    is_first[order[is_copy]] = False
    return np.flatnonzero(is_first)
