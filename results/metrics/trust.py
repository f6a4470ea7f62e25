"""Whom the server trusts: by behaviour, over time, and how soon a liar is found out."""

from typing import Literal

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from results.archive import Run


def values(run: Run) -> pd.DataFrame:
    """Every value the server computed: time_s, vehicle, behaviour, trust."""
    frame = run.table("trust", ["step", "vehicle", "trust"])
    if frame.empty:
        raise ValueError(
            f"{run.path} holds no trust values: the server never computed one. Run longer than its period."
        )
    frame = frame.assign(time_s=frame.step * run.dt_s, behaviour=frame.vehicle.map(run.roles))
    return frame[["time_s", "vehicle", "behaviour", "trust"]]


def over_time(run: Run) -> pd.DataFrame:
    """Spread of trust over vehicles: time_s, behaviour, n, mean, q25, median, q75."""
    return _spread(values(run), ["time_s", "behaviour"])


def final(run: Run) -> pd.DataFrame:
    """Spread over vehicles of the last value of each: behaviour, n, mean, q25, median, q75."""
    return _spread(values(run).drop_duplicates("vehicle", keep="last"), ["behaviour"])


def separation(run: Run) -> float:
    """Chance that an honest vehicle ends with more trust than a malicious one (ties count half)."""
    last = values(run).drop_duplicates("vehicle", keep="last")
    honest = last.trust[last.behaviour == "honest"].to_numpy()
    malicious = np.sort(last.trust[last.behaviour == "malicious"].to_numpy())
    if not len(honest) or not len(malicious):
        return float("nan")
    wins = np.searchsorted(malicious, honest, "left") + np.searchsorted(malicious, honest, "right")
    return float(wins.mean() / 2 / len(malicious))


def detection_delay(run: Run, threshold: float = 0.25, at: Literal["server", "vehicles"] = "server") -> pd.DataFrame:
    """Time from a vehicle's first lie to its trust falling below a threshold.

    Parameters
    ----------
    at
        At the server, or at the first vehicle that uses a value below the threshold.

    Returns
    -------
    vehicle, behaviour, delay_s, found: where not found, the delay is the time it was watched for (censored).
    """
    liars = run.table("vehicles", ["vehicle", "behaviour", "first_lie_step", "last_step"])
    liars = liars[liars.first_lie_step.notna()].astype({"first_lie_step": int}).set_index("vehicle")
    table, who = ("trust", "vehicle") if at == "server" else ("uses", "subject")
    low = run.table(table, ["step", who], where=pc.field("trust") < threshold)
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
