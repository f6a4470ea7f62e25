"""The graph of contacts over time."""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from results.archive import Run
from results.figures import style
from results.metrics import contacts


@style.styled
def draw(runs: Sequence[Run], every_s: float = 10.0, radius_m: float | None = None, pairs: str | None = None) -> Figure:
    """Mean degree, share of the largest component, and how far news of one actor could have gone, over time."""
    style.need(runs)
    figure, (degree, largest, reached) = style.sheet(columns=3, width=8.8, height=3.0)
    for i, run in enumerate(runs):
        frame = contacts.over_time(run, every_s, radius_m, pairs)
        line: dict[str, Any] = {"color": style.ink(i), "linestyle": style.dash(i), "marker": style.marker(i)}
        degree.plot(frame.time_s, frame.degree_mean, **line, markevery=style.sparse(len(frame)))
        largest.plot(frame.time_s, frame.largest_share, **line, markevery=style.sparse(len(frame)))
        news = contacts.spread(run, every_s, radius_m, pairs)
        reached.plot(news.time_s, news.reached_mean, **line, markevery=style.sparse(len(news)))
    style.panel(degree, "Contacts per actor in contact", style.TIME, "Mean degree")
    style.panel(largest, "Largest component", style.TIME, "Share of actors in contact")
    style.panel(reached, "News of one actor could reach", style.TIME, "Share of actors met so far")
    degree.set_ylim(bottom=0)
    style.share_axis(largest)
    style.share_axis(reached)
    for axes in (degree, largest, reached):
        axes.set_xlim(left=0)
    style.legend(figure, style.series_entries(runs))
    return figure
