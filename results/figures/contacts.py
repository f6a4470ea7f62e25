"""The graph of contacts over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from results.figures import style
from results.metrics import contact_graph
from results.run import Run

_POINTS = 60


@style.styled
def draw(runs: Sequence[Run], every_s: float = 10.0, radius_m: float | None = None, pairs: str | None = None) -> Figure:
    """Mean degree, share of the largest component, and how far a message of one actor could have spread, over time.

    Long runs are drawn as means of a sixtieth of their time, a single one with their range.
    """
    runs = style.arranged(runs)
    figure, (degree, largest, reached) = style.sheet(3, 1.9)
    for i, run in enumerate(runs):
        frame = contact_graph.over_time(run, every_s, radius_m, pairs)
        ink = style.inks(runs)[i]
        line: dict[str, Any] = {"color": ink, "linestyle": style.dash(i), "marker": style.marker(i)}
        for axes, values in ((degree, frame.degree_mean), (largest, frame.largest_share)):
            spread = values.groupby(np.arange(len(frame)) // max(1, len(frame) // _POINTS)).agg(["mean", "min", "max"])
            time_s = frame.time_s.to_numpy()[:: max(1, len(frame) // _POINTS)]
            axes.plot(time_s, spread["mean"], **line, markevery=style.sparse(len(spread)))
            if len(runs) == 1:
                axes.fill_between(time_s, spread["min"], spread["max"], color=ink, alpha=0.18, linewidth=0)
        reachable = contact_graph.temporal_reachability(run, every_s, radius_m, pairs)
        reached.plot(reachable.time_s, reachable.reached_mean, **line, markevery=style.sparse(len(reachable)))
    style.panel(degree, "Contacts per actor in contact", style.TIME, "Mean degree")
    style.panel(largest, "Largest component", style.TIME, "Share of actors in contact")
    style.panel(reached, "Temporal reachability", style.TIME, "Share reached, of actors met so far")
    degree.set_ylim(bottom=0)
    style.share_axis(largest)
    style.share_axis(reached)
    for axes in (degree, largest, reached):
        axes.set_xlim(left=0)
    style.legend(figure, style.series_entries(runs))
    return figure
