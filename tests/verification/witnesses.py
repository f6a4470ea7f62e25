"""Age of trust with witnesses at chosen and drawn junctions.

`python -m tests.verification.witnesses STUDY [STUDY ...] [PICTURE.png]`. Each STUDY is a folder of the study
`witnesses`, or of a part of it, such as some of its seeds. For each penetration, number of units and attack, the table
has means over seeds, and the ratio of `listed` to `random` within each seed (same traffic, same vehicles): geometric
mean, and its 95 % interval by bootstrap over seeds.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from results.figures import style
from results.study import open_study

COUNT, CHOOSE, ATTACK = "roadside.0.junctions", "roadside.0.choose", "attacks.0.attack"
EQUIPPED = "fleet.penetration_p"
KEYS = (COUNT, CHOOSE, ATTACK, EQUIPPED)
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


def measures_of(path: Path) -> pd.DataFrame:
    """The measures of a study, with its number of units, choice, attack and penetration, and the seed of each point."""
    study = open_study(path)
    first, found = study.points.iloc[0], study.measures
    config = study.run(first.point).config
    for key in KEYS:
        if key not in study.keys:
            found[key] = _value(config, key)
    return found.assign(seed=config["seed"] + found.replicate - first.replicate)


def _value(found: Any, key: str) -> Any:
    """The value of a dotted key of a config."""
    for part in key.split("."):
        found = found[int(part) if isinstance(found, list) else part]
    return found


def table(measures: pd.DataFrame) -> pd.DataFrame:
    """A row per metric, penetration, number of units and attack."""
    rows = []
    for metric, group in METRICS:
        mine = measures[(measures.metric == metric) & (measures.group == group)]
        for (equipped_p, count, attack), of in mine.groupby([EQUIPPED, COUNT, ATTACK]):
            wide = of.pivot(index="seed", columns=CHOOSE, values="value").dropna()
            row = {"equipped": equipped_p, "units": count, "attack": attack, "metric": metric, "n": len(wide)}
            row |= wide.mean().to_dict()
            if len(wide):
                row |= dict(
                    zip(("ratio", "low", "high"), ratio(wide.listed.to_numpy(), wide.random.to_numpy()), strict=True)
                )
            rows.append(row)
    return pd.DataFrame(rows)


@style.styled
def draw(found: pd.DataFrame) -> Figure:
    """Ratios of the 90th percentiles of the ages, by number of units and penetration."""
    figure, (axes,) = style.sheet(height=2.0)
    cases = found[["equipped", "units", "attack"]].drop_duplicates().sort_values(["equipped", "units", "attack"])
    has_attacks = cases.attack.nunique() > 1
    for offset, (metric, label) in enumerate(LABELS.items()):
        of = cases.merge(found[found.metric == metric], how="left")
        y = np.arange(len(of)) + 0.2 * (offset - 0.5)
        axes.errorbar(
            of.ratio, y, xerr=[of.ratio - of.low, of.high - of.ratio], color=style.ink(offset), linestyle="",
            marker=style.marker(offset), capsize=2, label=label,
        )  # fmt: skip
    names = [
        f"{r.units:g} units, {100 * r.equipped:.0f} %" + f", {r.attack.replace('_', '-')}" * has_attacks
        for r in cases.itertuples()
    ]
    axes.set_yticks(np.arange(len(cases)), names)
    axes.set_ylim(len(cases) - 0.4, -0.6)
    axes.axvline(1.0, color="0.4", lw=0.8)
    axes.axvline(0.5, color="0.4", lw=0.8, ls=":")
    axes.set_xlim(left=0)
    style.panel(axes, "Chosen against drawn junctions", "Ratio of the 90th percentiles of the age", "")
    style.legend(figure, axes.get_legend_handles_labels()[0])
    return figure


def main(*paths: str) -> None:
    studies = [path for path in paths if not path.endswith(".png")]
    found = table(pd.concat([measures_of(Path(path)) for path in studies], ignore_index=True))
    print(found.round(3).to_string(index=False))
    for path in paths[len(studies) :]:
        style.save(draw(found), path)


if __name__ == "__main__":
    main(*sys.argv[1:])
