"""Survival curves of encounters, with censoring in mind."""

from collections.abc import Sequence

import pandas as pd
from matplotlib.figure import Figure

from results.figures import style
from results.metrics import encounters
from results.run import Run
from results.tables import axis_label


@style.styled
def draw(runs: Sequence[Run], departure: encounters.Departure = "ends") -> Figure:
    """Kaplan-Meier curves by definition, with their 95 % bands; the axis ends where 1 % is left."""
    runs = style.arranged(runs, most=4)
    figure, (axes,) = style.sheet()
    curves = [encounters.survival(run, departure) for run in runs]
    all_kinds = pd.concat([curve[[*encounters.DEFINITION]] for curve in curves]).drop_duplicates()
    all_kinds = all_kinds.sort_values(["radius_m", "pairs", "hysteresis_s"]).reset_index(drop=True)
    labels = encounters.named(all_kinds).tolist()
    kinds = list(all_kinds.itertuples(index=False, name=None))
    longest_s = 0.0
    for i, curve in enumerate(curves):
        for kind, one in curve.groupby([*encounters.DEFINITION], observed=True):
            code = kinds.index(kind)
            color = style.ink(code)
            axes.plot(
                one.duration_s,
                one.survival,
                drawstyle="steps-post",
                color=color,
                linestyle=style.dash(i),
                marker=style.marker(code),
                markevery=0.08,
            )
            axes.fill_between(one.duration_s, one.low, one.high, step="post", color=color, alpha=0.15, linewidth=0)
            before = one.survival.shift(fill_value=1.0)
            longest_s = max(longest_s, float(one.duration_s[before >= 0.01].max()))
    if not longest_s:
        axes.text(0.5, 0.5, "too few encounters", transform=axes.transAxes, ha="center", color="#666666")
    style.panel(
        axes, "Encounters that last longer", axis_label("encounters", "duration_s", "Duration"), "Share of encounters"
    )
    style.share_axis(axes)
    axes.set_xlim(0, max(longest_s, 1.0) * 1.02)
    entries = []
    for code, label in enumerate(labels):
        entries.append(style.entry(label, color=style.ink(code), marker=style.marker(code)))
    style.legend(figure, entries, style.run_entries(runs))
    return figure
