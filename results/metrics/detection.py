"""What vehicles see and believe, against the truth: average precision, awareness, success of attacks."""

from typing import Literal

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from scipy.spatial import cKDTree

from results.archive import Run
from results.metrics.kitti import LEVELS, LOOSE, STRICT, Objects, Overlap, average_precision
from results.metrics.overlap import corners
from results.tables import CLASSES

Lists = Literal["local", "fused"]
"""Boxes of a vehicle's own sensor, or those it believes in the end."""

_TABLE: dict[Lists, str] = {"local": "detections", "fused": "fused"}

_BOX = ["x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad"]
_CLASS_OF_KIND = {
    "car": "car", "van": "car", "truck": "truck", "bus": "truck",
    "motorcycle": "cyclist", "bicycle": "cyclist", "pedestrian": "pedestrian",
}  # fmt: skip

FOCAL_PX = 960.0
"""Of the camera that KITTI's heights in pixels are meant for: 90 degrees on 1,920 pixels."""


def precision(
    run: Run,
    lists: tuple[Lists, ...] = ("local", "fused"),
    overlap: Overlap = "3d",
    loose: bool = False,
    range_m: float = 140.0,
    max_frames: int = 4000,
) -> pd.DataFrame:
    """Average precision by KITTI's rules, ranked over all frames together.

    A frame is what one equipped vehicle has ahead of it in one step: actors, and boxes, in its forward
    90 degrees up to `range_m`, itself left out.

    Parameters
    ----------
    loose
        KITTI's smaller limits of overlap (0.5 for cars, 0.25 for others) instead of 0.7 and 0.5.
    max_frames
        Steps are sampled evenly so that there are about this many frames.

    Returns
    -------
    boxes, class, level, ap11, ap40 (percent), n_truth, n_frames; classes that nobody met are left out.

    Notes
    -----
    Occlusion levels are those of Hurl et al.: more than 20 % hidden is 1, more than 50 % is 2; what no beam can
    reach is 3 and counts only at level "all". Truncation is not modelled: an object is in the picture with its
    centre or not at all.
    """
    run.require("actors", "sightings", *(_TABLE[which] for which in lists))
    steps = _sampled_steps(run, max_frames)
    truth, poses = _truth(run, steps, range_m)
    rows = []
    for which in lists:
        found = _found(run, which, steps, poses, range_m)
        for label in CLASSES:
            limit = (LOOSE if loose else STRICT)[label]
            if not (truth.label == label).any():
                continue
            answer = average_precision(truth, found, label, overlap, limit)
            rows += [
                {"boxes": which, "class": label, "level": level, "ap11": answer[level].ap11,
                 "ap40": answer[level].ap40, "n_truth": answer[level].n_truth, "n_frames": len(poses)}
                for level in LEVELS
            ]  # fmt: skip
    if not rows:
        raise ValueError(f"{run.path} holds no detections to judge: no equipped vehicle ever met anybody.")
    return pd.DataFrame(rows)


def awareness(
    run: Run, range_m: float = 70.0, ring_m: float = 10.0, min_score: float = 0.5, max_frames: int = 4000
) -> pd.DataFrame:
    """Share of the actors around an equipped vehicle that it knows of, by distance.

    Returns
    -------
    boxes, distance_m (middle of the ring), n_present, n_known, share. Known is an actor that a box of at
    least `min_score` is a true picture of.
    """
    steps = _sampled_steps(run, max_frames)
    poses, actors = _poses(run, steps)
    i, j = _near(poses, actors, range_m)
    around = pd.DataFrame({
        "step": poses.step.to_numpy()[i], "observer": poses.observer.to_numpy()[i], "actor": actors.actor.to_numpy()[j],
        "ring": np.hypot(*(poses[["x_m", "y_m"]].to_numpy()[i] - actors[["x_m", "y_m"]].to_numpy()[j]).T) // ring_m,
    })  # fmt: skip
    around = around[around.observer != around.actor]
    if around.empty:
        raise ValueError(f"{run.path}: no equipped vehicle ever had anybody within {range_m:g} m.")
    rows = []
    for which, table in _TABLE.items():
        good = (pc.field("score") >= min_score) & pc.field("truth_actor").is_valid() & _in(steps)
        columns = ["step", "observer", "truth_actor", *(["kind"] if which == "local" else [])]
        known = run.table(table, columns, where=good)
        if which == "local":
            known = known[known.kind == "sensed"]
        known = known[["step", "observer", "truth_actor"]].drop_duplicates().astype(np.int64)
        key = pd.MultiIndex.from_frame(around[["step", "observer", "actor"]])
        seen = key.isin(pd.MultiIndex.from_frame(known))
        counts = pd.DataFrame({"ring": around.ring, "known": seen}).groupby("ring").known.agg(["size", "sum"])
        rows.append(pd.DataFrame({
            "boxes": which, "distance_m": (counts.index + 0.5) * ring_m, "n_present": counts["size"],
            "n_known": counts["sum"], "share": counts["sum"] / counts["size"],
        }))  # fmt: skip
    return pd.concat(rows, ignore_index=True)


def attack_success(run: Run, min_score: float = 0.5) -> pd.DataFrame:
    """How many made-up boxes are believed.

    Returns
    -------
    One row: n_fabricated (boxes sent), n_believed (by at least one other vehicle, with at least `min_score`),
    share, and victims_mean: vehicles that believe a believed one.
    """
    run.require("detections", "fused")
    made = run.table(
        "detections", ["step", "observer", "k", "kind"], where=pc.field("said") & pc.field("truth_actor").is_null()
    )
    n_made = int((made.kind == "fabricated").sum())
    if not n_made:
        raise ValueError(f"{run.path} holds no attack: nobody made up a box. Raise fleet.malicious_p and run again.")
    believed = run.table(
        "fused", ["step", "observer", "source", "source_k"],
        where=pc.field("fabricated") & (pc.field("score") >= min_score),
    )  # fmt: skip
    victims = (
        believed[believed.observer != believed.source].groupby(["step", "source", "source_k"]).observer.nunique()
    )
    return pd.DataFrame([{
        "n_fabricated": n_made, "n_believed": len(victims), "share": len(victims) / n_made,
        "victims_mean": float(victims.mean()) if len(victims) else 0.0,
    }])  # fmt: skip


def _sampled_steps(run: Run, max_frames: int) -> np.ndarray:
    """Steps spread evenly over the run, with about `max_frames` equipped vehicles on the road in all."""
    spans = run.table("vehicles", ["equipped", "first_step", "last_step"])
    spans = spans[spans.equipped]
    n_frames = int((spans.last_step - spans.first_step + 1).sum())
    stride = max(1, -(-n_frames // max_frames))
    return np.arange(stride // 2, int(run.manifest["steps"]), stride)


def _in(steps: np.ndarray) -> pc.Expression:
    return pc.field("step").isin(steps.tolist())


def _poses(run: Run, steps: np.ndarray) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Equipped vehicles (step, observer, pose, frame number) and all actors (with size and class) in these steps."""
    actors = run.table("actors", ["step", "actor", "x_m", "y_m", "z_m", "yaw_rad"], where=_in(steps))
    vehicles = run.table("vehicles", ["vehicle", "kind", "length_m", "width_m", "height_m", "equipped"])
    vehicles["label"] = vehicles.kind.astype(object).map(_CLASS_OF_KIND)
    actors = actors.merge(vehicles.drop(columns="kind"), left_on="actor", right_on="vehicle").drop(columns="vehicle")
    actors = actors.sort_values(["step", "actor"], ignore_index=True)
    poses = actors[actors.equipped].rename(columns={"actor": "observer"}).reset_index(drop=True)
    return poses.assign(frame=np.arange(len(poses))), actors


def _near(poses: pd.DataFrame, actors: pd.DataFrame, range_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of an observer and an actor of the same step within range (horizontally), sorted."""
    if poses.empty:
        return np.zeros(0, int), np.zeros(0, int)
    steps = np.unique(actors.step)
    trees = [
        cKDTree(np.column_stack([f.x_m, f.y_m, np.searchsorted(steps, f.step) * (2.0 * range_m + 1)]))
        for f in (poses, actors)
    ]
    near = trees[0].sparse_distance_matrix(trees[1], range_m, output_type="ndarray")
    order = np.lexsort([near["j"], near["i"]])
    return near["i"][order], near["j"][order]


def _truth(run: Run, steps: np.ndarray, range_m: float) -> tuple[Objects, pd.DataFrame]:
    """Actors ahead of each equipped vehicle, and the poses that the frames are numbered by."""
    poses, actors = _poses(run, steps)
    i, j = _near(poses, actors, range_m)
    other = poses.observer.to_numpy()[i] != actors.actor.to_numpy()[j]
    i, j = i[other], j[other]
    box, ahead, height_px = _ahead(poses, i, actors[_BOX].to_numpy(np.float64)[j], range_m)
    i, j = i[ahead], j[ahead]
    seen = run.table("sightings", where=_in(steps)).set_index(["step", "observer", "actor"])
    key = pd.MultiIndex.from_arrays(
        [poses.step.to_numpy()[i], poses.observer.to_numpy()[i], actors.actor.to_numpy()[j]]
    )
    seen = seen.reindex(key)
    hidden = 1 - seen.n_points.to_numpy(np.float64) / np.maximum(seen.n_unoccluded.to_numpy(np.float64), 1)
    level = np.where(np.isnan(hidden), 3, (hidden > 0.2).astype(int) + (hidden > 0.5))
    label = actors.label.to_numpy(object)[j]
    return Objects(i, label, box[ahead], height_px[ahead], level, np.zeros(len(i)), np.ones(len(i))), poses


def _found(run: Run, which: Lists, steps: np.ndarray, poses: pd.DataFrame, range_m: float) -> Objects:
    """Boxes ahead of each equipped vehicle."""
    if which == "local":
        boxes = run.table("detections", ["step", "observer", "k", "class", *_BOX, "score", "kind"], where=_in(steps))
        boxes = boxes[boxes.kind == "sensed"]
    else:
        boxes = run.table("fused", ["step", "observer", "k", "class", *_BOX, "score"], where=_in(steps))
    frames = poses.set_index(["step", "observer"]).frame
    at = frames.reindex(pd.MultiIndex.from_frame(boxes[["step", "observer"]])).to_numpy(np.float64)
    boxes, at = boxes[~np.isnan(at)], at[~np.isnan(at)].astype(int)
    order = np.lexsort([boxes.k, at])
    boxes, at = boxes.iloc[order], at[order]
    box, ahead, height_px = _ahead(poses, at, boxes[_BOX].to_numpy(np.float64), range_m)
    n = int(ahead.sum())
    return Objects(
        at[ahead], boxes["class"].astype(object).to_numpy()[ahead], box[ahead], height_px[ahead],
        np.zeros(n, int), np.zeros(n), boxes.score.to_numpy(np.float64)[ahead],
    )  # fmt: skip


def _ahead(
    poses: pd.DataFrame, i: np.ndarray, box: np.ndarray, range_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes in the frames of their observers (x forward, y left), which lie in the field of view, heights in pixels."""
    eye = poses[["x_m", "y_m", "z_m", "yaw_rad", "height_m"]].to_numpy(np.float64)[i]
    eye[:, 2] += eye[:, 4] / 2  # on the roof
    cos, sin = np.cos(eye[:, 3]), np.sin(eye[:, 3])
    away = box[:, :3] - eye[:, :3]
    box = box.copy()
    box[:, 0], box[:, 1] = cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]
    box[:, 2], box[:, 6] = away[:, 2], box[:, 6] - eye[:, 3]
    ahead = (box[:, 0] > np.abs(box[:, 1])) & (np.hypot(box[:, 0], box[:, 1]) <= range_m)
    depth = np.maximum(corners(box)[..., 0], 0.5)  # the four upright edges
    top, bottom = (box[:, 2] + box[:, 5] / 2)[:, None], (box[:, 2] - box[:, 5] / 2)[:, None]
    height_px = FOCAL_PX * ((top / depth).max(axis=1) - (bottom / depth).min(axis=1))
    return box, ahead, height_px
