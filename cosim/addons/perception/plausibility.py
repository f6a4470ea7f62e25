"""What annotations and detections say about each other: signs that one of them means something else.

A data set can state sizes as halves, exchange length and width, or have its boxes in another frame, without any line
of a file being wrong. Each sign is a sentence for the reader of the figures; nothing is corrected.
"""

import math
from collections import Counter
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.addons.perception.recorded import Recorded, RecordedBoxes, listed

_FEWEST = 3
"""Boxes below which nothing is said."""
_MANY, _HARDLY = 10, 0.1
"""Detections of an agent beyond which a share below the second of them on objects is a sign."""
_NEAR_M = 2.0
"""A box within this distance from the middle of an object is of this object."""
_OTHER_SIZE = math.log(1.6)
"""Median ratio of two lengths that are not of one object."""
_TURNED_DEG = 20.0
"""Median angle between boxes that are not of one object: detectors are right to a few degrees."""
_CAR_M = (2.6, 8.0)
"""Lengths between which the median car is: the shortest car is 2.7 m long, the longest van 7 m."""


def remarks(data: Recorded) -> tuple[str, ...]:
    """Signs that sizes, angles, poses or frames mean something else, one sentence each."""
    of_set = (*_frames(data), *_agents(data), *_classes(data))
    return (*of_set, *of_boxes(data.truth, data.found))


def of_boxes(truth: RecordedBoxes, found: RecordedBoxes) -> tuple[str, ...]:
    """Signs that sizes or angles of boxes mean something else, one sentence each."""
    return (*_sizes(truth), *_differences(truth, found))


def _sizes(truth: RecordedBoxes) -> Iterator[str]:
    cars = truth.box[truth.label == "car"]
    if len(cars) < _FEWEST:
        return
    length, width = np.median(cars[:, 3:5], axis=0).tolist()
    if length < width:
        yield f"the annotated cars are {length:.1f} m long and {width:.1f} m wide (median). Are both exchanged?"
    elif not _CAR_M[0] <= length <= _CAR_M[1]:
        yield f"the annotated cars are {length:.1f} m long (median). Are these half, or twice, their lengths?"


def _frames(data: Recorded) -> Iterator[str]:
    """Detections that lie on objects in another frame than that of the agent's LiDAR."""
    if len(data.found) < _FEWEST or not len(data.truth):
        return
    frame = data.found.frame
    inverse = [np.linalg.inv(motions) for motions in data.world_from]
    rows = list(zip(frame.tolist(), data.found.agent.tolist(), strict=True))
    back = np.array([inverse[f][a] for f, a in rows])
    forth = np.array([data.world_from[f][a] for f, a in rows])
    one = np.ones(len(frame))
    centre = np.column_stack([data.found.box[:, :3], one])
    local = np.einsum("nij,nj->ni", back, centre)
    mirrored = np.einsum("nij,nj->ni", forth, local * [1, -1, 1, 1])
    n_right = _n_near(data.truth, frame, centre[:, :2])
    for places, words in (
        (local, "as boxes of the world"),
        (mirrored, "with y to the right of the LiDAR"),
    ):
        n = _n_near(data.truth, frame, places[:, :2])
        if n >= _FEWEST and n > 3 * n_right:
            yield (
                f"{n_right:,} of {len(frame):,} detections lie on an object; {words} {n:,} would. The frame that is "
                "read is that of the agent's LiDAR, x ahead and y to the left."
            )


def _agents(data: Recorded) -> Iterator[str]:
    """Agents hardly any of whose detections lie on an object, as if their poses were wrong."""
    if not len(data.truth) or not len(data.found):
        return
    frame, xy_m = data.found.frame, data.found.box[:, :2]
    to_object_m, _ = _nearest(data.truth, frame, xy_m)
    to_agent_m, _ = _nearest(data.aside, frame, xy_m)
    away = np.minimum(to_object_m, to_agent_m)
    rows = zip(data.found.frame.tolist(), data.found.agent.tolist(), strict=True)
    of_rows = [data.agents[frame][agent] for frame, agent in rows]
    names = np.array(of_rows, object)
    for name in sorted(set(of_rows)):
        mine = away[names == name] < _NEAR_M
        if len(mine) >= _MANY and mine.mean() < _HARDLY:
            n_near = int(mine.sum())
            yield (
                f"{n_near:,} of {len(mine):,} detections of agent {name} lie within {_NEAR_M:g} m of an "
                "object. Is its pose right?"
            )


def _classes(data: Recorded) -> Iterator[str]:
    """Detections of classes that no object has."""
    known = set(data.truth.label.tolist())
    counts = Counter(label for label in data.found.label.tolist() if label not in known)
    if data.has_classes and counts:
        yield f"detections of these classes count nowhere, because no object has them: {listed(counts)}."


def _n_near(truth: RecordedBoxes, frame: Int[ndarray, "n"], xy_m: Float[ndarray, "n 2"]) -> int:
    away, _ = _nearest(truth, frame, xy_m)
    return int((away < _NEAR_M).sum())


def _nearest(
    truth: RecordedBoxes, frame: Int[ndarray, "n"], xy_m: Float[ndarray, "n 2"]
) -> tuple[Float[ndarray, "n"], Int[ndarray, "n"]]:
    """Distance to the nearest object of the same frame, and its row; infinite if it is not near."""
    apart_m = 10 * _NEAR_M  # of frames: objects of another frame are not near
    places = np.column_stack([truth.box[:, :2], apart_m * truth.frame])
    tree = cKDTree(places)
    wanted = np.column_stack([xy_m, apart_m * frame])
    return tree.query(wanted, distance_upper_bound=_NEAR_M)  # type: ignore[no-any-return]


def _differences(truth: RecordedBoxes, found: RecordedBoxes) -> Iterator[str]:
    """What most detections have in common that lie on objects."""
    if not len(truth) or not len(found):
        return
    away, row = _nearest(truth, found.frame, found.box[:, :2])
    is_near = np.isfinite(away)
    ours, theirs = found.box[is_near], truth.box[row[is_near]]
    if len(ours) < _FEWEST:
        return
    ratios = ours[:, 3:6] / theirs[:, 3:6]
    crossed_ratios = ours[:, [4, 3]] / theirs[:, 3:5]
    ratio, crossed = np.median(ratios, axis=0), np.median(crossed_ratios, axis=0)
    turn = ours[:, 6] - theirs[:, 6]
    right_angle = np.pi / 2
    turned_rad = np.abs((turn + right_angle) % np.pi - right_angle)  # of the axes, whichever end is the front
    slenderness = theirs[:, 3] / theirs[:, 4]
    is_long = np.abs(np.log(slenderness)) > _OTHER_SIZE  # nobody knows the heading of a square
    turned_deg = np.degrees(np.median(turned_rad[is_long])) if is_long.sum() >= _FEWEST else 0.0
    above_m = ours[:, 2] - theirs[:, 2]
    lower = np.median(above_m / theirs[:, 5])
    is_crossed = (np.abs(crossed - 1) < 0.15).all()
    is_other_size = np.abs(np.log(ratio)).max() > _OTHER_SIZE
    if is_other_size and not (is_crossed and turned_deg > 45):
        times = ", ".join(f"{one:.2g}" for one in ratio)
        why = "Are length and width exchanged?" if is_crossed else "Are these half sizes, or in another order?"
        yield f"length, width and height of detections are {times} times those of the objects on which they lie. {why}"
    elif turned_deg > _TURNED_DEG and not is_crossed:
        yield (
            f"detections are turned by {turned_deg:.0f} degrees (median) against the objects on which they lie. Are "
            "angles of another direction, or another unit?"
        )
    if 0.35 < abs(lower) < 0.65:
        side = "below" if lower < 0 else "above"
        yield (
            f"detections lie half of a height {side} the objects on which they lie. Is a z that of the underside? "
            "`ap` does not depend on it, `ap_3d` does."
        )
