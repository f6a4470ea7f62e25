"""What the radio delivers: by distance and over time."""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from results.archive import Run
from results.figures import style
from results.metrics import radio
from results.tables import axis_label

_CAUSES = tuple(name.removeprefix("n_lost") for name in radio.LOST)
_FILLS = (style.INKS[0], "#dfe3e8", "#e8b9a6", "#ffffff", "#b9d9d2", "#f4dfae")


@style.styled
def draw(runs: Sequence[Run], every_s: float = 10.0) -> Figure:
    """Delivery ratio by distance and over time, what became of the rest, and the busy ratio where it was modelled."""
    style.need(runs)
    busy = [bool(run.radio.busy_ratio.notna().any()) for run in runs]
    if any(busy):
        figure, panels = style.sheet(columns=2, rows=2, height=5.6)
    else:
        figure, panels = style.sheet(columns=3, width=8.8, height=3.1)
    fates, *timed = panels[2:]
    for i, run in enumerate(runs):
        line: dict[str, Any] = {"color": style.ink(i), "linestyle": style.dash(i), "marker": style.marker(i)}
        by_distance, over_time = radio.by_distance(run), radio.over_time(run, every_s)
        panels[0].plot(by_distance.distance_m, by_distance.delivery_ratio, **line)
        panels[1].plot(over_time.time_s, over_time.delivery_ratio, **line, markevery=style.sparse(len(over_time)))
        total = radio.overall(run).iloc[0]
        style.shares_bar(fates, i, [total.delivery_ratio, *(total[f"lost{name}"] for name in _CAUSES)], _FILLS)
        if busy[i]:
            timed[0].plot(over_time.time_s, over_time.busy_ratio, **line, markevery=style.sparse(len(over_time)))
    style.panel(panels[0], "Delivered, by distance", axis_label("links", "ring_m", "Distance"), "Delivery ratio")
    style.panel(panels[1], "Delivered, over time", style.TIME, "Delivery ratio")
    for axes in panels[:2]:
        style.share_axis(axes)
    style.panel(fates, "What became of it", "Share of what was in reach", "")
    style.bars_axis(fates, style.names(runs))
    for axes in (*panels[:2], *timed):
        axes.set_xlim(left=0)
    if any(busy):
        style.panel(timed[0], "Channel busy, over time", style.TIME, axis_label("radio", "busy_ratio", "Busy ratio"))
        timed[0].set_ylim(
            0, 1.1 * max(float(run.radio.busy_ratio.max()) for run in runs if run.radio.busy_ratio.max() > 0)
        )
    parts = ["delivered", *(name.removeprefix("_").replace("_", " ") for name in _CAUSES)]
    style.legend(figure, style.bar_entries(parts, _FILLS), style.series_entries(runs))
    return figure
