"""Where errors of a partner's pose, and its age, put its boxes and the objects that only it has a return of."""

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.perception.kitti_frames import BOX, at_steps
from cosim.base.plane import turned_by
from results.run import Run

ERROR = ("error_east_m", "error_north_m", "error_rad")
"""Columns of a partner's error: of its position, and of its heading."""


def with_errors(
    beside: pd.DataFrame,
    std: tuple[float, float],
    seeded: tuple[float, float, float] | None,
) -> pd.DataFrame:
    """Partners with the errors of their poses.

    Parameters
    ----------
    std
        Standard deviations of east and of north [m], and of the heading [deg]; drawn for each row.
    seeded
        One error of every row instead: east, north [m] and heading [deg].
    """
    if seeded is None:
        position_m, heading_deg = std
        normal = np.random.default_rng(7).normal(size=(len(beside), 3))
        error = np.array([position_m, position_m, heading_deg]) * normal
    else:
        error = np.tile(seeded, (len(beside), 1))
    error = error * [1.0, 1.0, np.pi / 180.0]
    return beside.assign(**dict(zip(ERROR, error.T, strict=True)))


def displaced(boxes: pd.DataFrame, run: Run) -> pd.DataFrame:
    """Boxes of partners moved and turned with the errors of their senders' poses (`ERROR`) in their steps."""
    pose = _poses(run, boxes)
    error = boxes[[*ERROR]].to_numpy(float)
    world = _moved(boxes[[*BOX]].to_numpy(float), pose, pose + error)
    return boxes.assign(**dict(zip(BOX, world.T, strict=True)))


def with_larger_errors(boxes: pd.DataFrame, run: Run, factor: float) -> pd.DataFrame:
    """Boxes whose errors of position, size and heading are multiplied; false positives stay."""
    of = boxes.truth_actor.astype("Int64").fillna(-1).to_numpy(np.int64)
    table = run.table("actors", ["step", "actor", "x_m", "y_m", "z_m", "yaw_rad"], at_steps(np.unique(boxes.step)))
    sizes = run.table("vehicles", ["vehicle", "length_m", "width_m", "height_m"])
    table = table.merge(sizes, left_on="actor", right_on="vehicle").set_index(["step", "actor"])
    rows = pd.MultiIndex.from_arrays([boxes.step, of])
    true = table[[*BOX]].reindex(rows).to_numpy(float)
    box = boxes[[*BOX]].to_numpy(float)
    error = box - true
    turn = error[:, 6] + np.pi
    error[:, 6] = np.mod(turn, 2 * np.pi) - np.pi
    larger = true + factor * error
    larger[:, 3:6] = np.maximum(larger[:, 3:6], 0.1)
    real = np.isfinite(true[:, :1])
    return boxes.assign(**dict(zip(BOX, np.where(real, larger, box).T, strict=True)))


def seen_by_senders(
    run: Run,
    world: Float[ndarray, "t 7"],
    pairs: tuple[Int[ndarray, "t"], Int[ndarray, "t"]],
    own: pd.DataFrame,
    theirs: pd.DataFrame,
    delay_steps: int,
) -> Float[ndarray, "t 7"]:
    """Objects where the evaluation of OpenCOOD takes them to be.

    Parameters
    ----------
    world
        Boxes of the objects in the world frame.
    pairs
        Frame and actor of each.
    own, theirs
        Who has a return of what: frame, actor; of partners also step, observer and error. Of several partners the first
        by number tells where the object is.
    delay_steps
        Age of what partners send.

    Notes
    -----
    `reform_param` and `get_item_single_car` of V2X-ViT's code: what the ego has a return of stays. An object that only
    partners have a return of is taken relative to the partner's pose when it sent, and placed relative to its present
    pose with its error. So it is displaced by the partner's own motion and by the error that its boxes have, too.
    Deviations: theirs are ordered by the names of folders.
    """
    keys = pd.MultiIndex.from_arrays(pairs)
    first = theirs.sort_values(["frame", "actor", "observer"]).drop_duplicates(["frame", "actor"])
    of = pd.MultiIndex.from_frame(first[["frame", "actor"]]).get_indexer(keys)
    of_ego = keys.isin(pd.MultiIndex.from_frame(own[["frame", "actor"]]))
    rows = np.flatnonzero((of >= 0) & ~of_ego)
    sender = first.iloc[of[rows]]
    then = _poses(run, sender.assign(step=sender.step - delay_steps))
    now = _poses(run, sender) + sender[[*ERROR]].to_numpy(float)
    known = np.isfinite(then[:, 0])  # a partner that has just appeared has sent nothing
    placed = world.copy()
    rows = rows[known]
    placed[rows] = _moved(world[rows], then[known], now[known])
    return placed


def _poses(run: Run, of: pd.DataFrame) -> Float[ndarray, "n 3"]:
    """East, north and heading of observers in steps; NaN where they are not there."""
    table = run.table("actors", ["step", "actor", "x_m", "y_m", "yaw_rad"], at_steps(np.unique(of.step)))
    at = table.set_index(["step", "actor"]).reindex(pd.MultiIndex.from_frame(of[["step", "observer"]]))
    return at.to_numpy(float)


def _moved(
    box: Float[ndarray, "n 7"], start: Float[ndarray, "n 3"], end: Float[ndarray, "n 3"]
) -> Float[ndarray, "n 7"]:
    """Boxes carried along with poses from `start` to `end`."""
    turn = end[:, 2] - start[:, 2]
    from_start_m = box[:, :2] - start[:, :2]
    moved = box.copy()
    moved[:, :2] = end[:, :2] + turned_by(turn, from_start_m)
    moved[:, 6] += turn
    return moved
