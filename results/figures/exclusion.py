"""Precision and recall of exclusion by trust, as a front."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from results.figures import style
from results.metrics import exclusion
from results.run import Run

THRESHOLDS = (0.1, 0.25, 0.5)
"""Thresholds that are marked."""


@style.styled
def draw(runs: Sequence[Run]) -> Figure:
    """Precision over recall of the exclusion of senders, for every threshold on trust; the front is underlaid.

    A curve is a run, or a trust variant of one. Marked are thresholds of 0.1, 0.25 and 0.5.
    """
    runs = style.arranged(runs, most=6)
    figure, (axes,) = style.sheet(height=2.8)
    curves = [exclusion.curve(run) for run in runs]
    points = [curve.dropna() for curve in curves]
    recall, precision = (np.concatenate([c[name].to_numpy() for c in points]) for name in ("recall", "precision"))
    front = exclusion.is_on_front(recall, precision)
    order = np.argsort(recall[front])
    axes.plot(np.r_[0, recall[front][order]], np.r_[precision[front][order][:1], precision[front][order]],
              drawstyle="steps-pre", color=style.PALE, linewidth=7, solid_capstyle="butt", zorder=1)  # fmt: skip
    for i, curve in enumerate(curves):
        ink = style.inks(runs)[i]
        axes.plot(curve.recall, curve.precision, color=ink, linestyle=style.dash(i), zorder=2)
        for k, threshold in enumerate(THRESHOLDS):
            if (place := exclusion.at(curve, threshold)) is not None:
                axes.plot(*place, color=ink, marker=style.marker(k), markersize=6, markeredgecolor="white", zorder=3)
    style.panel(axes, "Exclusion by a threshold on trust", "Recall of exclusion",
                "Precision of exclusion")  # fmt: skip
    style.share_axis(axes)
    axes.set_xlim(-0.02, 1.03)
    marks = [
        Line2D([], [], color="#444444", linestyle="", marker=style.marker(k), label=f"below {threshold:g}")
        for k, threshold in enumerate(THRESHOLDS)
    ]
    marks.append(Line2D([], [], color=style.PALE, linewidth=7, label="front"))
    style.legend(figure, marks, _entries(runs) if len(runs) > 1 else [])
    return figure


def _entries(runs: Sequence[Run]) -> list[Line2D]:
    return [
        Line2D([], [], color=style.inks(runs)[i], linestyle=style.dash(i), label=name)
        for i, name in enumerate(style.names(runs))
    ]
