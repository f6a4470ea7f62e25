"""Early fusion: the detector looks at the merged clouds of an ego and its partners, as in Cooper [1]_.

It is computed from the recorded numbers of returns, for any partners, delay and errors on the same sweeps. With
`[early_fusion]`, a run does the same within its cycle (`cosim.step.early_fusion`).

References
----------
.. [1] Q. Chen, S. Tang, Q. Yang, S. Fu, "Cooper: Cooperative perception for connected autonomous vehicles based on 3D
   point clouds", ICDCS 2019.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.perception.kitti_frames import BOX, Poses, at_steps
from cosim.base.codes import ObjectClass
from cosim.base.plane import turned_by
from cosim.runs.replay_lidar import city_of, config_of, sweep, worlds
from cosim.step.perception import detector_draws
from cosim.traffic.actors import actor_key
from results.run import Run
from sensors.boxes import Boxes
from sensors.merged_clouds import Views, detect
from sensors.statistical_detector import StatisticalDetector

POINT_BYTES = 16
"""A point as data sets store it: x, y, z and intensity in single precision."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Disturbance:
    """What is wrong with the clouds of partners."""

    delay_steps: int
    """Their age. A partner knows where it was then; what it saw may have moved since."""
    error: Float[ndarray, "partners 3"]
    """Of each row of `beside`: error of its pose, east and north [m] and heading [rad]."""


def early_boxes(run: Run, poses: Poses, actors: pd.DataFrame, beside: pd.DataFrame, wrong: Disturbance) -> pd.DataFrame:
    """What the run's detector finds in merged clouds, as `sensors.merged_clouds.detect`.

    Parameters
    ----------
    poses, actors
        Egos and all actors of their steps, as `cosim.addons.perception.kitti_frames.posed` returns them.
    beside
        Partners (`observer`) of each frame.

    Returns
    -------
    Boxes: frame, class, box in the world frame, score, and the actor. False positives, which are those of the ego's own
    sweep, are not among them.

    Raises
    ------
    ValueError
        If the detector of the run is not one of the statistical ones.
    """
    config = config_of(run)
    if config.detector.model == "ideal":
        raise ValueError(f'{run.path.name}: detector.model = "ideal" finds all; early fusion needs a statistical one.')
    detector, found = StatisticalDetector(config.detector), []
    every = _views(run, poses, actors, beside, wrong)
    for step in np.unique(every.step):
        views = every[every.step == step]
        egos = poses[poses.step == step]
        here = actors[actors.step == step]
        actor = here.actor.to_numpy()
        names = _keys(run, actor)
        own = names[np.searchsorted(actor, egos.observer.to_numpy())]
        true = here[[*BOX]].to_numpy(float)
        early = detect(
            detector,
            views=Views(
                observer=np.searchsorted(egos.frame.to_numpy(), views.frame.to_numpy()),
                actor=np.searchsorted(actor, views.actor.to_numpy()),
                n_returns=views.n_points.to_numpy(np.int64),
                n_unoccluded=views.n_unoccluded.to_numpy(np.int64),
                range_m=views.away_m.to_numpy(),
                off_m=views[["east", "north"]].to_numpy(),
            ),
            boxes=Boxes(
                true[:, :3],
                true[:, 3:6],
                true[:, 6],
            ),
            label=np.array([ObjectClass[name.upper()] for name in here.label], np.uint8),
            origin_m=egos[["x_m", "y_m", "z_m"]].to_numpy(float),
            draws=detector_draws(config.seed, run.dt_s, int(step), names, own),
        ).reports
        boxes = early.boxes
        columns = np.column_stack([boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad])
        of_step = pd.DataFrame(columns, columns=[*BOX]).assign(
            frame=egos.frame.to_numpy()[early.observer],
            score=early.score,
            truth_actor=actor[early.actor],
        )
        labels = np.array([c.name.lower() for c in ObjectClass], object)
        of_step["class"] = labels[early.label]
        found.append(of_step)
    return pd.concat(found, ignore_index=True)


def _views(run: Run, poses: Poses, actors: pd.DataFrame, beside: pd.DataFrame, wrong: Disturbance) -> pd.DataFrame:
    """Returns of every vehicle on every object, by frame, and how far its points are displaced (east, north)."""
    ego = poses[["frame", "step", "observer"]].assign(at=poses.step, partner=-1)
    theirs = beside.merge(poses[["frame", "step"]], on="frame", how="left")
    theirs = theirs.assign(at=theirs.step - wrong.delay_steps, partner=np.arange(len(theirs)))
    watching = pd.concat([ego, theirs], ignore_index=True)
    steps = np.unique(watching["at"])
    seen = run.table("observability", where=at_steps(steps))
    seen = seen[seen.n_points > 0].rename(columns={"step": "at"})
    views = watching.merge(seen, on=["at", "observer"])
    then = run.table("actors", ["step", "actor", "x_m", "y_m"], at_steps(steps)).set_index(["step", "actor"])
    now = actors.set_index(["step", "actor"])[["x_m", "y_m"]]
    there = then.reindex(pd.MultiIndex.from_frame(views[["at", "actor"]])).to_numpy(float)
    here = now.reindex(pd.MultiIndex.from_frame(views[["step", "actor"]])).to_numpy(float)
    own = then.reindex(pd.MultiIndex.from_frame(views[["at", "observer"]])).to_numpy(float)
    arm = there - own
    error = np.vstack([wrong.error, np.zeros(3)])[views.partner.to_numpy()]  # the last row is the ego's
    off = there - here + turned_by(error[:, 2], arm)
    off = off - arm + error[:, :2]
    east, north = off.T
    views = views.assign(east=east, north=north, away_m=np.hypot(*arm.T))
    return views[np.isfinite(off).all(axis=1)]


def _keys(run: Run, actor: Int[ndarray, "n"]) -> ndarray:
    """Keys of actors in random draws."""
    vehicles = run.table("vehicles", ["vehicle", "sumo_id", "vehicle_class"]).set_index("vehicle")
    some = vehicles.loc[actor]
    pairs = zip(some.sumo_id, some.vehicle_class == "pedestrian", strict=True)
    return np.array([actor_key(name, person) for name, person in pairs], np.uint64)


def cloud_bytes(run: Run) -> list[float]:
    """Mean length of the raw cloud of one sweep [MB], at 16 bytes per return. Some sweeps are computed again."""
    config = config_of(run)
    city, counts = city_of(config), []
    steps = np.linspace(0, int(run.manifest["steps"]) - 1, 4).astype(int)
    for world in worlds(run, steps):
        row = np.flatnonzero(world.equipped)[:10]
        range_m = sweep(config, city, world, row).range_m
        counts += np.isfinite(range_m).sum(axis=(1, 2)).tolist()
    return [float(np.mean(counts)) * POINT_BYTES / 1e6]
