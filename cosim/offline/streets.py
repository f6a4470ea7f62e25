"""Encounters of runs with the form of the streets where they began, for a model of how long they last."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from cosim.mobility.scenario import find
from results.archive import open_run
from results.durations.hazards import proportional_hazards
from results.durations.samples import definitions
from results.metrics.encounters import DEFINITION
from results.metrics.survival import kaplan_meier, median
from results.run import Run
from sumo_nets import morphology

STREETS = ("junctions_per_km2", "lights_share", "street_length_m", "speed_limit_mps", "lanes")
"""Covariates of the place where an encounter begins."""
HEADINGS = ("same_direction", "opposite_direction")
"""Covariates of the two vehicles when it begins; otherwise their ways cross, or they are on different streets."""
_MOST_ROWS = 20_000
"""Encounters of a run that enter the model, drawn evenly if there are more."""
_SAME_COS, _OPPOSITE_COS = 0.9, -0.9


def encounters_with_streets(run: Run, radius_m: float | None = None) -> pd.DataFrame:
    """Encounters whose start was observed, with the streets around the place where they begin.

    Parameters
    ----------
    run
        A run with the table `actors`, of a scenario that has a network.
    radius_m
        Radius of the encounters. None takes the smallest that the run has.

    Returns
    -------
    a, b, lasted_steps, ended, lasted_s and the columns `STREETS` and `HEADINGS`.
    """
    run.require("encounters", "vehicles", "actors")
    named = str(run.config["traffic"]["scenario"])
    scenario = find(named)
    if scenario.net is None:
        raise ValueError(f"{run.path}: traffic.scenario = {named} has no network, so nothing is known of its streets.")
    found = definitions(run)
    if radius_m is not None:
        found = found[np.isclose(found.radius_m.to_numpy(float), radius_m)]
    if found.empty:
        raise ValueError(f"{run.path} has no encounters of radius {radius_m} m. Choose another --radius-m.")
    frame = run.table("encounters", [
        *DEFINITION, "a", "b", "start_step", "end_step", "censored_left", "censored_right",
    ])  # fmt: skip
    for column in DEFINITION:
        frame = frame[frame[column] == found.iloc[0][column]]
    frame = frame[~frame.censored_left].reset_index(drop=True)
    if len(frame) > _MOST_ROWS:
        frame = frame.iloc[np.linspace(0, len(frame) - 1, _MOST_ROWS).astype(int)].reset_index(drop=True)
    poses = [_pose(run, frame, who) for who in ("a", "b")]
    place = sum(pose[["x_m", "y_m"]].to_numpy(float) for pose in poses) / 2
    around = morphology.around(morphology.read(scenario.net), place + np.array(scenario.origin_m))
    cosine = np.cos(poses[0].yaw_rad.to_numpy(float) - poses[1].yaw_rad.to_numpy(float))
    steps = (frame.end_step - frame.start_step).to_numpy()
    columns = {name: getattr(around, name) for name in STREETS}
    return pd.DataFrame({
        "a": frame.a.to_numpy(), "b": frame.b.to_numpy(), "lasted_steps": steps, "lasted_s": steps * run.dt_s,
        "ended": ~frame.censored_right.to_numpy(bool), **columns,
        "same_direction": (cosine > _SAME_COS).astype(float),
        "opposite_direction": (cosine < _OPPOSITE_COS).astype(float),
    })  # fmt: skip


def _pose(run: Run, frame: pd.DataFrame, who: str) -> pd.DataFrame:
    """Place and heading of one of the two at the first step of each encounter."""
    wanted = frame[["start_step", who]].drop_duplicates()
    parts = [
        part.merge(wanted, left_on=["step", "actor"], right_on=["start_step", who])
        for part in run.parts("actors", ["step", "actor", "x_m", "y_m", "yaw_rad"])
    ]
    poses = pd.concat(parts).set_index(["step", "actor"])[["x_m", "y_m", "yaw_rad"]]
    return poses.loc[list(zip(frame.start_step.tolist(), frame[who].tolist(), strict=True))].reset_index(drop=True)


def judge_streets(
    folders: Sequence[Path], radius_m: float | None = None
) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Which property of the streets makes encounters long, over cities.

    Returns
    -------
    cities
        city, n, median_s (Kaplan-Meier) and the mean of each covariate.
    streets
        Hazard ratios of the streets alone, see `hazards.proportional_hazards`.
    with_headings
        The same beside the directions of the two vehicles, which the streets influence.
    """
    frames = []
    for number, folder in enumerate(folders):
        run = open_run(folder)
        one = encounters_with_streets(run, radius_m)
        shift = number * 10_000_000
        frames.append(one.assign(city=str(folder), a=one.a + shift, b=one.b + shift))
    frame = pd.concat(frames, ignore_index=True)
    rows = []
    for city, one in frame.groupby("city", sort=False):
        curve = kaplan_meier(one.lasted_s.to_numpy(float), one.ended.to_numpy(bool))
        means = {name: float(one[name].mean()) for name in (*STREETS, *HEADINGS)}
        rows.append({"city": city, "n": len(one), "median_s": median(curve), **means})
    return (
        pd.DataFrame(rows), proportional_hazards(frame, STREETS), proportional_hazards(frame, (*STREETS, *HEADINGS))
    )  # fmt: skip
