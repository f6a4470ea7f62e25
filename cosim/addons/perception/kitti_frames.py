"""Frames for average precision: the boxes ahead of one equipped vehicle in one step."""

from typing import Literal

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from numpy import ndarray

from cosim.addons.perception.kitti import LabelledObjects
from cosim.addons.perception.overlap import corners, within
from cosim.base.codes import BASE_VARIANT
from cosim.base.plane import turned_by, wrapped
from results.moments import at_steps
from results.run import Run
from results.sensing import interval_steps, sampling_stride, senses, sensing_steps

Lists = Literal["local", "fused", "early"]
"""Detections of a vehicle's own sensor, its fused objects, or what it detects in merged point clouds."""

TABLE_OF: dict[Lists, str] = {"local": "detections", "fused": "fused", "early": "early_fused"}
_INDEX_OF: dict[Lists, str] = {"local": "detection_index", "fused": "fused_index", "early": "early_index"}

BOX = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
_OBJECT_CLASS = {
    "car": "car",
    "van": "car",
    "truck": "truck",
    "bus": "truck",
    "motorcycle": "cyclist",
    "bicycle": "cyclist",
    "pedestrian": "pedestrian",
}

FOCAL_PX = 960.0
"""Of the camera that KITTI's heights in pixels are meant for: 90 degrees on 1,920 pixels."""

Poses = pd.DataFrame
"""Observers, the vehicles that sense in some steps: step, observer, its pose and size, frame (0, 1, ...)."""


def sampled_steps(run: Run, max_frames: int, observers: ndarray | None = None) -> ndarray:
    """Steps at equal distances over the run, with about `max_frames` frames (sweeps of equipped vehicles) in all.

    Parameters
    ----------
    observers
        As for `posed`.

    Returns
    -------
    Steps, ascending.
    """
    spans = run.table("vehicles", ["vehicle", "equipped", "first_step", "last_step"])
    counts = spans.equipped if observers is None else spans.equipped & spans.vehicle.isin(observers)
    spans, steps = spans[counts], sensing_steps(run)
    every = interval_steps(run, spans.vehicle.to_numpy(np.int64))
    n_frames = int(((spans.last_step - spans.first_step + 1).to_numpy() / every).sum())
    stride = sampling_stride(run, -(-n_frames // max_frames))
    return steps[stride // 2 :: stride]


def with_boxes(run: Run, lists: tuple[Lists, ...]) -> tuple[Lists, ...]:
    """The lists that the run's variant has.

    Only the base variant and variants that ask for it have fused objects. Only runs with `[early_fusion]` have early
    ones.
    """
    variants = run.config.get("trust_variant", [])
    fusing = {BASE_VARIANT} | {one["name"] for one in variants if one.get("fused")}
    fuses = run.variant in fusing
    merges = "early_fused" in run.tables and run.n_rows("early_fused") > 0
    return tuple(which for which in lists if {"fused": fuses, "early": merges}.get(which, True))


def posed(run: Run, steps: ndarray, observers: ndarray | None = None) -> tuple[Poses, pd.DataFrame]:
    """Observers and actors in some steps. An observer is a vehicle that senses in the step.

    Parameters
    ----------
    steps
        Steps in any order.
    observers
        Actor numbers; the observers are the equipped ones among them. Left out, they are all that sense.

    Returns
    -------
    Observers, each row with its frame, and all actors with size, `equipped` and class (`label`); both sorted by (step,
    actor).
    """
    actors = run.table("actors", ["step", "actor", "x_m", "y_m", "z_m", "yaw_rad"], where=at_steps(steps))
    vehicles = run.table("vehicles", ["vehicle", "vehicle_class", "length_m", "width_m", "height_m", "equipped"])
    vehicles["label"] = vehicles.vehicle_class.astype(object).map(_OBJECT_CLASS)
    actors = actors.merge(vehicles.drop(columns="vehicle_class"), left_on="actor", right_on="vehicle").drop(
        columns="vehicle"
    )
    actors = actors.sort_values(["step", "actor"], ignore_index=True)
    chosen = actors.equipped if observers is None else actors.equipped & actors.actor.isin(observers)
    chosen &= run.config.get("sensing", True)
    step, actor = actors[["step", "actor"]].to_numpy(np.int64).T
    chosen &= senses(run, step, actor)
    poses = actors[chosen].rename(columns={"actor": "observer"}).reset_index(drop=True)
    return poses.assign(frame=np.arange(len(poses))), actors


def observed_by_vehicle(run: Run, which: Lists, columns: list[str], where: pc.Expression) -> pd.DataFrame:
    """Rows of vehicles in the table of a list, with the actor number of the observer in place of its pseudonym."""
    frame = run.variant_table(TABLE_OF[which], columns, where)
    if which == "local" and len(frame):
        vehicle = frame.observer.map(run.subjects.vehicle)
        frame = frame.assign(observer=vehicle)[vehicle.notna()]  # roadside units are no subjects
    return frame


def near(poses: Poses, actors: pd.DataFrame, range_m: float) -> tuple[ndarray, ndarray]:
    """Pairs of an observer and an actor of the same step within a horizontal range. An observer is also near itself.

    Parameters
    ----------
    poses, actors
        As `posed` returns them.

    Returns
    -------
    Rows of `poses` and of `actors`, sorted by (row of `poses`, row of `actors`).
    """
    if poses.empty:
        return np.zeros(0, int), np.zeros(0, int)
    pose_m, actor_m = (frame[["x_m", "y_m"]].to_numpy() for frame in (poses, actors))
    i, j = within(poses.step.to_numpy(), pose_m, actors.step.to_numpy(), actor_m, range_m)
    order = np.lexsort([j, i])
    return i[order], j[order]


def pair_keys(poses: Poses, actors: pd.DataFrame, i: ndarray, j: ndarray) -> pd.MultiIndex:
    """Step, observer and actor of pairs of rows of `poses` and of `actors`."""
    keys = poses[["step", "observer"]].iloc[i]
    return pd.MultiIndex.from_frame(keys.assign(actor=actors.actor.to_numpy()[j]))


def others_near(poses: Poses, actors: pd.DataFrame, range_m: float) -> tuple[ndarray, ndarray]:
    """As `near`, of observers and other actors."""
    i, j = near(poses, actors, range_m)
    is_other = poses.observer.to_numpy()[i] != actors.actor.to_numpy()[j]
    return i[is_other], j[is_other]


def actors_ahead(
    run: Run, steps: ndarray, range_m: float, observers: ndarray | None = None
) -> tuple[LabelledObjects, Poses]:
    """Ground truth: the actors ahead of each observer.

    Parameters
    ----------
    steps, observers
        As for `posed`.

    Returns
    -------
    Actors in the frames of their observers, with score 1, truncation 0, and occlusion 3 (unknown) where the table
    `observability` does not hold the pair; and the observers.
    """
    poses, actors = posed(run, steps, observers)
    i, j, box, height_px = pairs_ahead(poses, actors, range_m)
    seen = run.table("observability", where=at_steps(steps)).set_index(["step", "observer", "actor"])
    seen = seen.reindex(pair_keys(poses, actors, i, j))
    n_points = seen.n_points.to_numpy(float)
    n_unoccluded = seen.n_unoccluded.to_numpy(float)
    hidden = 1 - n_points / np.maximum(n_unoccluded, 1)
    level = (hidden > 0.2).astype(int) + (hidden > 0.5)
    objects = LabelledObjects(
        frame=i,
        label=actors.label.to_numpy(object)[j],
        box=box,
        height_px=height_px,
        occlusion=np.where(np.isnan(hidden), 3, level),
        truncation=np.zeros(len(i)),
        score=np.ones(len(i)),
    )
    return objects, poses


def pairs_ahead(poses: Poses, actors: pd.DataFrame, range_m: float) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Pairs of an observer and another actor ahead of it within range.

    Parameters
    ----------
    poses, actors
        As `posed` returns them.

    Returns
    -------
    Row of the observer, row of the actor, and the actor's box and height as of `ahead_of`; sorted by the two rows.
    """
    i, j = others_near(poses, actors, range_m)
    world = actors[[*BOX]].to_numpy(float)[j]
    box, ahead, height_px = ahead_of(poses, i, world, range_m)
    return i[ahead], j[ahead], box[ahead], height_px[ahead]


def boxes_ahead(run: Run, which: Lists, steps: ndarray, poses: Poses, range_m: float) -> LabelledObjects:
    """Boxes in the list of each observer that lie ahead of it.

    Parameters
    ----------
    which
        The detections of its own sensor, its fused objects, or those in merged point clouds.
    steps
        Steps that are read.
    poses
        Observers. A box gets the frame of its observer; boxes of others are left out.

    Returns
    -------
    Boxes by frame, within a frame in the order of the list. The errors of the observer's own pose are undone.
    """
    index = _INDEX_OF[which]
    columns = ["step", "observer", index, "class", *BOX, "score"]
    if which != "local":
        where = at_steps(steps) & pc.field("observer").isin(poses.observer.unique().tolist())
    else:
        where = at_steps(steps) & (pc.field("origin") == "sensed")
    boxes = observed_by_vehicle(run, which, columns, where)
    frames = poses.set_index(["step", "observer"]).frame
    at = frames.reindex(pd.MultiIndex.from_frame(boxes[["step", "observer"]])).to_numpy(float)
    is_there = ~np.isnan(at)
    boxes, at = boxes[is_there], at[is_there].astype(int)
    order = np.lexsort([boxes[index], at])
    boxes, at = boxes.iloc[order], at[order]
    world = boxes[[*BOX]].to_numpy(float, copy=True)
    world = in_true_frame(world, poses, at, position_errors(run, poses))
    box, ahead, height_px = ahead_of(poses, at, world, range_m)
    n = int(ahead.sum())
    return LabelledObjects(
        frame=at[ahead],
        label=boxes["class"].astype(object).to_numpy()[ahead],
        box=box[ahead],
        height_px=height_px[ahead],
        occlusion=np.zeros(n, int),
        truncation=np.zeros(n),
        score=boxes.score.to_numpy(float)[ahead],
    )


def position_errors(run: Run, poses: Poses) -> ndarray:
    """Errors of each observer's estimate of its own pose: estimated minus true. Its boxes are displaced by them.

    Returns
    -------
    East [m], north [m] and heading [rad], one row per row of `poses`; 0 where the run has no errors.
    """
    if "position_errors" not in run.tables:
        return np.zeros((len(poses), 3))
    found = run.table("position_errors", where=at_steps(poses.step.unique())).set_index(["step", "vehicle"])
    found = found.reindex(pd.MultiIndex.from_frame(poses[["step", "observer"]]))
    return found[["error_x_m", "error_y_m", "error_yaw_rad"]].fillna(0.0).to_numpy(float)


def in_true_frame(boxes: ndarray, poses: Poses, i: ndarray, errors: ndarray) -> ndarray:
    """Boxes of the observers' estimated frames, placed where they are relative to the observers' true poses.

    Parameters
    ----------
    boxes
        x, y, z of the centre, length, width, height, yaw [n, 7].
    poses
        Observers.
    i
        Row of `poses` of each box's observer.
    errors
        As `position_errors` returns them.

    Returns
    -------
    The boxes [n, 7].
    """
    true_m = poses[["x_m", "y_m"]].to_numpy(float)[i]
    moved_m = boxes[:, :2] - errors[i, :2]
    yaw, turn = boxes[:, 6], errors[i, 2]
    turned_m = true_m + turned_by(-turn, moved_m - true_m)
    is_turned = turn != 0  # without an error of the heading, boxes keep every bit
    placed = boxes.copy()
    placed[:, :2] = np.where(is_turned[:, None], turned_m, moved_m)
    placed[:, 6] = np.where(is_turned, wrapped(yaw - turn), yaw)
    return placed


def ahead_of(
    poses: Poses,
    i: ndarray,
    box: ndarray,
    range_m: float,
) -> tuple[ndarray, ndarray, ndarray]:
    """World boxes as their observers have them.

    Parameters
    ----------
    poses
        Observers.
    i
        Row of `poses` of each box's observer.
    box
        x, y, z of the centre, length, width, height, yaw; world frame [n, 7].
    range_m
        Largest horizontal distance from the observer.

    Returns
    -------
    The boxes, x forward and y left of the middle of the observer's roof; whether each lies ahead (within 45 degrees of
    straight ahead) and within range; and their heights in the image [px].
    """
    eye = poses[["x_m", "y_m", "z_m", "yaw_rad", "height_m"]].to_numpy(float)[i]
    eye[:, 2] += eye[:, 4] / 2  # on the roof
    away = box[:, :3] - eye[:, :3]
    box = box.copy()
    box[:, :2] = turned_by(-eye[:, 3], away)
    box[:, 2] = away[:, 2]
    box[:, 6] -= eye[:, 3]
    forward, left = box[:, 0], box[:, 1]
    ahead = (forward > np.abs(left)) & (np.hypot(forward, left) <= range_m)
    depth = np.maximum(corners(box)[..., 0], 0.5)  # the four upright edges
    half_height = box[:, 5] / 2
    top = (box[:, 2] + half_height)[:, None] / depth
    bottom = (box[:, 2] - half_height)[:, None] / depth
    height_px = FOCAL_PX * (top.max(axis=1) - bottom.min(axis=1))
    return box, ahead, height_px
