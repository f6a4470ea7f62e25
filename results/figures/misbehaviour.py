"""How well trust tells liars from honest vehicles, and how soon."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from results.figures import style
from results.metrics import misbehaviour, trust
from results.run import Run
from results.tables import ROLES


@style.styled
def draw(runs: Sequence[Run], false_positives: float = 0.05) -> Figure:
    """True against false positives of thresholds on trust, and how soon vehicles fall below the one that is marked.

    Of values that rest on a evaluation; the diagonal is chance. Honest vehicles are watched from the first lie of anybody
    on; who leaves before is censored (Kaplan and Meier). Whose trust: the server's; without one, on the left the mean
    over those who hear a vehicle and hold a value, on the right that of the first of them to fall below.
    """
    style.need(runs)
    figure, (curves, delays) = style.sheet(columns=2, height=3.9)
    curves.plot([0, 1], [0, 1], color="#777777", linewidth=0.9, linestyle=(0, (2, 2)))
    shown: set[int] = set()
    limits = []
    for i, run in enumerate(runs):
        for role, curve in misbehaviour.roc(run).groupby("role"):
            code = ROLES.index(str(role))
            shown.add(code)
            curves.plot(curve.false_positives, curve.true_positives, color=style.ink(code), linestyle=style.dash(i))
        apart = misbehaviour.separability(run, false_positives)
        for row in apart.to_dict("records"):
            code = ROLES.index(row["role"])
            curves.plot(row["false_positives"], row["true_positives"], color=style.ink(code), marker=style.marker(code))
        limits.append(float(apart.threshold.iloc[0]))
        shown |= _delays(delays, run, limits[-1], style.dash(i))
    axes = "False positives: honest values", "True positives: liars' values"
    style.panel(curves, "ROC of a threshold on trust", *axes)
    style.share_axis(curves)
    curves.set_xlim(-0.02, 1.03)
    few = f"{100 * false_positives:g} %"
    style.panel(delays, f"Suspected at {few} false positives", "Time since the first lie [s]", "Share of vehicles")
    if not any(limits):
        delays.text(0.5, 0.5, f"more than {few} of\nhonest values are 0", ha="center", transform=delays.transAxes)
    style.share_axis(delays)
    delays.set_xlim(left=0)
    entries = [
        Line2D([], [], color=style.ink(code), marker=style.marker(code), label=ROLES[code])
        for code in sorted(shown)
    ]
    style.legend(figure, entries, style.run_entries(runs))
    return figure


def _delays(axes: Axes, run: Run, threshold: float, dash: object) -> set[int]:
    """Draw the delays; which roles there are."""
    shown = set()
    for role, one in misbehaviour.detection_delay(run, threshold, trust.kept_at(run)).groupby("role", observed=True):
        code = ROLES.index(str(role))
        shown.add(code)
        curve = misbehaviour.waiting(one)
        axes.plot(
            curve.duration_s, 1 - curve.survival, drawstyle="steps-post", color=style.ink(code), linestyle=dash,
            marker=style.marker(code), markevery=(2 * code, style.sparse(len(curve), 6)),
        )  # fmt: skip
    return shown
