"""Road users: sizes, speeds, braking, and what receivers say of their positions."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy import ndarray
from scipy import stats

from cosim.mobility.position_errors import GnssParams
from cosim.validation.facts import Measured
from results.metrics.conflicts import tracks
from results.metrics.safety import stops
from results.run import Run

_APPROACH_S = 15.0
"""Time before a stop in which its braking is looked for."""


def actor_size(runs: Sequence[Run], *, vehicle_class: str) -> Measured:
    """Mean length, width and height of a class [m]; every actor counts once."""
    columns = ["length_m", "width_m", "height_m"]
    rows = []
    for run in runs:
        table = run.table("vehicles", ["vehicle_class", *columns])
        mine = table[table.vehicle_class == vehicle_class]
        if mine.empty:
            raise ValueError(f"{run.path.name}: there is no {vehicle_class} in this run.")
        rows.append(mine[columns].astype(float).mean().to_numpy())
    return Measured.of_replicates(rows)


def walking_speed(runs: Sequence[Run], *, moving_mps: float) -> Measured:
    """Mean speed of pedestrians while they walk, each pedestrian once [m/s]."""
    rows = []
    for run in runs:
        kinds = run.table("vehicles", ["vehicle", "vehicle_class"])
        on_foot = kinds.vehicle[kinds.vehicle_class == "pedestrian"]
        poses = run.table("actors", ["actor", "speed_mps"])
        poses = poses[poses.actor.isin(on_foot) & (poses.speed_mps > moving_mps)]
        rows.append([float(poses.speed_mps.astype(float).groupby(poses.actor).mean().mean())])
    return Measured.of_replicates(rows)


def braking_to_a_stop(runs: Sequence[Run]) -> Measured:
    """Largest deceleration on the way to a stop, mean over stops [m/s2]."""
    return Measured.of_replicates([[float(_peaks(run).mean())] for run in runs])


def braking_limit(runs: Sequence[Run], *, limit_mps2: float) -> Measured:
    """Share of the stops in which no deceleration is larger than a limit."""
    return Measured.of_replicates([[float((_peaks(run) <= limit_mps2).mean())] for run in runs])


def _peaks(run: Run) -> Float[ndarray, "s"]:
    """Largest deceleration of cars within some seconds before each of their stops [m/s2]."""
    poses = tracks(run)
    kinds = run.table("vehicles", ["vehicle", "vehicle_class"])
    poses = poses[poses.actor.isin(kinds.vehicle[kinds.vehicle_class == "car"])]
    stopped = stops(run, poses)
    before = round(_APPROACH_S / run.dt_s)
    poses = poses.sort_values(["actor", "step"], kind="stable")
    down = (-poses.acceleration_mps2.fillna(0.0)).groupby(poses.actor).rolling(before, min_periods=1).max()
    peak = pd.Series(down.to_numpy(), pd.MultiIndex.from_frame(poses[["actor", "step"]]))
    found = peak.reindex(pd.MultiIndex.from_frame(stopped[["actor", "step"]])).to_numpy(np.float64)
    if not len(found):
        raise ValueError(f"{run.path.name}: no car stopped. Run longer.")
    return found


def position_error(runs: Sequence[Run], *, share: float) -> Measured:
    """Radius within which this share of the default position errors lies [m]."""
    return Measured.exact([GnssParams().std_m * stats.rayleigh.ppf(share)])
