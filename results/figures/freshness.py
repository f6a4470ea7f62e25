"""What stands behind trust when it is looked up, how old it is, and what attacks achieve meanwhile."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from results.figures import style
from results.metrics import attack, compare, freshness
from results.run import Run
from results.tables import axis_label


@style.styled
def draw(runs: Sequence[Run], over: str | None = None, threshold: float = 0.5) -> Figure:
    """Age, at lookups, of the newest evaluation by another vehicle that could see, and what lookups rest on.

    Runs that differ in one number alone, or in the one named by `over`, are drawn over it instead: ages, what lookups
    rest on, and the success of attacks at a score of `threshold`, with the means of repetitions as lines.
    """
    style.need(runs)
    studied = compare.axis(runs, over)
    if studied is not None:
        return _over(runs, studied[0], threshold)
    runs = style.arranged(runs)
    bars = [_shares(run, "all") for run in runs]
    labels = style.names(runs)
    if len(runs) == 1:
        roles = freshness.states(runs[0]).role.unique()
        bars, labels = [_shares(runs[0], role) for role in roles], list(roles)
    figure, (ages, shares) = style.sheet(2, max(2.2, 0.8 + 0.2 * len(bars)))
    longest_s = 0.0
    for i, run in enumerate(runs):
        for what, dash in (("newest evaluation", style.dash(0)), ("value", style.dash(2))):
            try:
                curve = freshness.distribution(run, what)
            except ValueError:
                continue  # nothing but defaults
            line = ages.step(curve.age_s, curve.share, where="post", color=style.inks(runs)[i], linestyle=dash)
            if len(runs) == 1:
                line[0].set_label({"value": "the value itself"}.get(what, what))
            longest_s = max(longest_s, float(curve.age_s[curve.share >= 0.99].min()))
    if longest_s == 0:
        ages.text(0.5, 0.5, "no value rests on an evaluation", ha="center", transform=ages.transAxes)
    elif len(runs) == 1:
        ages.legend(loc="lower right")
    for i, bar in enumerate(bars):
        style.shares_bar(shares, i, bar, _FILLS)
    style.panel(
        ages, "Age when looked up" if len(runs) == 1 else "Age when looked up (dotted: the value)",
        axis_label("trust_lookups", "age_s", "Age"), "Share of values at most this old",
    )  # fmt: skip
    style.share_axis(ages)
    ages.set_xlim(0, max(longest_s, 1.0) * 1.05)
    style.panel(shares, "What stands behind lookups" + (", by role" if len(runs) == 1 else ""), "Share of lookups", "")
    style.bars_axis(shares, labels)
    entries = style.bar_entries(freshness.STATES, _FILLS)
    there = [entry for entry, *found in zip(entries, *bars, strict=True) if any(share > 0 for share in found)]
    style.legend(figure, there, style.colour_entries(runs))
    return figure


_FILLS = (style.INKS[0], style.PALE, "#e8b9a6", "#ffffff")


def _shares(run: Run, role: str) -> list[float]:
    frame = freshness.states(run)
    share = frame[frame.role == role].set_index("state").share
    return [float(share.get(state, 0.0)) for state in freshness.STATES]


def _value(ask: Callable[[Run], pd.DataFrame], column: str, **where: str) -> Callable[[Run], float]:
    """A question: the value in the row of a table that has these others; NaN where there is none."""

    def found(run: Run) -> float:
        frame = ask(run)
        rows = frame[column][np.all([frame[name] == value for name, value in where.items()], axis=0)]
        return float(rows.max())

    return found


def _over(runs: Sequence[Run], key: str, threshold: float) -> Figure:
    """Three panels over a number; runs that differ in another key have lines of their own."""
    lies = {"effect": "inserted", "receivers": attack.HONEST, "role": "malicious"}

    def ages(run: Run) -> pd.DataFrame:
        return run.once("figure.ages", lambda: freshness.ages(run))

    def states(run: Run) -> pd.DataFrame:
        return run.once("figure.states", lambda: freshness.states(run))

    def success(run: Run) -> pd.DataFrame:
        return run.once(f"figure.success {threshold}", lambda: attack.success(run, (threshold,)))

    panels: Mapping[str, Mapping[str, Callable[[Run], float]]] = {
        "Mean age at lookup": {
            what: _value(ages, "mean_s", what=what, role="all") for what in freshness.AGES
        },
        "What stands behind lookups": {
            state: _value(states, "share", state=state, role="all") for state in freshness.STATES
        },
        f"Ghosts believed (score {threshold:g})": {
            "by receivers": _value(success, "share", among="received", **lies),
            "by the victim": _value(success, "share", among="intended", **lies),
        },
    }  # fmt: skip
    beside = [name for name in compare.differing(runs) if name != key]
    values = [dict(compare.flat(run.config)) for run in runs]
    groups = sorted(
        {tuple((name, value.get(name)) for name in beside) for value in values},
        key=lambda group: [compare.sort_key(x) for _, x in group],
    )
    asked = {name: question for panel in panels.values() for name, question in panel.items()}
    frame = compare.tabulate(runs, key, asked)
    panels = {title: names for title, names in panels.items() if frame[list(names)].notna().any(axis=None)}
    figure, axes = style.sheet(len(panels))
    frame["group"] = [groups.index(tuple((name, values[i].get(name)) for name in beside)) for i in frame["row"]]
    at, ticks = _positions(frame[key])
    for panel, (title, names) in zip(axes, panels.items(), strict=True):
        for i, name in enumerate(names):
            for g in range(len(groups)):
                one = frame[(frame.group == g) & frame[name].notna()]
                if one.empty:
                    continue
                mean = one.groupby(key)[name].mean()
                panel.plot(at(one[key]), one[name], linestyle="", marker=style.marker(i), color=style.ink(i), alpha=0.5)
                panel.plot(at(mean.index), mean, linestyle=style.dash(g), marker=style.marker(i), color=style.ink(i),
                           label=name if g == 0 else None)  # fmt: skip
        style.panel(panel, title, compare.label(key), "Age [s]" if title == "Mean age at lookup" else "Share")
        panel.set_xscale("log")
        panel.set_xticks(list(ticks), list(ticks.values()), minor=False)
        panel.minorticks_off()
        panel.legend(handlelength=2.2)
        panel.set_ylim(bottom=0)
    style.legend(figure, style.dash_entries([", ".join(f"{k} = {v}" for k, v in group) for group in groups]))
    return figure


def _positions(values: pd.Series) -> tuple[Callable[[pd.Series | pd.Index], np.ndarray], dict[float, str]]:
    """Places on a logarithmic axis, and their labels; "off" (infinite) stands a step beyond the largest, 0 before."""
    finite = sorted({v for v in values if np.isfinite(v) and v > 0}) or [1.0]
    place = {v: v for v in finite}
    place |= {np.inf: finite[-1] * 2.0, 0.0: finite[0] / 2.0}
    labels = {place[v]: "off" if v == np.inf else f"{v:g}" for v in sorted(set(values))}
    return lambda wanted: np.array([place[v] for v in wanted]), labels
