"""Trust in pseudonyms: by role of the vehicle behind them, and over time."""

from typing import Literal

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from results.metrics import intervals
from results.run import Run

At = Literal["server", "vehicles"]
"""Whose trust: that of the trust server, or that which vehicles look up."""

_INSTANTS = 600
"""Steps that suffice to draw trust over time where every vehicle keeps its own."""


def kept_at(run: Run) -> At:
    """Where trust is kept: at the server if it ever computed any."""
    return run.once("trust.kept_at", lambda: "server" if len(server_values(run)) else "vehicles")


def server_values(run: Run) -> pd.DataFrame:
    """What metrics need of the table `trust`, of the run's variant; not to be changed."""
    columns = [
        "step", "subject", "trust", "state", "n_evaluations", "n_evaluators", "newest_evaluation_age_s",
        "oldest_evaluation_age_s",
    ]  # fmt: skip
    return run.once("trust.server_values", lambda: run.variant_table("trust", columns))


def values(run: Run) -> pd.DataFrame:
    """Trust in each pseudonym while it is in use: step, time_s, subject, vehicle, role, trust, rated.

    Every value that the server computed; `rated` says whether it rests on at least one evaluation by another vehicle
    that could see. Without a server, the mean over the receivers that look the subject up and hold such a value of
    their own, at 600 instants at most.
    """
    return run.once("trust.values", lambda: _values(run))


def _values(run: Run) -> pd.DataFrame:
    if kept_at(run) == "server":
        frame = server_values(run)
        frame = frame.assign(rated=frame.n_evaluations > 0)
    else:
        frame = _own(run).assign(rated=True)
    who = run.subjects
    at = who.index.get_indexer(pd.Index(frame.subject))
    in_use = (at >= 0) & (frame.step.to_numpy() <= who.to_step.to_numpy()[at])
    frame, at = frame[in_use], at[in_use]
    frame = frame.assign(time_s=frame.step * run.dt_s, vehicle=who.vehicle.to_numpy()[at], role=who.role.array.take(at))
    return frame[["step", "time_s", "subject", "vehicle", "role", "trust", "rated"]]


def _own(run: Run) -> pd.DataFrame:
    """Mean of the values of their own that vehicles look up: step, subject, trust."""
    parts = run.variant_parts("trust_lookups", ["step"])
    steps = np.unique(np.concatenate([[0], *(part.step.unique() for part in parts)]))
    chosen = pc.field("step").isin(steps[:: -(-len(steps) // _INSTANTS)].tolist())
    chosen &= (pc.field("source") == "own") & (pc.field("n_evaluations") > 0)
    means = [
        part.groupby(["step", "subject"], as_index=False).trust.mean()
        for part in run.variant_parts("trust_lookups", ["step", "subject", "trust"], chosen)
    ]
    frame = pd.concat(means) if means else pd.DataFrame()
    if frame.empty:
        raise ValueError(
            f"{run.path} holds no trust values: neither the server nor a vehicle ever computed one. Set trust.host to "
            '"central" or "local", equip vehicles, and run longer than trust.server_period_s.'
        )
    return frame


def mean(run: Run) -> pd.DataFrame:
    """Mean of all values: role, n, mean with its interval (clustered by subject; see `intervals.columns`)."""
    return pd.DataFrame([
        {"role": role, "n": len(of_role)}
        | intervals.columns(intervals.of_units(of_role.trust.to_numpy(np.float64), of_role.subject.to_numpy()), "mean")
        for role, of_role in values(run).groupby("role", observed=True)
    ])  # fmt: skip


def over_time(run: Run) -> pd.DataFrame:
    """Quartiles of trust over subjects: time_s, role, n, mean, q25, median, q75."""
    return _quartiles(values(run), ["time_s", "role"])


def final(run: Run) -> pd.DataFrame:
    """Quartiles over subjects of the last value of each: role, n, mean, q25, median, q75; mean and median with their
    intervals (see `intervals.columns`)."""
    last = values(run).drop_duplicates("subject", keep="last")
    rows = [
        {"role": role}
        | intervals.columns(intervals.of_units(one.to_numpy(np.float64), np.arange(len(one))), "mean")
        | intervals.columns(intervals.median(one.to_numpy(np.float64)), "median")
        for role, one in last.groupby("role", observed=True).trust
    ]
    found = _quartiles(last, ["role"]).drop(columns=["mean", "median"])
    return found.merge(pd.DataFrame(rows), on="role")


def _quartiles(frame: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    groups = frame.groupby(by, observed=True).trust
    quartiles = groups.quantile(np.array([0.25, 0.5, 0.75])).unstack()
    quartiles.columns = ["q25", "median", "q75"]
    return groups.agg(n="size", mean="mean").join(quartiles).reset_index()
