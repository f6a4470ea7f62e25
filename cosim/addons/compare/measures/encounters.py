"""Laws of contacts between vehicles: which of two distributions fits better, per observation."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import stats
from scipy.spatial import cKDTree

from cosim.addons.compare.facts import Measured
from results.metrics.conflicts import tracks
from results.metrics.encounters import durations
from results.run import Run


def relative_speed_law(runs: Sequence[Run], *, radius_m: float, every_s: float, at_least_mps: float) -> Measured:
    """Log likelihood per pair of a logistic over that of a normal distribution, of relative speeds.

    The relative speed is the rate at which the distance of two moving vehicles within a radius changes.
    """
    return Measured.of_replicates([[_gain(_relative(run, radius_m, every_s, at_least_mps), "logistic", "norm")]
                                   for run in runs])  # fmt: skip


def link_duration_law(runs: Sequence[Run]) -> Measured:
    """Log likelihood per encounter of a generalised Pareto over that of an exponential distribution, of durations.

    Only encounters whose two ends were observed count. The Pareto distribution has one parameter more; Akaike's penalty
    for it is taken off.
    """
    rows = []
    for run in runs:
        table = durations(run)
        whole = table.duration_s[table.start_seen & table.end_seen & (table.duration_s > 0)].to_numpy(np.float64)
        rows.append([_gain(whole, "genpareto", "expon", loc=0.0) - 1.0 / len(whole)])
    return Measured.of_replicates(rows)


def gap_law(runs: Sequence[Run]) -> Measured:
    """Share of the variance of the logarithm of survival that a straight line explains, of times between contacts."""
    rows = []
    for run in runs:
        gap = np.sort(durations(run).gap_s.dropna().to_numpy(np.float64))
        if len(gap) < 20:
            raise ValueError(f"{run.path.name}: {len(gap)} pairs met again, too few. Run longer.")
        longer = 1.0 - (np.arange(len(gap)) + 0.5) / len(gap)
        kept = longer > 0.02  # the last few values decide nothing
        rows.append([float(np.corrcoef(gap[kept], np.log(longer[kept]))[0, 1] ** 2)])
    return Measured.of_replicates(rows)


def _gain(values: Float[ndarray, "n"], one: str, other: str, loc: float | None = None) -> float:
    """Mean log likelihood of `values` under one fitted distribution minus that under another one."""
    fixed: dict[str, Any] = {} if loc is None else {"floc": loc}
    means = []
    for name in (one, other):
        law = getattr(stats, name)
        means.append(float(law.logpdf(values, *law.fit(values, **fixed)).mean()))
    return means[0] - means[1]


def _relative(run: Run, radius_m: float, every_s: float, at_least_mps: float) -> Float[ndarray, "p"]:
    """Rate of change of distance of moving vehicles near each other, at some moments [m/s]."""
    poses = tracks(run)
    poses = poses[(poses.speed_mps >= at_least_mps) & (poses.step % max(1, round(every_s / run.dt_s)) == 0)]
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
