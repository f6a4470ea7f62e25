"""Where and when the trust that is used is stale: heat maps over space and time."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy import ndarray

from cosim.addons.pictures import stale
from results.figures import style
from results.metrics.freshness import FRESH_S
from results.run import Run

_LEAST = 5
"""Lookups below which a cell is left empty."""
_BINS = 40


@style.styled
def draw(runs: Sequence[Run], cell_m: float = 50.0, fresh_s: float = FRESH_S) -> Figure:
    """Share of lookups whose newest evaluation is too old or absent, by the receiver's place, and by time and place.

    The place over time is the direction in which the city is longer. There is a row of panels for each run.
    """
    runs = style.arranged(runs, most=3)
    figure, panels = style.sheet(2 * len(runs), 2.6)
    for i, (run, name) in enumerate(zip(runs, style.names(runs), strict=True)):
        found = stale.placed(run, fresh_s)
        n, n_stale = found.n.to_numpy(), found.n_stale.to_numpy()
        x, y = (found[c].to_numpy(float) for c in ("x_m", "y_m"))
        prefix = f"{name}:" if len(runs) > 1 else "Stale trust"
        over_space, over_time = panels[2 * i : 2 * i + 2]
        mesh = _heat(over_space, x, y, _edges(x, cell_m), _edges(y, cell_m), n, n_stale)
        style.map_panel(over_space, f"{prefix} over space")
        along, label = x, "East [m]"
        if np.ptp(y) >= np.ptp(x):
            along, label = y, "North [m]"
        step = found.step.to_numpy()
        n_steps = int(step.max()) + 1
        ticks = np.linspace(0, n_steps * run.dt_s, min(_BINS, n_steps) + 1)
        middle_s = (step + 0.5) * run.dt_s  # of the step, which no tick between steps is near
        _heat(over_time, middle_s, along, ticks, _edges(along, cell_m), n, n_stale)
        style.panel(over_time, f"{prefix} over time", style.TIME, label)
        over_time.grid(visible=False)
    label = f"Share of lookups without an evaluation of the last {fresh_s:g} s"
    bar = figure.colorbar(mesh, ax=panels[-1], location="bottom", shrink=0.8, aspect=40)
    bar.set_label(style.fitted(label))
    return figure


def _edges(values: ndarray, cell_m: float) -> ndarray:
    first = np.floor(values.min() / cell_m)
    last = np.floor(values.max() / cell_m)
    return np.arange(first, last + 2) * cell_m


def _heat(  # type: ignore[no-untyped-def]
    axes: Axes,
    x: ndarray,
    y: ndarray,
    x_edges: ndarray,
    y_edges: ndarray,
    n: ndarray,
    n_stale: ndarray,
):
    """Shares in cells; those with few lookups stay empty."""
    edges = (x_edges, y_edges)
    total, *_ = np.histogram2d(x, y, edges, weights=n)
    old, *_ = np.histogram2d(x, y, edges, weights=n_stale)
    share = np.ma.masked_where(total < _LEAST, old / np.maximum(total, 1))
    if (total < _LEAST).all():
        axes.text(0.5, 0.5, "too few lookups", transform=axes.transAxes, ha="center", color="#666666")
    return axes.pcolormesh(*edges, share.T, cmap="cividis", vmin=0, vmax=1, rasterized=True)
