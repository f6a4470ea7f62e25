"""Converts the result of a step to rows of the run's tables.

This is the last stage of a step: `cosim.runs.drive` calls `step` with what all stages have computed, and the recorder
writes the rows to the run folder. `results/TABLES.md` says what each column means. A function named `_TABLE_rows` gives
the rows of one table. The others append rows to several tables. Nothing here changes the result.

A column `NAME__valid` says in which rows `NAME` has a value. In the other rows the table has null.
"""

import copy
from collections.abc import Container, Mapping, Sequence
from dataclasses import fields
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.attacks.params import roles_of
from cosim.base.codes import EvaluationKind, LookupState, MessageType
from cosim.base.plane import wrapped
from cosim.base.ragged import place_in_group, stable_order
from cosim.messages.content import FABRICATED, SELF, SENSED
from cosim.messages.cpm_generation import Inclusion
from cosim.messages.pseudonyms import PseudonymUse
from cosim.messages.trust_hosts import Lookups, ServerTraffic
from cosim.radio.message_round import FrameOutcomes, Outcome, Receptions, RoundKind
from cosim.step.known import Known
from cosim.step.listing import Listed
from cosim.step.parts import Parts
from cosim.step.reactions import Reactions
from cosim.step.reports import late_pseudonyms
from cosim.step.result import Sensed, StepResult
from cosim.step.state import State
from cosim.step.trackers import evidence_audit
from cosim.step.trackers.attack_start import AttackStartTracker
from cosim.step.trackers.channel_counts import (
    channel_busy_ratio,
    latency_histogram,
    pdr_by_distance,
    vehicle_channel,
)
from cosim.step.tracking import late_of
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.schedule import Schedule
from cosim.world import World
from results.encounters import Rows, by_variant
from sensors.boxes import Boxes
from sensors.scene import Shape
from sensors.tracking import ObjectStates
from trust.fusion import Fused
from trust.tables import TrustScores

Columns = Mapping[str, ndarray | None]
"""Columns of a table, ready for the recorder."""


class TakesRows(Protocol):
    """Takes rows of tables: a `results.recorder.Recorder`, or a class that keeps them in memory."""

    @property
    def tables(self) -> Container[str]:
        """Names of the tables whose rows are kept."""

    def append(self, table: str, step: int, columns: Columns) -> None:
        """Add rows of one step, as `Recorder.append`."""


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


def step(recorder: TakesRows, result: StepResult, dt_s: float) -> None:
    """Append all rows of a step to the tables of a run.

    Parameters
    ----------
    recorder
        Takes the rows.
    result
        Result of the step.
    dt_s
        Length of a step [s].
    """
    world, now_step = result.world, result.world.step
    actors(recorder, world)
    if result.reactions is not None:
        recorder.append("reactions", now_step, _reaction_rows(result.reactions))
    _encounters(recorder, now_step, result.encounters)
    pseudonyms(recorder, now_step, result.ended_pseudonyms)
    sensed = result.sensed
    if sensed is None:
        return
    _detections(recorder, world, sensed)
    if sensed.listed.tracks is not None:
        recorder.append("tracks", now_step, _track_rows(sensed, sensed.listed.tracks))
    if "stated_accuracies" in recorder.tables and sensed.listed.objects.variance_m2.any():
        recorder.append("stated_accuracies", now_step, _stated_accuracy_rows(sensed))  # else poses are exact
    recorder.append("cpm_content", now_step, _cpm_content_rows(world, sensed))
    _channel(recorder, world, sensed)
    if "receptions" in recorder.tables:
        _receptions(recorder, now_step, sensed)
    recorder.append("evaluations", now_step, _evaluation_rows(sensed))
    if "transmitted_evaluations" in recorder.tables:
        _transmitted(recorder, now_step, sensed)
    recorder.append("evidence", now_step, _evidence_rows(world, sensed))
    _trust(recorder, world, sensed, dt_s)
    _fused(recorder, world, sensed)
    _early(recorder, world, sensed)
    units = world.actor[world.is_roadside]
    for rows in sensed.attack_outcomes():
        recorder.append("attack_outcomes", now_step, _without(np.isin(rows["receiver"], units), rows))


def actors(recorder: TakesRows, world: World) -> None:
    """Append the poses of all actors on the road."""
    x, y, z = world.boxes.xyz_m.T
    rows = {
        "actor": world.actor,
        "x_m": x,
        "y_m": y,
        "z_m": z,
        "yaw_rad": world.boxes.yaw_rad,
        "speed_mps": world.speed_mps,
    }
    recorder.append("actors", world.step, _without(world.is_roadside, rows))


def _without(left_out: Bool[ndarray, "n"], rows: Columns) -> Columns:
    """The rows that are not left out. Most tables are about vehicles and leave out roadside units."""
    if not left_out.any():
        return rows
    kept = ~left_out
    return {name: None if column is None else column[kept] for name, column in rows.items()}


def _reaction_rows(found: Reactions) -> Columns:
    commands, why = found.commands, found.commands.reasons
    assert why is not None, "reactions have reasons"
    return {
        "vehicle": commands.actor,
        "source_step": why.source_step,
        "source": why.source,
        "source_index": why.source_index,
        "gap_m": why.gap_m,
        "speed_mps": commands.speed_mps,
        "deceleration_mps2": found.deceleration_mps2,
        "fabricated": found.fabricated,
        "truth_actor": found.truth_actor,
        "truth_actor__valid": found.is_real,
    }


def _encounters(recorder: TakesRows, now_step: int, closed: Sequence[Rows]) -> None:
    """Append encounters that have ended; `closed` has one item per definition in the config."""
    for rows in closed:
        base, others = by_variant(rows)
        recorder.append("encounters", now_step, base)
        if others:
            recorder.append("encounter_trust", now_step, others)


def pseudonyms(recorder: TakesRows, now_step: int, ended: PseudonymUse) -> None:
    """Append pseudonyms that are no longer used."""
    recorder.append("pseudonyms", now_step, _pseudonym_rows(ended))


def _pseudonym_rows(used: PseudonymUse) -> Rows:
    return {
        "pseudonym": used.pseudonym,
        "vehicle": used.vehicle,
        "identity": used.identity,
        "from_step": used.from_step,
        "to_step": used.to_step,
        "refused_step": used.refused_step,
        "refused_step__valid": used.refused_step >= 0,
    }


def box_columns(boxes: Boxes) -> Rows:
    """Columns of boxes, by name."""
    x, y, z = boxes.xyz_m.T
    length, width, height = boxes.lwh_m.T
    return {
        "x_m": x,
        "y_m": y,
        "z_m": z,
        "length_m": length,
        "width_m": width,
        "height_m": height,
        "yaw_rad": boxes.yaw_rad,
    }


def _detections(recorder: TakesRows, world: World, sensed: Sensed) -> None:
    """Append detections, the errors of the poses behind them, and what the LiDARs could have seen."""
    now_step, positioned, seen = world.step, sensed.positioned, sensed.positioned.observed.observability
    recorder.append("detections", now_step, detection_columns(world, sensed.listed, _observer(sensed)))
    if positioned.error is not None:
        x, y, heading = positioned.error.T
        errors: Rows = {"vehicle": sensed.vehicles.actor, "error_x_m": x, "error_y_m": y}
        if heading.any():  # a draw is never exactly 0, so all are 0 if headings have no errors
            errors["error_yaw_rad"] = heading
        units = world.is_roadside[sensed.vehicles.row]  # they know where they stand
        recorder.append("position_errors", now_step, _without(units, errors))
    n_dropped = sensed.listed.n_dropped
    causes = np.flatnonzero(n_dropped)
    recorder.append("dropped_detections", now_step, {"cause": causes, "n": n_dropped[causes]})
    visible = {
        "observer": sensed.sensing.actor[seen.observer],
        "actor": world.actor[seen.actor],
        "n_points": seen.n_returns,
        "n_unoccluded": seen.n_unoccluded,
    }
    recorder.append("observability", now_step, visible)


def _observer(sensed: Sensed) -> Int[ndarray, "d"]:
    """Pseudonym of the sender of each detection that is listed in this step."""
    return sensed.senders.pseudonym[sensed.listed.detections.message]


def detection_columns(world: World, listed: Listed | Known, pseudonym: Int[ndarray, "d"]) -> Rows:
    """Columns of the table `detections`; `pseudonym` is that of the observer of each detection."""
    objects, truth = listed.objects, listed.truth
    return {
        "observer": pseudonym,
        "detection_index": objects.detection_index,
        "class": objects.label,
        **box_columns(objects.boxes),
        "score": objects.score,
        "n_points": objects.n_points,
        "speed_mps": objects.speed_mps,
        "speed_mps__valid": ~np.isnan(objects.speed_mps),
        "acceleration_mps2": objects.acceleration_mps2,
        "acceleration_mps2__valid": ~np.isnan(objects.acceleration_mps2),
        "origin": objects.origin,
        "transmitted": objects.transmitted,
        "lied": truth.lied,
        "withheld": listed.withheld,
        "target": world.actor[objects.target],
        "target__valid": (objects.target != objects.observer) | truth.is_phantom,
        "truth_actor": world.actor[truth.actor_row],
        "truth_actor__valid": truth.is_real,
        "truth_iou": truth.iou,
        "truth_iou__valid": truth.is_real,
        "truth_occlusion": truth.occlusion,
        "truth_occlusion__valid": truth.is_sensed,
    }


def _track_rows(sensed: Sensed, states: ObjectStates) -> Columns:
    """Rows of detections that have a track or a velocity. `states` has one row per sensed detection, in list order."""
    listed = sensed.listed.objects
    moves = ~np.isnan(listed.velocity_mps).any(axis=1)
    tracked = listed.origin == SENSED
    rows = np.flatnonzero(tracked | moves)
    state_of_row = (np.cumsum(tracked) - 1).clip(0)[rows]  # meaningless where the detection has no track
    is_tracked, has_velocity = tracked[rows], moves[rows]

    def from_state(values: ndarray) -> ndarray:
        return values[state_of_row] if len(values) else np.zeros(len(rows), values.dtype)

    x, y = listed.velocity_mps[rows].T
    return {
        "observer": _observer(sensed)[rows],
        "detection_index": listed.detection_index[rows],
        "object_id": from_state(states.object_id),
        "object_id__valid": is_tracked,
        "age_s": from_state(states.age_s),
        "age_s__valid": is_tracked,
        "velocity_x_mps": x,
        "velocity_x_mps__valid": has_velocity,
        "velocity_y_mps": y,
        "velocity_y_mps__valid": has_velocity,
        "existence_p": from_state(states.existence_p),
        "existence_p__valid": is_tracked,
    }


def _stated_accuracy_rows(sensed: Sensed) -> Columns:
    stated = sensed.listed.objects
    return {
        "observer": _observer(sensed),
        "detection_index": stated.detection_index,
        **_std("", "m", stated.variance_m2),
        **_std("relative_", "m", stated.relative_m2),
        **_std("velocity_", "mps", stated.velocity_variance),
        "yaw_std_rad": np.sqrt(stated.heading_variance),
        "size_std": np.sqrt(stated.size_variance),
    }


def _std(name: str, unit: str, variance: Float[ndarray, "d 3"]) -> Rows:
    """Columns of the standard deviations east and north, and of their correlation, from variances xx, xy, yy."""
    xx, xy, yy = variance.T
    x_std, y_std = np.sqrt(xx), np.sqrt(yy)
    both = x_std * y_std
    correlation = np.divide(xy, both, out=np.zeros(len(both)), where=both > 0)
    return {f"{name}x_std_{unit}": x_std, f"{name}y_std_{unit}": y_std, f"{name}xy_correlation": correlation}


def _cpm_content_rows(world: World, sensed: Sensed) -> Columns:
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
    return _without(world.is_roadside[sensed.vehicles.row[sensed.senders.vehicle]], rows)


def _channel(recorder: TakesRows, world: World, sensed: Sensed) -> None:
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
    recorder.append("vehicle_channel", now_step, _without(world.is_roadside[sensed.vehicles.row], rows))


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


def _receptions(recorder: TakesRows, now_step: int, sensed: Sensed) -> None:
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


def _evaluation_rows(sensed: Sensed) -> Columns:
    """Evaluations of what is new to each evaluator since it last sensed."""
    evaluated, known, detections = sensed.evaluated, sensed.known, sensed.known.detections
    member, evaluator = evaluated.lists.member, evaluated.lists.owner[evaluated.lists.of_member()]
    rows: Rows = {
        "evaluator": known.pseudonym[evaluator],
        "observer": known.pseudonym[detections.message[member]],
        "detection_index": detections.detection_index[member],
        "evaluation": evaluated.reported.evaluation,
        "visibility": evaluated.reported.visibility,
        "n_points": evaluated.n_points,
        "plausible": evaluated.plausible,
        "plausible__valid": ~evaluated.matched,
        "matched": evaluated.matched,
        "lied": evaluated.lied,
        "detection_step": known.detection_step(member),
    }
    if evaluated.number is not None:
        rows["detection_index"], rows["kind"] = np.divmod(evaluated.number, len(EvaluationKind))
        rows["plausible__valid"] = (rows["kind"] == EvaluationKind.DETECTION) & ~evaluated.matched
    new = np.flatnonzero(known.is_new(sensed.senders.source[evaluator], member))
    return {name: column.take(new) for name, column in rows.items()}


def _transmitted(recorder: TakesRows, now_step: int, sensed: Sensed) -> None:
    """Append evaluations as transmitted, and the scores that were transmitted with the detections."""
    sent, own = sensed.evaluated.sent, sensed.evaluated.kept_messages
    rows = {
        "evaluator": np.repeat(sent.evaluator, np.diff(sent.ptr)),
        "observer": sent.observer,
        "detection_index": sent.detection_index,
        "evaluation": sent.evaluation,
        "visibility": sent.visibility,
        "own_evaluation": own.evaluation,
        "own_visibility": own.visibility,
        "detection_step": sent.detection_step,
    }
    if sensed.evaluated.number is not None:
        rows["detection_index"], rows["kind"] = np.divmod(sent.detection_index, len(EvaluationKind))
    recorder.append("transmitted_evaluations", now_step, rows)
    detections, chosen = sensed.listed.detections, sensed.listed.objects.transmitted
    scores = {
        "observer": _observer(sensed)[chosen],
        "detection_index": detections.detection_index[chosen],
        "score": detections.score[chosen],
    }
    recorder.append("transmitted_scores", now_step, scores)


def _evidence_rows(world: World, sensed: Sensed) -> Columns:
    """Counts of what the new evaluations say of real and of fabricated detections."""
    known, (lists, _, reported) = sensed.known, sensed.evaluated.of_detections()
    evaluator = lists.owner[lists.of_member()]
    new = np.flatnonzero(known.is_new(sensed.senders.source[evaluator], lists.member))
    evaluations = evidence_audit.AuditedEvaluations(
        evaluator=evaluator[new],
        detection=lists.member[new],
        evaluation=reported.evaluation[new],
        visibility=reported.visibility[new],
    )
    detections = evidence_audit.AuditedDetections(
        message=known.detections.message,
        actor=known.truth.actor_row,
        is_real=known.truth.is_real,
        is_fabricated=known.objects.origin == FABRICATED,
    )
    attacks = world.attack[sensed.vehicles.row[known.vehicle]] > 0
    n_copies = 0
    for broadcast in sensed.rounds:
        n_copies += broadcast.round.frames.n_duplicate
        for late in (*broadcast.late, *broadcast.late_clouds):
            n_copies += late.round.frames.n_duplicate
    return evidence_audit.audit(evaluations, detections, attacks, n_copies)


def _trust(recorder: TakesRows, world: World, sensed: Sensed, dt_s: float) -> None:
    """Append the tables of trust, which are about vehicles: without look-ups of roadside units or about them."""
    used = sensed.looked_up.messages
    receiver = sensed.sensing.actor[used.receiver]
    subject = sensed.known.pseudonym[used.message]
    # Several messages of one sender may be in use; its trust is looked up once.
    _, chosen = np.unique(receiver.astype(np.int64) << 32 | subject, return_index=True)
    units = world.is_roadside[sensed.vehicles.row]
    pseudonym = sensed.vehicles.pseudonym[units]
    if units.any():
        by_vehicle = ~np.isin(receiver, sensed.vehicles.actor[units])
        chosen = chosen[(by_vehicle & ~np.isin(subject, pseudonym))[chosen]]

    lookups = [found.take(chosen) for found in sensed.looked_up.lookups]
    of_variant = []
    for variant, scores in enumerate(sensed.published):
        if scores is None:
            continue
        if units.any():
            scores = scores.take(~np.isin(scores.subject, pseudonym))
        of_variant.append((variant, scores))
    _published(recorder, world.step, dt_s, of_variant)
    recorder.append("server", world.step, _server_rows(sensed.servers))
    _lookups(recorder, world.step, receiver[chosen], subject[chosen], lookups)


def _server_rows(servers: Sequence[ServerTraffic | None]) -> Columns:
    """One row per trust variant that has a server: the traffic from and to it."""
    names = ("variant", *_UP, *_DOWN)
    rows: dict[str, list[int]] = {name: [] for name in names}
    for variant, server in enumerate(servers):
        if server is None:
            continue
        rows["variant"].append(variant)
        for name in _UP:
            rows[name].append(getattr(server.up, name))
        for name in _DOWN:
            rows[name].append(getattr(server.down, name))
    return {name: np.array(values, np.int64) for name, values in rows.items()}


_UP = ("n_reports", "n_reached", "n_lost", "n_late", "n_over_capacity", "n_outage", "uplink_bytes")
_DOWN = ("n_addressed", "n_informed")


def _published(recorder: TakesRows, now_step: int, dt_s: float, of_variant: Sequence[tuple[int, TrustScores]]) -> None:
    """Append the trust scores that servers computed in this step, one variant after another.

    `of_variant` has the number of each variant whose server computed scores, and these scores.
    """
    if not of_variant:
        return

    def joined(name: str) -> ndarray:
        return np.concatenate([getattr(scores, name) for _, scores in of_variant])

    n = [len(scores.subject) for _, scores in of_variant]
    uncertainty, is_evaluated, oldest = (joined(x) for x in ("uncertainty", "is_evaluated", "oldest_evaluation_step"))
    n_evaluators = [s.n_evaluations if s.n_evaluators is None else s.n_evaluators for _, s in of_variant]
    rows = {
        "variant": np.repeat([v for v, _ in of_variant], n),
        "subject": joined("subject"),
        "trust": joined("trust"),
        "uncertainty": uncertainty,
        "uncertainty__valid": ~np.isnan(uncertainty),
        "weight": joined("weight"),
        "state": np.where(is_evaluated, LookupState.EVALUATED, LookupState.UNEVALUATED),
        **_evaluations_behind(
            n=joined("n_evaluations"),
            n_evaluators=np.concatenate(n_evaluators),
            newest_s=(now_step - joined("newest_evaluation_step")) * dt_s,
            oldest_s=np.where(oldest < 0, np.nan, (now_step - oldest) * dt_s),
            some=is_evaluated,
            counted=np.repeat([scores.n_evaluators is not None for _, scores in of_variant], n),
        ),
    }
    recorder.append("trust", now_step, rows)


def _lookups(
    recorder: TakesRows,
    now_step: int,
    receiver: Int[ndarray, "n"],
    subject: Int[ndarray, "n"],
    lookups: Sequence[Lookups],
) -> None:
    """Append look-ups of trust and their sums, sorted by variant and subject.

    Parameters
    ----------
    receiver, subject
        Per look-up, the actor number of the vehicle that looks up, and the pseudonym that it asks about.
    lookups
        Per trust variant, the answers, aligned with `receiver` and `subject`.
    """
    n, n_variants = len(receiver), len(lookups)
    nothing = np.zeros(n, np.int64)

    def joined(name: str) -> ndarray:
        columns = (getattr(found, name) for found in lookups)
        return np.concatenate([nothing if column is None else column for column in columns])

    answers = Lookups(*(joined(field.name) for field in fields(Lookups)))
    recorder.append("lookup_totals", now_step, _lookup_totals(answers, n_variants))
    order = stable_order(subject)
    first = n * np.arange(n_variants)  # row of the first answer of each variant
    found = answers.take((first[:, None] + order).ravel())
    rows = {
        "variant": np.repeat(np.arange(n_variants), n),
        "subject": np.tile(subject[order], n_variants),
        "receiver": np.tile(receiver[order], n_variants),
        "trust": found.trust,
        "source": found.source,
        "state": found.state,
        "age_s": found.age_s,
        "age_s__valid": ~found.is_default,
        **_evaluations_behind(
            n=found.n_evaluations,
            n_evaluators=np.asarray(found.n_evaluators),
            newest_s=found.newest_evaluation_age_s,
            oldest_s=found.oldest_evaluation_age_s,
            some=found.is_known,
            counted=np.repeat([one.n_evaluators is not None for one in lookups], n),
        ),
    }
    recorder.append("trust_lookups", now_step, rows)


def _lookup_totals(found: Lookups, n_variants: int) -> Rows:
    """Sums over the look-ups of a step by variant and state, without states that do not occur.

    `found` holds the look-ups of all variants, one variant after another.
    """
    n_states = len(LookupState)
    n_groups = n_variants * n_states
    variant = np.repeat(np.arange(n_variants), len(found.state) // n_variants)
    group = variant * n_states + found.state
    has_value, is_known = ~found.is_default, found.is_known

    def total(of: ndarray, weight: ndarray | None = None) -> ndarray:
        return np.bincount(group[of], None if weight is None else weight[of], n_groups)

    oldest_s = total(is_known, found.oldest_evaluation_age_s)
    rows = {
        "variant": np.repeat(np.arange(n_variants), n_states),
        "state": np.tile(np.arange(n_states), n_variants),
        "n": np.bincount(group, minlength=n_groups),
        "n_valued": total(has_value),
        "age_sum_s": total(has_value, found.age_s),
        "newest_evaluation_age_sum_s": total(is_known, found.newest_evaluation_age_s),
        "oldest_evaluation_age_sum_s": oldest_s,
        "oldest_evaluation_age_sum_s__valid": ~np.isnan(oldest_s),
    }
    occurs = rows["n"] > 0
    return {name: column[occurs] for name, column in rows.items()}


def _evaluations_behind(
    n: Int[ndarray, "n"],
    n_evaluators: Int[ndarray, "n"],
    newest_s: Float[ndarray, "n"],
    oldest_s: Float[ndarray, "n"],
    some: Bool[ndarray, "n"],
    counted: Bool[ndarray, "n"],
) -> Rows:
    """Columns about the evaluations behind trust values.

    `some` is true for values with at least one evaluation, `counted` where the number of evaluators is known. An oldest
    age that the model does not keep is NaN.
    """
    return {
        "n_evaluations": n,
        "n_evaluators": n_evaluators,
        "n_evaluators__valid": counted,
        "newest_evaluation_age_s": newest_s,
        "newest_evaluation_age_s__valid": some,
        "oldest_evaluation_age_s": oldest_s,
        "oldest_evaluation_age_s__valid": some & ~np.isnan(oldest_s),
    }


def _fused(recorder: TakesRows, world: World, sensed: Sensed) -> None:
    """Append the fused objects of every trust variant that fuses, and how many evaluations are behind them."""
    known = sensed.known
    listed, pseudonym = known.objects, known.pseudonym[known.detections.message]
    is_unit = world.is_roadside[sensed.sensing.row]
    for variant, fused in enumerate(sensed.fused()):
        if fused is None:
            continue
        ego, seed, pose = fused.ego, fused.seed, fused.pose
        is_of_other = pose != seed  # the pose is that of another detection than the seed of the group
        evidence = {
            "variant": np.array([variant]),
            "n_evaluations": np.array([fused.n_evaluations.sum()]),
            "n_evaluators": np.array([fused.n_evaluators.sum()]),
        }
        recorder.append("fused_evidence", world.step, evidence)
        rows: Rows = {
            "variant": np.full(len(ego), variant),
            "observer": sensed.sensing.actor[ego],
            "fused_index": place_in_group(ego),
            "score": fused.score,
            "n_sources": fused.n_sources,
            "ego_detected": fused.ego_detected,
            "source": pseudonym[seed],
            "source_index": listed.detection_index[seed],
            "pose": pseudonym[pose],
            "pose__valid": is_of_other,
            "pose_index": listed.detection_index[pose],
            "pose_index__valid": is_of_other,
            "fabricated": listed.origin[seed] == FABRICATED,
            "source_step": known.detection_step(seed),
            "pose_step": known.detection_step(pose),
            **_moved(sensed, fused),
        }
        recorder.append("fused", world.step, _without(is_unit[ego], rows))


def _early(recorder: TakesRows, world: World, sensed: Sensed) -> None:
    """Append the objects detected in merged point clouds, and the clouds that vehicles sent."""
    early = sensed.early
    if early is None:
        return
    ego, actor = early.ego, sensed.sensing.actor
    is_unit = world.is_roadside[sensed.sensing.row]
    objects = {
        "observer": actor[ego],
        "early_index": place_in_group(ego),
        "class": early.label,
        **box_columns(early.boxes),
        "score": early.score,
        "n_points": early.n_points,
        "n_sweeps": early.n_sweeps,
        "truth_actor": world.actor[early.actor_row],
        "truth_actor__valid": early.is_real,
        "truth_iou": early.iou,
        "truth_iou__valid": early.is_real,
    }
    recorder.append("early_fused", world.step, _without(is_unit[ego], objects))
    clouds = {
        "sender": actor,
        "n_points": early.offered.n_points,
        "length_bytes": early.offered.length_bytes,
        "n_sent": early.n_frames,
        "n_in_range": early.n_in_range,
        "n_received": early.n_received,
        "n_received_late": early.n_received_late,
    }
    recorder.append("clouds", world.step, clouds)


def _moved(sensed: Sensed, fused: Fused) -> Rows:
    """How far each box has been moved since it was sent, by its velocity and by fusion; no columns if none is."""
    known = sensed.known
    moved = np.zeros((len(fused.ego), 7))
    if known.moved_m is not None:
        moved[:, :2] = known.moved_m[fused.pose]
    if all(f is None or f.box is None for f in sensed.fused()):
        return {} if known.moved_m is None else {"moved_x_m": moved[:, 0], "moved_y_m": moved[:, 1]}
    if fused.box is not None:
        was = known.objects.boxes.take(fused.seed)
        moved += fused.box - np.column_stack([was.xyz_m, was.lwh_m, was.yaw_rad])
        moved[:, 6] = wrapped(moved[:, 6])
    names = box_columns(known.objects.boxes.take(fused.seed[:0]))
    return {f"moved_{name}": column for name, column in zip(names, moved.T, strict=True)}


def open_rows(state: State, parts: Parts, registry: ActorRegistry, end_step: int) -> dict[str, list[Columns]]:
    """Rows of encounters, pseudonyms and vehicles that are still open, by table, as if recording ended at `end_step`.

    Parameters
    ----------
    state
        State after the last step; it is not changed.
    parts
        Components of the run.
    registry
        All actors so far.
    end_step
        One past the last step.
    """
    split = [by_variant(tracker.close(end_step)) for tracker in copy.deepcopy(state.encounters)]
    return {
        "encounters": [base for base, _ in split],
        "encounter_trust": [others for _, others in split if others],
        "pseudonyms": [_pseudonym_rows(parts.pseudonyms.in_use(state.pseudonyms))],
        "vehicles": [vehicle_rows(registry, roles_of(parts.config.attacks), state.attack_start, parts.schedule)],
    }


def vehicle_rows(
    registry: ActorRegistry, role_of_attack: UInt8[ndarray, "a"], attack_start: AttackStartTracker, schedule: Schedule
) -> Columns:
    """Columns of the table `vehicles` for all actors.

    Parameters
    ----------
    registry
        All actors so far.
    role_of_attack
        Role by number of the attack; number 0 is that of vehicles without an attack.
    attack_start
        When each vehicle first attacked.
    schedule
        When each vehicle senses.
    """
    lwh, equipped = registry.lwh_m, registry.equipped & (registry.shape != Shape.ROADSIDE_UNIT)
    attack_start_step, attacked = attack_start.first_steps(len(registry))
    interval, phase = schedule.of_vehicles(registry.name_key)
    sensing: Rows = {
        "sensing_interval_steps": interval,
        "sensing_interval_steps__valid": equipped,
        "sensing_phase_steps": phase,
        "sensing_phase_steps__valid": equipped,
    }
    return {
        "vehicle": np.arange(len(registry), dtype=np.int32),
        "sumo_id": np.array(registry.names, object),
        "vehicle_class": registry.shape,
        "length_m": lwh[:, 0],
        "width_m": lwh[:, 1],
        "height_m": lwh[:, 2],
        "equipped": equipped,
        "role": role_of_attack[registry.attack],
        "role__valid": equipped,
        "attack": registry.attack.astype(np.int16) - 1,
        "attack__valid": equipped & (registry.attack > 0),
        "first_step": registry.first_step,
        "last_step": registry.last_step,
        "n_steps": registry.n_steps,
        "attack_start_step": attack_start_step,
        "attack_start_step__valid": attacked,
        **sensing,
    }
