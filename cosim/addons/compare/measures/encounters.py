"""Relative speeds of vehicles near each other, and what lies behind the ages of trust."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import stats
from scipy.spatial import cKDTree

from results.measure import measure as run_metrics
from results.run import Run

MEASURES = ("relative_speed_law", "metric", "little")


def relative_speed_law(run: Run, *, radius_m: float, every_s: float, at_least_mps: float) -> list[float]:
    """Log likelihood per pair of a logistic over that of a normal distribution, of relative speeds.

    The relative speed is the rate at which the distance of two moving vehicles within a radius changes.
    """
    values = _relative(run, radius_m, every_s, at_least_mps)
    logistic, normal = (float(law.logpdf(values, *law.fit(values)).mean()) for law in (stats.logistic, stats.norm))
    return [logistic - normal]


def metric(run: Run, *, names: Sequence[str], group: str, minus: Sequence[str] = ()) -> list[float]:
    """Metrics of a run, of one group; or what they are above others."""
    topics = tuple({name.partition(".")[0] for name in (*names, *minus)})
    table = run_metrics(run, topics=topics)
    value = table[table.group == group].set_index("metric").value
    less = [float(value.get(name, np.nan)) for name in minus] or [0.0] * len(names)
    return [float(value.get(name, np.nan)) - off for name, off in zip(names, less, strict=True)]


def little(run: Run, *, radius_m: float) -> list[float]:
    """Rate of contacts of a vehicle times their mean duration, over its mean number of neighbours.

    By Little's law it is 1. Rate and duration come from the table `encounters`, neighbours from poses.
    """
    group = f"all, {radius_m:g} m"
    rate_per_h, mean_s = metric(run, names=["encounters.per_vehicle_h", "encounters.duration.km_mean_s"], group=group)
    poses, n = (
        run.sql("""
        SELECT step, x_m, y_m FROM actors JOIN vehicles ON vehicle = actor WHERE vehicle_class <> 'pedestrian'
    """),
        0,
    )
    for _, now in poses.groupby("step"):
        n += 2 * len(cKDTree(now[["x_m", "y_m"]].to_numpy(np.float64)).query_pairs(radius_m, output_type="ndarray"))
    return [rate_per_h / 3600 * mean_s * len(poses) / n]


def _relative(run: Run, radius_m: float, every_s: float, at_least_mps: float) -> Float[ndarray, "p"]:
    """Rate of change of distance of moving vehicles near each other, at some moments [m/s]."""
    poses = run.sql("""
        SELECT step, x_m, y_m, yaw_rad, speed_mps FROM actors JOIN vehicles ON vehicle = actor
        WHERE vehicle_class <> 'pedestrian' AND speed_mps >= $slowest AND step % $every = 0 ORDER BY step, actor
    """, slowest=at_least_mps, every=max(1, round(every_s / run.dt_s)))  # fmt: skip
    found = []
    for _, now in poses.groupby("step"):
        xy = now[["x_m", "y_m"]].to_numpy(np.float64)
        yaw, speed = now.yaw_rad.to_numpy(np.float64), now.speed_mps.to_numpy(np.float64)
        if len(xy) < 2:
            continue
        i, j = cKDTree(xy).query_pairs(radius_m, output_type="ndarray").T
        apart = xy[j] - xy[i]
        moving = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        away = np.maximum(np.hypot(*apart.T), 1e-6)
        found.append(((moving[j] - moving[i]) * apart).sum(axis=1) / away)
    return np.concatenate(found)
