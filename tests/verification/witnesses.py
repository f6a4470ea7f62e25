"""Age of trust with witnesses at chosen and drawn junctions.

`python -m tests.verification.witnesses STUDY [STUDY ...] [PICTURE.png]`. Each STUDY is a folder of the study
`witnesses`, or of a part of it. For each penetration, number of units and attack, the table has means over replicates,
and the ratio of `listed` to `random` within each replicate (same traffic, same vehicles): geometric mean, and its 95 %
interval by bootstrap over replicates.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from results.study import Study, open_study

COUNT, CHOOSE, ATTACK = "roadside.0.junctions", "roadside.0.choose", "attacks.0.attack"
EQUIPPED = "fleet.penetration_p"
CAPPED, EVALUATED_AGE = "freshness.capped_age", "freshness.newest_evaluation_age"
METRICS = (
    (f"{CAPPED}.mean_s", "all"), (f"{CAPPED}.median_s", "all"), (f"{CAPPED}.p90_s", "all"),
    (f"{EVALUATED_AGE}.median_s", "all"), (f"{EVALUATED_AGE}.p90_s", "all"),
    ("freshness.lookup_state.share", "evaluated, all"), ("misbehaviour.at_lookup.auc", "malicious"),
)  # fmt: skip
LABELS = {f"{CAPPED}.p90_s": "of all lookups", f"{EVALUATED_AGE}.p90_s": "of lookups with an evaluation"}


def ratio(chosen: np.ndarray, drawn: np.ndarray, n: int = 10_000) -> tuple[float, float, float]:
    """Geometric mean of the paired ratios, and the 2.5 and 97.5 % quantiles of its bootstrap distribution."""
    logs = np.log(chosen / drawn)
    picks = np.random.default_rng(0).integers(0, len(logs), (n, len(logs)))
    low, high = np.quantile(logs[picks].mean(axis=1), [0.025, 0.975])
    return tuple(np.exp([logs.mean(), low, high]).tolist())


def table(path: Path) -> pd.DataFrame:
    """A row per metric, penetration, number of units and attack."""
    study, rows = open_study(path), []
    measures = study.measures
    for key in (COUNT, CHOOSE, ATTACK, EQUIPPED):
        if key not in study.keys:
            measures[key] = _of_all(study, key)
    for metric, group in METRICS:
        mine = measures[(measures.metric == metric) & (measures.group == group)]
        for (equipped_p, count, attack), of in mine.groupby([EQUIPPED, COUNT, ATTACK]):
            wide = of.pivot(index="replicate", columns=CHOOSE, values="value").dropna()
            row = {"equipped": equipped_p, "units": count, "attack": attack, "metric": metric, "n": len(wide)}
            row |= wide.mean().to_dict()
            if len(wide):
                row |= dict(
                    zip(("ratio", "low", "high"), ratio(wide.listed.to_numpy(), wide.random.to_numpy()), strict=True)
                )
            rows.append(row)
    return pd.DataFrame(rows)


def _of_all(study: Study, key: str) -> Any:
    """A key of the config that has one value in the whole study."""
    found: Any = study.run(study.points.point.iloc[0]).config
    for part in key.split("."):
        found = found[int(part) if isinstance(found, list) else part]
    return found


def draw(found: pd.DataFrame, path: Path) -> None:
    """Ratios of the 90th percentiles of the ages, by number of units and penetration."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 3.2), layout="constrained")
    cases = found[["equipped", "units", "attack"]].drop_duplicates().sort_values(["equipped", "units", "attack"])
    has_attacks = cases.attack.nunique() > 1
    for offset, (metric, label) in enumerate(LABELS.items()):
        of = cases.merge(found[found.metric == metric], how="left")
        y = np.arange(len(of)) + 0.2 * (offset - 0.5)
        axes.errorbar(
            of.ratio, y, xerr=[of.ratio - of.low, of.high - of.ratio], fmt="os"[offset], capsize=3, label=label
        )  # fmt: skip
    names = [
        f"{r.units:g} units, {r.equipped:.0%}" + f", {r.attack.replace('_', '-')}" * has_attacks
        for r in cases.itertuples()
    ]
    axes.set_yticks(np.arange(len(cases)), names)
    axes.set_ylim(len(cases) - 0.4, -0.6)
    axes.axvline(1.0, color="0.4", lw=0.8)
    axes.axvline(0.5, color="0.4", lw=0.8, ls=":")
    axes.set_xlim(left=0)
    axes.set_xlabel("90th percentile of the age, chosen / drawn junctions")
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    figure.savefig(path, dpi=150)


def main(*paths: str) -> None:
    studies = [path for path in paths if not path.endswith(".png")]
    found = pd.concat([table(Path(path)) for path in studies], ignore_index=True)
    print(found.round(3).to_string(index=False))
    for path in paths[len(studies) :]:
        draw(found, Path(path))


if __name__ == "__main__":
    main(*sys.argv[1:])
