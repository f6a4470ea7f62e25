"""Converts the result of a step to rows of the run's tables.

This is the last stage of a step: `cosim.runs.drive` calls `step` with what all stages have computed, and the recorder
writes the rows to the run folder. `results/TABLES.md` says what each column means. A function named `TABLE_rows` gives
the rows of one table. The others append rows to several tables. Rows of messages are in `channel_rows`, those of
evaluations and trust in `trust_rows`. Nothing here changes the result.

A column `NAME__valid` says in which rows `NAME` has a value. In the other rows the table has null.
"""

import copy
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.attacks.params import roles_of
from cosim.base.plane import wrapped
from cosim.base.ragged import place_in_group
from cosim.messages.content import FABRICATED, SENSED
from cosim.messages.pseudonyms import PseudonymUse
from cosim.runs import channel_rows, trust_rows
from cosim.runs.rows import Columns, TakesRows, without
from cosim.step.known import Known
from cosim.step.listing import Listed
from cosim.step.parts import Parts
from cosim.step.reactions import Reactions
from cosim.step.result import Sensed, StepResult
from cosim.step.state import State
from cosim.step.trackers.attack_start import AttackStartTracker
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.schedule import Schedule
from cosim.world import World
from results.encounters import Rows, by_variant
from sensors.boxes import Boxes
from sensors.scene import Shape
from sensors.tracking.tracks import ObjectStates
from trust.fusion import Fused


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
    recorder.append("cpm_content", now_step, channel_rows.cpm_content_rows(world, sensed))
    channel_rows.channel(recorder, world, sensed)
    if "receptions" in recorder.tables:
        channel_rows.receptions(recorder, now_step, sensed)
    recorder.append("evaluations", now_step, trust_rows.evaluation_rows(sensed))
    if "transmitted_evaluations" in recorder.tables:
        trust_rows.transmitted(recorder, now_step, sensed)
    recorder.append("evidence", now_step, trust_rows.evidence_rows(world, sensed))
    trust_rows.trust(recorder, world, sensed, dt_s)
    _fused(recorder, world, sensed)
    _early(recorder, world, sensed)
    units = world.actor[world.is_roadside]
    for rows in sensed.attack_outcomes():
        recorder.append("attack_outcomes", now_step, without(np.isin(rows["receiver"], units), rows))


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
    recorder.append("actors", world.step, without(world.is_roadside, rows))


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
    recorder.append("detections", now_step, detection_columns(world, sensed.listed, sensed.observer()))
    if positioned.error is not None:
        x, y, heading = positioned.error.T
        errors: Rows = {"vehicle": sensed.vehicles.actor, "error_x_m": x, "error_y_m": y}
        if heading.any():  # a draw is never exactly 0, so all are 0 if headings have no errors
            errors["error_yaw_rad"] = heading
        units = world.is_roadside[sensed.vehicles.row]  # they know where they stand
        recorder.append("position_errors", now_step, without(units, errors))
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
        "observer": sensed.observer()[rows],
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
        "observer": sensed.observer(),
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
        recorder.append("fused", world.step, without(is_unit[ego], rows))


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
    recorder.append("early_fused", world.step, without(is_unit[ego], objects))
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
