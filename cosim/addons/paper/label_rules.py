"""Average precision at level "all" of the same detections, under several rules of which actors are labelled.

    python -m cosim.addons.paper.label_rules RUN... [--frames N]

The command recomputes the sweeps of finished runs with a camera's pixels instead of the LiDAR's beams, with and without
buildings. It counts why actors ahead return no points. The paper evaluates "any object within the forward facing 90
degree FoV area up to 140 metres". Its data set labels actors with at least one visible pixel.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy import ndarray

from cosim.config.config import Config
from cosim.runs import replay_lidar
from cosim.world import World
from results.archive import open_run
from results.metrics.kitti import LabelledObjects, average_precision
from results.metrics.kitti_frames import actors_ahead, boxes_ahead, pairs_ahead, posed
from results.run import Run
from sensors import evidence
from sensors.scene import Scene

CLASSES = ("car", "pedestrian")
RANGE_M = 140.0
N_COLUMNS, ELEVATION_DEG = 1920, tuple(np.linspace(-25.0, 5.0, 601))
"""The camera: 1,920 columns over 90 degrees, as for KITTI's heights, and rows 0.05 degrees apart."""

NEARER_M = (120.0, 100.0, 80.0)


def label_rules(runs: Sequence[Run], max_frames: int = 1500) -> pd.DataFrame:
    """Average precision of single vehicles at level "all" by rule, and why actors return no points.

    Parameters
    ----------
    runs
        Finished runs.
    max_frames
        Largest number of frames per run.

    Returns
    -------
    One row per class and rule. Columns: class; n (actors ahead within 140 m); rule; share (labelled actors); ap11 [%];
    and for each class the shares returned, behind_buildings, behind_actors, too_far (visible, beyond the LiDAR's range)
    and too_sparse (visible, within the range), which add up to 1.
    """
    parts = [_seen(run, max_frames) for run in runs]
    first = np.cumsum([0, *(n for *_, n in parts)])
    truth = _joined([p[0] for p in parts], first)
    found = _joined([p[1] for p in parts], first)
    seen = pd.concat([p[2] for p in parts], ignore_index=True)
    rows = []
    for label in CLASSES:
        mine = truth.label == label
        some = seen[mine]
        if not len(some):
            continue
        visible, returned = some.pixels > 0, some.returns > 0
        why = {
            "returned": returned, "behind_buildings": ~visible & ~returned & (some.pixels_without_buildings > 0),
            "behind_actors": ~visible & ~returned & (some.pixels_without_buildings == 0),
            "too_far": visible & ~returned & (some.range_m > some.lidar_m),
            "too_sparse": visible & ~returned & (some.range_m <= some.lidar_m),
        }  # fmt: skip
        shares = {name: float(is_so.mean()) for name, is_so in why.items()}
        rules = {"every actor": visible | True, "with a visible pixel": visible}
        rules |= {f"with a visible pixel, within {m:g} m": visible & (some.range_m <= m) for m in NEARER_M}
        for rule, keep in (rules | {"with a return": returned}).items():
            chosen = np.flatnonzero(mine)[keep.to_numpy()]
            answer = average_precision(_rows(truth, chosen), found, label)["all"]
            rows.append({"class": label, "n": len(some), "rule": rule, "share": float(keep.mean()),
                         "ap11": answer.ap11} | shares)  # fmt: skip
    return pd.DataFrame(rows)


def _seen(run: Run, max_frames: int) -> tuple[LabelledObjects, LabelledObjects, pd.DataFrame, int]:
    """For a sample of frames: actors ahead, detections, each actor's returns, pixels and range, number of frames."""
    config = replay_lidar.config_of(run)
    every = np.arange(0, int(run.manifest["steps"]), config.sense_every_steps)
    n_frames = len(posed(run, every)[0])
    steps = every[:: max(1, -(-n_frames // max_frames))]
    truth, poses = actors_ahead(run, steps, RANGE_M)
    found = boxes_ahead(run, "local", steps, poses, RANGE_M)
    _, actors = posed(run, steps)
    i, j, *_ = pairs_ahead(poses, actors, RANGE_M)
    city = replay_lidar.city_of(config)
    counts = pd.concat([_counts(config, city, world) for world in replay_lidar.worlds(run, config, steps)])
    key = pd.MultiIndex.from_arrays([
        poses.step.to_numpy()[i], poses.observer.to_numpy()[i], actors.actor.to_numpy()[j]
    ])  # fmt: skip
    seen = counts.set_index(["step", "observer", "actor"]).reindex(key).fillna(0).reset_index(drop=True)
    seen["range_m"], seen["lidar_m"] = np.hypot(truth.box[:, 0], truth.box[:, 1]), config.lidar.max_range_m
    return truth, found, seen, len(poses)


def _counts(config: Config, city: Scene, world: World) -> pd.DataFrame:
    """LiDAR returns, pixels of a camera at the same place, and pixels without buildings, by observer and actor."""
    rows = np.flatnonzero(world.equipped)
    camera = replace(
        config.lidar, n_azimuths=N_COLUMNS, elevation_deg=ELEVATION_DEG, fov_deg=90.0, max_range_m=2 * RANGE_M,
        range_sigma_m=0.0, dropout_p=0.0,
    )  # fmt: skip
    nothing = Scene.from_footprints([], [], [])
    found = []
    for block in np.array_split(rows, -(-len(rows) // 64)):
        parts = {
            "returns": _returns(config, city, world, block),
            "pixels": _returns(replace(config, lidar=camera), city, world, block),
            "pixels_without_buildings": _returns(replace(config, lidar=camera), nothing, world, block),
        }
        found.append(pd.DataFrame(parts).fillna(0).reset_index(names=["observer", "actor"]))
    return pd.concat(found).assign(step=world.step)


def _returns(config: Config, city: Scene, world: World, rows: ndarray) -> pd.Series:
    """Number of returns by actor numbers of the observer and of the actor."""
    sweeps = replay_lidar.sweep(config, city, world, rows)
    seen = evidence.observability(sweeps, world.boxes, world.shape)
    some = seen.n_returns > 0
    index = pd.MultiIndex.from_arrays([world.actor[rows[seen.observer[some]]], world.actor[seen.actor[some]]])
    return pd.Series(seen.n_returns[some], index)


def _rows(objects: LabelledObjects, keep: ndarray) -> LabelledObjects:
    columns = ("frame", "label", "box", "height_px", "occlusion", "truncation", "score")
    return LabelledObjects(*(getattr(objects, name)[keep] for name in columns))


def _joined(parts: Sequence[LabelledObjects], first: ndarray) -> LabelledObjects:
    """Objects of several runs, with consecutive frame numbers."""
    columns = ("label", "box", "height_px", "occlusion", "truncation", "score")
    frame = np.concatenate([part.frame + n for part, n in zip(parts, first[:-1], strict=True)])
    return LabelledObjects(frame, *(np.concatenate([getattr(part, name) for part in parts]) for name in columns))


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("runs", nargs="+", type=Path, help="run folders")
    asked.add_argument("--frames", type=int, default=1500, help="frames of each run")
    words = asked.parse_args()
    found = label_rules([open_run(path) for path in words.runs], words.frames)
    print(found.round({"share": 3, "ap11": 1}).to_string(index=False))


if __name__ == "__main__":
    main()
