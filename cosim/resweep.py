"""Sweeps of a run that is over: its worlds read back from the tables, and cast again ray by ray."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
from jaxtyping import Int
from numpy import ndarray

from cosim import rng
from cosim.config import Config, load
from cosim.mobility.replay import Recorded
from cosim.roster import Roster
from cosim.scenario import find
from cosim.world import World
from results.figures import style
from results.figures.sweep import draw
from results.run import Run
from sensors import cloud
from sensors.boxes import Boxes
from sensors.lidar import Sweeps, scan
from sensors.scene import Scene


def config_of(run: Run) -> Config:
    """The experiment that a run was."""
    return load(run.path / "config.toml")


def city_of(config: Config) -> Scene:
    """The buildings that it saw."""
    return find(config.traffic.scenario, config.traffic.trace).city()


def worlds(run: Run, config: Config) -> Iterator[World]:
    """The world of every step, as it was sensed."""
    whole = replace(config.traffic, begin_s=None, warmup_s=None, trace=None)
    traffic = Recorded(whole, run.path, Roster(config.fleet, config.seed))
    try:
        for _ in range(int(run.manifest["steps"])):
            yield traffic.advance()
    finally:
        traffic.close()


def sweep(world: World, observers: Int[ndarray, "e"], city: Scene, config: Config, out: Sweeps | None = None) -> Sweeps:
    """What these rows of the world measured in that step; noise is a function of who and when, hence the same again."""
    keys = rng.keys(rng.key(config.seed, rng.Stream.SWEEP, world.step), world.name_key[observers])
    return scan(world.boxes, world.shape, np.asarray(observers), city, config.lidar, keys, out)


@dataclass(frozen=True, slots=True)
class Look:
    """What one vehicle saw in one step, in the frame of its sensor."""

    sweeps: Sweeps
    """Of this vehicle alone."""
    actors: Boxes
    """Everybody within range but itself."""
    reported: Boxes
    """What its detector made of it."""


def look(run: Run, vehicle: int, step: int) -> Look:
    """The sweep of a vehicle again; ValueError where it did not sense."""
    config = config_of(run)
    n_steps = int(run.manifest["steps"])
    if not 0 <= step < n_steps or step % config.sense_every_steps:
        every = config.sense_every_steps
        raise ValueError(
            f"--step {step}: nobody sensed then. {run.path} has the steps 0 to {n_steps - 1}"
            + (f", and senses in every {every}th." if every > 1 else ".")
        )
    run.require("actors", "vehicles", "detections")
    world = next(w for w in worlds(run, config) if w.step == step)
    there = world.actor[world.equipped]
    if vehicle not in there:
        some = ", ".join(map(str, there[:8]))
        raise ValueError(f"--vehicle {vehicle} has no sensor on the road in step {step}. These have: {some}, ...")
    row = np.flatnonzero(world.actor == vehicle)
    sweeps = sweep(world, row, city_of(config), config)
    rows = np.flatnonzero(np.linalg.norm(world.boxes.xyz_m - sweeps.poses.origin_m, axis=1) < config.lidar.max_range_m)
    rows = rows[rows != row]
    own = run.subjects.index[run.subjects.vehicle == vehicle].tolist()
    told = run.table("detections", where=(pc.field("step") == step) & pc.field("observer").isin(own))
    told = told[told.origin == "sensed"]
    boxes = Boxes(
        told[["x_m", "y_m", "z_m"]].to_numpy(float), told[["length_m", "width_m", "height_m"]].to_numpy(float),
        told.yaw_rad.to_numpy(float),
    )  # fmt: skip
    actors, reported = (sweeps.poses.to_sensor(np.zeros(len(b), int), b) for b in (world.boxes.take(rows), boxes))
    return Look(sweeps, actors, reported)


def write(run: Run, vehicle: int, step: int, out: Path | None) -> Path:
    """The sweep as a picture from above, or as a point cloud: the end of the file's name decides."""
    seen = look(run, vehicle, step)
    points = cloud.cloud_of(seen.sweeps, 0)
    out = out or run.path / f"sweep-{vehicle}-{step}.png"
    form = next((end for end in sorted(cloud.FORMATS, key=len, reverse=True) if out.name.endswith(end)), None)
    if form is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(cloud.FORMATS[form](points))
        return out
    if out.suffix not in style.FORMATS:
        raise ValueError(
            f"--out {out}: {out.suffix or 'no ending'} is neither a picture ({', '.join(style.FORMATS)}) "
            f"nor a point cloud ({', '.join(cloud.FORMATS)}). Give one of these endings."
        )
    boxes = {
        name: np.column_stack([b.xyz_m[:, :2], b.lwh_m[:, :2], b.yaw_rad])
        for name, b in (("who is there", seen.actors), ("reported by the detector", seen.reported))
    }
    title = f"What vehicle {vehicle} saw at {step * run.dt_s:g} s: {len(points[0]):,} returns"
    return style.save(draw(*points, boxes, title), out)
