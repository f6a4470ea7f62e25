"""Draws the table of `twelve_attacks` as two pictures.

`python -m tests.verification.attack_map TABLE PICTURE` draws a heat map of trust models and attacks, the ideal observer
first; if the table has several shares of attackers, the AUC over the share. Intervals are those of `twelve_attacks`.
"""

import sys

import pandas as pd

from results.figures import style
from results.figures.study import _heat_maps
from tests.verification.twelve_attacks import estimate

MODEL, ATTACK, SHARE = "trust.model", "attacks.0.attack", "share_p"


def auc(rows: pd.DataFrame, *by: str) -> pd.DataFrame:
    """AUC with its interval over worlds, a row for each combination of these columns, in the order of the table."""
    of = rows[rows.attack != "none"].groupby(list(by), sort=False)
    found = [dict(zip(by, key, strict=True)) | estimate(one, "won", "pairs")._asdict() for key, one in of]
    return pd.DataFrame(found).rename(columns={"value": "mean", "n_units": "n"})


@style.styled
def heat_map(rows: pd.DataFrame):
    """Models from the largest of their smallest AUC downwards, under the ideal observer."""
    of_models = rows[rows.model != "bound"]
    found = auc(of_models, "model", "attack").assign(metric="misbehaviour.auc")
    worst = found.groupby("model")["mean"].min().sort_values(ascending=False)
    found = found.sort_values("model", key=lambda of: of.map(worst), ascending=False, kind="stable")
    ideal = auc(rows[rows.model == "bound"], "model", "attack").assign(
        metric="evidence.auc_bound", model=worst.index[0]
    )
    frame = pd.concat([found, ideal]).rename(columns={"model": MODEL, "attack": ATTACK})
    frame = frame.assign(group="malicious", unit="1", label="honest above attacker (AUC)")
    figure = _heat_maps(frame, ["misbehaviour.auc:malicious"], ATTACK, MODEL, at=())
    axes = figure.axes[0]
    axes.set_title(axes.get_title(loc="left").replace("seeds", "worlds"))
    return figure


@style.styled
def curves(rows: pd.DataFrame):
    """AUC over the share of attackers, a panel for each attack, a line for each model."""
    found = auc(rows[rows.model != "bound"], "attack", "model", SHARE)
    attacks, models = found.attack.unique(), found.model.unique()
    figure, panels = style.sheet(len(attacks), 2.2, across=2)
    for axes, attack in zip(panels, attacks, strict=True):
        for i, model in enumerate(models):
            of = found[(found.attack == attack) & (found.model == model)].sort_values(SHARE)
            ends = [of["mean"] - of.low, of.high - of["mean"]]
            axes.errorbar(
                of[SHARE] + 0.004 * (i - 1), of["mean"], ends, label=model if axes is panels[0] else None,
                color=style.ink(i), marker=style.marker(i), linestyle=style.dash(i), capsize=1.5, elinewidth=0.8,
            )  # fmt: skip
        axes.axhline(0.5, color="grey", linewidth=0.8)
        axes.set_ylim(0, 1)
        axes.set_xticks(sorted(found[SHARE].unique()))
        style.panel(axes, attack, "share of attackers among the equipped", "AUC" if axes is panels[0] else "")
    style.legend(figure, panels[0].get_legend_handles_labels()[0])
    return figure


if __name__ == "__main__":
    table, picture = sys.argv[1:]
    known = pd.read_csv(table)
    draw = curves if known.loc[known.attack != "none", SHARE].nunique() > 1 else heat_map
    style.save(draw(known), picture)
