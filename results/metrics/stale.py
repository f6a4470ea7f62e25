"""Where and when the trust that receivers look up is stale."""

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from results.metrics.freshness import FRESH_S
from results.run import Run

Grid = Int[ndarray, "a b"]


def is_stale(newest_age_s: Float[ndarray, "n"], fresh_s: float) -> Bool[ndarray, "n"]:
    """Whether the newest evaluation behind a value is older than `fresh_s` [s], or there is none (NaN)."""
    return ~(newest_age_s <= fresh_s)


def placed(run: Run, fresh_s: float = FRESH_S) -> pd.DataFrame:
    """Lookups of trust by place and time.

    Returns
    -------
    A row for each receiver and step: step, x_m and y_m of the receiver, n lookups, n_stale of them.
    """
    run.require("trust_lookups", "actors")
    parts = []
    for part in run.variant_parts("trust_lookups", ["step", "receiver", "newest_evaluation_age_s"]):
        stale = is_stale(part.newest_evaluation_age_s.to_numpy(np.float64, na_value=np.nan), fresh_s)
        found = part.assign(n_stale=stale).groupby(["step", "receiver"]).n_stale.agg(["size", "sum"]).reset_index()
        where = pc.field("step").isin(found.step.unique().tolist())
        at = run.table("actors", ["step", "actor", "x_m", "y_m"], where)
        parts.append(found.merge(at, left_on=["step", "receiver"], right_on=["step", "actor"]))
    if not parts or not sum(map(len, parts)):
        raise ValueError(f"{run.path} has no lookups of trust: no vehicle received a message.")
    frame = pd.concat(parts, ignore_index=True).rename(columns={"size": "n", "sum": "n_stale"})
    return frame[["step", "x_m", "y_m", "n", "n_stale"]]
