"""Where encounters begin: a map of their rate."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy import ndarray

from results.figures import style
from results.metrics import encounters
from results.moments import at_steps
from results.run import Run

_OFFSET = 1 << 30
"""Makes grid numbers positive."""


@style.styled
def draw(runs: Sequence[Run], cell_m: float = 25.0, radius_m: float | None = None, pairs: str | None = None) -> Figure:
    """Encounters begun per cell and hour, at the middle of the two, over the streets as they were driven."""
    runs = style.arranged(runs, most=4)
    begun = [_begun(run, radius_m, pairs) for run in runs]
    streets = [_streets(run) for run in runs]
    spans = [np.ptp(street, axis=0) for street in streets]
    ratios = [north_m / max(east_m, 1) for east_m, north_m in spans]
    tallest = max(style.FLATTEST, *ratios)
    height = (style.WIDTH - 1) * tallest + 1.5
    highest = 5.0 if len(runs) == 1 else 3.2
    figure, panels = style.sheet(len(runs), min(height, highest))
    figure.set_layout_engine("compressed")
    counts = [_cells(points, street, cell_m) for points, street in zip(begun, streets, strict=True)]
    rates = []
    for run, (count, _, _) in zip(runs, counts, strict=True):
        hours = run.manifest["steps"] * run.dt_s / 3600
        rates.append(count / hours)
    top = max(rate.max() for rate in rates)
    lowest = min(rate[rate > 0].min() for rate in rates)
    lowest = min(lowest, top / 2)
    norm = LogNorm(lowest, top)

    each = zip(panels, runs, style.names(runs), streets, rates, counts, strict=True)
    for axes, run, run_name, street, rate, (_, x, y) in each:
        axes.scatter(*street.T, s=1.2, color=style.PALE, linewidths=0, rasterized=True)
        shown = np.ma.masked_equal(rate, 0)
        mesh = axes.pcolormesh(x, y, shown.T, norm=norm, cmap="viridis_r", rasterized=True)
        title = run_name if len(runs) > 1 else "Where encounters begin"
        counted = encounters.definition(run, radius_m, pairs)
        style.map_panel(axes, f"{title}\n{counted['pairs']} pairs within {counted['radius_m']:g} m")
    credits = {run.manifest.get("net", {}).get("attribution") for run in runs}
    if text := ", ".join(sorted(filter(None, credits))):
        style.credit(panels[-1], text)
    label = f"Encounters begun per hour in {cell_m:g} m cells"
    bar = figure.colorbar(mesh, ax=panels, label=label, location="bottom", shrink=0.8, aspect=30)
    ticks = _ticks(lowest, top, is_long=len(runs) == 1)
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    return figure


def _ticks(lowest: float, top: float, is_long: bool) -> list[float]:
    """Round rates between two rates, so few that their labels do not overlap on a long or a short bar."""
    digits: tuple[int, ...] = (1, 2, 5)
    if top >= (200 if is_long else 20) * lowest:
        digits = (1, 3) if top < 200 * lowest else (1,)
    ticks = []
    for exponent in range(-3, 7):
        round_rates = [digit * 10.0**exponent for digit in digits]
        ticks += [rate for rate in round_rates if lowest <= rate <= top]
    return ticks


def _begun(run: Run, radius_m: float | None, pairs: str | None) -> ndarray:
    """Where encounters begin [n 2]."""
    frame = encounters.begun(run, radius_m, pairs).rename(columns={"start_step": "step"})
    poses = run.table("actors", ["step", "actor", "x_m", "y_m"], at_steps(frame.step.unique()))
    poses = poses.set_index(["step", "actor"])
    keys = [pd.MultiIndex.from_frame(frame[["step", who]]) for who in ("a", "b")]
    one, other = (poses.reindex(key).to_numpy() for key in keys)
    return (one + other) / 2


def _streets(run: Run) -> ndarray:
    """Places where someone drove or walked [n 2]."""
    places: ndarray = np.zeros(0, np.int64)
    for part in run.parts("actors", ["x_m", "y_m"]):
        xy_m = part[["x_m", "y_m"]].to_numpy(float)
        x, y = np.round(xy_m / 2).astype(np.int64).T + _OFFSET
        places = np.union1d(places, (x << 32) | y)
    return np.column_stack([places >> 32, places & 0xFFFFFFFF]) * 2.0 - 2 * _OFFSET


def _cells(points: ndarray, street: ndarray, cell_m: float) -> tuple[ndarray, ndarray, ndarray]:
    """Number of points by cell (east, north), and the edges of the cells."""
    west, south = np.floor(street.min(axis=0) / cell_m)
    far_east, far_north = np.ceil(street.max(axis=0) / cell_m) + 1
    x = np.arange(west, far_east + 1) * cell_m
    y = np.arange(south, far_north + 1) * cell_m
    east, north = points.T
    count, _, _ = np.histogram2d(east, north, (x, y))
    return count, x, y
