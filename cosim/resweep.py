"""Sweeps of a run that is over: its worlds read back from the tables, and cast again ray by ray."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim import rng
from cosim.config import Config, load
from cosim.mobility.replay import Recorded
from cosim.roster import Roster
from cosim.scenario import find
from cosim.world import World
from results.archive import Run
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
