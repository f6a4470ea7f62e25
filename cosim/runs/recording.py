"""Converts the result of a step to rows of the run's tables. It reads the result only."""

import copy
from collections.abc import Container, Mapping, Sequence
from dataclasses import fields
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.attacks.params import roles_of
from cosim.base.codes import EvaluationKind, LookupState, MessageType
from cosim.base.ragged import ptr_of, stable_order
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
from cosim.step.trackers.channel_counts import latency_histogram, pdr_by_distance, vehicle_channel
from cosim.step.tracking import late_of
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.schedule import Schedule
from cosim.world import World
from results.encounters import Rows, by_variant
from sensors.boxes import Boxes
from sensors.scene import Shape
from sensors.statistical_detector import wrap
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
    at = result.world.step
    actors(recorder, result.world)
    if result.reactions is not None:
        _reactions(recorder, at, result.reactions)
    encounters(recorder, at, result.encounters)
    pseudonyms(recorder, at, result.ended_pseudonyms)
    sensed = result.sensed
    if sensed is None:
        return
    _detections(recorder, result.world, sensed)
    _tracks(recorder, at, sensed)
    if "stated_accuracies" in recorder.tables:
        _stated_accuracies(recorder, at, sensed)
    _cpm_content(recorder, result.world, sensed)
    _channel(recorder, result.world, sensed)
    if "receptions" in recorder.tables:
        _receptions(recorder, at, sensed)
    _evaluations(recorder, at, sensed)
    _evidence(recorder, result.world, sensed)
    _trust(recorder, result.world, sensed, dt_s)
    _fused(recorder, result.world, sensed)
    _early(recorder, result.world, sensed)
    units = result.world.actor[result.world.is_roadside]
    for rows in sensed.attack_outcomes:
        recorder.append("attack_outcomes", at, _without(np.isin(rows["receiver"], units), rows))


def actors(recorder: TakesRows, world: World) -> None:
    """Append the poses of all actors on the road."""
    xyz, yaw = world.boxes.xyz_m, world.boxes.yaw_rad
    rows = {
        "actor": world.actor, "x_m": xyz[:, 0], "y_m": xyz[:, 1], "z_m": xyz[:, 2], "yaw_rad": yaw,
        "speed_mps": world.speed_mps,
    }  # fmt: skip
    recorder.append("actors", world.step, _without(world.is_roadside, rows))


def _without(left_out: Bool[ndarray, "n"], rows: Columns) -> Columns:
    """The rows that are not left out."""
    if not left_out.any():
        return rows
    return {name: None if column is None else column[~left_out] for name, column in rows.items()}


def _reactions(recorder: TakesRows, at: int, found: Reactions) -> None:
    why = found.commands.reasons
    assert why is not None, "reactions have reasons"
    recorder.append("reactions", at, {
        "vehicle": found.commands.actor, "source_step": why.source_step, "source": why.source,
        "source_index": why.source_index, "gap_m": why.gap_m, "speed_mps": found.commands.speed_mps,
        "deceleration_mps2": found.deceleration_mps2, "fabricated": found.fabricated,
        "truth_actor": found.truth_actor, "truth_actor__valid": found.is_real,
    })  # fmt: skip


def encounters(recorder: TakesRows, at: int, closed: Sequence[Rows]) -> None:
    """Append encounters that have ended; `closed` has one item per definition in the config."""
    for rows in closed:
        base, others = by_variant(rows)
        recorder.append("encounters", at, base)
        if others:
            recorder.append("encounter_trust", at, others)


def pseudonyms(recorder: TakesRows, at: int, ended: PseudonymUse) -> None:
    """Append pseudonyms that are no longer used."""
    recorder.append("pseudonyms", at, _pseudonym_rows(ended))


def _pseudonym_rows(used: PseudonymUse) -> Rows:
    return {
        "pseudonym": used.pseudonym, "vehicle": used.vehicle, "identity": used.identity,
        "from_step": used.from_step, "to_step": used.to_step, "refused_step": used.refused_step,
        "refused_step__valid": used.refused_step >= 0,
    }  # fmt: skip


def box_columns(boxes: Boxes) -> Rows:
    """Columns of boxes, by name."""
    x, y, z = boxes.xyz_m.T
    length, width, height = boxes.lwh_m.T
    return {
        "x_m": x, "y_m": y, "z_m": z, "length_m": length, "width_m": width, "height_m": height,
        "yaw_rad": boxes.yaw_rad,
    }  # fmt: skip


def _detections(recorder: TakesRows, world: World, sensed: Sensed) -> None:
    seen = sensed.positioned.observed.observability
    pseudonym = sensed.senders.pseudonym[sensed.listed.detections.message]
    recorder.append("detections", world.step, detection_columns(world, sensed.listed, pseudonym))
    if sensed.positioned.error is not None:
        x, y, heading = sensed.positioned.error.T
        recorder.append("position_errors", world.step, {
            "vehicle": sensed.vehicles.actor, "error_x_m": x, "error_y_m": y,
            **({"error_yaw_rad": heading} if heading.any() else {}),  # a draw is never exactly 0
        })  # fmt: skip
    n_dropped = sensed.listed.n_dropped
    faults = np.flatnonzero(n_dropped)
    recorder.append("dropped_detections", world.step, {"cause": faults, "n": n_dropped[faults]})
    recorder.append("observability", world.step, {
        "observer": sensed.sensing.actor[seen.observer], "actor": world.actor[seen.actor],
        "n_points": seen.n_returns, "n_unoccluded": seen.n_unoccluded,
    })  # fmt: skip


def detection_columns(world: World, listed: Listed | Known, pseudonym: Int[ndarray, "d"]) -> Rows:
    """Columns of the table `detections`; `pseudonym` is that of the observer of each detection."""
    objects, truth = listed.objects, listed.truth
    return {
        "observer": pseudonym, "detection_index": objects.detection_index,
        "class": objects.label, **box_columns(objects.boxes), "score": objects.score, "n_points": objects.n_points,
        "speed_mps": objects.speed_mps, "speed_mps__valid": ~np.isnan(objects.speed_mps),
        "acceleration_mps2": objects.acceleration_mps2,
        "acceleration_mps2__valid": ~np.isnan(objects.acceleration_mps2),
        "origin": objects.origin, "transmitted": objects.transmitted, "lied": truth.lied,
        "withheld": listed.withheld, "target": world.actor[objects.target],
        "target__valid": (objects.target != objects.observer) | truth.is_phantom,
        "truth_actor": world.actor[truth.actor_row], "truth_actor__valid": truth.is_real,
        "truth_iou": truth.iou, "truth_iou__valid": truth.is_real,
        "truth_occlusion": truth.occlusion, "truth_occlusion__valid": truth.is_sensed,
    }  # fmt: skip


def _tracks(recorder: TakesRows, at: int, sensed: Sensed) -> None:
    states, listed = sensed.listed.tracks, sensed.listed.objects
    if states is None:
        return
    moves = ~np.isnan(listed.velocity_mps).any(axis=1)
    tracked = listed.origin == SENSED
    rows = np.flatnonzero(tracked | moves)
    of_state, is_tracked = (np.cumsum(tracked) - 1).clip(0)[rows], tracked[rows]

    def from_state(values: ndarray) -> ndarray:
        return values[of_state] if len(values) else np.zeros(len(rows), values.dtype)

    x, y = listed.velocity_mps[rows].T
    recorder.append("tracks", at, {
        "observer": sensed.senders.pseudonym[sensed.listed.detections.message[rows]],
        "detection_index": listed.detection_index[rows],
        "object_id": from_state(states.object_id), "object_id__valid": is_tracked,
        "age_s": from_state(states.age_s), "age_s__valid": is_tracked,
        "velocity_x_mps": x, "velocity_x_mps__valid": moves[rows],
        "velocity_y_mps": y, "velocity_y_mps__valid": moves[rows],
        "existence_p": from_state(states.existence_p), "existence_p__valid": is_tracked,
    })  # fmt: skip


def _stated_accuracies(recorder: TakesRows, at: int, sensed: Sensed) -> None:
    stated = sensed.listed.objects
    if not stated.variance_m2.any():  # exact poses, or matching that asks for no accuracy
        return
    recorder.append("stated_accuracies", at, {
        "observer": sensed.senders.pseudonym[sensed.listed.detections.message],
        "detection_index": stated.detection_index, **_position_std("", stated.variance_m2),
        **_position_std("relative_", stated.relative_m2),
        "speed_std_mps": np.sqrt(stated.velocity_variance), "yaw_std_rad": np.sqrt(stated.heading_variance),
        "size_std": np.sqrt(stated.size_variance),
    })  # fmt: skip


def _position_std(name: str, variance_m2: Float[ndarray, "d 3"]) -> Rows:
    """Columns of the standard deviations and the correlation of positions, from variances xx, xy, yy."""
    xx, xy, yy = variance_m2.T
    x_std_m, y_std_m = np.sqrt(xx), np.sqrt(yy)
    both = x_std_m * y_std_m
    correlation = np.divide(xy, both, out=np.zeros(len(both)), where=both > 0)
    return {f"{name}x_std_m": x_std_m, f"{name}y_std_m": y_std_m, f"{name}xy_correlation": correlation}


def _cpm_content(recorder: TakesRows, world: World, sensed: Sensed) -> None:
    listed, content, n = sensed.listed, sensed.listed.content, len(sensed.senders)
    message, is_self, length = listed.detections.message, listed.objects.origin == SELF, sensed.rounds[0].length_bytes
    counts = np.bincount(
        (message * len(Inclusion) + content.inclusion)[~is_self], minlength=n * len(Inclusion)
    ).reshape(n, len(Inclusion))  # fmt: skip
    is_unit = world.is_roadside[sensed.vehicles.row[sensed.senders.vehicle]]
    recorder.append("cpm_content", world.step, _without(is_unit, {
        "sender": sensed.senders.pseudonym, "length_bytes": length,
        "n_objects": counts.sum(axis=1) - counts[:, Inclusion.WITHHELD],
        **{column: counts[:, inclusion] for column, inclusion in INCLUSIONS.items()},
        "self_report": np.bincount(message[is_self & content.included], minlength=n) > 0,
        "sensors": content.has_sensors & (length > 0),
    }))  # fmt: skip


def _channel(recorder: TakesRows, world: World, sensed: Sensed) -> None:
    n, at = len(sensed.vehicles), world.step
    received = []
    for message_type, kind, reach in zip(MessageType, RoundKind, sensed.reach, strict=True):
        broadcast, late = sensed.rounds[kind], late_of(sensed.rounds, kind)
        cbr = broadcast.round.frames.cbr
        frames = [broadcast.round.frames, *(messages.round.frames for messages in late)]
        outcomes = _joined(frames, ("distance_m", "los_state", "outcome"))
        decided = outcomes["outcome"] != Outcome.WAITING  # a frame counts when it is sent or expires
        if not decided.all():
            rows_decided = np.flatnonzero(decided)
            outcomes = {name: column.take(rows_decided) for name, column in outcomes.items()}
        by_distance, total = pdr_by_distance(**outcomes, columns=OUTCOMES)
        recorder.append("radio", at, _of(message_type, {
            "n_sent": np.array([sum(one.n_transmissions.sum() for one in frames)]),
            "n_relayed": np.array([sum(one.n_relayed for one in frames)]),
            "n_duplicate": np.array([sum(one.n_duplicate for one in frames)]),
            "sent_bytes": np.array([sum(one.sent_bytes for one in frames)]), **total,
            "cbr": None if cbr is None else np.array([cbr[:n].mean()]),
        }))  # fmt: skip
        found = [broadcast.links.vehicles, *(messages.links.vehicles for messages in late)]
        received += [one.receiver for one in found]
        latency_s = np.concatenate([one.latency_s for one in found])
        recorder.append("pdr_by_distance", at, _of(message_type, by_distance))
        recorder.append("latency_histogram", at, _of(message_type, latency_histogram(latency_s)))
        recorder.append("packet_inter_reception", at, _of(message_type, reach.inter_reception))
    rows = {"vehicle": sensed.vehicles.actor} | vehicle_channel(
        n, [reach.n_in_range for reach in sensed.reach], received,
        [broadcast.round.frames.cbr for broadcast in sensed.rounds],
    )  # fmt: skip
    recorder.append("vehicle_channel", at, _without(world.is_roadside[sensed.vehicles.row], rows))


def _of(message_type: MessageType, rows: Mapping[str, ndarray | None]) -> dict[str, ndarray | None]:
    n = next(len(values) for values in rows.values() if values is not None)
    return {"message_type": np.full(n, message_type), **rows}


def _joined(parts: Sequence[FrameOutcomes], names: Sequence[str]) -> dict[str, ndarray]:
    """These columns of several rounds, one after another."""
    if len(parts) == 1:
        return {name: getattr(parts[0], name) for name in names}
    return {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}


def _receptions(recorder: TakesRows, at: int, sensed: Sensed) -> None:
    for message_type, kind in zip(MessageType, RoundKind, strict=True):
        found = sensed.rounds[kind].links.vehicles
        senders = [sensed.senders.pseudonym[found.message]]
        steps, parts = [np.full(len(found.message), at)], [found]
        for late in late_of(sensed.rounds, kind):
            pseudonym = late_pseudonyms(late, sensed.carried)
            known = late.links.vehicles.take(pseudonym[late.links.vehicles.message] >= 0)
            senders.append(pseudonym[known.message])
            steps.append(late.step[known.message])
            parts.append(known)
        found, sender, step = Receptions.concat(parts), np.concatenate(senders), np.concatenate(steps)
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
        recorder.append("receptions", at, _of(message_type, rows))


def _first_copies(sender: Int[ndarray, "n"], step: Int[ndarray, "n"], found: Receptions) -> Int[ndarray, "k"]:
    """Rows of the first reception of each message at each receiver: a sender may send copies, and they may be late."""
    order = np.argsort(found.latency_s, kind="stable")
    for key in (found.receiver, step, sender):
        order = order.take(stable_order(key.take(order)))
    same = np.zeros(len(order), bool)
    same[1:] = True
    for key in (found.receiver, step, sender):
        same[1:] &= np.diff(key.take(order)) == 0
    is_first = np.ones(len(order), bool)
    is_first[order[same]] = False
    return np.flatnonzero(is_first)


def _evaluations(recorder: TakesRows, at: int, sensed: Sensed) -> None:
    evaluated, known = sensed.evaluated, sensed.known
    lists, reported, detections = evaluated.lists, evaluated.reported, sensed.known.detections
    by, member = lists.of_member(), lists.member
    rows: Rows = {
        "evaluator": known.pseudonym[lists.owner[by]], "observer": known.pseudonym[detections.message[member]],
        "detection_index": detections.detection_index[member], "evaluation": reported.evaluation,
        "visibility": reported.visibility, "n_points": evaluated.n_points, "plausible": evaluated.plausible,
        "plausible__valid": ~evaluated.matched, "matched": evaluated.matched, "lied": evaluated.lied,
        "detection_step": known.detection_step(member),
    }  # fmt: skip
    if evaluated.number is not None:
        rows["detection_index"], rows["kind"] = np.divmod(evaluated.number, len(EvaluationKind))
        rows["plausible__valid"] = (rows["kind"] == EvaluationKind.DETECTION) & ~evaluated.matched
    new = np.flatnonzero(known.is_new(sensed.senders.source[lists.owner[by]], member))
    recorder.append("evaluations", at, {name: column.take(new) for name, column in rows.items()})
    if "transmitted_evaluations" in recorder.tables:
        _transmitted(recorder, at, sensed)


def _transmitted(recorder: TakesRows, at: int, sensed: Sensed) -> None:
    sent, own = sensed.evaluated.sent, sensed.evaluated.kept_messages
    number: Rows = {"detection_index": sent.detection_index}
    if sensed.evaluated.number is not None:
        number["detection_index"], number["kind"] = np.divmod(sent.detection_index, len(EvaluationKind))
    recorder.append("transmitted_evaluations", at, {
        "evaluator": np.repeat(sent.evaluator, np.diff(sent.ptr)), "observer": sent.observer, **number,
        "evaluation": sent.evaluation, "visibility": sent.visibility,
        "own_evaluation": own.evaluation, "own_visibility": own.visibility,
        "detection_step": sent.detection_step,
    })  # fmt: skip
    detections, chosen = sensed.listed.detections, sensed.listed.objects.transmitted
    recorder.append("transmitted_scores", at, {
        "observer": sensed.senders.pseudonym[detections.message[chosen]],
        "detection_index": detections.detection_index[chosen], "score": detections.score[chosen],
    })  # fmt: skip


def _evidence(recorder: TakesRows, world: World, sensed: Sensed) -> None:
    known, (lists, _, reported) = sensed.known, sensed.evaluated.of_detections()
    evaluator = lists.owner[lists.of_member()]
    is_new = known.is_new(sensed.senders.source[evaluator], lists.member)
    rows = np.flatnonzero(is_new)
    evaluations = evidence_audit.AuditedEvaluations(
        evaluator=evaluator[rows],
        detection=lists.member[rows],
        evaluation=reported.evaluation[rows],
        visibility=reported.visibility[rows],
    )
    detections = evidence_audit.AuditedDetections(
        message=known.detections.message,
        actor=known.truth.actor_row,
        is_real=known.truth.is_real,
        is_fabricated=known.objects.origin == FABRICATED,
    )
    attacks = world.attack[sensed.vehicles.row[known.vehicle]] > 0
    n_copies = sum(broadcast.round.frames.n_duplicate for broadcast in sensed.rounds)
    recorder.append("evidence", world.step, evidence_audit.audit(evaluations, detections, attacks, n_copies))


def _trust(recorder: TakesRows, world: World, sensed: Sensed, dt_s: float) -> None:
    used = sensed.looked_up.messages
    receiver, subject = sensed.sensing.actor[used.receiver], sensed.known.pseudonym[used.message]
    lookups = sensed.looked_up.lookups
    # Several messages of one sender may be in use; its trust is looked up once.
    _, once = np.unique(receiver.astype(np.int64) << 32 | subject, return_index=True)
    receiver, subject, lookups = receiver[once], subject[once], [found.take(once) for found in lookups]
    published, units = list(sensed.published), world.is_roadside[sensed.vehicles.row]
    if units.any():  # the tables of trust are about vehicles
        actor, own = sensed.vehicles.actor[units], sensed.vehicles.pseudonym[units]
        between = np.flatnonzero(~np.isin(receiver, actor) & ~np.isin(subject, own))
        receiver, subject, lookups = receiver[between], subject[between], [found.take(between) for found in lookups]
        published = [None if s is None else s.take(np.flatnonzero(~np.isin(s.subject, own))) for s in published]
    trust(recorder, world.step, dt_s, published, sensed.servers, receiver, subject, lookups)


def trust(
    recorder: TakesRows, at: int, dt_s: float, published: Sequence[TrustScores | None],
    servers: Sequence[ServerTraffic | None], receiver: Int[ndarray, "n"], subject: Int[ndarray, "n"],
    lookups: Sequence[Lookups],
) -> None:  # fmt: skip
    """Append the tables of trust for one step.

    Parameters
    ----------
    recorder
        Takes the rows.
    at
        Number of the step.
    dt_s
        Length of a step [s].
    published
        Per trust variant, the values that its server computed in this step; None if it computed none.
    servers
        Per trust variant, the traffic from and to its server; None if it has no server.
    receiver, subject
        Per lookup, the actor number of the vehicle that looks up, and the pseudonym that it asks about.
    lookups
        Per trust variant, the answers, aligned with `receiver` and `subject`.
    """
    _published(recorder, at, dt_s, [(v, scores) for v, scores in enumerate(published) if scores is not None])
    of_server = [(v, server) for v, server in enumerate(servers) if server is not None]
    counts = {name: np.array([getattr(server.up, name) for _, server in of_server], np.int64) for name in _UP}
    counts |= {name: np.array([getattr(server.down, name) for _, server in of_server], np.int64) for name in _DOWN}
    recorder.append("server", at, {"variant": np.array([v for v, _ in of_server], np.int64)} | counts)
    _lookups(recorder, at, receiver, subject, lookups)


def _published(recorder: TakesRows, at: int, dt_s: float, of_variant: Sequence[tuple[int, TrustScores]]) -> None:
    """Append the rows of all variants, one variant after another."""
    if not of_variant:
        return

    def joined(name: str) -> ndarray:
        return np.concatenate([getattr(scores, name) for _, scores in of_variant])

    n = [len(scores.subject) for _, scores in of_variant]
    uncertainty, is_evaluated = joined("uncertainty"), joined("is_evaluated")
    evaluators = [scores.n_evaluations if (m := scores.n_evaluators) is None else m for _, scores in of_variant]
    recorder.append("trust", at, {
        "variant": np.repeat([v for v, _ in of_variant], n), "subject": joined("subject"), "trust": joined("trust"),
        "uncertainty": uncertainty, "uncertainty__valid": ~np.isnan(uncertainty),
        "weight": joined("weight"), "state": np.where(is_evaluated, LookupState.EVALUATED, LookupState.UNEVALUATED),
        **_evaluations_behind(
            joined("n_evaluations"), np.concatenate(evaluators), (at - joined("newest_evaluation_step")) * dt_s,
            (at - joined("oldest_evaluation_step")) * dt_s, is_evaluated,
            np.repeat([scores.n_evaluators is not None for _, scores in of_variant], n),
        ),
    })  # fmt: skip


_UP = ("n_reports", "n_reached", "n_lost", "n_late", "n_over_capacity", "n_outage", "uplink_bytes")
_DOWN = ("n_addressed", "n_informed")


def _lookups(
    recorder: TakesRows, at: int, receiver: Int[ndarray, "n"], subject: Int[ndarray, "n"], lookups: Sequence[Lookups]
) -> None:
    """Append the rows of all variants, sorted by variant and subject."""
    n, n_variants = len(receiver), len(lookups)
    counted = np.repeat([found.n_evaluators is not None for found in lookups], n)
    nothing = np.zeros(n, np.int64)
    whole = Lookups(*(
        np.concatenate([nothing if (column := getattr(found, f.name)) is None else column for found in lookups])
        for f in fields(Lookups)
    ))  # fmt: skip
    recorder.append("lookup_totals", at, _lookup_totals(whole, n_variants))
    order = stable_order(subject)
    found = whole.take((np.arange(n_variants)[:, None] * n + order).ravel())
    recorder.append("trust_lookups", at, {
        "variant": np.repeat(np.arange(n_variants), n), "subject": np.tile(subject[order], n_variants),
        "receiver": np.tile(receiver[order], n_variants), "trust": found.trust, "source": found.source,
        "state": found.state, "age_s": found.age_s, "age_s__valid": ~found.is_default,
        **_evaluations_behind(
            found.n_evaluations, np.asarray(found.n_evaluators), found.newest_evaluation_age_s,
            found.oldest_evaluation_age_s, found.is_known, counted,
        ),
    })  # fmt: skip


def _lookup_totals(found: Lookups, n_variants: int) -> Rows:
    """Sums over the lookups of a step by variant and state, without states that do not occur.

    `found` holds the lookups of all variants, one variant after another.
    """
    n_states = len(LookupState)
    group = np.repeat(np.arange(n_variants), len(found.state) // n_variants) * n_states + found.state
    valued, known = ~found.is_default, found.is_known

    def total(of: ndarray, weight: ndarray | None = None) -> ndarray:
        return np.bincount(group[of], None if weight is None else weight[of], n_variants * n_states)

    rows = {
        "variant": np.repeat(np.arange(n_variants), n_states), "state": np.tile(np.arange(n_states), n_variants),
        "n": np.bincount(group, minlength=n_variants * n_states), "n_valued": total(valued),
        "age_sum_s": total(valued, found.age_s),
        "newest_evaluation_age_sum_s": total(known, found.newest_evaluation_age_s),
        "oldest_evaluation_age_sum_s": total(known, found.oldest_evaluation_age_s),
    }  # fmt: skip
    there = rows["n"] > 0
    return {name: column[there] for name, column in rows.items()}


def _evaluations_behind(
    n: Int[ndarray, "n"], n_evaluators: Int[ndarray, "n"], newest_s: Float[ndarray, "n"],
    oldest_s: Float[ndarray, "n"], some: Bool[ndarray, "n"], counted: Bool[ndarray, "n"],
) -> Rows:  # fmt: skip
    """Columns about the evaluations behind trust values.

    `some` is true for values with at least one evaluation, `counted` where the number of evaluators is known.
    """
    return {
        "n_evaluations": n, "n_evaluators": n_evaluators, "n_evaluators__valid": counted,
        "newest_evaluation_age_s": newest_s, "newest_evaluation_age_s__valid": some,
        "oldest_evaluation_age_s": oldest_s, "oldest_evaluation_age_s__valid": some,
    }  # fmt: skip


def _fused(recorder: TakesRows, world: World, sensed: Sensed) -> None:
    known = sensed.known
    listed, pseudonym = known.objects, known.pseudonym[known.detections.message]
    for variant, fused in enumerate(sensed.fused):
        if fused is None:
            continue
        ego, moved = fused.ego, fused.pose != fused.seed
        recorder.append("fused_evidence", world.step, {
            "variant": np.array([variant]), "n_evaluations": np.array([fused.n_evaluations.sum()]),
            "n_evaluators": np.array([fused.n_evaluators.sum()]),
        })  # fmt: skip
        rows: Rows = {
            "variant": np.full(len(ego), variant), "observer": sensed.sensing.actor[ego],
            "fused_index": np.arange(len(ego)) - ptr_of(ego, len(sensed.sensing))[ego],
            "score": fused.score, "n_sources": fused.n_sources, "ego_detected": fused.ego_detected,
            "source": pseudonym[fused.seed], "source_index": listed.detection_index[fused.seed],
            "pose": pseudonym[fused.pose], "pose__valid": moved,
            "pose_index": listed.detection_index[fused.pose], "pose_index__valid": moved,
            "fabricated": listed.origin[fused.seed] == FABRICATED,
            "source_step": known.detection_step(fused.seed), "pose_step": known.detection_step(fused.pose),
            **_moved(sensed, fused),
        }  # fmt: skip
        recorder.append("fused", world.step, _without(world.is_roadside[sensed.sensing.row[ego]], rows))


def _early(recorder: TakesRows, world: World, sensed: Sensed) -> None:
    early = sensed.early
    if early is None:
        return
    ego, actor, is_unit = early.ego, sensed.sensing.actor, world.is_roadside[sensed.sensing.row]
    recorder.append("early_fused", world.step, _without(is_unit[ego], {
        "observer": actor[ego], "early_index": np.arange(len(ego)) - ptr_of(ego, len(actor))[ego],
        "class": early.label, **box_columns(early.boxes), "score": early.score, "n_points": early.n_points,
        "n_sweeps": early.n_sweeps, "truth_actor": world.actor[early.actor_row], "truth_actor__valid": early.is_real,
        "truth_iou": early.iou, "truth_iou__valid": early.is_real,
    }))  # fmt: skip
    recorder.append("clouds", world.step, {
        "sender": actor, "n_points": early.offered.n_points, "length_bytes": early.offered.length_bytes,
        "n_sent": early.n_frames, "n_in_range": early.n_in_range, "n_received": early.n_received,
    })  # fmt: skip


def _moved(sensed: Sensed, fused: Fused) -> Rows:
    """How far each box has been moved since it was sent, by its velocity and by fusion; no columns if none is."""
    known = sensed.known
    moved = np.zeros((len(fused.ego), 7))
    if known.moved_m is not None:
        moved[:, :2] = known.moved_m[fused.pose]
    if all(f is None or f.box is None for f in sensed.fused):
        return {} if known.moved_m is None else {"moved_x_m": moved[:, 0], "moved_y_m": moved[:, 1]}
    if fused.box is not None:
        was = known.objects.boxes.take(fused.seed)
        moved += fused.box - np.column_stack([was.xyz_m, was.lwh_m, was.yaw_rad])
        moved[:, 6] = wrap(moved[:, 6])
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
        "sensing_interval_steps": interval, "sensing_interval_steps__valid": equipped,
        "sensing_phase_steps": phase, "sensing_phase_steps__valid": equipped,
    }  # fmt: skip
    return {
        "vehicle": np.arange(len(registry), dtype=np.int32), "sumo_id": np.array(registry.names, object),
        "vehicle_class": registry.shape, "length_m": lwh[:, 0], "width_m": lwh[:, 1], "height_m": lwh[:, 2],
        "equipped": equipped, "role": role_of_attack[registry.attack], "role__valid": equipped,
        "attack": registry.attack.astype(np.int16) - 1, "attack__valid": equipped & (registry.attack > 0),
        "first_step": registry.first_step, "last_step": registry.last_step,
        "attack_start_step": attack_start_step, "attack_start_step__valid": attacked, **sensing,
    }  # fmt: skip
