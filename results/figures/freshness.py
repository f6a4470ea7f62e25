"""How fresh trust is when it is looked up."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from results.figures import style
from results.metrics import compare, freshness, misbehaviour
from results.run import Run
from results.tables import axis_label


@style.styled
def draw(runs: Sequence[Run], fresh_s: float = 10.0, over: str | None = None) -> Figure:
    """Distribution of the age of trust at the lookup, and the shares of fresh, stale and default values.

    Runs that differ in one number alone, or in the one named by `over`, are also drawn over it.
    """
    style.need(runs)
    studied = compare.axis(runs, over)
    if studied is None:
        figure, (ages, shares) = style.sheet(columns=2, height=max(3.2, 1.6 + 0.36 * len(runs)))
    else:
        figure, (ages, shares, below, beside) = style.sheet(columns=2, rows=2, height=6.4)
        _against(runs, studied[0], below, beside, fresh_s)
    bars = [freshness.shares(run, fresh_s) for run in runs]
    labels = style.names(runs)
    if len(runs) == 1:
        groups = freshness.shares_by_role(runs[0], fresh_s).groupby("role", sort=False)
        bars, labels = [*bars, *(frame for _, frame in groups)], ["all", *(str(role) for role, _ in groups)]
    longest_s = 0.0
    for i, run in enumerate(runs):
        if bars[i].n.iloc[:2].sum() == 0:
            continue  # the default has no age
        curve = freshness.distribution(run)
        ages.plot(
            curve.age_s, curve.share, color=style.ink(i), linestyle=style.dash(i), marker=style.marker(i),
            markevery=0.12,
        )  # fmt: skip
        longest_s = max(longest_s, float(curve.age_s[curve.share >= 0.99].min()))
    if longest_s == 0:
        ages.text(0.5, 0.5, "no value but the default", ha="center", transform=ages.transAxes)
    for i, bar in enumerate(bars):
        style.shares_bar(shares, i, bar.share.tolist(), _FILLS)
    if 0 < fresh_s < longest_s:
        ages.axvline(fresh_s, color="#777777", linewidth=0.9)
        ages.annotate(
            f"stale beyond {fresh_s:g} s", (fresh_s, 0.04), xytext=(4, 0), textcoords="offset points", fontsize=8
        )
    style.panel(
        ages,
        "Age of trust when looked up",
        axis_label("trust_lookups", "age_s", "Age"),
        "Share of lookups at most this old",
    )
    style.share_axis(ages)
    ages.set_xlim(0, max(longest_s, 1.0) * 1.05)
    title = "How fresh" + (", by role" if len(runs) == 1 else "")
    style.panel(shares, title, f"Share of lookups (fresh: at most {fresh_s:g} s)", "")
    style.bars_axis(shares, labels)
    entries = style.bar_entries(freshness.STATES, _FILLS)
    style.legend(figure, entries, style.series_entries(runs))
    return figure


_FILLS = (style.INKS[0], "#e8b9a6", "#ffffff")

_AGES: Mapping[str, Callable[[Run], float]] = {
    "value": lambda run: _mean(freshness.at_lookup(run).query("source != 'default'"), "mean_s"),
    "newest evidence": lambda run: _mean(freshness.evidence_at_lookup(run), "newest_s"),
    "oldest evidence": lambda run: _mean(freshness.evidence_at_lookup(run), "oldest_s"),
}


def _against(runs: Sequence[Run], key: str, ages: Axes, shares: Axes, fresh_s: float) -> None:
    """Means of every run over the number in which they differ; a line through repetitions' means."""
    of_lookups: Mapping[str, Callable[[Run], float]] = {
        "default": lambda run: freshness.shares(run, fresh_s).share.iloc[2],
        "stale": lambda run: freshness.shares(run, fresh_s).share.iloc[1],
        "encounters over without trust": lambda run: _mean(freshness.without_trust(run), "share"),
        "honest above malicious": misbehaviour.separation,
    }
    frame = compare.tabulate(runs, key, {**_AGES, **of_lookups})
    for axes, names in ((ages, list(_AGES)), (shares, list(of_lookups))):
        for i, name in enumerate(names):
            one = frame[[key, name]].dropna()
            if one.empty:
                continue
            mean = one.groupby(key)[name].mean()
            axes.plot(one[key], one[name], linestyle="", marker=style.marker(i), color=style.ink(i))
            axes.plot(mean.index, mean, linestyle=style.dash(i), marker=style.marker(i), color=style.ink(i), label=name)
        axes.legend(fontsize=7.5, handlelength=2.2)
    style.panel(
        ages, "Age where trust is looked up, mean", compare.label(key), axis_label("trust_lookups", "age_s", "Age")
    )
    ages.set_ylim(bottom=0)
    style.panel(shares, "Trust where it is looked up", compare.label(key), "Share")
    style.share_axis(shares)


def _mean(frame: pd.DataFrame, column: str) -> float:
    """Mean of a column, weighted by `n`."""
    known = frame[frame[column].notna()]
    return float(np.average(known[column], weights=known.n)) if len(known) else float("nan")
