"""Makes fabricated detections look like those of a detector, so that no column of a message gives them away."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.attacks.attack import AttackContext, fabricated
from cosim.base import rng
from cosim.base.ragged import differs_from_last, place_in_group
from cosim.messages.content import FABRICATED, SENSED, Detections, claims_to_be_own
from sensors.boxes import Boxes

N_ALIKE = 8
"""A fabricated detection resembles one of this many detections of its class at the most similar distances."""
_KEPT = 64
"""Detections of each class that are kept for steps in which there are none."""
_SHUFFLE = np.uint64(1 << 32)
"""Names the draws of the order of equal scores; attacks have smaller numbers."""


def ghosts(
    listed: Detections,
    observer: Int[ndarray, "c"],
    label: UInt8[ndarray, "c"],
    boxes: Boxes,
    context: AttackContext,
    target: Int[ndarray, "c"] | None = None,
) -> Detections:
    """Add objects that do not exist to the lists, as a detector would report them if they stood there.

    Each ghost takes score, size, number of returns and speed of a real detection of its class, made by any vehicle at
    a similar distance. So these values have the distribution of the detector, whatever the detector is. Its speed is
    along its own heading; it has none where the real detection has none, because its track is new.

    Parameters
    ----------
    listed
        The detections of the step.
    observer, label
        Row of the world of the vehicle that adds each ghost, ascending, and its class.
    boxes
        Where the ghosts stand. They keep their ground and get the size of a detection.
    target
        As `attack.fabricated`.
    """
    if context.params.appearance == "paper":
        return fabricated(listed, observer, label, boxes, np.ones(len(observer)), target)
    pool = _pool(listed if context.seen is None else context.seen, context)
    chosen = _alike(pool, observer, label, boxes, context)
    has_donor = chosen >= 0
    donor = chosen[has_donor]
    n = len(observer)
    xyz_m, lwh_m = boxes.xyz_m.copy(), boxes.lwh_m.copy()
    score = np.ones(n)
    n_points = np.zeros(n, np.int32)
    speed_mps = np.full(n, np.nan)
    lwh_m[has_donor] = pool["lwh_m"][donor]
    score[has_donor] = pool["score"][donor]
    n_points[has_donor] = pool["n_points"][donor]
    speed_mps[has_donor] = pool["speed_mps"][donor]
    higher_m = lwh_m[:, 2] - boxes.lwh_m[:, 2]
    xyz_m[:, 2] += higher_m / 2
    boxes = Boxes(xyz_m, lwh_m, boxes.yaw_rad)
    along = np.column_stack([np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)])
    velocity_mps = speed_mps[:, None] * along
    return fabricated(listed, observer, label, boxes, score, target, n_points=n_points, velocity_mps=velocity_mps)


def _pool(seen: Detections, context: AttackContext) -> dict[str, ndarray]:
    """Detections of this step, and the last ones of classes that are rare: class, distance and what ghosts take."""
    rows = np.flatnonzero(seen.origin == SENSED)
    boxes, by = seen.boxes.take(rows), seen.observer[rows]
    now = {
        "label": seen.label[rows],
        "range_m": _range_m(boxes.xyz_m, by, context),
        "name_key": context.name_key(by),
        "detection_index": seen.detection_index[rows],
        "lwh_m": boxes.lwh_m,
        "score": seen.score[rows],
        "n_points": seen.n_points[rows],
        "speed_mps": np.linalg.norm(seen.velocity_mps[rows], axis=1),
    }
    # By distance, and then by name, so that no draw depends on actor numbers.
    order = np.lexsort((now["detection_index"], now["name_key"], now["range_m"]))
    now = {name: column[order] for name, column in now.items()}
    before = context.memory.get("detected")
    pool = dict(now)
    if before is not None:
        rare = np.isin(before["label"], np.setdiff1d(before["label"], now["label"]))
        for name, column in before.items():
            pool[name] = np.concatenate([now[name], column[rare]])
    labels = pool["label"]
    last = [np.flatnonzero(labels == label)[:_KEPT] for label in np.unique(labels)]
    kept = np.concatenate([np.zeros(0, np.int64), *last])
    context.memory["detected"] = {name: column[kept] for name, column in pool.items()}
    return pool


def _range_m(
    xyz_m: Float[ndarray, "n 3"],
    observer: Int[ndarray, "n"],
    context: AttackContext,
) -> Float[ndarray, "n"]:
    """Horizontal distance of each point from its observer."""
    own_m = context.world.boxes.xyz_m[observer, :2]
    return np.linalg.norm(xyz_m[:, :2] - own_m, axis=1)


def _alike(
    pool: dict[str, ndarray],
    observer: Int[ndarray, "c"],
    label: UInt8[ndarray, "c"],
    boxes: Boxes,
    context: AttackContext,
) -> Int[ndarray, "c"]:
    """For each ghost, the row of the pool that it resembles; -1 if the pool has none of its class."""
    range_m = _range_m(boxes.xyz_m, observer, context)
    draw = context.uniforms(context.name_key(observer), place_in_group(observer))[:, 0]
    chosen = np.full(len(observer), -1)
    for one in np.unique(label):
        of_class = np.flatnonzero(pool["label"] == one)
        mine = np.flatnonzero(label == one)
        if not len(of_class):
            continue
        of_class_m = pool["range_m"][of_class]
        order = np.argsort(of_class_m, kind="stable")
        n = min(N_ALIKE, len(of_class))
        place = np.searchsorted(of_class_m[order], range_m[mine])
        begin = np.clip(place - n // 2, 0, len(of_class) - n)
        drawn = (draw[mine] * n).astype(np.int64)
        chosen[mine] = of_class[order[begin + drawn]]
    return chosen


def numbered(
    listed: Detections,
    name_key: UInt64[ndarray, "n"],
    seed: int,
    step: int,
) -> tuple[Detections, Int[ndarray, "d"]]:
    """The lists with detections numbered by falling score, as detectors number them. Self reports keep number 0.

    Fabricated detections would otherwise have the highest numbers, and a list in any other order than those of honest
    vehicles would tell that it was changed. Among equal scores, chance decides in lists with fabricated detections.

    Parameters
    ----------
    listed
        Sorted by key.
    name_key
        Key of the name of each actor, by row of the world.

    Returns
    -------
    The lists, sorted by their key again, and the row of `listed` of each of their rows.
    """
    begins = differs_from_last(listed.observer) | differs_from_last(listed.identity)
    of_list = np.cumsum(begins) - 1
    is_self = claims_to_be_own(listed)
    rises = np.diff(listed.score, prepend=np.inf) > 0
    is_next = ~begins & ~np.roll(is_self, 1)
    lies = np.isin(of_list, of_list[listed.origin == FABRICATED])
    is_unsorted = np.isin(of_list, of_list[rises & is_next])
    rows = np.flatnonzero((lies | is_unsorted) & ~is_self)
    if not len(rows):
        return listed, np.arange(len(listed))
    index = listed.detection_index.copy()
    key = rng.key(seed, rng.Stream.ATTACK, step)
    names = name_key[listed.observer[rows]]
    draw = rng.uniforms(key, _SHUFFLE, names, index[rows])[:, 0]
    draw[~lies[rows]] = 0.0
    falling = -listed.score[rows]
    by_score = np.lexsort((draw, falling, of_list[rows]))
    index[rows[by_score]] = index[rows]
    again = replace(listed, detection_index=index)
    order = np.lexsort((index, of_list))
    return again.take(order), order
