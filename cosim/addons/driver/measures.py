"""Speeds, braking, headways, overlaps and times between CAMs of vehicles, beside published ones in `cosim compare`."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.driver.conflicts import begins, driven_km, following, overlaps, tracks
from cosim.addons.driver.safety import stops
from cosim.messages.cpm_generation import FASTER_MPS, INTERVAL_S, MOVED_M, TURNED_RAD
from results.run import Run

_APPROACH_S = 15.0
"""Time before a stop in which its braking is looked for."""
_MOST_BY_TIME = 3
"""N_GenCam of EN 302 637-2: CAMs in a row that follow at the latest interval, before the next waits for a second."""


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
    steps_ago = poses.step.diff(lag).to_numpy()[lag:]
    is_same = (actor[lag:] == actor[:-lag]) & (steps_ago == lag)
    slower_mps = speed[:-lag] - speed[lag:]
    drop[lag:] = np.where(is_same, slower_mps, 0.0)
    n = begins(drop >= drop_mps, drop < drop_mps / 2, actor).sum()
    return [1000 * n / driven_km(poses, run)]


def mild_braking(run: Run, *, begin_mps2: float, limit_mps2: float) -> list[float]:
    """Share of the decelerations of cars beyond one limit that stay below another."""
    poses = _cars(run)
    down = -poses.acceleration_mps2.fillna(0.0).to_numpy()
    event = np.cumsum(begins(down >= begin_mps2, down < begin_mps2, poses.actor.to_numpy()))
    peak = pd.Series(down).groupby(event).max()
    return [float((peak[peak >= begin_mps2] < limit_mps2).mean())]


def mean_speed(run: Run, *, vehicle_class: str = "car") -> list[float]:
    """Distance over time of all vehicles of a class on the road, standing ones included [km/h]."""
    return [3.6 * float(_cars(run, vehicle_class).speed_mps.astype(float).mean())]


def steady_headway(
    run: Run, *, closing_mps: float, acceleration_mps2: float, slowest_mps: float, range_m: float, longest_s: float
) -> list[float]:
    """Mean time from a leader's front to a follower's front of cars that follow steadily [s].

    Steady means: speeds differ by no more than `closing_mps`, the follower's acceleration is no larger than
    `acceleration_mps2`, and it drives with `slowest_mps` or more. Leaders are those of `cosim.addons.driver.conflicts`,
    up to `range_m` ahead. Cars more than `longest_s` behind theirs drive freely and are left out.
    """
    poses = tracks(run)
    pairs = following(run, poses, range_m).merge(
        poses[["step", "actor", "speed_mps", "acceleration_mps2"]], on=["step", "actor"]
    )
    length_m = run.table("vehicles", ["vehicle", "length_m"]).set_index("vehicle").length_m
    steady = (pairs.closing_mps.abs() <= closing_mps) & (pairs.acceleration_mps2.abs() <= acceleration_mps2)
    are_cars = pairs.actor.isin(_cars_of(run))
    pairs = pairs[steady & (pairs.speed_mps >= slowest_mps) & are_cars]
    if pairs.empty:
        raise ValueError(f"{run.path.name}: no car followed another steadily. Run longer.")
    headway_s = ((pairs.gap_m + pairs.leader.map(length_m)) / pairs.speed_mps).astype(float)
    return [float(headway_s[headway_s <= longest_s].mean())]


def overlapping(run: Run) -> list[float]:
    """Pairs of vehicles that overlap by more than 0.3 m, per million km of all vehicles."""
    poses = tracks(run)
    return [1e6 * len(overlaps(run, poses)) / driven_km(poses, run)]


def cam_interval(run: Run) -> list[float]:
    """Mean time between the CAMs of a car [s]."""
    return [float(_cam_intervals_s(run).mean())]


def cam_interval_shares(run: Run, *, edges_s: Sequence[float]) -> Float[ndarray, "k"]:
    """Share of the times between the CAMs of a car that lie above each edge and up to the next."""
    n, _ = np.histogram(_cam_intervals_s(run) - run.dt_s / 2, edges_s)
    return n / n.sum()


def _cars_of(run: Run, vehicle_class: str = "car") -> "pd.Series[int]":
    kinds = run.table("vehicles", ["vehicle", "vehicle_class"])
    return kinds.vehicle[kinds.vehicle_class == vehicle_class]


def _cars(run: Run, vehicle_class: str = "car") -> pd.DataFrame:
    """Poses of cars, or of another class, by actor, then step."""
    poses = tracks(run)
    poses = poses[poses.actor.isin(_cars_of(run, vehicle_class))].sort_values(["actor", "step"], kind="stable")
    return poses.reset_index(drop=True)


def _peaks(run: Run) -> Float[ndarray, "s"]:
    """Largest deceleration of cars within some seconds before each of their stops [m/s2]."""
    poses = _cars(run)
    stopped = stops(run, poses)
    before = round(_APPROACH_S / run.dt_s)
    down = (-poses.acceleration_mps2.fillna(0.0)).groupby(poses.actor).rolling(before, min_periods=1).max()
    peak = pd.Series(down.to_numpy(), pd.MultiIndex.from_frame(poses[["actor", "step"]]))
    found = peak.reindex(pd.MultiIndex.from_frame(stopped[["actor", "step"]])).to_numpy(float)
    if not len(found):
        raise ValueError(f"{run.path.name}: no car stopped. Run longer.")
    return found


def _cam_intervals_s(run: Run) -> Float[ndarray, "n"]:
    """Times between the CAMs that each car would send by EN 302 637-2, clause 6.1.3, if it checked in every step."""
    poses = _cars(run)
    wide = [poses.pivot(index="step", columns="actor", values=name) for name in ("x_m", "y_m", "yaw_rad", "speed_mps")]
    poses_of_step = np.stack([one.to_numpy(float) for one in wide], axis=1)  # steps, quantities, cars
    longest = round(INTERVAL_S / run.dt_s)
    n = poses_of_step.shape[2]
    sent = np.full((4, n), np.nan)
    since, by_time = np.zeros(n, int), np.zeros(n, int)
    wait, found = np.full(n, longest), [np.zeros(0, int)]
    for now in poses_of_step:
        since += 1
        x, y, turn, faster = now - sent
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        changed = np.hypot(x, y) > MOVED_M
        changed |= np.abs(turn) > TURNED_RAD
        changed |= np.abs(faster) > FASTER_MPS
        due = np.isfinite(x) & (changed | (since >= wait))
        found.append(since[due])
        by_time[due] = np.where(changed, 0, by_time + 1)[due]
        wait[by_time >= _MOST_BY_TIME] = longest
        wait = np.where(due & changed, since, wait)
        new = due | (np.isfinite(now[0]) & np.isnan(sent[0]))
        sent[:, new] = now[:, new]
        since[new] = 0
    return np.concatenate(found) * run.dt_s
