"""How well trust tells attackers from honest vehicles, and how soon."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from results.figures import style
from results.metrics import misbehaviour, trust
from results.run import Run


@style.styled
def draw(runs: Sequence[Run], false_positives: float = 0.05) -> Figure:
    """Receiver operating characteristic of thresholds on trust, and time to detection at the marked one.

    Of trust values that rest on at least one evaluation; the diagonal is chance. Honest pseudonyms are watched from the
    first attack of any vehicle on; those that go out of use before they are suspected are censored (Kaplan and Meier).
    The trust is the server's; without one, above the mean of the values that receivers hold, below that of the first
    of them to fall below the threshold.
    """
    runs = style.arranged(runs, most=4)
    roles = style.roles_of(runs)
    figure, (curves, delays) = style.sheet(2)
    curves.plot([0, 1], [0, 1], color="#777777", linewidth=0.9, linestyle=(0, (2, 2)))
    shown: set[str] = set()
    limits = []
    for i, run in enumerate(runs):
        for role, curve in misbehaviour.roc(run).groupby("role"):
            shown.add(str(role))
            color = style.role_look(str(role), roles)["color"]
            curves.plot(curve.false_positives, curve.true_positives, color=color, linestyle=style.dash(i))
        found = misbehaviour.classification(run, false_positives)
        for row in found.to_dict("records"):
            curves.plot(row["false_positives"], row["true_positives"], **style.role_look(row["role"], roles))
        limits.append(float(found.threshold.iloc[0]))
        shown |= _delays(delays, run, roles, limits[-1], style.dash(i))
    axes = "False positive rate (honest values)", "True positive rate (attackers' values)"
    style.panel(curves, "ROC of a threshold on trust", *axes)
    style.share_axis(curves)
    curves.set_xlim(-0.02, 1.03)
    few = f"{100 * false_positives:g} %"
    subjects = style.subjects_of(runs)
    begin = "the first attack" if subjects == "vehicles" else "it is watched"
    axes = f"Time since {begin} [s]", f"Share of {subjects} (Kaplan-Meier)"
    style.panel(delays, f"Suspected at {few} false positives", *axes)
    if not any(limits):
        delays.text(0.5, 0.5, f"more than {few} of\nhonest values are 0", ha="center", transform=delays.transAxes)
    style.share_axis(delays)
    delays.set_xlim(left=0)
    mark = style.entry(f"above: threshold at {few}", color="#444444", marker="o", linestyle="")
    style.legend(figure, [*style.role_entries(shown, roles), mark], style.run_entries(runs))
    return figure


def _delays(axes: Axes, run: Run, roles: Sequence[str], threshold: float, dash: object) -> set[str]:
    """Draw the times to detection; which roles there are."""
    shown = set()
    found = misbehaviour.detection_delay(run, threshold, trust.kept_at(run))
    for role, one in found.groupby("role", observed=True):
        shown.add(str(role))
        curve = misbehaviour.waiting(one)
        look = style.role_look(str(role), roles)
        markers = 2 * roles.index(str(role)), style.sparse(len(curve), 6)
        axes.plot(
            curve.duration_s,
            1 - curve.survival,
            drawstyle="steps-post",
            linestyle=dash,
            markevery=markers,
            **look,
        )
    return shown
