"""Recorded data sets through our matching, fusion and metrics: average precision alone, with late fusion, and fused."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.offline.recorded_trust import Trusted, trusted
from results.datasets import dair, kitti_folder, opv2v
from results.datasets.recorded import Boxes, Recorded
from results.metrics.kitti import LEVELS, LOOSE, STRICT, Objects, average_precision
from results.metrics.late_fusion import kept
from results.metrics.matched import precision_and_recall
from sensors import boxes as geometry
from trust.fusion import SensorEvidence, fuse
from trust.matching import match
from trust.params import TrustParams
from trust.tables import Detections, Evaluations, FusionInput, ObjectLists, SenderTrust

Layout = Literal["opv2v", "dair-v2x", "kitti"]
CLASSES = ("car", "pedestrian", "cyclist", "truck")
_KITTI_COLUMNS = ("class", "level", "overlap", "ap11", "ap40", "n_truth", "n_boxes")


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
) -> tuple[dict[str, Any], pd.DataFrame]:
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

    Returns
    -------
    What was read: layout, and numbers of frames, agents, objects and boxes. And average precision in percent: for KITTI
    by class and level; for the others by class, method and overlap, `ap` from above and `ap_3d` of volumes. The table
    is empty if there are no detections.

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
    if found == "kitti":
        return _kitti(*kitti_folder.read(folder, detections))
    data = (opv2v if found == "opv2v" else dair).read(folder, detections)
    about: dict[str, Any] = {
        "layout": found, "frames": len(data.frames), "agents": sum(map(len, data.agents)), "objects": len(data.truth),
        "boxes": len(data.found),
    }  # fmt: skip
    if not len(data.found):
        return about, pd.DataFrame()
    helps = _helping(data, partners_m)
    table, judged = _cooperative(data, helps, range_m, overlaps)
    about["frames_without_clouds"] = judged.n_unread
    about["trust"] = judged.agents.astype(object).where(judged.agents.notna(), None).to_dict("records")
    return about, table


def _kitti(truth: Objects, found: Objects) -> tuple[dict[str, Any], pd.DataFrame]:
    rows = []
    for label in CLASSES if len(found) else ():
        n = int((truth.label == label).sum())
        for overlap in dict.fromkeys((STRICT[label], LOOSE[label])) if n else ():
            answer = average_precision(truth, found, label, min_overlap=overlap)
            rows += [
                (label, level, overlap, answer[level].ap11, answer[level].ap40, answer[level].n_truth,
                 int((found.label == label).sum()))
                for level in LEVELS
            ]  # fmt: skip
    frames = int(truth.frame.max(initial=-1)) + 1
    about = {"layout": "kitti", "frames": frames, "agents": frames, "objects": len(truth), "boxes": len(found)}
    return about, pd.DataFrame(rows, columns=list(_KITTI_COLUMNS))


def _cooperative(
    data: Recorded, helps: Bool[ndarray, "n"], range_m: float, overlaps: Sequence[float]
) -> tuple[pd.DataFrame, Trusted]:
    """Average precision of the ego alone, of late fusion and of our fusion, by class and overlap; and trust."""
    received = _take(data.found, helps)
    judged = trusted(data, received)
    methods: dict[str, Boxes] = {
        "ego": _take(data.found, data.found.agent == 0),
        "late": _late(received),
        "averaging": _fused(received, "averaging"),
        "additive": _fused(received, "additive"),
    }
    if not judged.n_unread:  # in all frames, as the others
        methods["trupercept_1"] = judged.fused
    truth = _take(data.truth, _within(data, data.truth, range_m))
    rows = []
    for label in dict.fromkeys(truth.label.tolist()):
        mine = _take(truth, truth.label == label)
        for method, boxes in methods.items():
            theirs = _take(boxes, (boxes.label == label) & _within(data, boxes, range_m))
            for overlap in overlaps:
                pair = (mine.frame, mine.box), (theirs.frame, theirs.box, theirs.score)
                ap, recall = precision_and_recall(*pair, overlap, "bev")
                ap_3d, _ = precision_and_recall(*pair, overlap, "3d")
                rows.append((label, method, overlap, 100 * ap, 100 * ap_3d, 100 * recall, len(mine), len(theirs)))
    table = pd.DataFrame(rows, columns=["class", "method", "overlap", "ap", "ap_3d", "recall", "n_truth", "n_boxes"])
    return table, judged


def _helping(data: Recorded, partners_m: float) -> Bool[ndarray, "n"]:
    """Whether each box is of the ego or of an agent near it."""
    near = [np.hypot(*(pose[:, :2] - pose[0, :2]).T) <= partners_m for pose in data.pose]
    return np.array(
        [near[f][a] for f, a in zip(data.found.frame.tolist(), data.found.agent.tolist(), strict=True)], bool
    )


def _within(data: Recorded, boxes: Boxes, range_m: float) -> Bool[ndarray, "n"]:
    ego = np.array([pose[0, :2] for pose in data.pose]).reshape(-1, 2)
    return np.hypot(*(boxes.box[:, :2] - ego[boxes.frame]).T) <= range_m


def _take(boxes: Boxes, keep: ndarray) -> Boxes:
    return Boxes(boxes.frame[keep], boxes.agent[keep], boxes.label[keep], boxes.box[keep], boxes.score[keep])


def _late(boxes: Boxes) -> Boxes:
    """Non-maximum suppression of all agents' boxes, class by class."""
    _, label = np.unique(boxes.label.astype(str), return_inverse=True)
    kinds = int(label.max(initial=0)) + 1
    return _take(boxes, kept(boxes.frame * kinds + label, boxes.box, boxes.score))


def _fused(boxes: Boxes, method: Literal["averaging", "additive"]) -> Boxes:
    """Fused objects of the egos, with equal trust in all agents: our matching and fusion, one frame a time step.

    Every agent's boxes of a frame are one message, and every ego has received all of them. There are no evaluations of
    boxes by other agents: they need the agents' sweeps.
    """
    names = sorted(set(boxes.label.tolist()))
    label = np.array([names.index(name) for name in boxes.label], np.uint8)
    key = boxes.frame * (int(boxes.agent.max(initial=0)) + 1) + boxes.agent
    _, message = np.unique(key, return_inverse=True)
    first = np.flatnonzero(np.diff(message, prepend=-1))
    index = np.arange(len(boxes)) - first[message] + 1
    table = Detections(message, index, label, np.clip(boxes.score, 0.0, 1.0), np.zeros(len(boxes), bool))
    frames, begin = np.unique(boxes.frame, return_index=True)
    ptr = np.append(begin, len(boxes))
    owner = message[begin]  # the ego's message; of the first partner, where the ego has no boxes
    lists = ObjectLists(ptr, np.arange(len(boxes)), owner)
    pairs = geometry.overlapping_pairs(_apart(boxes), label, message)
    same = boxes.frame[pairs[0]] == boxes.frame[pairs[1]]
    params = TrustParams(method=method)
    groups = match(lists, table, (pairs[0][same], pairs[1][same], pairs[2][same]), params)
    none = Evaluations(np.zeros(0), np.zeros(0))
    evaluated = ObjectLists(np.zeros(1, int), np.zeros(0, int), np.zeros(0, int))
    n = len(groups.seeds())
    evidence = SensorEvidence(np.zeros(n, int), np.ones(n, bool), np.ones(n, bool))
    others = np.flatnonzero(~np.isin(np.arange(len(first)), owner))
    of = np.searchsorted(frames, boxes.frame[first[others]])
    trusted = SenderTrust(np.searchsorted(of, np.arange(len(frames) + 1)), others, np.ones(len(others)))
    given = FusionInput(lists, groups, table, evaluated, none, none)
    found = fuse(given, trusted, evidence, np.zeros(len(boxes)), params)
    fused = _take(boxes, found.seed)
    return Boxes(fused.frame, fused.agent, fused.label, boxes.box[found.pose], found.score)


def _apart(boxes: Boxes) -> geometry.Boxes:
    """The boxes with their frames side by side, so that boxes of different frames do not overlap."""
    centre: Float[ndarray, "n 3"] = boxes.box[:, :3] - boxes.box[:, :3].min(axis=0, initial=0.0)
    number: Int[ndarray, "n"] = np.unique(boxes.frame, return_inverse=True)[1]
    middle = pd.DataFrame(boxes.box[:, :2]).groupby(number).transform("mean").to_numpy()
    centre[:, :2] = boxes.box[:, :2] - middle
    room = 2.0 * float(np.abs(centre[:, :2]).max(initial=0.0)) + 100.0
    side = int(np.ceil(np.sqrt(number.max(initial=0) + 1)))
    centre[:, 0] += room * (number % side)
    centre[:, 1] += room * (number // side)
    return geometry.Boxes(centre, boxes.box[:, 3:6], boxes.box[:, 6])
