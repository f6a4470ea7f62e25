"""A city as it is: streets and buildings."""

from collections.abc import Sequence

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from results.figures import style


@style.styled
def draw(
    streets: Sequence[np.ndarray],
    widths_m: Sequence[float],
    buildings: Sequence[np.ndarray],
    title: str = "",
    attribution: str = "",
) -> Figure:
    """Draw the lanes and buildings of a city.

    Parameters
    ----------
    streets, widths_m
        Lanes as lines, one row (x, y) per point [m]; further columns are ignored. A line is about as wide as the
        lane [m].
    buildings
        Outer rings of the buildings, one row (x, y) per corner [m].
    title, attribution
        Title of the map, and small text in its corner.

    Raises
    ------
    ValueError
        If there is no street.
    """
    if not streets:
        raise ValueError("A city without a street cannot be drawn.")
    lines = [street[:, :2] for street in streets]
    corners = np.concatenate(lines)
    low, high = corners.min(axis=0), corners.max(axis=0)
    span = np.maximum(high - low, 1.0)
    side = style.WIDTH - 0.5
    height = side * span[1] / span[0] + 0.6
    height = float(np.clip(height, 1.4, 5.0))
    figure, (axes,) = style.sheet(height=height)
    scale = 72 * min(side / span[0], height / span[1])  # points per metre
    rings = [ring[:, :2] for ring in buildings]
    axes.add_collection(PolyCollection(rings, facecolor=style.PALE, edgecolor="none"))
    thick = np.maximum(np.asarray(widths_m) * scale, 0.15)
    axes.add_collection(LineCollection(lines, colors=style.INKS[0], linewidths=thick))
    margin = 0.02 * span.max()
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    style.map_panel(axes, title)
    if attribution:
        credit = style.credit(axes, attribution)
        credit.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1})
    return figure
