"""Detections and fused objects against ground truth: average precision, awareness."""

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Int
from numpy import ndarray

from cosim.addons.perception.kitti import FEWEST, LOOSE, STRICT, Overlap, average_precision
from cosim.addons.perception.kitti_frames import (
    TABLE_OF,
    Lists,
    actors_ahead,
    at_steps,
    boxes_ahead,
    near,
    observed_by_vehicle,
    posed,
    sampled_steps,
    with_boxes,
)
from cosim.addons.perception.measures.frames import range_of
from cosim.base.codes import ObjectClass, labels
from results.metrics.trust import HONEST
from results.run import Run

CLASSES = labels(ObjectClass)


def precision(
    run: Run,
    lists: tuple[Lists, ...] = tuple(TABLE_OF),
    overlap: Overlap = "3d",
    loose: bool = False,
    range_m: float = 140.0,
    max_frames: int = 4000,
    nearest_m: float = 0.0,
) -> pd.DataFrame:
    """Average precision by KITTI's rules, ranked over all frames together.

    A frame holds what is ahead of one honest vehicle in one step: actors, and boxes, in its forward
    90 degrees up to `range_m`, itself left out. The lists of others contain what they fabricate.

    Parameters
    ----------
    loose
        KITTI's smaller limits of overlap (0.5 for cars and trucks, 0.25 for others) instead of 0.7 and 0.5.
    max_frames
        Steps are sampled evenly so that there are about this many frames.
    nearest_m
        Actors and boxes that are nearer to the vehicle do not count.

    Returns
    -------
    boxes, class, level, ap11, ap40 (percent), n_truth, n_frames; classes without an object are left out.

    Notes
    -----
    Occlusion levels are those of Hurl et al.: more than 20 % hidden is 1, more than 50 % is 2; what no beam can
    reach is 3 and counts only at level "all". Truncation is not modelled: an object is in the picture with its
    centre or not at all.
    """
    lists = with_boxes(run, lists)
    run.require("actors", "observability", *(TABLE_OF[which] for which in lists))
    honest = _honest(run)
    steps = sampled_steps(run, max_frames, honest)
    truth, poses = actors_ahead(run, steps, range_m, honest)
    truth = truth.take(range_of(truth) >= nearest_m)
    answers = []
    for which in lists:
        found = boxes_ahead(run, which, steps, poses, range_m)
        found = found.take(range_of(found) >= nearest_m)
        for label in CLASSES:
            limit = (LOOSE if loose else STRICT)[label]
            if not (truth.label == label).any():
                continue
            answer = average_precision(truth, found, label, overlap, limit)
            answers += [
                {
                    "boxes": which,
                    "class": label,
                    "level": level,
                    "ap11": one.ap11,
                    "ap40": one.ap40,
                    "n_truth": one.n_truth,
                    "n_frames": len(poses),
                }
                for level, one in answer.items()
            ]
    if not answers:
        where = f"{nearest_m:g} to {range_m:g} m ahead of it"
        raise run.lacks("detections to rank", f"no honest vehicle ever had an actor {where}.")
    return pd.DataFrame(answers)


def _honest(run: Run) -> Int[ndarray, "k"]:
    """Actor numbers of the honest vehicles."""
    subjects = run.subjects
    return subjects.vehicle[subjects.role == HONEST].unique()


def ranked(run: Run, max_frames: int = 4000) -> pd.DataFrame:
    """The rows of `precision` with enough objects to rank."""
    found = precision(run, max_frames=max_frames)
    return found[found.n_truth >= FEWEST]


def awareness_total(run: Run, max_frames: int = 4000) -> pd.DataFrame:
    """Environmental awareness over all distances up to 70 m: boxes, share."""
    known = awareness(run, max_frames=max_frames).groupby("boxes")[["n_known", "n_present"]].sum()
    return (known.n_known / known.n_present).rename("share").reset_index()


_BIN_M = 10.0
"""Width of the bins of distance."""


def awareness(
    run: Run,
    range_m: float = 70.0,
    min_score: float = 0.5,
    max_frames: int = 4000,
) -> pd.DataFrame:
    """Environmental awareness: share of the actors around an honest vehicle that are in its list, by distance.

    Returns
    -------
    boxes, distance_m (middle of the bin), n_present, n_known, share. An actor is known where a box of at
    least `min_score` is really its.
    """
    honest = _honest(run)
    steps = sampled_steps(run, max_frames, honest)
    poses, actors = posed(run, steps, honest)
    i, j = near(poses, actors, range_m)
    own_m = poses[["x_m", "y_m"]].to_numpy()[i]
    away_m = own_m - actors[["x_m", "y_m"]].to_numpy()[j]
    around = pd.DataFrame(
        {
            "step": poses.step.to_numpy()[i],
            "observer": poses.observer.to_numpy()[i],
            "actor": actors.actor.to_numpy()[j],
            "bin": np.hypot(*away_m.T) // _BIN_M,
        }
    )
    around = around[around.observer != around.actor]
    if around.empty:
        raise run.lacks("objects to know", f"no honest vehicle ever had an actor within {range_m:g} m.")
    rows = []
    for which in with_boxes(run, tuple(TABLE_OF)):
        good = (pc.field("score") >= min_score) & at_steps(steps)
        columns = ["step", "observer", "truth_actor", *(["origin"] if which == "local" else [])]
        known = observed_by_vehicle(run, which, columns, good)
        if which == "local":
            known = known[known.origin == "sensed"]
        known = known[known.truth_actor.notna()]  # not in `good`: `fused` would look it up for all of its rows
        known = known[["step", "observer", "truth_actor"]].drop_duplicates().astype(np.int64)
        key = pd.MultiIndex.from_frame(around[["step", "observer", "actor"]])
        seen = key.isin(pd.MultiIndex.from_frame(known))
        counts = pd.DataFrame({"bin": around.bin, "known": seen}).groupby("bin").known.agg(["size", "sum"])
        rows.append(
            pd.DataFrame(
                {
                    "boxes": which,
                    "distance_m": (counts.index + 0.5) * _BIN_M,
                    "n_present": counts["size"],
                    "n_known": counts["sum"],
                    "share": counts["sum"] / counts["size"],
                }
            )
        )
    return pd.concat(rows, ignore_index=True)
