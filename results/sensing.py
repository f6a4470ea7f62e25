"""When the vehicles of a run sensed."""

import math

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from results.run import Run


def interval_steps(run: Run, vehicle: Int[ndarray, "k"]) -> Int[ndarray, "k"]:
    """Steps from one sweep of each vehicle to its next one.

    Parameters
    ----------
    vehicle
        Numbers of equipped vehicles.
    """
    return _schedule(run)[0][vehicle]


def phase_steps(run: Run, vehicle: Int[ndarray, "k"]) -> Int[ndarray, "k"]:
    """First step of the run in which each vehicle would sense.

    Parameters
    ----------
    vehicle
        Numbers of equipped vehicles.
    """
    return _schedule(run)[1][vehicle]


def senses(
    run: Run,
    step: Int[ndarray, "k"],
    vehicle: Int[ndarray, "k"],
) -> Bool[ndarray, "k"]:
    """Whether each vehicle, which is on the road and equipped, senses in the step in the same row, if it senses at all.

    Parameters
    ----------
    step
        Steps.
    vehicle
        Numbers of equipped vehicles.
    """
    interval, phase = (column[vehicle] for column in _schedule(run))
    return step % interval == phase


def sensing_steps(run: Run) -> Int[ndarray, "s"]:
    """Steps in which any equipped vehicle can have sensed, ascending."""
    interval, phase = (np.unique(column) for column in _schedule(run))
    every = int(np.gcd.reduce([*interval, *phase]))
    return np.arange(0, int(run.manifest["steps"]), every)


def is_lock_step(run: Run) -> bool:
    """Whether all vehicles sense at the same steps."""
    return all(len(np.unique(column)) == 1 for column in _schedule(run))


def sampling_stride(run: Run, least: int) -> int:
    """Smallest stride, at least `least`, by which a sample of steps has vehicles of all intervals and phases alike.

    Every n-th step has the same share of each vehicle's sweeps if n has no factor in common with any sensing interval.
    """
    interval, _ = _schedule(run)
    common = math.lcm(*np.unique(interval).tolist())
    stride = max(1, least)
    while not is_lock_step(run) and math.gcd(stride, common) > 1:
        stride += 1
    return stride


def _schedule(run: Run) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    """Interval and phase of every vehicle, by its number. Those of vehicles that are not equipped mean nothing."""
    return run.once_for_all("sensing", lambda: _read(run))


def _read(run: Run) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    names = ["sensing_interval_steps", "sensing_phase_steps"]
    vehicles = run.table("vehicles", ["vehicle", *names])
    senses = run.config.get("sensing", True)
    interval_s = run.config.get("sensing_interval_s", run.dt_s) if senses else run.dt_s
    every = max(1, int(run.manifest.get("sense_every_steps", round(interval_s / run.dt_s))))
    size = 1 + int(vehicles.vehicle.max()) if len(vehicles) else 1
    columns = np.full(size, every), np.zeros(size, np.int64)
    for column, name in zip(columns, names, strict=True):
        known = vehicles[vehicles[name].notna()]
        column[known.vehicle.to_numpy(np.int64)] = known[name].to_numpy(np.int64)
    return columns
