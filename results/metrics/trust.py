"""Who is trusted: by role, and over time."""

from typing import Literal

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from results.run import Run

At = Literal["server", "vehicles"]
"""Whose trust: the server's, or that which vehicles use."""

_INSTANTS = 600
"""Steps that suffice to draw trust over time where every vehicle keeps its own."""


def kept_at(run: Run) -> At:
    """Where trust is kept: at the server if it ever computed any."""
    return "server" if len(run.table("trust", ["step"])) else "vehicles"


def values(run: Run) -> pd.DataFrame:
    """Trust in each vehicle while it is on the road: step, time_s, vehicle, role, trust, judged.

    Every value that the server computed; `judged` says whether it rests on a evaluation of anybody who could see (the
    ledger has 0 for who was only ever unseen). Without a server, the mean over those who hear the vehicle and hold a
    value of their own, at 600 instants at most; what those rest on is not recorded: `judged` is true of all.
    """
    if kept_at(run) == "server":
        frame = run.table("trust", ["step", "vehicle", "trust", "n_evaluations"])
        frame = frame.assign(judged=frame.n_evaluations > 0)
    else:
        frame = _own(run).assign(judged=True)
    last_step = run.table("vehicles", ["vehicle", "last_step"]).set_index("vehicle").last_step
    frame = frame[frame.step <= frame.vehicle.map(last_step)]
    frame = frame.assign(time_s=frame.step * run.dt_s, role=frame.vehicle.map(run.roles))
    return frame[["step", "time_s", "vehicle", "role", "trust", "judged"]]


def _own(run: Run) -> pd.DataFrame:
    """Mean of the values of their own that vehicles use: step, vehicle, trust."""
    steps = np.unique(np.concatenate([[0], *(part.step.unique() for part in run.parts("trust_lookups", ["step"]))]))
    chosen = pc.field("step").isin(steps[:: -(-len(steps) // _INSTANTS)].tolist())
    means = [
        part[part.source == "own"].groupby(["step", "subject"], as_index=False).trust.mean()
        for part in run.parts("trust_lookups", ["step", "subject", "source", "trust"], chosen)
    ]
    frame = pd.concat(means) if means else pd.DataFrame()
    if frame.empty:
        raise ValueError(
            f"{run.path} holds no trust values: neither the server nor a vehicle ever came to one. Set trust.host to "
            '"central" or "local", equip vehicles, and run longer than trust.server_period_s.'
        )
    return frame.rename(columns={"subject": "vehicle"})


def mean(run: Run) -> pd.DataFrame:
    """Mean of all values: role, n, mean."""
    return values(run).groupby("role", observed=True).trust.agg(n="size", mean="mean").reset_index()


def over_time(run: Run) -> pd.DataFrame:
    """Spread of trust over vehicles: time_s, role, n, mean, q25, median, q75."""
    return _spread(values(run), ["time_s", "role"])


def final(run: Run) -> pd.DataFrame:
    """Spread over vehicles of the last value of each: role, n, mean, q25, median, q75."""
    return _spread(values(run).drop_duplicates("vehicle", keep="last"), ["role"])


def _spread(frame: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    groups = frame.groupby(by, observed=True).trust
    spread = groups.quantile(np.array([0.25, 0.5, 0.75])).unstack()
    spread.columns = ["q25", "median", "q75"]
    return groups.agg(n="size", mean="mean").join(spread).reset_index()
