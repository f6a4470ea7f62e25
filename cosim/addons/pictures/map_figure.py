"""Where encounters begin: a map of their rate."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from results.figures import style
from results.metrics import encounters
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
    height = min((style.WIDTH - 1) * tallest + 1.5, 5.0 if len(runs) == 1 else 3.2)
    figure, panels = style.sheet(len(runs), height)
    figure.set_layout_engine("compressed")
    counts = [_cells(points, street, cell_m) for points, street in zip(begun, streets, strict=True)]
    hours = [run.manifest["steps"] * run.dt_s / 3600 for run in runs]
    rates = [count / duration for (count, _, _), duration in zip(counts, hours, strict=True)]
    top = max(rate.max() for rate in rates)
    lowest = min(rate[rate > 0].min() for rate in rates)
    lowest = min(lowest, top / 2)
    norm = LogNorm(lowest, top)

    def _definition(run: Run) -> str:
        chosen = encounters.definition(run, radius_m, pairs)
        return f"{chosen['pairs']} pairs within {chosen['radius_m']:g} m"

    each = zip(panels, runs, style.names(runs), streets, rates, counts, strict=True)
    for axes, run, run_name, street, rate, (_, x, y) in each:
        axes.scatter(*street.T, s=1.2, color=style.PALE, linewidths=0, rasterized=True)
        mesh = axes.pcolormesh(x, y, np.ma.masked_equal(rate, 0).T, norm=norm, cmap="viridis_r", rasterized=True)
        title = run_name if len(runs) > 1 else "Where encounters begin"
        style.map_panel(axes, f"{title}\n{_definition(run)}")
    credits = sorted({credit for run in runs if (credit := run.manifest.get("net", {}).get("attribution"))})
    if credits:
        panels[-1].annotate(
            ", ".join(credits), (1, 0), xycoords="axes fraction", xytext=(-3, 3), textcoords="offset points",
            ha="right", fontsize=style.SMALLEST, color="#444444",
        )  # fmt: skip
    label = f"Encounters begun per hour in {cell_m:g} m cells"
    bar = figure.colorbar(mesh, ax=panels, label=label, location="bottom", shrink=0.8, aspect=30)
    round_rates = [digit * 10.0**e for e in range(-3, 7) for digit in (1, 2, 5)]
    ticks = [rate for rate in round_rates if lowest <= rate <= top]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    return figure


def _begun(run: Run, radius_m: float | None, pairs: str | None) -> np.ndarray:
    """Where encounters begin [n 2]."""
    frame = encounters.begun(run, radius_m, pairs).rename(columns={"start_step": "step"})
    poses = run.table(
        "actors", ["step", "actor", "x_m", "y_m"], where=pc.field("step").isin(frame.step.unique().tolist())
    )
    poses = poses.set_index(["step", "actor"])
    keys = [pd.MultiIndex.from_frame(frame[["step", who]]) for who in ("a", "b")]
    one, other = (poses.reindex(key).to_numpy() for key in keys)
    return (one + other) / 2


def _streets(run: Run) -> np.ndarray:
    """Places where someone drove or walked [n 2]."""
    places: np.ndarray = np.zeros(0, np.int64)
    for part in run.parts("actors", ["x_m", "y_m"]):
        xy_m = part[["x_m", "y_m"]].to_numpy(np.float64)
        x, y = np.round(xy_m / 2).astype(np.int64).T + _OFFSET
        places = np.union1d(places, (x << 32) | y)
    return np.column_stack([places >> 32, places & 0xFFFFFFFF]) * 2.0 - 2 * _OFFSET


def _cells(points: np.ndarray, street: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    low = np.floor(street.min(axis=0) / cell_m)
    high = np.ceil(street.max(axis=0) / cell_m) + 1
    x, y = (np.arange(first, last + 1) * cell_m for first, last in zip(low, high, strict=True))
    east, north = points.T
    count, _, _ = np.histogram2d(east, north, (x, y))
    return count, x, y
