"""Measures of how vehicles meet (relative speed, Little's law), and one that reads any metric of a run."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import stats
from scipy.spatial import cKDTree

from cosim.base.codes import PARKED
from cosim.base.plane import ahead_of
from results.measure import measure as run_metrics
from results.metrics import encounters
from results.run import Run

MEASURES = ("relative_speed_law", "metric", "littles_law")


def relative_speed_law(run: Run, *, radius_m: float, every_s: float, at_least_mps: float) -> list[float]:
    """How much better a logistic distribution fits the relative speeds than a normal distribution.

    Returns
    -------
    Mean log likelihood per pair of the fitted logistic distribution, minus that of the fitted normal distribution.
    """
    speeds_mps = _relative_speeds_mps(run, radius_m, every_s, at_least_mps)
    if len(speeds_mps) < 2:
        raise ValueError(f"no two pairs of vehicles of {at_least_mps:g} m/s or more were within {radius_m:g} m.")
    logistic = stats.logistic.logpdf(speeds_mps, *stats.logistic.fit(speeds_mps)).mean()
    normal = stats.norm.logpdf(speeds_mps, *stats.norm.fit(speeds_mps)).mean()
    return [float(logistic) - float(normal)]


def metric(run: Run, *, names: Sequence[str], group: str, minus: Sequence[str] = ()) -> list[float]:
    """Metrics of a run, of one group. If `minus` names a further metric for each of them, it is subtracted."""
    all_names = [*names, *minus]
    topics = tuple({name.partition(".")[0] for name in all_names})
    table = run_metrics(run, topics=topics)
    value = table[table.group == group].set_index("metric").value
    found = np.array([value.get(name, np.nan) for name in all_names], np.float64)
    if minus:
        found = found[: len(names)] - found[len(names) :]
    return found.tolist()


def littles_law(run: Run, *, radius_m: float) -> list[float]:
    """Rate of contacts of a vehicle times their mean duration, over its mean number of neighbours.

    By Little's law it is 1. Rate and duration come from the table `encounters`, neighbours from poses. Pedestrians do
    not count, and parked cars and roadside units meet nobody. Of several hystereses, the least counts.
    """
    kinds = encounters.summary(run).assign(per_vehicle_h=encounters.rates(run).per_vehicle_h)
    of_vehicles = (kinds.pairs == "all") & ~kinds.pedestrians.astype(bool)
    kinds = kinds[of_vehicles & (kinds.radius_m == radius_m)].reindex(columns=["per_vehicle_h", "km_mean_s"])
    if kinds.empty:
        raise ValueError(
            f"{run.path.name} has no encounters of all vehicles within {radius_m:g} m. Add a section [[encounters]] "
            'with pairs = "all" and without pedestrians.'
        )
    rate_per_h, mean_s = kinds.iloc[0]
    query = """
        SELECT step, x_m, y_m FROM actors JOIN vehicles ON vehicle = actor
        WHERE vehicle_class NOT IN ('pedestrian', 'roadside_unit') AND NOT starts_with(sumo_id, $parked)
    """
    poses = run.sql(query, parked=PARKED)
    n_neighbours = 0  # over all poses; each pair within the radius is two neighbours
    for _, now in poses.groupby("step"):
        xy_m = now[["x_m", "y_m"]].to_numpy(float)
        n_neighbours += 2 * len(cKDTree(xy_m).query_pairs(radius_m, output_type="ndarray"))
    return [rate_per_h / 3600 * mean_s * len(poses) / n_neighbours]


def _relative_speeds_mps(run: Run, radius_m: float, every_s: float, at_least_mps: float) -> Float[ndarray, "p"]:
    """Rate at which the distance of two vehicles changes, for each pair within `radius_m`, every `every_s`.

    Vehicles slower than `at_least_mps` are left out. The rate is negative where two vehicles approach each other.
    """
    every_steps = max(1, round(every_s / run.dt_s))
    query = """
        SELECT step, x_m, y_m, yaw_rad, speed_mps FROM actors JOIN vehicles ON vehicle = actor
        WHERE vehicle_class <> 'pedestrian' AND speed_mps >= $slowest AND step % $every = 0 ORDER BY step, actor
    """
    poses = run.sql(query, slowest=at_least_mps, every=every_steps)
    found = []
    for _, now in poses.groupby("step"):
        xy_m = now[["x_m", "y_m"]].to_numpy(float)
        speed_mps = now.speed_mps.to_numpy(float)
        if len(xy_m) < 2:
            continue
        i, j = cKDTree(xy_m).query_pairs(radius_m, output_type="ndarray").T
        velocity_mps = speed_mps[:, None] * ahead_of(now.yaw_rad.to_numpy(float))
        from_i_to_j_m = xy_m[j] - xy_m[i]
        distance_m = np.maximum(np.hypot(*from_i_to_j_m.T), 1e-6)
        relative_mps = velocity_mps[j] - velocity_mps[i]
        found.append((relative_mps * from_i_to_j_m).sum(axis=1) / distance_m)
    return np.concatenate([np.zeros(0), *found])
