"""The paper's tables beside what our cities give: average precision by method, and what attackers change."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from results.figures import style
from results.metrics.kitti import LEVELS

METHODS = {
    "local": "ego alone", "trupercept_1": "TruPercept 1", "trupercept_2": "TruPercept 2",
    "trupercept_3": "TruPercept 3", "corrected": "corrected pose",
}  # fmt: skip
CLASSES = ("car", "pedestrian")
SETTINGS = ("trustworthy", "unreliable", "malicious")
_PAPER: Any = {"color": "black", "marker": "_", "markersize": 9, "markeredgewidth": 1.8, "linestyle": ""}


@style.styled
def draw_tables(rows: pd.DataFrame) -> Figure:
    """Average precision by class and level, a colour per method: the paper's, and mean and interval of each city.

    Upper panels with reports of the vehicles about themselves, lower ones without.
    """
    rows = rows[rows.what == "average precision"]
    cities = list(dict.fromkeys(rows.city))
    kinds = [kind for kind in (True, False) if (rows.self_reports == kind).any()]
    figure, panels = style.sheet(2 * len(kinds), 1.9)
    for row, kind in enumerate(kinds):
        for column, label in enumerate(CLASSES):
            axes = panels[2 * row + column]
            some = rows[(rows.self_reports == kind) & (rows["class"] == label)]
            _levels(axes, some, cities)
            said = "with self-reports" if kind else "without self-reports"
            style.panel(axes, f"{label}, {said}", "", "AP 3D, 11 points [%]")
    entries = [Line2D([], [], color=style.ink(i), lw=4, label=name) for i, name in enumerate(METHODS.values())]
    style.legend(figure, [*entries, Line2D([], [], **_PAPER, label="paper"), *_city_entries(cities)])
    return figure


def _levels(axes: Axes, some: pd.DataFrame, cities: list[str]) -> None:
    for at, level in enumerate(LEVELS):
        for i, method in enumerate(METHODS):
            x = at + 0.16 * (i - 2)
            found = some[(some.level == level) & (some.method == method)]
            if len(found) and pd.notna(found.paper.iloc[0]):
                axes.plot([x], [found.paper.iloc[0]], **_PAPER)
            for k, city in enumerate(cities):
                one = found[found.city == city]
                _point(axes, x + 0.05 * (k - (len(cities) - 1) / 2), one, "mean", "low", "high", style.ink(i), k)
    axes.set_xticks(range(len(LEVELS)), list(LEVELS))
    axes.set_xlim(-0.5, len(LEVELS) - 0.5)
    axes.set_ylim(0, 102)
    axes.grid(visible=False, axis="x")


def _point(axes: Axes, x: float, one: pd.DataFrame, mean: str, low: str, high: str, ink: str, city: int) -> None:
    """A mean with its interval, where there is one."""
    if not len(one) or pd.isna(one[mean].iloc[0]):
        return
    value = float(one[mean].iloc[0])
    ends = [[value - one[low].iloc[0]], [one[high].iloc[0] - value]]
    error = None if np.isnan(ends).any() else ends
    axes.errorbar(
        [x], [value], yerr=error, color=ink, marker=style.marker(city), markersize=4, linestyle="", elinewidth=1.0
    )


def _city_entries(cities: list[str]) -> list[Line2D]:
    grey: Any = {"color": "#666666", "linestyle": ""}
    return [Line2D([], [], marker=style.marker(k), label=city, **grey) for k, city in enumerate(cities)]


@style.styled
def draw_trust_levels(rows: pd.DataFrame) -> Figure:
    """Mean trust at the end by setting, and the change of average precision that attackers cause, by method."""
    cities = list(dict.fromkeys(rows[rows.what == "average precision"].city))
    figure, (left, middle, right) = style.sheet(3, 1.9)
    trusted = rows[rows.what.str.startswith("mean trust at the end") & (rows.method == "local")]
    for at, setting in enumerate(SETTINGS):
        for i, who in enumerate(("all others", "drawn as attackers")):
            found = trusted[(trusted.setting == setting) & trusted.what.str.endswith(who)]
            x = at + 0.24 * (i - 0.5)
            if found.paper.notna().any():
                left.plot([x], [found.paper.dropna().iloc[0]], **_PAPER)
            for k, city in enumerate(cities):
                _point(left, x + 0.07 * (k - 0.5), found[found.city == city], "mean", "low", "high", style.ink(i), k)
    style.panel(left, "Mean trust at the end", "", "Trust")
    left.set_xticks(range(3), SETTINGS)
    style.share_axis(left, 0.6)
    whom = [Line2D([], [], color=style.ink(i), lw=4, label=("others", "drawn attackers")[i]) for i in range(2)]
    left.legend(handles=whom, loc="upper right")
    ap = rows[(rows.what == "average precision") & (rows.level == "all")]
    for axes, label in ((middle, "car"), (right, "pedestrian")):
        for at, setting in enumerate(SETTINGS[1:]):
            for i, method in enumerate(METHODS):
                found = ap[(ap.setting == setting) & (ap["class"] == label) & (ap.method == method)]
                for k, city in enumerate(cities):
                    one, x = found[found.city == city], at + 0.16 * (i - 2) + 0.05 * (k - 0.5)
                    _point(axes, x, one, "change", "change_low", "change_high", style.ink(i), k)
        axes.axhline(0, color="#666666", linewidth=0.8)
        style.panel(axes, f"Change of AP, {label}, all", "", "Points against honest vehicles")
        axes.set_xticks(range(2), SETTINGS[1:])
        axes.set_xlim(-0.5, 1.5)
    shown = [m for m in METHODS if (ap.method == m).any()]
    entries = [Line2D([], [], color=style.ink(list(METHODS).index(m)), lw=4, label=METHODS[m]) for m in shown]
    style.legend(figure, [*entries, Line2D([], [], **_PAPER, label="paper"), *_city_entries(cities)])
    return figure
