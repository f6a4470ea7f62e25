"""Trust models side by side: which of them tell attackers from honest vehicles, how soon, and at what cost."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from results.figures import style
from results.metrics import intervals, misbehaviour
from results.run import Run


@style.styled
def draw(runs: Sequence[Run], false_positives: float = 0.05) -> Figure:
    """Per trust variant, of trust as vehicles look it up: area under the ROC curve, attackers below a threshold, and
    honest pseudonyms suspected by mistake.

    Every run is drawn once for each of its trust variants, with all its attackers together; central and local trust
    are measured alike. The dashed line is chance. In the second panel the threshold is each variant's own: that of the
    stated share of false positives among honest values. In the third it is `trust.suspect_below`. Bars are 95 %
    intervals, clustered by vehicle.
    """
    variants, titles = style.variants_of(runs)
    labels = [style.fitted(title, 18) for title in titles]
    lines = 1 + max(label.count("\n") for label in labels)
    for run in variants:
        run.require("trust_lookups")
    figure, panels = style.sheet(3, 0.7 + 0.15 * lines * len(variants))
    few = f"{100 * false_positives:g} %"

    def draw_row(i: int, run: Run) -> None:
        found = misbehaviour.compared_at_lookup(run, false_positives)
        for axes, estimate in zip(panels, found.values(), strict=True):
            _dot(axes, estimate, i)

    for i in style.draw_each(variants, draw_row):
        for axes in panels:
            axes.text(0.0, i, "no values", va="center", color="#666666")
    panels[0].axvline(0.5, color="#777777", linewidth=0.9, linestyle=(0, (2, 2)))
    panel_titles = (
        ("Honest above attacker, at lookup", "Area under the ROC curve"),
        (f"Below the threshold at {few} false positives", "Share of evaluated lookups of attackers"),
        (f"Honest {style.subjects_of(runs)} suspected", "Share of (receiver, honest sender) pairs"),
    )
    longest = max(len(line) for label in labels for line in label.split("\n"))
    for axes, (title, x) in zip(panels, panel_titles, strict=True):
        style.panel(axes, style.fitted(title, 57 - longest), x, "")  # a title begins where the labels end
        axes.set_yticks(range(len(labels)), labels)
        axes.set_ylim(len(labels) - 0.4, -0.6)
        axes.set_xlim(-0.02, 1.03)
    return figure


def _dot(axes: Axes, found: intervals.ClusteredEstimate, i: int) -> None:
    """One value in its row, with its interval."""
    colour = style.ink(0)
    axes.plot(found.value, i, color=colour, marker="o", linestyle="")
    if not np.isnan(found.low):
        axes.plot([found.low, found.high], [i, i], color=colour, linewidth=1.2)
