"""Trust models side by side: which of them tell attackers from honest vehicles, how soon, and at what cost."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from results.figures import style
from results.metrics import intervals, misbehaviour, security, trust
from results.run import Run


@style.styled
def draw(runs: Sequence[Run], false_positives: float = 0.05) -> Figure:
    """Per trust variant: area under the ROC curve, share ever suspected, and honest vehicles suspected by mistake.

    Every run is drawn once for each of its trust variants, with all its attackers together. The line is chance. In the
    middle and on the right the threshold is each variant's own: that of the stated share of false positives among
    honest values. Bars are 95 % intervals, clustered by vehicle (pseudonym).
    """
    style.need(runs)
    variants = [run.as_variant(name) for run in runs for name in run.variants]
    labels = [run.variant if len(runs) == 1 else f"{run.path.name}, {run.variant}" for run in variants]
    height = 1.6 + 0.24 * len(variants)
    figure, (ranks, found, mistakes) = style.sheet(columns=3, width=10.4, height=height)
    few = f"{100 * false_positives:g} %"
    for i, run in enumerate(variants):
        frame = misbehaviour.scored_vehicles(run).query("rated")
        is_honest = frame.role == misbehaviour.HONEST
        honest, attacking = frame[is_honest], frame[~is_honest]
        _dot(ranks, intervals.auc(honest.trust.to_numpy(np.float64), honest.subject.to_numpy(),
                                  attacking.trust.to_numpy(np.float64), attacking.subject.to_numpy()), i)  # fmt: skip
        limit = misbehaviour.threshold_at(honest.trust.to_numpy(np.float64), false_positives)
        if np.isnan(limit):
            continue
        delays = misbehaviour.detection_delay(run, limit, trust.kept_at(run))
        delays = delays[delays.role != misbehaviour.HONEST]
        _dot(found, intervals.of_units(delays.found.to_numpy(bool), delays.subject.to_numpy()), i)
        _dot(mistakes, security.false_exclusions(run, limit), i)
    ranks.axvline(0.5, color="#777777", linewidth=0.9, linestyle=(0, (2, 2)))
    titles = (
        ("Honest above attacker", "Area under the ROC curve"),
        (f"Suspected at {few} false positives", "Share of attackers ever suspected"),
        ("False exclusions", "Per honest vehicle-hour [1/h]"),
    )
    for axes, (title, x) in zip((ranks, found, mistakes), titles, strict=True):
        style.panel(axes, title, x, "")
        axes.set_yticks(range(len(labels)), labels if axes is ranks else [""] * len(labels))
        axes.set_ylim(len(labels) - 0.4, -0.6)
        axes.set_xlim(left=-0.02)
    ranks.set_xlim(-0.02, 1.03)
    found.set_xlim(-0.02, 1.03)
    return figure


def _dot(axes: Axes, found: intervals.Estimate, i: int) -> None:
    """One value in its row, with its interval."""
    colour = style.ink(0)
    axes.plot(found.value, i, color=colour, marker="o", linestyle="")
    if not np.isnan(found.low):
        axes.plot([found.low, found.high], [i, i], color=colour, linewidth=1.2)
