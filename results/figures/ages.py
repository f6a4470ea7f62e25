"""Tails of the ages of trust, on logarithmic axes."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from results.figures import style
from results.metrics import freshness
from results.run import Run
from results.tables import axis_label


@style.styled
def draw(runs: Sequence[Run]) -> Figure:
    """Complementary distribution of ages at lookup: the share of values that are older than an age.

    On logarithmic axes a straight line is a power law, and a line that bends down falls faster than any.
    """
    runs = style.arranged(runs, most=6)
    figure, (axes,) = style.sheet()
    kinds, shown, reasons = list(freshness.AGES), set(), []
    lowest, shortest_s, longest_s = 1.0, float("inf"), 0.0
    for i, run in enumerate(runs):
        for k, what in enumerate(kinds):
            try:
                curve = freshness.distribution(run, what)
            except ValueError as reason:  # nothing but defaults, or single lookups were not kept
                reasons.append(reason)
                continue
            older = 1 - curve.share.to_numpy()
            older[-1] = older[-2]  # up to the largest age, beyond which nothing is left to draw
            there = curve.age_s > 0
            if not there.any():
                continue
            age_s, older = curve.age_s[there], older[there]
            look = style.look(k)
            if len(runs) > 1:
                look["color"] = style.inks(runs)[i]
            every = 0.15 if len(age_s) > 2 else None  # a single age has no line to set marks along
            axes.plot(age_s, older, drawstyle="steps-post", markevery=every, **look)
            shown.add(k)
            lowest = min(lowest, float(older.min()))
            shortest_s = min(shortest_s, float(age_s.min()))
            longest_s = max(longest_s, float(age_s.max()))
    age = axis_label("trust_lookups", "age_s", "Age")
    style.panel(axes, "Ages of trust when it is looked up", age, "Share that is older")
    if not shown:
        raise reasons[0]
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(shortest_s * 0.9, longest_s * 1.2)
    style.numbered(axes.xaxis)
    axes.set_ylim(max(lowest * 0.7, 1e-6), 1.3)
    entries = []
    for k in sorted(shown):
        look = style.look(k)
        if len(runs) > 1:
            look["color"] = "black"
        name = "the value itself" if kinds[k] == "value" else kinds[k]
        entries.append(style.entry(name, **look))
    style.legend(figure, entries, style.colour_entries(runs))
    return figure
