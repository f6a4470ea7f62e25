"""Packet delivery ratio by distance, over time and on the map; losses, latency, inter-reception time, busy ratio."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy import ndarray

from results.figures import style
from results.metrics import radio
from results.run import Run
from results.tables import axis_label

_CAUSES = tuple(name.removeprefix("n_lost") for name in radio.LOST)
_PARTS = ("delivered", *_CAUSES)
_FILLS = (style.INKS[0], "#dfe3e8", "#e8b9a6", "#ffffff", "#b9d9d2", "#f4dfae")
_LOS_STATES = {"los": "line of sight", "nlos": "behind buildings", "unknown": "line of sight not modelled"}


@style.styled
def draw(runs: Sequence[Run], every_s: float = 10.0, cell_m: float = 50.0) -> Figure:
    """Packet delivery ratio by distance and over time, losses by cause, latency, packet inter-reception time, channel
    busy ratio; maps of a single run."""
    runs = style.arranged(runs)
    has_maps = len(runs) == 1 and {"vehicle_channel", "actors"}.issubset(runs[0].tables)
    figure, panels = style.sheet(7 if has_maps else 6, 1.8)
    distance, losses, late, gaps, timed, busy = panels[:6]
    maps: list[Axes] = []
    for axes in panels[6:]:
        place = axes.get_subplotspec()
        assert place is not None
        axes.remove()
        place.get_gridspec().set_height_ratios([1, 1, 1, 1, 1, 1, 2])
        halves = place.subgridspec(1, 2)
        maps = [figure.add_subplot(halves[0, i]) for i in range(2)]
    lines = [_line(i, colour) for i, colour in enumerate(style.inks(runs))]
    found = {state for run in runs for state in run.pdr_by_distance.los_state.unique()}
    states = sorted(found, key=list(_LOS_STATES).index)
    occurs: set[str] = set()
    for i, (run, line) in enumerate(zip(runs, lines, strict=True)):
        _by_distance(distance, run, line)
        total = radio.overall(run).iloc[0]
        shares = [total.pdr, *(total[f"lost{name}"] for name in _CAUSES)]
        parts = dict(zip(_PARTS, shares, strict=True))
        occurs |= {name for name, share in parts.items() if share > 0}
        style.shares_bar(losses, i, list(parts.values()), _FILLS)
        _late(late, run, line)
        _inter_reception(gaps, run, line)
        over_time = radio.over_time(run, every_s)
        for axes, column in ((timed, "pdr"), (busy, "cbr")):
            axes.plot(over_time.time_s, over_time[column], **line, markevery=style.sparse(len(over_time)))
    style.panel(
        distance,
        "Delivery by distance",
        axis_label("pdr_by_distance", "distance_bin_m", "Distance"),
        "Packet delivery ratio",
    )
    style.panel(losses, "Received and lost", "Share of frames in range", "")
    style.bars_axis(losses, style.names(runs) if len(runs) > 1 else [""])
    style.panel(late, "Latency", "Latency [ms]", "Share at most this late")
    style.panel(gaps, "Packet inter-reception", "Packet inter-reception time [s]", "Share longer")
    style.panel(timed, "Delivery over time", style.TIME, "Packet delivery ratio")
    style.panel(busy, "Channel busy ratio", style.TIME, axis_label("radio", "cbr", "Channel busy ratio"))
    for axes, why in ((distance, "too few messages"), (gaps, "too few messages, or none is lost")):
        if not axes.lines:
            axes.text(0.5, 0.5, why, transform=axes.transAxes, ha="center", color="#666666")
    for axes in (distance, late, timed):
        style.share_axis(axes)
    for axes in (distance, timed, busy):
        axes.set_xlim(left=0)
    for axes in (timed, busy):  # of a run shorter than two windows there is one point
        axes.set_xlim(right=max(axes.get_xlim()[1], every_s))
    most = pd.Series([float(run.radio.cbr.max()) for run in runs]).max()
    if most == most:
        busy.set_ylim(0, 1.1 * max(most, 1e-3))
    else:
        busy.text(0.5, 0.5, "not modelled", transform=busy.transAxes, ha="center", color="#666666")
    if maps:
        _maps(figure, maps, runs[0], cell_m)
    names = [part.strip("_").replace("_", " ") for part in _PARTS]
    bars = dict(zip(_PARTS, style.bar_entries(names, _FILLS), strict=True))
    entries: list[Any] = [bar for part, bar in bars.items() if part in occurs]
    if len(states) > 1:
        entries += [_los_entry(state) for state in states]
    style.legend(figure, entries, style.series_entries(runs))
    return figure


def _line(i: int, colour: str) -> dict[str, Any]:
    return {"color": colour, "linestyle": style.dash(i), "marker": style.marker(i)}


def _by_distance(axes: Axes, run: Run, line: dict[str, Any]) -> None:
    """A line with and without line of sight, hollow without."""
    found = radio.by_distance(run, by_los=True)
    for state, curve in found[found.n_in_range >= 20].groupby("los_state", observed=True):
        hollow: dict[str, Any] = {"markerfacecolor": "white"} if state == "nlos" else {}
        axes.plot(curve.distance_m, curve.pdr, **line, **hollow)


def _los_entry(state: str) -> Line2D:
    fill = "white" if state == "nlos" else "#444444"
    return style.entry(_LOS_STATES[state], color="#444444", marker="o", markerfacecolor=fill)


def _late(axes: Axes, run: Run, line: dict[str, Any]) -> None:
    """Both rounds together."""
    try:
        found = radio.latency(run)
    except ValueError:  # no message was received
        return
    curve = found.groupby("latency_s").n_delivered.sum()
    share = curve.cumsum() / curve.sum()
    axes.plot(1e3 * share.index, share, **line, markevery=style.sparse(len(share)))
    axes.set_xscale("log")
    style.numbered(axes.xaxis)


def _inter_reception(axes: Axes, run: Run, line: dict[str, Any]) -> None:
    try:
        curve = radio.inter_reception(run)
    except ValueError:  # no pair with two receptions
        return
    curve = curve[curve.longer > 0]
    if not curve.pir_s.any():  # no message is missing
        return
    pir_s = np.append(curve.pir_s.min() / 2, curve.pir_s)
    longer = np.append(1, curve.longer)
    axes.step(pir_s, longer, where="post", **line, markevery=style.sparse(len(pir_s)))
    axes.set_yscale("log")
    axes.set_xscale("log")
    style.numbered(axes.xaxis)


def _maps(figure: Figure, panels: Sequence[Axes], run: Run, cell_m: float) -> None:
    """Channel busy ratio and share of messages lost by place of the receiver; dark is more in both."""
    cells = radio.by_place(run, cell_m)
    cells = cells.assign(lost=1 - cells.pdr)
    for axes, (column, title) in zip(panels, (("cbr", "Busy ratio"), ("lost", "Messages lost")), strict=True):
        x, y, values = _grid(cells, column, cell_m)
        most = 1 if column == "lost" else None
        mesh = axes.pcolormesh(x, y, values, cmap="viridis_r", rasterized=True, vmin=0, vmax=most)
        style.map_panel(axes, title)
        if np.isnan(values).all():
            why = "not modelled" if column == "cbr" else "not known\nwith relays"
            axes.text(0.5, 0.5, why, transform=axes.transAxes, ha="center", va="center", color="#666666")
        else:
            figure.colorbar(mesh, ax=axes, shrink=0.5)


def _grid(cells: pd.DataFrame, column: str, cell_m: float) -> tuple[ndarray, ndarray, ndarray]:
    """Edges of the cells, and their values by (north, east)."""
    west_m, south_m = cells.x_m.min(), cells.y_m.min()
    east = ((cells.x_m - west_m) / cell_m).round().astype(int)
    north = ((cells.y_m - south_m) / cell_m).round().astype(int)
    n_north, n_east = north.max() + 1, east.max() + 1
    values = np.full((n_north, n_east), np.nan)
    values[north, east] = cells[column]
    x = west_m + (np.arange(n_east + 1) - 0.5) * cell_m
    y = south_m + (np.arange(n_north + 1) - 0.5) * cell_m
    return x, y, values
