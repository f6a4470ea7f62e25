"""Hard braking of half an hour with ghosts: how much they add, and how much of that trust takes back, with intervals.

    cosim sweep safety_half_hour --out out
    python -m tests.verification.half_hour_of_ghosts out

Runs of one seed begin with the same traffic and drift apart from the first ghost on, so that they are compared in
stretches of `BATCH_S`: the difference of the rates in one stretch of one seed is one unit, and the intervals are
Student's t over units (method of batch means [1]_). Where the differences of successive stretches are correlated by
r > 0, n units count as n (1 - r) / (1 + r); below two there is no interval: queues, and with them travel times, outlast
a stretch.

References
----------
.. [1] Law, "Simulation Modeling and Analysis", 5th edition, 2015, section 9.5.3.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from cosim.addons.driver import safety
from cosim.addons.driver.conflicts import tracks
from results.archive import open_run
from results.study import open_study

BATCH_S = 150.0
FIRST_S = 30.0
"""Before this, ghosts have hardly begun: left out."""
ARM = ["attacks.0.share_p", "trust.method", "trust.model"]
"""Keys that tell the arms of a study apart, as far as it sweeps them."""


def of_run(path: Path) -> pd.DataFrame:
    """Per stretch: km driven, vehicle-seconds, hard and emergency braking, stops, reactions to ghosts and to others."""
    run = open_run(path)
    poses = tracks(run)
    edges = np.arange(FIRST_S, run.manifest["steps"] * run.dt_s + 1e-9, BATCH_S) / run.dt_s

    def count(steps, weights=None):
        return np.histogram(steps, edges, weights=weights)[0].astype(float)

    events, why = safety.braking(run, poses), safety.reactions(run)
    return pd.DataFrame({
        "km": count(poses.step, poses.speed_mps.astype(float) * run.dt_s / 1000),
        "seconds": count(poses.step) * run.dt_s,
        **{name: count(events.step[events.severity == name]) for name in ("hard", "emergency")},
        "stops": count(safety.stops(run, poses).step),
        "to_ghosts": count(why.step[why.kind == "ghost"]), "to_others": count(why.step[why.kind != "ghost"]),
    })  # fmt: skip


def table(study: Path) -> pd.DataFrame:
    """Stretches of all finished runs of a study: arm, replicate and number of the stretch, and what `of_run` counts."""
    points = open_study(study).points
    points = points[points.state == "finished"]
    parts = []
    for point in points.to_dict("records"):
        found = of_run(study / "runs" / point["run"])
        arm = " ".join(f"{point[key]:g}" if key == ARM[0] else point[key] for key in ARM if key in point)
        parts.append(found.assign(arm=arm, replicate=point["replicate"], stretch=np.arange(len(found))))
    return pd.concat(parts, ignore_index=True)


def difference(rows: pd.DataFrame, arm: str, other: str, what: str) -> tuple[float, float, float]:
    """Difference of two arms' rates per km, mean over stretches, and half its 95 % interval; units that count."""
    rate = rows.assign(rate=rows[what] / rows.km)
    rate = rate.pivot_table(index=["replicate", "stretch"], columns="arm", values="rate")
    d = (rate[arm] - rate[other]).dropna()
    pairs = pd.concat([d, d.groupby("replicate").shift(1)], axis=1).dropna().to_numpy()
    r = max(0.0, float(np.corrcoef(pairs.T)[0, 1]))
    n = len(d) * (1 - r) / (1 + r)
    half = stats.t.ppf(0.975, n - 1) * d.std(ddof=1) / np.sqrt(n) if n >= 2 else np.nan
    return float(d.mean()), float(half), n


def main(folders: list[str]) -> None:
    """Rates of every arm per km, and its differences to no liar and to ghosts without trust."""
    for folder in folders:
        rows = table(Path(folder))
        sums = rows.groupby("arm").sum(numeric_only=True)
        print(f"\n{folder}: {rows.groupby('arm').replicate.nunique().to_dict()} seeds; km {sums.km.round().to_dict()}")
        print(sums.drop(columns=["km", "replicate", "stretch"]).div(sums.km, axis=0).round(4).to_string())
        calm, ghosts = (next(a for a in sums.index if a.startswith(f"{s:g} any")) for s in (0.0, 0.2))
        for what in ("hard", "emergency", "stops", "seconds"):
            for other in (calm, ghosts):
                for arm in [a for a in sums.index if a not in (calm, other)]:
                    mean, half, n = difference(rows, arm, other, what)
                    print(f"{what:9s} {arm:27s} - {other:18s} {mean:+.3f} [{mean - half:+.3f}, {mean + half:+.3f}] /km,"
                          f" {n:.1f} stretches")  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
