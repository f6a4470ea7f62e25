"""How often a message arrives in a contact, by the time since the contact began."""

import numpy as np
import pandas as pd

from results.metrics import contact_graph
from results.metrics.encounters import DEFINITION
from results.run import Run

_MOST = 2_000_000
"""Steps in contact that suffice for a curve."""


def definition(run: Run, radius_m: float | None = None) -> dict[str, float | str]:
    """The definition of contacts: pairs of equipped vehicles if they were recorded apart, else the first."""
    recorded = run.table("encounters", ["pairs"]).pairs
    return contact_graph.definition(run, radius_m, "equipped" if (recorded == "equipped").any() else None)


def contacts(run: Run, radius_m: float | None = None) -> pd.DataFrame:
    """Contacts of equipped vehicles whose beginning was recorded.

    Parameters
    ----------
    radius_m
        Radius of the contacts, as `encounters.radius_m`; the default is the smallest of the config.

    Returns
    -------
    a, b, start_step, end_step, duration_s, end_seen.
    """
    columns = ["a", "b", "start_step", "end_step", "duration_s", "censored_left", "censored_right"]
    met = run.table("encounters", [*columns, *DEFINITION])
    for name, chosen in definition(run, radius_m).items():
        met = met[met[name] == chosen]
    met = met[~met.censored_left & met.a.isin(run.roles.index) & met.b.isin(run.roles.index)]
    return met.assign(end_seen=~met.censored_right)[["a", "b", "start_step", "end_step", "duration_s", "end_seen"]]


def by_age(run: Run, radius_m: float | None = None, every_s: float = 5.0) -> pd.DataFrame:
    """Delivery of collective perception messages in contacts of equipped vehicles.

    Parameters
    ----------
    radius_m
        As in `contacts`.
    every_s
        Width of the bins of age.

    Returns
    -------
    age_s (middle of the bin); n: pairs of a step and a direction in contact; and share of those in which at least one
    message arrived.

    Notes
    -----
    Counted are the steps in which vehicles sense, both directions of every contact. A vehicle that sends nothing, such
    as a jammer, counts as one whose messages do not arrive. Of many contacts, every k-th counts.
    """
    run.require("receptions")
    met = contacts(run, radius_m)
    first, length = met.start_step.to_numpy(np.int64), (met.end_step - met.start_step).to_numpy(np.int64)
    stride = max(1, -(-int(length.sum()) // _MOST))
    a, b, first, length = (v[::stride] for v in (met.a.to_numpy(), met.b.to_numpy(), first, length))
    row = np.repeat(np.arange(len(a)), length)
    age = np.arange(len(row)) - np.repeat(np.cumsum(length) - length, length)
    step = first[row] + age
    senses = step % int(run.manifest.get("sense_every_steps", 1)) == 0
    row, age, step = row[senses], age[senses], step[senses]
    both = pd.DataFrame({
        "step": np.r_[step, step], "sender": np.r_[a[row], b[row]], "receiver": np.r_[b[row], a[row]],
        "bin": np.floor(np.r_[age, age] * run.dt_s / every_s).astype(np.int64),
    })  # fmt: skip
    arrived = run.sql("""
        SELECT DISTINCT message_step AS step, vehicle AS sender, receiver, true AS arrived
        FROM receptions JOIN subjects ON pseudonym = sender WHERE message_type = 'cpm'
    """)
    both = both.merge(arrived, on=["step", "sender", "receiver"], how="left")
    of_bin = both.arrived.notna().groupby(both["bin"]).agg(["size", "mean"])
    age_s = (of_bin.index.to_numpy() + 0.5) * every_s
    return pd.DataFrame({"age_s": age_s, "n": of_bin["size"].to_numpy(), "share": of_bin["mean"].to_numpy()})
