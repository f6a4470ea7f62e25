"""Fit a detector profile to the average precision that was published of the detector.

    python -m tests.calibration.fit_detector avod --fit runs/a runs/b --hold-out runs/c runs/d

runs no simulation: it takes observability and false positives from runs that exist, moves the parameters of each class
until the KITTI figures of single vehicles come to the published ones, and writes `sensors/profiles/<name>.toml` with
the figures on runs that the fit has not seen, and curves beside it.
"""

import argparse
import json
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import tomli_w
from numpy import ndarray
from scipy.optimize import differential_evolution
from scipy.special import expit, logit

import sensors
from cosim.addons.perception import kitti_frames
from cosim.addons.perception.kitti import LEVELS, LOOSE, STRICT, LabelledObjects, Precision, average_precision
from cosim.runs import replay_lidar
from cosim.step.perception import detector_draws
from cosim.world import LABELS
from results.archive import open_run
from results.figures import style
from results.run import Run
from sensors.boxes import Boxes, iou_3d
from sensors.evidence import Observability, observability
from sensors.false_positives import false_positives
from sensors.reports import Reports
from sensors.statistical_detector import DetectorParams, pair_normals, reports_of_actors
from tests.calibration import picture as pictures

PROFILES = Path(sensors.__file__).parent / "profiles"
RANGE_M = 140.0
_COLUMNS = ("frame", "label", "box", "height_px", "occlusion", "truncation", "score")

FITTED = {
    "found_max_p": (logit, expit, 0.3),
    "half_returns": (np.log, np.exp, 0.4),
    "occlusion_loss": (logit, expit, 0.7),
    "xy_sigma_m": (np.log, np.exp, 0.3),
    "xy_sigma_sparse_m": (np.log, np.exp, 0.4),
    "size_sigma": (np.log, np.exp, 0.3),
    "score_logit": (np.asarray, np.asarray, 1.0),
    "score_error": (np.log, np.exp, 0.5),
}
"""Parameters that are moved, one value per class; how they are made free of bounds, and how far off they may be."""

PRIOR = 0.15
"""Weight of being one such distance off the first guess, in (points / `CLOSE`)²: picks one of many fits."""

CLOSE = 2.0
GENERATIONS = 30


@dataclass(frozen=True, slots=True)
class Sample:
    """Input of the detectors of a run: one frame per equipped vehicle and step."""

    name: str
    truth: LabelledObjects
    poses: kitti_frames.Poses
    seen: Observability
    boxes: Boxes
    label: ndarray
    origin_m: ndarray
    z: ndarray
    false: tuple[ndarray, ndarray, Boxes, ndarray]
    """Frame, class, box and score of the false positives."""


@dataclass(frozen=True, slots=True)
class Reported:
    """What the detectors report on some samples, as the metrics take it."""

    truth: LabelledObjects
    found: LabelledObjects
    iou: ndarray
    """Overlap of each box with the actor behind it."""


def sample(run: Run, profile: str, model: SimpleNamespace, max_frames: int) -> Sample:
    """Frames of a run, evenly spread over it; the false positives are those of the model."""
    params = DetectorParams(model=profile)
    config = replace(replay_lidar.config_of(run), detector=params)
    city = replay_lidar.city_of(config)
    steps = kitti_frames.sampled_steps(run, max_frames)
    truth, poses = kitti_frames.actors_ahead(run, steps, RANGE_M)
    seen, boxes, label, origin_m, z, false = (list[Any]() for _ in range(6))
    n_frames = n_actors = 0
    for world in replay_lidar.worlds(run):
        observers = np.flatnonzero(world.equipped)
        if world.step not in steps or not len(observers):
            continue
        sweeps = replay_lidar.sweep(config, city, world, observers)
        here = observability(sweeps, world.boxes, world.shape)
        names = world.name_key
        draws = detector_draws(config.seed, config.traffic.step_s, world.step, names, names[observers])
        z.append(pair_normals(here, draws, model))
        spurious = false_positives(sweeps, here, draws, model)
        false.append((spurious.observer + n_frames, spurious.label, spurious.boxes, spurious.score))
        seen.append((here.observer + n_frames, here.actor + n_actors, here.n_returns, here.n_unoccluded, here.range_m))
        boxes.append(world.boxes)
        label.append(world.label)
        origin_m.append(sweeps.poses.origin_m.copy())
        n_frames += len(observers)
        n_actors += len(world)
    assert n_frames == len(poses), f"{run.path}: {len(poses)} frames in its tables, {n_frames} when cast again"
    frame, kind, false_boxes, score = zip(*false, strict=True)
    return Sample(
        run.name, truth, poses, Observability(*map(np.concatenate, zip(*seen, strict=True))), Boxes.concat(boxes),
        np.concatenate(label), np.concatenate(origin_m), np.concatenate(z),
        (np.concatenate(frame), np.concatenate(kind), Boxes.concat(false_boxes), np.concatenate(score)),
    )  # fmt: skip


def reported(samples: Sequence[Sample], model: SimpleNamespace | None, label: str | None = None) -> Reported:
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
    return Reported(_joined(truths), _joined(founds), np.concatenate(ious))


def _found(one: Sample, model: SimpleNamespace | None) -> tuple[LabelledObjects, ndarray]:
    if model is None:
        rows = np.flatnonzero(one.seen.n_returns > 0)
        actor = one.seen.actor[rows]
        made = Reports.of_actors(one.seen, rows, one.label[actor], one.boxes.take(actor), np.ones(len(rows)))
        false = np.zeros(0, int), np.zeros(0, np.uint8), one.boxes.take(rows[:0]), np.zeros(0)
        least = 0.0
    else:
        made = reports_of_actors(one.seen, one.boxes, one.label, one.origin_m, one.z, model)
        false, least = one.false, model.min_score
    o, label, false_boxes, score = false
    iou = np.concatenate([iou_3d(made.boxes, one.boxes.take(made.actor)), np.zeros(len(o))])
    frame, label = np.concatenate([made.observer, o]), np.concatenate([made.label, label])
    boxes, score = Boxes.concat([made.boxes, false_boxes]), np.concatenate([made.score, score])
    order = np.lexsort([-score, frame])
    order = order[score[order] >= least]
    table = np.column_stack([boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad])[order]
    box, ahead, height_px = kitti_frames.ahead_of(one.poses, frame[order], table, RANGE_M)
    order, none = order[ahead], np.zeros(int(ahead.sum()))
    names = np.array(LABELS, object)[label[order]]
    return LabelledObjects(
        frame[order], names, box[ahead], height_px[ahead], none.astype(int), none, score[order]
    ), iou[order]


def _rows(objects: LabelledObjects, keep: ndarray) -> LabelledObjects:
    return LabelledObjects(*(getattr(objects, name)[keep] for name in _COLUMNS))


def _later(objects: LabelledObjects, first: int) -> LabelledObjects:
    return replace(objects, frame=objects.frame + first)


def _joined(parts: Sequence[LabelledObjects]) -> LabelledObjects:
    return LabelledObjects(*(np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS))


def of_actors_with_returns(samples: Sequence[Sample], label: str, everything: Reported) -> dict[str, Precision]:
    """The same where only actors with a return are labelled, as in data sets labelled by people or from pixels."""
    mine = _rows(everything.truth, everything.truth.label == label)
    ideal = reported(samples, None, label).found
    where = [np.ascontiguousarray(np.column_stack([a.frame, a.box[:, :2]])).view("V24")[:, 0] for a in (mine, ideal)]
    found = _rows(everything.found, everything.found.label == label)
    return average_precision(_rows(mine, np.isin(where[0], where[1])), found, label)


def figures(one: Reported, label: str, loose: bool = False) -> dict[str, Precision]:
    """Average precision by level, 3D, KITTI's limits; `loose` takes the smaller ones."""
    return average_precision(one.truth, one.found, label, min_overlap=(LOOSE if loose else STRICT)[label])


def ceiling(samples: Sequence[Sample], label: str) -> dict[str, Precision]:
    """What a detector would reach that reports everything with a return, exactly, and nothing else."""
    return figures(reported(samples, None, label), label)


def fit(
    samples: Sequence[Sample], label: str, target: Sequence[float], start: SimpleNamespace, loose: Sequence[float] = ()
) -> SimpleNamespace:
    """The model whose figures of one class come closest to the published ones; the other classes stay.

    A figure beyond the ceiling of the data is replaced by what can be reached. `loose` are figures at the smaller
    overlap; where there are any, they tell objects that are missed from boxes that are off.
    """
    row = LABELS.index(label)
    limit = ceiling(samples, label)
    aims = [
        np.minimum(wanted, [0.97 * limit[level].ap11 for level in LEVELS[: len(wanted)]]) for wanted in (target, loose)
    ]
    first = np.array([forth(getattr(start, name)[row]) for name, (forth, _, _) in FITTED.items()])
    scale = np.array([far for _, _, far in FITTED.values()])

    def model_at(x: ndarray) -> SimpleNamespace:
        model = SimpleNamespace(**{k: v.copy() if isinstance(v, ndarray) else v for k, v in vars(start).items()})
        for (name, (_, back, _)), value in zip(FITTED.items(), x * scale + first, strict=True):
            getattr(model, name)[row] = back(value)
        return model

    def cost(x: ndarray) -> float:
        found, total = reported(samples, model_at(x), label), PRIOR * float((x**2).sum())
        for is_loose, aim in enumerate(aims):
            if len(aim):
                answer = figures(found, label, bool(is_loose))
                off = np.array([answer[level].ap11 for level in LEVELS[: len(aim)]]) - aim
                total += float(((off / CLOSE) ** 2).sum())
        return total

    best = differential_evolution(
        cost, [(-2.5, 2.5)] * len(first), x0=np.zeros(len(first)), popsize=6, maxiter=GENERATIONS, tol=1e-3,
        init="sobol", rng=np.random.default_rng(0), polish=False,
    )  # fmt: skip
    return model_at(best.x)


def as_model(parameters: dict[str, Any]) -> SimpleNamespace:
    """The numbers of a profile's file, tuples as arrays."""
    return SimpleNamespace(**{k: np.array(v) if isinstance(v, list) else v for k, v in parameters.items()})


def as_written(values: ndarray) -> list[float]:
    """Plain numbers of four digits."""
    return [float(f"{value:.4g}") for value in values]


def calibrate(
    name: str, fitted_on: Sequence[Run], held_out: Sequence[Run], max_frames: int = 1500, is_fitted: bool = False
) -> Path:
    """Fit, evaluate on runs that the fit has not seen, and write the profile and its picture.

    With `is_fitted` the fitted values of the profile are kept, for a profile whose other values have changed.
    """
    path = PROFILES / f"{name}.toml"
    profile = tomllib.loads(path.read_text(encoding="utf-8"))
    guess = {k: v for k, v in profile["first_guess"].items() if k != "source"}
    model = as_model(guess)
    samples = [sample(run, name, model, max_frames) for run in fitted_on]
    loose = profile.get("published_loose", {})
    if is_fitted:
        model = as_model(guess | profile["fitted"])
    for label, target in () if is_fitted else profile["published"].items():
        model = fit(samples, label, target, model, loose.get(label, ()))
    fitted = {name: as_written(getattr(model, name)) for name in FITTED}
    model = as_model(guess | fitted)

    fresh = [sample(run, name, model, max_frames) for run in held_out]
    everything = reported(fresh, model)
    n_frames = sum(len(one.poses) for one in fresh)
    report: dict[str, Any] = {
        "fitted_on": [about(run) for run in fitted_on], "held_out": [about(run) for run in held_out],
        "frames": n_frames, "levels": list(LEVELS),
    }  # fmt: skip
    curves, scores = {}, {}
    for label, target in profile["published"].items():
        on_fresh = figures(everything, label)
        report[label] = {
            "published": target,
            **{what: [round(float(answer[level].ap11), 1) for level in LEVELS]
               for what, answer in (
                   ("reached", on_fresh),
                   ("on_fitted_runs", figures(reported(samples, model, label), label)),
                   ("most_that_can_be", ceiling(fresh, label)),
                   ("reached_of_the_seen", of_actors_with_returns(fresh, label, everything)),
               )},
        }  # fmt: skip
        if label in loose:
            reached = figures(everything, label, loose=True)
            report[label]["published_loose"] = loose[label]
            report[label]["reached_loose"] = [round(float(reached[level].ap11), 1) for level in LEVELS]
        own = everything.found.label == label
        hit = own & (everything.iou > STRICT[label])
        scores[label] = everything.found.score[hit], everything.found.score[own & ~hit]
        curves[label] = {level: on_fresh[level].precision for level in LEVELS}
        report[label]["boxes_per_frame_above_half"] = [
            round(float((values > 0.5).sum() / n_frames), 3) for values in scores[label]
        ]
    write(path, profile | {"fitted": fitted, "calibration": report})
    picture = style.save(pictures.draw(curves, scores, n_frames), path.with_suffix(".png"))
    for label in profile["published"]:
        print(label, *(f"{what}: {value}" for what, value in report[label].items()), sep="\n  ")
    return picture


def about(run: Run) -> str:
    """What a run was, so that it can be driven again."""
    config = replay_lidar.config_of(run)
    return (
        f"{config.traffic.scenario}, traffic.seed = {config.traffic.seed}, seed = {config.seed}, "
        f"{run.manifest['steps'] * run.dt_s:g} s sensed every {config.sensing_interval_s:g} s, "
        f"fleet.penetration_p = {config.fleet.penetration_p:g}"
    )


def write(path: Path, profile: dict[str, Any]) -> None:
    """A profile as TOML, lists of numbers on one line."""

    def one_line(found: re.Match[str]) -> str:
        return f"= {json.dumps(tomllib.loads(f'x = {found[1]}')['x'])}"

    text = re.sub(r"= (\[[-+\d.e,\s\[\]]*\n\])", one_line, tomli_w.dumps(profile))
    path.write_text(text, encoding="utf-8")


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("profile", choices=sorted(p.stem for p in PROFILES.glob("*.toml")))
    asked.add_argument("--fit", nargs="+", required=True, type=Path, help="run folders to fit on")
    asked.add_argument("--hold-out", nargs="+", required=True, type=Path, help="run folders to evaluate on")
    asked.add_argument("--keep", action="store_true", help="keep the fitted values and evaluate them again")
    words = asked.parse_args()
    fitted_on, held_out = ([open_run(path) for path in paths] for paths in (words.fit, words.hold_out))
    print(calibrate(words.profile, fitted_on, held_out, is_fitted=words.keep))


if __name__ == "__main__":
    main()
