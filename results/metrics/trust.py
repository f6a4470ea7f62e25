"""Who is trusted: by behaviour, over time, and how soon a liar is found out."""

from typing import Literal

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from results.archive import Run

At = Literal["server", "vehicles"]
"""Whose trust: the server's, or that which vehicles use."""

_INSTANTS = 600
"""Steps that suffice to draw trust over time where every vehicle keeps its own."""


def kept_at(run: Run) -> At:
    """Where trust is kept: at the server if it ever computed any."""
    return "server" if len(run.table("trust", ["step"])) else "vehicles"


def values(run: Run) -> pd.DataFrame:
    """Trust in each vehicle while it is on the road: time_s, vehicle, behaviour, trust.

    Every value that the server computed. Without a server, the mean over those who hear the vehicle and hold a
    value of their own, at 600 instants at most.
    """
    if kept_at(run) == "server":
        frame = run.table("trust", ["step", "vehicle", "trust"])
    else:
        frame = _own(run)
    last_step = run.table("vehicles", ["vehicle", "last_step"]).set_index("vehicle").last_step
    frame = frame[frame.step <= frame.vehicle.map(last_step)]
    frame = frame.assign(time_s=frame.step * run.dt_s, behaviour=frame.vehicle.map(run.roles))
    return frame[["time_s", "vehicle", "behaviour", "trust"]]


def _own(run: Run) -> pd.DataFrame:
    """Mean of the values of their own that vehicles use: step, vehicle, trust."""
    steps = np.unique(np.concatenate([[0], *(part.step.unique() for part in run.parts("uses", ["step"]))]))
    chosen = pc.field("step").isin(steps[:: -(-len(steps) // _INSTANTS)].tolist())
    means = [
        part[part.source == "own"].groupby(["step", "subject"], as_index=False).trust.mean()
        for part in run.parts("uses", ["step", "subject", "source", "trust"], chosen)
    ]
    frame = pd.concat(means) if means else pd.DataFrame()
    if frame.empty:
        raise ValueError(
            f"{run.path} holds no trust values: neither the server nor a vehicle ever came to one. Set trust.where to "
            '"central" or "local", equip vehicles, and run longer than trust.server_period_s.'
        )
    return frame.rename(columns={"subject": "vehicle"})


def over_time(run: Run) -> pd.DataFrame:
    """Spread of trust over vehicles: time_s, behaviour, n, mean, q25, median, q75."""
    return _spread(values(run), ["time_s", "behaviour"])


def final(run: Run) -> pd.DataFrame:
    """Spread over vehicles of the last value of each: behaviour, n, mean, q25, median, q75."""
    return _spread(values(run).drop_duplicates("vehicle", keep="last"), ["behaviour"])


def below(run: Run, threshold: float = 0.25) -> pd.DataFrame:
    """Share of the values under a threshold, by behaviour: behaviour, n, share; of the honest, false alarms."""
    frame = values(run)
    groups = (frame.trust < threshold).groupby(frame.behaviour, observed=True)
    return groups.agg(n="size", share="mean").reset_index()


def separation(run: Run) -> float:
    """Chance that an honest vehicle ends with more trust than a malicious one (ties count half)."""
    last = values(run).drop_duplicates("vehicle", keep="last")
    honest = last.trust[last.behaviour == "honest"].to_numpy()
    malicious = np.sort(last.trust[last.behaviour == "malicious"].to_numpy())
    if not len(honest) or not len(malicious):
        return float("nan")
    wins = np.searchsorted(malicious, honest, "left") + np.searchsorted(malicious, honest, "right")
    return float(wins.mean() / 2 / len(malicious))


def detection_delay(run: Run, threshold: float = 0.25, at: At = "server") -> pd.DataFrame:
    """Time from a vehicle's first lie to its trust falling below a threshold.

    Parameters
    ----------
    at
        At the server, or at the first vehicle that uses a value below the threshold (a default does not count).

    Returns
    -------
    vehicle, behaviour, delay_s, found: where not found, the delay is the time it was watched for (censored).
    """
    liars = run.table("vehicles", ["vehicle", "behaviour", "first_lie_step", "last_step"])
    liars = liars[liars.first_lie_step.notna()].astype({"first_lie_step": int}).set_index("vehicle")
    table, who = ("trust", "vehicle") if at == "server" else ("uses", "subject")
    is_low = pc.field("trust") < threshold
    low = run.table(table, ["step", who], where=is_low if at == "server" else is_low & pc.field("age_s").is_valid())
    low = low.assign(lied=low[who].map(liars.first_lie_step))
    first = low[low.step >= low.lied].groupby(who).step.min().reindex(liars.index)
    found = first.notna()
    last = np.minimum(liars.last_step, run.manifest["steps"] - 1)
    delay_s = (first.where(found, last) - liars.first_lie_step) * run.dt_s
    return pd.DataFrame({"behaviour": liars.behaviour, "delay_s": delay_s, "found": found}).reset_index()


def _spread(frame: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    groups = frame.groupby(by, observed=True).trust
    spread = groups.quantile([0.25, 0.5, 0.75]).unstack()
    spread.columns = ["q25", "median", "q75"]
    return groups.agg(n="size", mean="mean").join(spread).reset_index()
