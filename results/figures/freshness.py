"""How fresh trust is when it is used."""

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.patches import Patch

from results.archive import Run
from results.figures import style
from results.metrics import freshness
from results.tables import axis_label


@style.styled
def draw(runs: Sequence[Run], fresh_s: float = 10.0) -> Figure:
    """Distribution of the age of trust at use, and the shares of fresh, stale and default values."""
    style.need(runs)
    figure, (ages, shares) = style.sheet(columns=2, height=3.2)
    longest_s = 0.0
    for i, run in enumerate(runs):
        curve = freshness.distribution(run)
        ages.plot(
            curve.age_s,
            curve.share,
            color=style.ink(i),
            linestyle=style.dash(i),
            marker=style.marker(i),
            markevery=0.12,
        )
        longest_s = max(longest_s, float(curve.age_s[curve.share >= 0.99].min()))
        left = 0.0
        for code, share in enumerate(freshness.shares(run, fresh_s).share):
            shares.barh(
                i, share, 0.6, left, color=_fill(code), hatch=style.HATCHES[code], edgecolor="#333333", linewidth=0.6
            )
            if share > 0.08:
                shares.text(
                    left + share / 2, i, f"{100 * share:.0f} %", ha="center", va="center", fontsize=8,
                    color="white" if code == 0 else "black",
                    bbox={"facecolor": _fill(code), "edgecolor": "none", "pad": 1.2},
                )  # fmt: skip
            left += share
    if fresh_s < longest_s:
        ages.axvline(fresh_s, color="#777777", linewidth=0.9)
        ages.annotate(
            f"stale beyond {fresh_s:g} s", (fresh_s, 0.04), xytext=(4, 0), textcoords="offset points", fontsize=8
        )
    style.panel(ages, "Age of trust when used", axis_label("uses", "age_s", "Age"), "Share of uses at most this old")
    style.share_axis(ages)
    ages.set_xlim(0, max(longest_s, 1.0) * 1.05)
    style.panel(shares, "Where the value came from", f"Share of uses (fresh: at most {fresh_s:g} s)", "")
    shares.set_yticks(range(len(runs)), style.names(runs))
    shares.set_ylim(len(runs) - 0.2, -0.8)
    shares.set_xlim(0, 1)
    shares.grid(visible=False, axis="y")
    labels = ("fresh", "stale", "default")
    entries = [
        Patch(facecolor=_fill(code), hatch=style.HATCHES[code], edgecolor="#333333", linewidth=0.6, label=label)
        for code, label in enumerate(labels)
    ]
    style.legend(figure, entries + style.series_entries(runs))
    return figure


def _fill(code: int) -> str:
    return (style.INKS[0], "#e8b9a6", "#ffffff")[code]
