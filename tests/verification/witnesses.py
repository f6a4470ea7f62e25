"""Age of trust with witnesses at chosen and drawn junctions: `python -m tests.verification.witnesses STUDY [PICTURE]`.

STUDY is a folder of the study `witnesses`. For each number of units and attack, the table has means over replicates,
and the ratio of `listed` to `random` within each replicate (same traffic, same vehicles): geometric mean, and its 95 %
interval by bootstrap over replicates.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from results.study import open_study

COUNT, CHOOSE, ATTACK = "roadside.0.junctions", "roadside.0.choose", "attacks.0.attack"
METRICS = (
    ("freshness.newest_evaluation_age.median_s", "all"), ("freshness.newest_evaluation_age.p90_s", "all"),
    ("freshness.lookup_state.share", "evaluated, all"), ("misbehaviour.at_lookup.auc", "malicious"),
)  # fmt: skip


def ratio(chosen: np.ndarray, drawn: np.ndarray, n: int = 10_000) -> tuple[float, float, float]:
    """Geometric mean of the paired ratios, and the 2.5 and 97.5 % quantiles of its bootstrap distribution."""
    logs = np.log(chosen / drawn)
    picks = np.random.default_rng(0).integers(0, len(logs), (n, len(logs)))
    low, high = np.quantile(logs[picks].mean(axis=1), [0.025, 0.975])
    return tuple(np.exp([logs.mean(), low, high]).tolist())


def table(path: Path) -> pd.DataFrame:
    """A row per number of units, attack and metric."""
    study, rows = open_study(path), []
    measures = study.measures
    for keys in (COUNT, CHOOSE, ATTACK):
        if keys not in study.keys:
            measures[keys] = "-"
    for metric, group in METRICS:
        mine = measures[(measures.metric == metric) & (measures.group == group)]
        for (count, attack), of in mine.groupby([COUNT, ATTACK]):
            wide = of.pivot(index="replicate", columns=CHOOSE, values="value").dropna()
            row = {"units": count, "attack": attack, "metric": metric, "n": len(wide)} | wide.mean().to_dict()
            if len(wide):
                row |= dict(
                    zip(("ratio", "low", "high"), ratio(wide.listed.to_numpy(), wide.random.to_numpy()), strict=True)
                )
            rows.append(row)
    return pd.DataFrame(rows)


def draw(found: pd.DataFrame, path: Path) -> None:
    """Ratio of the ages against the number of units."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 3.2), layout="constrained")
    ages = found[found.metric.str.startswith("freshness.newest")]
    for offset, (metric, of) in enumerate(ages.groupby("metric", sort=False)):
        label = "median" if "median" in metric else "90th percentile"
        x = np.arange(len(of)) + 0.15 * (offset - 0.5)
        axes.errorbar(
            of.ratio, x, xerr=[of.ratio - of.low, of.high - of.ratio], fmt="o", capsize=3, label=f"{label} of the age"
        )  # fmt: skip
    axes.set_yticks(np.arange(len(of)), [f"{r.units:g} units, {r.attack.replace('_', '-')}" for r in of.itertuples()])
    axes.set_ylim(-0.6, len(of) - 0.4)
    axes.axvline(1.0, color="0.4", lw=0.8)
    axes.axvline(0.5, color="0.4", lw=0.8, ls=":")
    axes.set_xlim(0, 1.5)
    axes.set_xlabel("age: chosen junctions / drawn ones")
    axes.legend(loc="upper left", frameon=False, fontsize=8)
    figure.savefig(path, dpi=150)


def main(folder: str, picture: str = "") -> None:
    found = table(Path(folder))
    print(found.round(3).to_string(index=False))
    if picture:
        draw(found, Path(picture))


if __name__ == "__main__":
    main(*sys.argv[1:])
