"""Fit a detector profile to the average precision that was published of the detector.

    python -m cosim.calibrate avod --fit runs/a runs/b --hold-out runs/c runs/d

drives nothing: it takes sightings and false boxes from runs that exist, moves the parameters of each class until the
KITTI figures of single vehicles come to the published ones, and writes `sensors/profiles/<name>.toml` with the figures
on runs that the fit has not seen, and curves beside it.
"""

import argparse
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import tomli_w
from numpy import ndarray
from scipy.optimize import differential_evolution
from scipy.special import expit, logit

from cosim import resweep, rng
from cosim.cycle import CLUTTER_SLOTS, luck
from cosim.world import LABELS
from results.archive import Run, open_run
from results.metrics import detection
from results.metrics.kitti import LEVELS, Objects, Precision, average_precision
from sensors import detector
from sensors.boxes import Boxes, iou_3d
from sensors.clutter import N_CLUTTER_DRAWS, false_alarms
from sensors.evidence import Sightings, sightings
from sensors.lidar import Sweeps

PROFILES = Path(detector.__file__).parent / "profiles"
RANGE_M = 140.0
_COLUMNS = ("frame", "label", "box", "height_px", "occlusion", "truncation", "score")

FITTED = {
    "found_max_p": (logit, expit, 0.7),
    "half_returns": (np.log, np.exp, 0.7),
    "occlusion_loss": (logit, expit, 0.7),
    "xy_sigma_m": (np.log, np.exp, 0.5),
    "xy_sigma_sparse_m": (np.log, np.exp, 0.7),
    "size_sigma": (np.log, np.exp, 0.5),
    "score_logit": (np.asarray, np.asarray, 1.0),
    "score_error": (np.log, np.exp, 0.7),
}
"""Parameters that are moved, one value per class; how they are made free of bounds, and how far off they may be."""

PRIOR = 0.15
"""Weight of being one such distance off the first guess, in (points / `CLOSE`)²: picks one of many fits."""

CLOSE = 2.0


@dataclass(frozen=True, slots=True)
class Sample:
    """What the detectors of a run had before them: one frame per equipped vehicle and step."""

    name: str
    truth: Objects
    poses: pd.DataFrame
    seen: Sightings
    boxes: Boxes
    label: ndarray
    origin_m: ndarray
    z: ndarray
    false: tuple[ndarray, ndarray, Boxes, ndarray]
    """Frame, class, box and score of the false boxes."""


@dataclass(frozen=True, slots=True)
class Said:
    """What the detectors made of some samples, as the metrics want it."""

    truth: Objects
    found: Objects
    iou: ndarray
    """Overlap of each box with the actor behind it."""


def sample(run: Run, profile: str, max_frames: int) -> Sample:
    """Frames of a run, evenly spread over it."""
    params = detector.DetectorParams(profile=profile)  # type: ignore[arg-type]
    config, model = replace(resweep.config_of(run), detector=params), detector.resolved(params)
    city = resweep.city_of(config)
    steps = detection._sampled_steps(run, max_frames)
    truth, poses = detection._truth(run, steps, RANGE_M)
    seen, boxes, label, origin_m, z, false = [], [], [], [], [], []
    n_frames = n_actors = 0
    sweeps: Sweeps | None = None
    for world in resweep.worlds(run, config):
        observers = np.flatnonzero(world.equipped)
        if world.step not in steps or not len(observers):
            continue
        sweeps = resweep.sweep(world, observers, city, config, sweeps)
        here, names = sightings(sweeps, world.boxes, world.shape), world.name_key
        z.append(luck(names[observers[here.o]], names[here.actor], world.step, config))
        slots = np.repeat(names[observers], CLUTTER_SLOTS), np.tile(np.arange(CLUTTER_SLOTS), len(observers))
        u = rng.uniforms(rng.key(config.seed, rng.Stream.CLUTTER, world.step), *slots, n=N_CLUTTER_DRAWS)
        o, *made_up = false_alarms(sweeps, here, u.reshape(len(observers), CLUTTER_SLOTS, N_CLUTTER_DRAWS), model)
        false.append((o + n_frames, *made_up))
        seen.append((here.o + n_frames, here.actor + n_actors, here.n_returns, here.n_unoccluded, here.range_m))
        boxes.append(world.boxes)
        label.append(world.label)
        origin_m.append(sweeps.poses.origin_m.copy())
        n_frames += len(observers)
        n_actors += len(world)
    assert n_frames == len(poses), f"{run.path}: {len(poses)} frames in its tables, {n_frames} when cast again"
    o, kind, made_up_boxes, score = zip(*false, strict=True)
    return Sample(
        run.name, truth, poses, Sightings(*map(np.concatenate, zip(*seen, strict=True))), Boxes.concat(boxes),
        np.concatenate(label), np.concatenate(origin_m), np.concatenate(z),
        (np.concatenate(o), np.concatenate(kind), Boxes.concat(made_up_boxes), np.concatenate(score)),
    )  # fmt: skip


def said(samples: Sequence[Sample], model: SimpleNamespace | None, label: str | None = None) -> Said:
    """What the detectors report, of all classes or of one alone; without a model, everything with a return."""
    parts, first = [], 0
    for one in samples:
        truth, (found, iou) = one.truth, _found(one, model)
        if label is not None:
            kept = found.label == label
            truth, found, iou = _rows(truth, truth.label == label), _rows(found, kept), iou[kept]
        parts.append((_later(truth, first), _later(found, first), iou))
        first += len(one.poses)
    truths, founds, ious = zip(*parts, strict=True)
    return Said(_joined(truths), _joined(founds), np.concatenate(ious))


def _found(one: Sample, model: SimpleNamespace | None) -> tuple[Objects, ndarray]:
    if model is None:
        rows = np.flatnonzero(one.seen.n_returns > 0)
        actor = one.seen.actor[rows]
        made = detector.Reports(one.seen.o[rows], one.label[actor], one.boxes.take(actor), np.ones(len(rows)), actor)
        false = np.zeros(0, int), np.zeros(0, np.uint8), one.boxes.take(rows[:0]), np.zeros(0)
        least = 0.0
    else:
        made = detector.reported(one.seen, one.boxes, one.label, one.origin_m, one.z, model)
        false, least = one.false, model.min_score
    o, label, made_up, score = false
    iou = np.concatenate([iou_3d(made.boxes, one.boxes.take(made.actor)), np.zeros(len(o))])
    frame, label = np.concatenate([made.o, o]), np.concatenate([made.label, label])
    boxes, score = Boxes.concat([made.boxes, made_up]), np.concatenate([made.score, score])
    order = np.lexsort([-score, frame])
    order = order[score[order] >= least]
    table = np.column_stack([boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad])[order]
    box, ahead, height_px = detection._ahead(one.poses, frame[order], table, RANGE_M)
    order, none = order[ahead], np.zeros(int(ahead.sum()))
    names = np.array(LABELS, object)[label[order]]
    return Objects(frame[order], names, box[ahead], height_px[ahead], none.astype(int), none, score[order]), iou[order]


def _rows(objects: Objects, keep: ndarray) -> Objects:
    return Objects(*(getattr(objects, name)[keep] for name in _COLUMNS))


def _later(objects: Objects, first: int) -> Objects:
    return replace(objects, frame=objects.frame + first)


def _joined(parts: Sequence[Objects]) -> Objects:
    return Objects(*(np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS))


def figures(one: Said, label: str) -> dict[str, Precision]:
    """Average precision by level, 3D, KITTI's limits."""
    return average_precision(one.truth, one.found, label)


def ceiling(samples: Sequence[Sample], label: str) -> dict[str, Precision]:
    """What a detector would reach that reports everything with a return, exactly, and nothing else."""
    return figures(said(samples, None, label), label)


def fit(samples: Sequence[Sample], label: str, target: Sequence[float], start: SimpleNamespace) -> SimpleNamespace:
    """The model whose figures of one class come closest to the published ones; the other classes stay.

    Where the world lets nobody reach a figure, what can be reached stands for it.
    """
    row, n = LABELS.index(label), len(target)
    limit = ceiling(samples, label)
    aim = np.minimum(target, [0.97 * limit[level].ap11 for level in LEVELS[:n]])
    first = np.array([forth(getattr(start, name)[row]) for name, (forth, _, _) in FITTED.items()])
    scale = np.array([far for _, _, far in FITTED.values()])

    def model_at(x: ndarray) -> SimpleNamespace:
        model = SimpleNamespace(**{k: v.copy() if isinstance(v, ndarray) else v for k, v in vars(start).items()})
        for (name, (_, back, _)), value in zip(FITTED.items(), x * scale + first, strict=True):
            getattr(model, name)[row] = back(value)
        return model

    def cost(x: ndarray) -> float:
        answer = figures(said(samples, model_at(x), label), label)
        off = np.array([answer[level].ap11 for level in LEVELS[:n]]) - aim
        return float(((off / CLOSE) ** 2).sum() + PRIOR * (x**2).sum())

    best = differential_evolution(
        cost, [(-2.5, 2.5)] * len(first), x0=np.zeros(len(first)), popsize=6, maxiter=30, tol=1e-3,
        init="sobol", rng=np.random.default_rng(0), polish=False,
    )  # fmt: skip
    return model_at(best.x)
