"""What the radio delivers: by distance and over time."""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from results.archive import Run
from results.figures import style
from results.metrics import radio
from results.tables import axis_label


@style.styled
def draw(runs: Sequence[Run], every_s: float = 10.0) -> Figure:
    """Packet delivery ratio by distance, and over time beside the busy ratio where it was modelled."""
    style.need(runs)
    busy = [bool(run.radio.busy_ratio.notna().any()) for run in runs]
    figure, panels = style.sheet(columns=3 if any(busy) else 2, width=8.4 if any(busy) else 7.2, height=3.1)
    for i, run in enumerate(runs):
        line: dict[str, Any] = {"color": style.ink(i), "linestyle": style.dash(i), "marker": style.marker(i)}
        by_distance, over_time = radio.by_distance(run), radio.over_time(run, every_s)
        panels[0].plot(by_distance.distance_m, by_distance.delivery_ratio, **line)
        panels[1].plot(over_time.time_s, over_time.delivery_ratio, **line, markevery=style.sparse(len(over_time)))
        if busy[i]:
            panels[2].plot(over_time.time_s, over_time.busy_ratio, **line, markevery=style.sparse(len(over_time)))
    style.panel(panels[0], "Delivered, by distance", axis_label("links", "ring_m", "Distance"), "Delivery ratio")
    style.panel(panels[1], "Delivered, over time", style.TIME, "Delivery ratio")
    for axes in panels[:2]:
        style.share_axis(axes)
    for axes in panels:
        axes.set_xlim(left=0)
    if any(busy):
        style.panel(panels[2], "Channel busy, over time", style.TIME, axis_label("radio", "busy_ratio", "Busy ratio"))
        panels[2].set_ylim(
            0, 1.1 * max(float(run.radio.busy_ratio.max()) for run in runs if run.radio.busy_ratio.max() > 0)
        )
    style.legend(figure, style.series_entries(runs))
    return figure
