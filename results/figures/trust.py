"""Trust over time: median and quartiles over the pseudonyms of each role."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from results.figures import style
from results.metrics import intervals, trust
from results.run import Run
from results.tables import axis_label


@style.styled
def draw(runs: Sequence[Run], vehicles: Sequence[int] = ()) -> Figure:
    """Median and quartiles, over pseudonyms, of the trust in them, by role.

    It is the server's at the time of its computation; without a server, the mean of the values that receivers hold
    of their own. `vehicles` (actor numbers) are drawn one by one as thin lines beside it.
    """
    runs = style.arranged(runs, most=4)
    roles = style.roles_of(runs)
    figure, (axes,) = style.sheet(height=2.8)
    shown, tops = set(), 0.0
    for i, run in enumerate(runs):
        for role, quartiles in trust.over_time(run).groupby("role", observed=True):
            shown.add(str(role))
            look = style.role_look(str(role), roles)
            tops = max(tops, float(quartiles.q75.quantile(0.98)))
            if len(runs) == 1:
                axes.fill_between(
                    quartiles.time_s, quartiles.q25, quartiles.q75, color=look["color"], alpha=0.18, linewidth=0
                )
            markers = 2 * roles.index(str(role)), style.sparse(len(quartiles))
            axes.plot(quartiles.time_s, quartiles["median"], linestyle=style.dash(i), markevery=markers, **look)
        _single(axes, run, vehicles, roles)
    lines = list(axes.lines)
    begins_s = set()
    for run in runs:
        starts = run.vehicles.attack_start_step.dropna()
        if len(starts):
            begins_s.add(float(starts.min()) * run.dt_s)
    if len(begins_s) == 1:
        (begin_s,) = begins_s
        axes.axvline(begin_s, color="#444444", linewidth=0.8, linestyle=(0, (2, 2)))
        axes.annotate(
            "attacks begin",
            (begin_s, 1),
            xycoords=("data", "axes fraction"),
            xytext=(4, -3),
            va="top",
            textcoords="offset points",
            fontsize=style.SMALL,
        )
    what = "median and quartiles" if len(runs) == 1 else "medians"
    places = {"server": "at the server", "vehicles": "at those who receive their messages"}
    kept_at = {trust.kept_at(run) for run in runs}
    where = " or ".join(text for at, text in places.items() if at in kept_at)
    title = f"Trust in {style.subjects_of(runs)} {where}: {what}"
    style.panel(axes, title, style.TIME, axis_label("trust", "trust", "Trust"))
    top = max((float(np.max(line.get_ydata())) for line in lines), default=1.0)
    if len(runs) == 1:
        top = max(top, tops)
    style.share_axis(axes, min(1.0, 1.15 * float(top)))
    axes.set_xlim(left=0)
    if len(runs) == 1 and (before := _before(runs[0])):
        axes.set_xlabel(f"{style.TIME}\n{before}", fontsize=style.SMALLEST, linespacing=1.3)
    style.legend(figure, style.role_entries(shown, roles), style.run_entries(runs))
    return figure


def _before(run: Run) -> str:
    """How attackers and honest vehicles compare before any attack, while all behave alike; empty where never."""
    starts, frame = run.vehicles.attack_start_step.dropna(), trust.values(run)
    first = starts.min() if len(starts) else 0
    frame = frame[frame.rated & (frame.step < first)]
    found = {}
    for role, one in frame.groupby("role", observed=True):
        of_vehicle = one.groupby("vehicle").trust
        sums, n = of_vehicle.sum(), of_vehicle.size()
        found[str(role)] = intervals.ratio(sums.to_numpy(), n.to_numpy())
    known = {role: mean for role, mean in found.items() if mean.low == mean.low}
    if len(known) < 2 or "honest" not in known:
        return ""
    honest = known["honest"]
    texts, apart = [], []
    for role, mean in known.items():
        interval = f"[{mean.low:.2f}, {mean.high:.2f}]"
        texts.append(f"{role} {mean.value:.2f} {interval}")
        if mean.low > honest.high or mean.high < honest.low:
            apart.append(role)
    text = "; ".join(texts)
    reason = (
        f"{' and '.join(apart)} differ from honest: by where they drive, not what they do"
        if apart
        else "all behave alike, and the difference is chance"
    )
    return style.fitted(f"Before any attack, mean [95 %]: {text}; {reason}.", 62)


def _single(axes: Axes, run: Run, vehicles: Sequence[int], roles: Sequence[str]) -> None:
    values = trust.values(run)
    for vehicle in vehicles:
        mine = values[values.vehicle == vehicle]
        if mine.empty:
            raise ValueError(f"{run.path} holds no trust in vehicle {vehicle}.")
        for _, one in mine.groupby("subject"):  # a line for each of its pseudonyms
            color = style.role_look(str(one.role.iloc[0]), roles)["color"]
            axes.plot(one.time_s, one.trust, color=color, linewidth=0.7)
            last = one.iloc[-1]
            axes.annotate(
                str(vehicle),
                (last.time_s, last.trust),
                xytext=(3, 0),
                textcoords="offset points",
                fontsize=style.SMALLEST,
                va="center",
                annotation_clip=False,
            )
