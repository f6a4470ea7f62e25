"""Survival of durations and of the times between encounters on logarithmic axes, with the fitted families."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.addons.durations.families import FAMILIES
from cosim.addons.durations.fit import fits
from cosim.addons.durations.goodness import FEWEST_AT_RISK, product_limit, tail_curve
from cosim.addons.durations.samples import LABELS, Durations, What, definitions, of_run
from results.figures import style
from results.metrics.encounters import named
from results.run import Run


@style.styled
def draw(runs: Sequence[Run], radius_m: float | None = None, pairs: str | None = None) -> Figure:
    """Kaplan-Meier curves of durations and inter-contact times, log-log and semi-logarithmic.

    One run is drawn with all families. Of several runs, each is drawn with its best family by AIC.
    """
    runs = style.arranged(runs, most=len(style.INKS))
    figure, panels = style.sheet(4, 1.9, across=2)
    whats: tuple[What, ...] = ("duration", "inter_contact")
    shown: list[str] = []
    titles = []
    for i, run in enumerate(runs):
        definition = _chosen(run, radius_m, pairs)
        titles.append(str(named(definition.to_frame().T, definitions(run)).iloc[0]))
        for row, what in enumerate(whats):
            sample = of_run(run, what, definition)
            in_row = panels[2 * row : 2 * row + 2]
            shown += _curves(in_row, sample, i, len(runs) == 1)
    for row, what in enumerate(whats):
        for column, scale in enumerate(("log", "linear")):
            axes = panels[2 * row + column]
            title = f"{LABELS[what].capitalize()}s" + (", log-log" if scale == "log" else ", semi-log")
            style.panel(axes, title, f"{LABELS[what].capitalize()} [s]", "Share that lasts longer")
            if axes.lines:
                axes.set_xscale(scale)
                axes.set_yscale("log")
                axes.minorticks_off()
                for axis in (axes.xaxis, axes.yaxis)[scale == "linear" :]:
                    style.numbered(axis, most=100.0)
            else:
                axes.text(0.5, 0.5, "too few", transform=axes.transAxes, ha="center", color="#666666")
    figure.suptitle(" / ".join(dict.fromkeys(titles)), fontsize=style.SMALL)
    entries = []
    if len(runs) == 1:
        entries.append(style.entry("Kaplan-Meier, 95 %", color=style.INKS[0], marker="o", linestyle=""))
        for i, (name, family) in enumerate(FAMILIES.items()):
            if name in shown:
                look = {"color": style.ink(i + 1), "linestyle": style.dash(i)}
                entries.append(style.entry(family.label, **look))
    else:
        for i, name in enumerate(style.names(runs)):
            entries.append(style.entry(name, color=style.ink(i), marker=style.marker(i)))
    style.legend(figure, entries)
    return figure


def _chosen(run: Run, radius_m: float | None, pairs: str | None) -> pd.Series:
    """The definition that is drawn: the first one that the options name."""
    found = definitions(run)
    if found.empty:
        raise ValueError(f"{run.path} holds no encounters: no two came within the radius of each other.")
    keep = np.ones(len(found), bool)
    if radius_m is not None:
        keep &= np.isclose(found.radius_m.to_numpy(float), radius_m)
    if pairs is not None:
        keep &= (found.pairs == pairs).to_numpy()
    if not keep.any():
        said = "; ".join(named(found).tolist())
        raise ValueError(f"{run.path} has no encounters with these options. It has: {said}.")
    return found[keep].iloc[0]


def _curves(panels: Sequence[Axes], sample: Durations, number: int, is_alone: bool) -> list[str]:
    """Draw the curve of one sample and its families into both panels; returns the families drawn."""
    if not sample.ended.any():
        return []
    curve = product_limit(sample)
    are_many = curve.n_at_risk >= FEWEST_AT_RISK
    curve = curve[are_many & (curve.survival > 0) & (curve.duration_s > 0)]
    if len(curve) < 2:
        return []
    try:
        found = fits(sample)
    except ValueError:
        found = []
    names, ink = list(FAMILIES), style.ink(number)
    look: dict[str, Any] = {"color": ink, "marker": style.marker(number), "markersize": 3}
    for axes in panels:
        every = style.sparse(len(curve), 60)
        axes.plot(curve.duration_s, curve.survival, linestyle="", markevery=every, **look)
        axes.fill_between(curve.duration_s, curve.low, curve.high, color=ink, alpha=0.2, linewidth=0)
        for one in found if is_alone else found[:1]:
            x_s, survival = tail_curve(sample, one)
            some = survival > 0.3 * float(curve.survival.min())
            family = names.index(one.name)
            colour = style.ink(family + 1) if is_alone else ink
            dash = style.dash(family)
            axes.plot(x_s[some], survival[some], color=colour, linestyle=dash, linewidth=1.3)
    return [one.name for one in found]
