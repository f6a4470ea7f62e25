"""Recorded data sets through our matching, fusion and metrics: average precision alone, with late fusion, and fused."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.addons.perception import dair, kitti_folder, opv2v
from cosim.addons.perception.kitti import FEWEST, LEVELS, LOOSE, STRICT, LabelledObjects, average_precision
from cosim.addons.perception.late_fusion import NMS_OVERLAP, kept
from cosim.addons.perception.matched import precision_and_recall
from cosim.addons.perception.opv2v import ObjectFrame
from cosim.addons.perception.overlap import in_blocks, iou_bev, near_pairs
from cosim.addons.perception.plausibility import of_boxes, remarks
from cosim.addons.perception.recorded import Recorded, RecordedBoxes, listed
from cosim.addons.perception.recorded_trust import Trusted, trusted
from cosim.base.plane import turned_by
from cosim.base.ragged import differs_from_last, ptr_of
from sensors import boxes as geometry
from trust.fusion import SensorEvidence, fuse
from trust.matching import match
from trust.params import TrustParams
from trust.tables import Evaluations, FusionInput, ObjectLists, SenderTrust, SentDetections

Layout = Literal["opv2v", "dair-v2x", "kitti"]
CLASSES = ("car", "pedestrian", "cyclist", "truck")
_MOST_CLASSES = 255
_MOST_PAIRS, _PAIRS_PER_BOX = 1_000_000, 50
"""Pairs of boxes that are near to each other, beyond which a data set is refused: so many in all, and for each box."""
_AGENT_M = (4.5, 2.0, 1.6)
"""Length, width and height of a vehicle around its LiDAR, where nobody has annotated it."""
_KITTI_COLUMNS = ("class", "level", "overlap", "ap11", "ap40", "n_truth", "n_boxes")


Evaluated = tuple[dict[str, Any], pd.DataFrame]
"""What was read and left out, and the table of average precisions."""


def layout_of(folder: Path) -> Layout:
    """Which layout a folder has.

    Raises
    ------
    ValueError
        In one line, if it has none that is known.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is not a folder. Give the folder of a data set.")
    if dair.root_of(folder) is not None:
        return "dair-v2x"
    if kitti_folder.labels_in(folder) is not None:
        return "kitti"
    if opv2v.stamps(folder):
        return "opv2v"
    raise ValueError(
        f"{folder} has none of the known layouts: OPV2V and V2V4Real (SCENARIO/AGENT/000000.yaml), DAIR-V2X "
        f"({dair.INDEX}), KITTI (training/label_2/000000.txt)."
    )


def evaluate(
    folder: Path,
    layout: Layout | None = None,
    detections: Path | None = None,
    range_m: float = 100.0,
    partners_m: float = 70.0,
    overlaps: Sequence[float] = (0.5, 0.7),
    ego: str | None = None,
    objects: ObjectFrame | None = None,
) -> Evaluated:
    """Evaluate the detections of a data set.

    Parameters
    ----------
    layout
        One of `Layout`; found out if left out.
    detections
        Folder of the detections, in the tree that the reader of the layout states; left out, they lie with the data.
    range_m
        Objects and boxes count up to this horizontal distance from the ego; not used of KITTI.
    partners_m
        Agents up to this distance from the ego cooperate with it.
    overlaps
        Intersection over union from which a box is right; KITTI has limits of its own.
    ego
        Name of the agent that is the ego; left out, that of the layout's own loader.
    objects
        Frame of the objects of the layout `opv2v`; left out, it is found out.

    Returns
    -------
    What was read: layout, and numbers of frames, agents, objects and boxes; `classes`, by class the numbers of objects
    by the class that the files say; `remarks`, sentences; and `missing`, why there is no figure, if there is none. And
    average precision in percent: for KITTI by class and level; for the others by class, method and overlap, `ap` from
    above and `ap_3d` of volumes.

    Raises
    ------
    ValueError
        In one line, if a file is wrong or missing.
    """
    found = layout or layout_of(folder)
    if found not in get_args(Layout):
        raise ValueError(f"--layout {found} is unknown. There are: {', '.join(get_args(Layout))}.")
    if detections is not None and not detections.is_dir():
        raise ValueError(f"--detections {detections} is not a folder.")
    if ego is not None and found == "kitti":
        raise ValueError(f"--ego {ego} goes with several agents. KITTI has one; leave it out.")
    if objects is not None and found != "opv2v":
        raise ValueError(f"--objects {objects} goes with the layout opv2v. Leave it out.")
    if found == "kitti":
        return _kitti(kitti_folder.read(folder, detections))
    if found == "opv2v":
        data = opv2v.read(folder, detections, ego, objects)
    else:
        data = dair.read(folder, detections, ego)
    return _evaluated(data, range_m, partners_m, overlaps)


def _evaluated(data: Recorded, range_m: float, partners_m: float, overlaps: Sequence[float]) -> Evaluated:
    _check_density(data.frames, data.truth, data.found)
    truth, agents = _without_agents(data)
    about: dict[str, Any] = {
        "layout": data.layout,
        "frames": len(data.frames),
        "agents": sum(map(len, data.agents)),
        "objects": len(truth),
        "boxes": len(data.found),
        "egos": Counter(names[0] for names in data.agents),
        "classes": _by_class(data.classes),
        "remarks": list(data.remarks),
    }
    n_objects = len(truth)
    truth = truth.take(_within(data, truth, range_m))
    counts = truth.label == "car" if not data.has_classes else np.ones(len(truth), bool)
    if not n_objects:
        about["missing"] = "No object is annotated in any frame."
    elif not len(data.found):
        about["missing"] = (
            f"There are no detections beside {n_objects:,} objects. Name their folder: --detections. `cosim export "
            "opv2v` writes them with --set detections=true."
        )
    elif not len(truth):
        about["missing"] = f"No object is within {range_m:g} m of the ego. A larger distance: --range-m."
    elif not counts.any():
        others = listed(Counter(truth.label.tolist()))
        about["missing"] = f"The detections have no class, so they count as cars, and no object is one: {others}."
    if "missing" in about:
        return about, pd.DataFrame()
    about["remarks"] += [*remarks(data), *_twice(truth)]
    if not counts.all():
        others = listed(Counter(truth.label[~counts].tolist()))
        about["remarks"].append(
            f"detections of this layout have no class: they count as cars. Objects of other classes are left out, and "
            f"boxes on them: {others}."
        )
    truth, ignored = truth.take(counts), _joined(agents, truth.take(~counts))
    table, judged = _cooperative(data, truth, ignored, partners_m, range_m, overlaps)
    about["boxes_left_out"] = int(_on(data.found, ignored, truth).sum())
    about["frames_without_clouds"] = judged.n_unread
    if judged.why_unread:
        about["remarks"].append(judged.why_unread)
    about["trust"] = judged.agents.astype(object).where(judged.agents.notna(), None).to_dict("records")
    return about, table


def _by_class(
    counts: Mapping[tuple[str, str], int],
) -> dict[str, dict[str, int]]:
    """By our class, the numbers of annotations by the class that the files say."""
    found: dict[str, dict[str, int]] = {}
    for (said, ours), n in sorted(counts.items()):
        found.setdefault(ours, {})[said] = n
    return found


def _kitti(data: kitti_folder.KittiFolder) -> Evaluated:
    truth, found, rows = data.truth, data.found, []
    about: dict[str, Any] = {
        "layout": "kitti",
        "frames": data.n_frames,
        "agents": data.n_frames,
        "objects": len(truth),
        "boxes": len(found),
        "classes": _by_class(data.classes),
        "remarks": list(data.remarks),
    }
    labels = [label for label in CLASSES if (truth.label == label).any()]
    if not labels:
        about["missing"] = f"No object is of the classes {', '.join(CLASSES)}."
    elif not len(found):
        about["missing"] = f"There are no detections beside {len(truth):,} labels. Name their folder: --detections."
    if "missing" in about:
        return about, pd.DataFrame(columns=list(_KITTI_COLUMNS))
    names = tuple(str(n) for n in range(data.n_frames))
    boxes = []
    for of in (truth, found):
        listed_boxes = RecordedBoxes(of.frame, of.frame, of.label, of.box, of.score)
        boxes.append(listed_boxes.take(of.box[:, 3] > 0))
    _check_density(names, *boxes)
    about["remarks"] += of_boxes(*boxes)
    about["remarks"] += _without_height(truth, "labels")
    about["remarks"] += _without_height(found, "detections")
    for label in labels:
        n_boxes = int((found.label == label).sum())
        for overlap in dict.fromkeys((STRICT[label], LOOSE[label])):
            answer = average_precision(truth, found, label, min_overlap=overlap)
            for level in LEVELS:
                one = answer[level]
                values = (one.ap11, one.ap40) if one.n_truth else (np.nan, np.nan)
                rows.append((label, level, overlap, *values, one.n_truth, n_boxes))
    if any(row[5] < FEWEST for row in rows):
        about["remarks"].append(
            f"average precision of fewer than {FEWEST} objects says little: it is the mean over {FEWEST - 1} shares of "
            "the objects, and with fewer even a detector without a mistake has less than 100."
        )
    return about, pd.DataFrame(rows, columns=list(_KITTI_COLUMNS))


def _without_height(objects: LabelledObjects, words: str) -> list[str]:
    """A remark on boxes that are nowhere in the image, as those of a detector that has no camera."""
    height_px = objects.height_px[np.isin(objects.label, CLASSES)]
    n = int((height_px <= 0).sum())
    remark = (
        f"{n:,} of {len(height_px):,} {words} have no height in the image (columns 5 to 8), so they count at level all "
        "alone: the other levels take boxes of 25 pixels and more. Project them into the image."
    )
    return [remark] * (n > 0)


def _check_density(frames: Sequence[str], truth: RecordedBoxes, found: RecordedBoxes) -> None:
    """Check that the work on pairs of boxes is bounded, and that classes are few.

    Raises
    ------
    ValueError
        In one line, if thousands of boxes lie on each other, or there are more than 255 classes.
    """
    if (n := len(set(found.label.tolist()))) > _MOST_CLASSES:
        raise ValueError(f"the detections have {n:,} classes, more than {_MOST_CLASSES}.")
    both = _joined(truth, found)
    if not len(both):
        return
    xy_m = both.box[:, :2]
    diagonal = np.hypot(both.box[:, 3], both.box[:, 4])
    reach = float(diagonal.max(initial=0.0))
    apart = 2.0 * reach + 1.0 + np.ptp(xy_m, axis=0).max()
    tree = cKDTree(np.column_stack([xy_m, both.frame * apart]))
    pairs = (int(tree.count_neighbors(tree, reach)) - len(both)) // 2
    if pairs > _MOST_PAIRS + _PAIRS_PER_BOX * len(both):
        n_boxes = np.bincount(both.frame)
        frame = int(n_boxes.argmax())
        raise ValueError(
            f"frame {frames[frame]} has {n_boxes[frame]:,} boxes that lie on each other: {pairs:,} "
            "pairs are near in all frames. Suppress boxes of the same object before (non-maximum suppression)."
        )


def _without_agents(data: Recorded) -> tuple[RecordedBoxes, RecordedBoxes]:
    """The objects that are no cooperating vehicle, and a box of each cooperating vehicle.

    An object in whose footprint the LiDAR of such a vehicle stands is this vehicle, whatever its number. A vehicle that
    nobody has annotated gets a box around its LiDAR.
    """
    rows = []
    for frame, (names, poses) in enumerate(zip(data.agents, data.pose, strict=True)):
        for name, pose in zip(names, poses, strict=True):
            if not opv2v.is_roadside(name) and name != dair.AGENTS[1]:
                box = np.array([*pose[:3], *_AGENT_M, pose[3]])
                rows.append((frame, -1, "agent", box, 1.0))
    agents = RecordedBoxes.of(rows)
    i, j = near_pairs(data.truth.frame, data.truth.box, agents.frame, agents.box)
    boxes = data.truth.box[i]
    between = agents.box[j, :2] - boxes[:, :2]
    away = turned_by(-boxes[:, 6], between)
    is_inside = (np.abs(away) < boxes[:, 3:5] / 2).all(axis=1)
    is_agent = np.zeros(len(data.truth), bool)
    is_agent[i[is_inside]] = True
    truth = data.truth.take(~is_agent)
    annotated = _joined(data.aside, data.truth.take(is_agent))
    is_unknown = _best_overlap(agents, _joined(annotated, truth)) <= NMS_OVERLAP
    return truth, _joined(annotated, agents.take(is_unknown))


def _on(boxes: RecordedBoxes, ignored: RecordedBoxes, truth: RecordedBoxes) -> Bool[ndarray, "n"]:
    """Whether each box is of an ignored object: it overlaps one as boxes of one object do, and no counted one more."""
    overlap = _best_overlap(boxes, ignored)
    return (overlap > NMS_OVERLAP) & (overlap >= _best_overlap(boxes, truth))


def _best_overlap(boxes: RecordedBoxes, others: RecordedBoxes) -> Float[ndarray, "n"]:
    """Largest intersection over union, from above, of each box with others of its frame."""
    best = np.zeros(len(boxes))
    if len(boxes) and len(others):
        i, j = near_pairs(boxes.frame, boxes.box, others.frame, others.box)
        overlap = in_blocks(iou_bev, boxes.box[i], others.box[j])
        np.maximum.at(best, i, overlap)
    return best


def _twice(truth: RecordedBoxes) -> list[str]:
    """A remark on objects that lie on each other."""
    i, j = near_pairs(truth.frame, truth.box, truth.frame, truth.box)
    once = i < j
    i, j = i[once], j[once]
    shares = in_blocks(iou_bev, truth.box[i], truth.box[j])
    n = int((shares > 0.5).sum())
    return [f"{n:,} pairs of objects with different numbers lie on each other: each object counts."] * bool(n)


def _cooperative(
    data: Recorded,
    truth: RecordedBoxes,
    ignored: RecordedBoxes,
    partners_m: float,
    range_m: float,
    overlaps: Sequence[float],
) -> tuple[pd.DataFrame, Trusted]:
    """Average precision of the ego alone, of late fusion and of our fusion, by class and overlap; and trust.

    Boxes on what is ignored count neither as right nor as false, in every method.
    """
    near = _near_ego(data, partners_m)
    sources = zip(data.found.frame.tolist(), data.found.agent.tolist(), strict=True)
    is_near = [agent in near[frame] for frame, agent in sources]
    received = data.found.take(np.array(is_near, bool))
    judged = trusted(data, near, received)
    methods: dict[str, RecordedBoxes] = {
        "ego": data.found.take(data.found.agent == 0),
        "late": _late(received),
        "averaging": _fused(received, "averaging"),
        "additive": _fused(received, "additive"),
    }
    if not judged.n_unread:  # in all frames, as the others
        methods["trupercept_1"] = judged.fused
    left = {}
    for method, boxes in methods.items():
        counts = _within(data, boxes, range_m) & ~_on(boxes, ignored, truth)
        left[method] = boxes.take(counts)
    rows = []
    for label in dict.fromkeys(truth.label.tolist()):
        mine = truth.take(truth.label == label)
        for method, boxes in left.items():
            theirs = boxes.take(boxes.label == label)
            for overlap in overlaps:
                pair = (mine.frame, mine.box), (theirs.frame, theirs.box, theirs.score)
                ap, recall = precision_and_recall(*pair, overlap, "bev")
                ap_3d, _ = precision_and_recall(*pair, overlap, "3d")
                percent = 100 * ap, 100 * ap_3d, 100 * recall
                rows.append((label, method, overlap, *percent, len(mine), len(theirs)))
    table = pd.DataFrame(rows, columns=["class", "method", "overlap", "ap", "ap_3d", "recall", "n_truth", "n_boxes"])
    return table, judged


def _near_ego(data: Recorded, partners_m: float) -> list[Int[ndarray, "k"]]:
    """In each frame, the ego and the agents near it."""
    near = []
    for pose in data.pose:
        away_m = pose[:, :2] - pose[0, :2]
        near.append(np.flatnonzero(np.hypot(*away_m.T) <= partners_m))
    return near


def _within(data: Recorded, boxes: RecordedBoxes, range_m: float) -> Bool[ndarray, "n"]:
    of_egos = [pose[0, :2] for pose in data.pose]
    ego = np.array(of_egos).reshape(-1, 2)
    away_m = boxes.box[:, :2] - ego[boxes.frame]
    return np.hypot(*away_m.T) <= range_m


def _joined(*parts: RecordedBoxes) -> RecordedBoxes:
    """Boxes of all parts, sorted by frame and agent."""
    whole = RecordedBoxes.concat(parts)
    return whole.take(np.lexsort([whole.agent, whole.frame]))


def _late(boxes: RecordedBoxes) -> RecordedBoxes:
    """Non-maximum suppression of all agents' boxes, class by class."""
    _, label = np.unique(boxes.label.astype(str), return_inverse=True)
    kinds = int(label.max(initial=0)) + 1
    return boxes.take(kept(boxes.frame * kinds + label, boxes.box, boxes.score))


def _fused(boxes: RecordedBoxes, method: Literal["averaging", "additive"]) -> RecordedBoxes:
    """Fused objects of the egos, with equal trust in all agents: our matching and fusion, one frame a time step.

    Every agent's boxes of a frame are one message, and every ego has received all of them. There are no evaluations of
    boxes by other agents: they need the agents' sweeps.
    """
    names = sorted(set(boxes.label.tolist()))
    label = np.array([names.index(name) for name in boxes.label], np.uint8)
    key = boxes.frame * (int(boxes.agent.max(initial=0)) + 1) + boxes.agent
    _, message = np.unique(key, return_inverse=True)
    first = np.flatnonzero(differs_from_last(message))
    index = np.arange(len(boxes)) - first[message] + 1
    score = np.clip(boxes.score, 0.0, 1.0)
    table = SentDetections(message, index, label, score, np.zeros(len(boxes), bool))
    frames, begin = np.unique(boxes.frame, return_index=True)
    ptr = np.append(begin, len(boxes))
    owner = message[begin]  # the ego's message; of the first partner, where the ego has no boxes
    lists = ObjectLists(ptr, np.arange(len(boxes)), owner)
    i, j, share = geometry.overlapping_pairs(_apart(boxes), label, message)
    same = boxes.frame[i] == boxes.frame[j]
    params = TrustParams(method=method)
    overlapping = i[same], j[same], share[same]
    groups = match(lists, table, overlapping, params)
    none = Evaluations(np.zeros(0), np.zeros(0))
    evaluated = ObjectLists(np.zeros(1, int), np.zeros(0, int), np.zeros(0, int))
    n = len(groups.seeds())
    every = np.ones(n, bool)
    evidence = SensorEvidence(np.zeros(n, int), every, every)
    others = np.flatnonzero(~np.isin(np.arange(len(first)), owner))
    of = np.searchsorted(frames, boxes.frame[first[others]])
    trusted = SenderTrust(ptr_of(of, len(frames)), others, np.ones(len(others)))
    given = FusionInput(lists, groups, table, evaluated, none, none)
    found = fuse(given, trusted, evidence, np.zeros(len(boxes)), params)
    fused = boxes.take(found.seed)
    return RecordedBoxes(fused.frame, fused.agent, fused.label, boxes.box[found.pose], found.score)


def _apart(boxes: RecordedBoxes) -> geometry.Boxes:
    """The boxes with their frames side by side, so that boxes of different frames do not overlap."""
    xyz_m = boxes.box[:, :3]
    xy_m = xyz_m[:, :2]
    centre: Float[ndarray, "n 3"] = xyz_m - xyz_m.min(axis=0, initial=0.0)
    number: Int[ndarray, "n"] = np.unique(boxes.frame, return_inverse=True)[1]
    middle = pd.DataFrame(xy_m).groupby(number).transform("mean").to_numpy()
    around_m = xy_m - middle
    centre[:, :2] = around_m
    room = 2.0 * float(np.abs(around_m).max(initial=0.0)) + 100.0
    side = int(np.ceil(np.sqrt(number.max(initial=0) + 1)))
    centre[:, 0] += room * (number % side)
    centre[:, 1] += room * (number // side)
    return geometry.Boxes(centre, boxes.box[:, 3:6], boxes.box[:, 6])
