"""Trust over time: median and middle half of the vehicles of each role."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from results.figures import style
from results.metrics import trust
from results.run import Run
from results.tables import ROLES, axis_label


@style.styled
def draw(runs: Sequence[Run], vehicles: Sequence[int] = ()) -> Figure:
    """Median and middle half, over vehicles, of the trust in them, by role.

    It is the server's at the time of its computation; without a server, the mean over those who hear a vehicle and
    hold a value of their own. `vehicles` are drawn one by one as thin lines beside it.
    """
    style.need(runs)
    figure, (axes,) = style.sheet()
    shown = set()
    for i, run in enumerate(runs):
        for role, spread in trust.over_time(run).groupby("role", observed=True):
            code = ROLES.index(str(role))
            shown.add(code)
            if len(runs) == 1:
                axes.fill_between(spread.time_s, spread.q25, spread.q75, color=style.ink(code), alpha=0.18, linewidth=0)
            axes.plot(
                spread.time_s, spread["median"], color=style.ink(code), linestyle=style.dash(i),
                marker=style.marker(code), markevery=(2 * code, style.sparse(len(spread))),
            )  # fmt: skip
        _single(axes, run, vehicles)
    begins_s = {float(lies.min()) * run.dt_s for run in runs if (lies := run.vehicles.attack_start_step.dropna()).size}
    for begin_s in begins_s if len(begins_s) == 1 else ():
        axes.axvline(begin_s, color="#444444", linewidth=0.8, linestyle=(0, (2, 2)))
        axes.annotate(
            "lies begin", (begin_s, 1), xycoords=("data", "axes fraction"), xytext=(4, -3), va="top",
            textcoords="offset points", fontsize=8,
        )  # fmt: skip
    what = "median and middle half" if len(runs) == 1 else "medians"
    places = {"server": "at the server", "vehicles": "as those who hear them trust them"}
    where = " or ".join(text for at, text in places.items() if any(trust.kept_at(run) == at for run in runs))
    style.panel(axes, f"Trust in vehicles {where}: {what}", style.TIME, axis_label("trust", "trust", "Trust"))
    style.share_axis(axes)
    axes.set_xlim(left=0)
    entries = [
        Line2D([], [], color=style.ink(code), marker=style.marker(code), label=ROLES[code])
        for code in sorted(shown)
    ]
    style.legend(figure, entries, style.run_entries(runs))
    return figure


def _single(axes: Axes, run: Run, vehicles: Sequence[int]) -> None:
    values = trust.values(run)
    for vehicle in vehicles:
        one = values[values.vehicle == vehicle]
        if one.empty:
            raise ValueError(f"Nobody in {run.path} ever judged vehicle {vehicle}.")
        code = ROLES.index(one.role.iloc[0])
        axes.plot(one.time_s, one.trust, color=style.ink(code), linewidth=0.7)
        axes.annotate(
            str(vehicle), (one.time_s.iloc[-1], one.trust.iloc[-1]), xytext=(3, 0), textcoords="offset points",
            fontsize=7, va="center", annotation_clip=False,
        )  # fmt: skip
