"""Speeds, braking, headways and overlaps of vehicles, which stand beside published ones in `cosim compare`."""

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.driver.conflicts import begins, following, overlaps, tracks
from cosim.addons.driver.safety import stops
from results.run import Run

_APPROACH_S = 15.0
"""Time before a stop in which its braking is looked for."""


def braking_to_a_stop(run: Run) -> list[float]:
    """Largest deceleration on the way to a stop, mean over stops [m/s2]."""
    return [float(_peaks(run).mean())]


def braking_limit(run: Run, *, limit_mps2: float) -> list[float]:
    """Share of the stops in which no deceleration is larger than a limit."""
    return [float((_peaks(run) <= limit_mps2).mean())]


def sudden_slowing(run: Run, *, drop_mps: float) -> list[float]:
    """Times per 1,000 km that a car slows by this much within one second. The next time counts after it has not."""
    poses = _cars(run)
    lag = round(1.0 / run.dt_s)
    speed, actor = poses.speed_mps.to_numpy(float), poses.actor.to_numpy()
    drop = np.zeros(len(poses))
    same = (actor[lag:] == actor[:-lag]) & (poses.step.diff(lag).to_numpy()[lag:] == lag)
    drop[lag:] = np.where(same, speed[:-lag] - speed[lag:], 0.0)
    n = begins(drop >= drop_mps, drop < drop_mps / 2, actor).sum()
    return [1000 * n / _km(poses, run)]


def mild_braking(run: Run, *, begin_mps2: float, limit_mps2: float) -> list[float]:
    """Share of the decelerations of cars beyond one limit that stay below another."""
    poses = _cars(run)
    down = -poses.acceleration_mps2.fillna(0.0).to_numpy()
    event = np.cumsum(begins(down >= begin_mps2, down < begin_mps2, poses.actor.to_numpy()))
    peak = pd.Series(down).groupby(event).max()
    return [float((peak[peak >= begin_mps2] < limit_mps2).mean())]


def mean_speed(run: Run) -> list[float]:
    """Distance over time of all cars on the road, standing ones included [km/h]."""
    return [3.6 * float(_cars(run).speed_mps.astype(float).mean())]


def steady_headway(run: Run, *, closing_mps: float, acceleration_mps2: float, slowest_mps: float) -> list[float]:
    """Mean time from a leader's front to a follower's front of cars that follow steadily [s].

    Steady means: speeds differ by no more than `closing_mps`, the follower's acceleration is no larger than
    `acceleration_mps2`, and it drives with `slowest_mps` or more. Leaders are those of `cosim.addons.driver.conflicts`.
    """
    poses = tracks(run)
    pairs = following(run, poses).merge(
        poses[["step", "actor", "speed_mps", "acceleration_mps2"]], on=["step", "actor"]
    )
    length_m = run.table("vehicles", ["vehicle", "length_m"]).set_index("vehicle").length_m
    steady = (pairs.closing_mps.abs() <= closing_mps) & (pairs.acceleration_mps2.abs() <= acceleration_mps2)
    pairs = pairs[steady & (pairs.speed_mps >= slowest_mps) & pairs.actor.isin(_cars_of(run))]
    if pairs.empty:
        raise ValueError(f"{run.path.name}: no car followed another steadily. Run longer.")
    return [float(((pairs.gap_m + pairs.leader.map(length_m)) / pairs.speed_mps).astype(float).mean())]


def overlapping(run: Run) -> list[float]:
    """Pairs of vehicles that overlap by more than 0.3 m, per million km of all vehicles."""
    poses = tracks(run)
    return [1e6 * len(overlaps(run, poses)) / _km(poses, run)]


def _cars_of(run: Run) -> "pd.Series[int]":
    kinds = run.table("vehicles", ["vehicle", "vehicle_class"])
    return kinds.vehicle[kinds.vehicle_class == "car"]


def _cars(run: Run) -> pd.DataFrame:
    """Poses of cars, by actor, then step."""
    poses = tracks(run)
    poses = poses[poses.actor.isin(_cars_of(run))].sort_values(["actor", "step"], kind="stable")
    return poses.reset_index(drop=True)


def _km(poses: pd.DataFrame, run: Run) -> float:
    return float(poses.speed_mps.astype(float).sum()) * run.dt_s / 1000


def _peaks(run: Run) -> Float[ndarray, "s"]:
    """Largest deceleration of cars within some seconds before each of their stops [m/s2]."""
    poses = _cars(run)
    stopped = stops(run, poses)
    before = round(_APPROACH_S / run.dt_s)
    down = (-poses.acceleration_mps2.fillna(0.0)).groupby(poses.actor).rolling(before, min_periods=1).max()
    peak = pd.Series(down.to_numpy(), pd.MultiIndex.from_frame(poses[["actor", "step"]]))
    found = peak.reindex(pd.MultiIndex.from_frame(stopped[["actor", "step"]])).to_numpy(np.float64)
    if not len(found):
        raise ValueError(f"{run.path.name}: no car stopped. Run longer.")
    return found
