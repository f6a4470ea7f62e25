"""LiDAR sweeps of a finished run: its worlds are read from the tables, and the sweeps are computed again.

They equal the run's sweeps, because their noise depends only on seed, vehicle and step.
"""

import logging
from collections.abc import Iterator
from typing import cast

import numpy as np
import pyarrow.compute as pc
from jaxtyping import Int
from numpy import ndarray

from cosim.config.config import Config, of_run_without_code
from cosim.runs.inputs import changed_inputs
from cosim.step.perception import swept
from cosim.traffic.actors import actor_key
from cosim.traffic.meshes import with_meshes
from cosim.traffic.scenario import find
from cosim.world import World
from results.run import Run
from sensors.boxes import Boxes
from sensors.lidar import Sweeps
from sensors.scene import Scene, Shape

_LOG = logging.getLogger(__name__)


def config_of(run: Run) -> Config:
    """The config in a run's manifest, to read its traffic and compute its sweeps again.

    The default choice replaces each class of the user's own, so no user code is loaded. If files that the config names
    have changed since the run, a warning is logged.
    """
    config = of_run_without_code(run.manifest["config"], run.path)
    scenario = find(config.traffic.scenario, config.traffic.trace)
    if changed := changed_inputs(config, scenario, run.manifest.get("net", {})):
        _LOG.warning("%s: changed since it was recorded: %s", run.path, ", ".join(changed))
    return config


def city_of(config: Config) -> Scene:
    """The buildings of the config's scenario, and the config's trees and meshes."""
    city = find(config.traffic.scenario, config.traffic.trace).city(config.trees, config.seed)
    return with_meshes(city, config.meshes, config.vehicle_meshes)


def worlds(run: Run, steps: Int[ndarray, "s"] | None = None) -> Iterator[World]:
    """The worlds of these steps as they were sensed, in ascending order.

    Parameters
    ----------
    steps
        Numbers of steps, in any order. None: all steps. Steps without actors are left out.

    Yields
    ------
    Worlds without attacks (`attack` is 0) and without lane paths.
    """
    run.require("actors", "vehicles")
    steps = np.arange(int(run.manifest["steps"])) if steps is None else steps
    vehicles = run.table("vehicles").sort_values("vehicle")
    shape = np.array([Shape[c.upper()] for c in vehicles.vehicle_class], np.uint8)
    lwh_m = vehicles[["length_m", "width_m", "height_m"]].to_numpy(float)
    names = zip(vehicles.sumo_id, (shape == Shape.PEDESTRIAN).tolist(), strict=True)
    name_key = np.array([actor_key(name, person) for name, person in names], np.uint64)
    equipped = vehicles.equipped.to_numpy(bool)
    for part in run.parts("actors", where=pc.field("step").isin(np.asarray(steps).tolist())):
        for step, rows in part.sort_values(["step", "actor"]).groupby("step"):
            actor = rows.actor.to_numpy(np.int64)
            xyz_m = rows[["x_m", "y_m", "z_m"]].to_numpy(float)
            boxes = Boxes(xyz_m, lwh_m[actor], rows.yaw_rad.to_numpy(float))
            speed_mps = rows.speed_mps.to_numpy(float)
            attack = np.zeros(len(actor), np.uint8)
            yield World(
                int(cast(int, step)),
                actor,
                name_key[actor],
                shape[actor],
                boxes,
                speed_mps,
                equipped[actor],
                attack,
            )


def sweep(config: Config, city: Scene, world: World, rows: Int[ndarray, "e"]) -> Sweeps:
    """Sweeps of the vehicles in these rows of the world, in new memory."""
    return swept(world, rows, city, config.lidar, config.weather, config.seed)
