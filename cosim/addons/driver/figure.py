"""What drivers suffer from what vehicles believe."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from cosim.addons.driver import safety
from cosim.addons.driver.conflicts import tracks
from results.figures import style
from results.run import Run

_INKS = {"ghost": style.ROLE_INKS["malicious"], "false positive": style.INKS[3], "real": style.INKS[0]}
_COUNTS = {
    "hard_braking.per_km": "hard braking",
    "emergency_braking.per_km": "emergency\nbraking",
    "ttc.per_km": "time to\ncollision < 3 s",
    "pet.per_km": "post-encroach-\nment < 2 s",
    "stops.per_km": "stops",
}
_PARTS = 20
"""Parts of a run that are drawn over time."""


@style.styled
def draw(runs: Sequence[Run]) -> Figure:
    """Safety events per vehicle-kilometre, hard braking over time, and what drivers reacted to.

    Time is drawn in twenty parts of the run, of at least one step. Reactions are speeds commanded because of fused
    objects that the own detector does not report; those to ghosts and to false positives are false alarms. Without a
    driver that reacts there are none.
    """
    runs = style.arranged(runs)
    inks = style.inks(runs)
    reacts = any("reactions" in run.tables and run.n_rows("reactions") for run in runs)
    figure, (events, over_time, *causes) = style.sheet(3 if reacts else 2, 2.2)
    width = 0.8 / len(runs)
    for i, run in enumerate(runs):
        found = safety.summary(run)
        if not found["driven_km"]:
            raise ValueError(f"{run.path}: no vehicle was ever on the road. Let it run longer, or scale the demand up.")
        aside = (i - (len(runs) - 1) / 2) * width
        at = np.arange(len(_COUNTS)) + aside
        values = [found.get(name, 0.0) for name in _COUNTS]
        hatch = style.HATCHES[i % len(style.HATCHES)]
        events.barh(at, values, width, color=inks[i], hatch=hatch, edgecolor="#333333", linewidth=0.5)
        _over_time(over_time, run, style.look(i) | {"color": inks[i]})
    over_time.set_ylim(bottom=0)
    events.set_xlim(left=0)
    events.set_yticks(range(len(_COUNTS)), list(_COUNTS.values()))
    events.invert_yaxis()
    style.panel(events, "Safety events", "Per vehicle-kilometre [1/km]", "")
    style.panel(over_time, "Hard braking", style.TIME, "Per vehicle-kilometre [1/km]")
    kinds = []
    for axes in causes:
        there = _causes(axes, runs)
        style.panel(axes, "What drivers react to", "Per vehicle-kilometre [1/km]", "")
        kinds = [Patch(facecolor=_INKS[kind], edgecolor="#333333", label=kind) for kind in _INKS if kind in there]
    style.legend(figure, kinds, style.series_entries(runs))
    return figure


def _over_time(axes: Axes, run: Run, look: dict[str, Any]) -> None:
    """Hard braking per kilometre in parts of the run; none where nobody drives."""
    poses = tracks(run)
    n_steps = run.manifest["steps"]
    edges = np.linspace(0, n_steps, min(_PARTS, n_steps) + 1)
    driven_km = poses.speed_mps * run.dt_s / 1000
    way_km, _ = np.histogram(poses.step, edges, weights=driven_km)
    events = safety.braking(run, poses)
    n, _ = np.histogram(events.step[events.severity == "hard"], edges)
    rate = n / np.where(way_km > 0, way_km, np.nan)
    axes.plot(edges[1:] * run.dt_s, rate, **look)


def _causes(axes: Axes, runs: Sequence[Run]) -> set[str]:
    """Reactions per kilometre by kind, one bar per run; the kinds that there are."""
    there: set[str] = set()
    for i, run in enumerate(runs):
        axes.barh(i, 0.0, 0.6)
        if "reactions" not in run.tables or not run.n_blocks("reactions"):
            continue
        bottom = 0.0
        row: Any
        for row in safety.by_kind(run).itertuples():
            axes.barh(i, row.per_km, 0.6, bottom, color=_INKS[row.kind], edgecolor="#333333", linewidth=0.5)
            bottom += row.per_km
            there |= {row.kind} if row.n else set()
    axes.set_xlim(left=0)
    names = style.names(runs) if len(runs) > 1 else [""]
    axes.set_yticks(range(len(runs)), names)
    axes.set_ylim(len(runs) - 0.3, -0.7)
    return there
