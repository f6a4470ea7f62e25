"""What cooperation adds to average precision, and what delays and errors take from it, by the rules of data sets.

The detections of a run go through late fusion as OpenCOOD does it: boxes of the ego and of its partners in one frame,
then non-maximum suppression. In early fusion the detector looks at the merged clouds. So one run answers with and
without partners, early and late, with and without delay and errors, on the same sweeps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.addons.perception.kitti_frames import (
    BOX,
    Poses,
    ahead_of,
    at_steps,
    observed_by_vehicle,
    others_near,
    posed,
    sampled_steps,
)
from cosim.addons.perception.late_fusion import kept
from cosim.addons.perception.matched import Found, Truth, precision_and_recall
from cosim.addons.perception.measures.displaced import (
    ERROR,
    displaced,
    seen_by_senders,
    with_errors,
    with_larger_errors,
)
from cosim.addons.perception.measures.early_fusion import Disturbance, early_boxes
from cosim.addons.perception.measures.mixed import frames_at_speed, in_turn
from cosim.base.ragged import place_in_group
from results.run import Run
from results.sensing import is_lock_step

_FRAMES = 1500
Fusion = Literal["none", "late", "early"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Setting:
    """How a data set is evaluated, and how its messages are disturbed."""

    overlaps: tuple[float, ...]
    range_m: float
    partners_m: float
    """Largest distance of a partner from the ego."""
    partners: int
    """Largest number of partners, the nearest ones; egos without any are left out."""
    delay_steps: int = 0
    """Age of what partners send."""
    position_m: float = 0.0
    """Standard deviation of the error of a partner's position, for east and for north."""
    heading_deg: float = 0.0
    """Standard deviation of the error of its heading."""
    seeded_error: tuple[float, float, float] | None = None
    """One error of every partner in every frame instead: east [m], north [m] and heading [deg]."""
    area_m: tuple[float, float] = (np.inf, np.inf)
    """Objects and boxes count that far ahead or behind the ego, and to its sides."""
    sensed_m: tuple[float, float] = (np.inf, np.inf)
    """A vehicle's own boxes are that far ahead or behind it, and to its sides."""
    min_score: float = 0.0
    """Boxes with a lower score are left out."""
    box_errors: float = 1.0
    """Factor on the errors of boxes against their objects, to be as accurate as another detector."""
    ranked: Literal["all", "by frame"] = "all"
    """Whether the boxes of all frames are ranked together, or those of one frame and then those of the next."""
    label: str = "car"
    slower_mps: float = np.inf
    """Only objects slower than this count; the boxes of others are no false positives."""
    truth: Literal["exact", "of senders"] = "exact"
    """Where an object is of which only partners have a return: where it is, or where OpenCOOD takes it to be."""


def precision_gain(run: Run, *, fusion: Fusion, over: Literal[Fusion, "in time"], **options: object) -> ndarray:
    """Average precision of one fusion minus that of another one, as OpenCOOD counts it [points].

    Parameters
    ----------
    fusion, over
        The two. "in time" is the first one with what partners send now; errors of pose are in both.
    options
        Those of `Setting`. Objects count that the ego or one of its partners has a return of.
    """
    setting = _setting(options)
    other = (replace(setting, delay_steps=0), fusion) if over == "in time" else (setting, over)
    return _precision(run, setting, fusion) - _precision(run, *other)


def late_gain_at_speed(slow: Run, fast: Run, *, mean_speed_mps: float, **options: object) -> ndarray:
    """Gain of late fusion over the ego alone, over frames of two worlds in the shares that give a mean speed [points].

    Parameters
    ----------
    slow, fast
        Runs in the two worlds.
    mean_speed_mps
        Mean speed of the egos over all frames.
    options
        As `precision_gain`.
    """
    setting = _setting(options)
    late = [_evaluated(run, setting, "late") for run in (slow, fast)]
    alone = [_evaluated(run, setting, "none") for run in (slow, fast)]
    chosen = frames_at_speed(alone[0].ego_mps, alone[1].ego_mps, mean_speed_mps)
    return _precision_of(late, chosen, setting) - _precision_of(alone, chosen, setting)


def _setting(options: Mapping[str, Any]) -> Setting:
    given: dict[str, Any] = dict(options)
    for name, one in options.items():
        if isinstance(one, list):
            given[name] = tuple(one)
    return Setting(**given)


@dataclass(frozen=True, slots=True)
class CooperationScores:
    """Objects and boxes of a run by frame."""

    truth: Truth
    found: Found
    ego_mps: Float[ndarray, "f"]
    """Speed of the ego in each frame."""


def _precision(run: Run, setting: Setting, fusion: Fusion) -> Float[ndarray, "o"]:
    """Average precision by overlap [%]."""
    one = _evaluated(run, setting, fusion)
    return _areas(one.truth, one.found, setting)


def _precision_of(
    parts: Sequence[CooperationScores], chosen: Sequence[Int[ndarray, "c"]], setting: Setting
) -> Float[ndarray, "o"]:
    """Average precision of some frames of several runs together, by overlap [%]."""
    rows = []
    for frames, one in zip(chosen, parts, strict=True):
        rows.append((frames, one.truth, one.found))
    truth, found = in_turn(rows)
    return _areas(truth, _ranked(found, setting), setting)


def _areas(truth: Truth, found: Found, setting: Setting) -> Float[ndarray, "o"]:
    return np.array([100 * precision_and_recall(truth, found, one)[0] for one in setting.overlaps])


def _evaluated(run: Run, setting: Setting, fusion: Fusion) -> CooperationScores:
    if not is_lock_step(run):
        raise ValueError(
            f"{run.path}: vehicles sense at different steps, and this measure joins what they detect in one step. "
            'Run with sensing_phase = "common" and without sensing_groups.'
        )
    steps = sampled_steps(run, _FRAMES)
    steps = steps[steps >= setting.delay_steps]
    poses, actors = posed(run, steps)
    frame, partner = _partners(poses, actors, setting)
    poses = poses[poses.frame.isin(frame)].reset_index(drop=True)
    renumbered = pd.Series(np.arange(len(poses)), poses.frame.to_numpy())
    poses = poses.assign(frame=np.arange(len(poses)))
    beside = pd.DataFrame({"frame": renumbered.loc[frame].to_numpy(), "observer": partner})
    beside = with_errors(beside, (setting.position_m, setting.heading_deg), setting.seeded_error)
    truth = _truth(run, steps, poses, actors, beside, setting)
    found = _found(run, steps, poses, actors, beside, setting, fusion)
    return CooperationScores(truth, found, _speed(run, poses.step.to_numpy(), poses.observer.to_numpy()))


def _partners(poses: Poses, actors: pd.DataFrame, setting: Setting) -> tuple[ndarray, ndarray]:
    """Frames and actor numbers of the partners in them."""
    equipped = actors[actors.equipped].reset_index(drop=True)
    i, j = others_near(poses, equipped, setting.partners_m)
    own_m = poses[["x_m", "y_m"]].to_numpy()[i]
    away_m = own_m - equipped[["x_m", "y_m"]].to_numpy()[j]
    order = np.lexsort([np.hypot(*away_m.T), i])
    i, j = i[order], j[order]
    few = place_in_group(i) < setting.partners
    i, j = i[few], j[few]
    return poses.frame.to_numpy()[i], equipped.actor.to_numpy()[j]


def _truth(
    run: Run, steps: ndarray, poses: Poses, actors: pd.DataFrame, beside: pd.DataFrame, setting: Setting
) -> Truth:
    """Actors of the class around each ego that somebody has a return of."""
    i, j = others_near(poses, actors, setting.range_m)
    actor = actors.actor.to_numpy()
    keep = actors.label.to_numpy()[j] == setting.label
    i, j = i[keep], j[keep]
    seen = run.table("observability", ["step", "observer", "actor", "n_points"], at_steps(steps))
    seen = seen[seen.n_points > 0]
    own = poses[["frame", "step", "observer"]].merge(seen, on=["step", "observer"])
    theirs = beside.merge(poses[["frame", "step"]], on="frame").merge(seen, on=["step", "observer"])
    pairs = pd.concat([own, theirs])[["frame", "actor"]]
    around = pd.MultiIndex.from_arrays([i, actor[j]])
    known = around.isin(pd.MultiIndex.from_frame(pairs))
    i, j = i[known], j[known]
    if np.isfinite(setting.slower_mps):
        now = actors[["step", "actor"]].iloc[j]
        slow = _speed(run, now.step.to_numpy(), now.actor.to_numpy()) < setting.slower_mps
        i, j = i[slow], j[slow]
    world = actors[[*BOX]].to_numpy(float)[j]
    if setting.truth == "of senders":
        world = seen_by_senders(run, world, (i, actor[j]), own, theirs, setting.delay_steps)
    box, _, _ = ahead_of(poses, i, world, setting.range_m)
    inside = _within(box, setting.area_m)
    return i[inside], box[inside]


def _found(
    run: Run, steps: ndarray, poses: Poses, actors: pd.DataFrame, beside: pd.DataFrame, setting: Setting, fusion: Fusion
) -> Found:
    """Boxes after suppression: of the egos; of them and of partners as they were and with their errors; or of merged
    clouds, with the false positives of the egos."""
    old = np.unique(np.concatenate([steps, steps - setting.delay_steps]))
    where = at_steps(old) & (pc.field("origin") == "sensed")
    columns = ["step", "observer", "class", *BOX, "score", "truth_actor"]
    boxes = observed_by_vehicle(run, "local", columns, where)
    boxes = boxes[(boxes["class"] == setting.label) & (boxes.score >= setting.min_score)]
    boxes = _sensed(boxes, run, setting)
    if np.isfinite(setting.slower_mps):
        of = boxes.truth_actor.astype("Int64").fillna(-1).to_numpy(np.int64)
        boxes = boxes[~(_speed(run, boxes.step.to_numpy(), of) >= setting.slower_mps)]
    if setting.box_errors != 1:
        boxes = with_larger_errors(boxes, run, setting.box_errors)
    own = poses[["frame", "step", "observer"]].merge(boxes, on=["step", "observer"])
    every = own
    if fusion == "late":
        theirs = beside.merge(poses[["frame", "step"]], on="frame")
        theirs = theirs.assign(step=theirs.step - setting.delay_steps)
        theirs = displaced(theirs.merge(boxes, on=["step", "observer"]), run)
        every = pd.concat([own, theirs], ignore_index=True)
    if fusion == "early":
        error = beside[[*ERROR]].to_numpy(float)
        wrong = Disturbance(delay_steps=setting.delay_steps, error=error)
        merged = early_boxes(run, poses, actors, beside[["frame", "observer"]], wrong)
        merged = merged[merged["class"] == setting.label]
        every = pd.concat([own[own.truth_actor.isna()], merged], ignore_index=True)
    frame = every.frame.to_numpy(np.int64)
    boxes_of_all = every[[*BOX]].to_numpy(float)
    box, _, _ = ahead_of(poses, frame, boxes_of_all, setting.range_m)
    is_near = np.hypot(box[:, 0], box[:, 1]) <= setting.range_m
    rows = np.flatnonzero(is_near & _within(box, setting.area_m))
    score = every.score.to_numpy(float)
    rows = rows[kept(frame[rows], box[rows], score[rows])]
    return _ranked((frame[rows], box[rows], score[rows]), setting)


def _ranked(found: Found, setting: Setting) -> Found:
    """Boxes in the order in which the data set ranks them."""
    if setting.ranked == "all":
        return found
    frame, box, score = found
    rank = np.lexsort([-score, frame])
    by_rank = -np.arange(len(rank), dtype=np.float64)
    return frame[rank], box[rank], by_rank


def _within(
    box: Float[ndarray, "n 7"],
    area_m: tuple[float, float],
) -> Bool[ndarray, "n"]:
    """Whether boxes in the frame of a vehicle lie in an area around it."""
    return (np.abs(box[:, :2]) <= area_m).all(axis=1)


def _sensed(boxes: pd.DataFrame, run: Run, setting: Setting) -> pd.DataFrame:
    """Boxes in the area in which their own observers look for objects."""
    if not np.isfinite(setting.sensed_m).any() or boxes.empty:
        return boxes
    poses, _ = posed(run, np.unique(boxes.step))
    of = pd.MultiIndex.from_frame(poses[["step", "observer"]]).get_indexer(
        pd.MultiIndex.from_frame(boxes[["step", "observer"]])
    )
    in_world = boxes[[*BOX]].to_numpy(float)
    box, _, _ = ahead_of(poses, of, in_world, setting.range_m)
    return boxes[_within(box, setting.sensed_m)]


def _speed(run: Run, step: ndarray, actor: ndarray) -> Float[ndarray, "n"]:
    """Speed of actors in steps [m/s]; NaN where there is no such actor."""
    table = run.table("actors", ["step", "actor", "speed_mps"], at_steps(np.unique(step)))
    speed = table.set_index(["step", "actor"]).speed_mps
    return speed.reindex(pd.MultiIndex.from_arrays([step, actor])).to_numpy(float)
