"""One vehicle's point cloud from above, with the boxes that are there and those that its detector reports."""

from collections.abc import Mapping

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy import ndarray

from results.figures import style

SURFACES = {1: ("road", style.PALE), 2: ("buildings", "#7d8794"), 3: ("actors", style.INKS[1])}
"""Colour of what returned, by code; 3 and above are actors."""


@style.styled
def draw(xyz: ndarray, hit: ndarray, boxes: Mapping[str, ndarray], title: str) -> Figure:
    """A cloud from above.

    Parameters
    ----------
    xyz
        Returns in the sensor frame (x forward, drawn upwards; y left) [k 3].
    hit
        What returned: 1 road, 2 building, 3 and above an actor [k].
    boxes
        By name, boxes in the same frame: x, y, length, width, yaw [n 5].
    """
    away_m = np.hypot(xyz[:, 0], xyz[:, 1])
    far_m = float(away_m.max(initial=10.0))
    is_ahead_only = float(xyz[:, 0].min(initial=0.0)) > -0.1 * far_m
    figure, (panel,) = style.sheet(height=2.4 if is_ahead_only else 3.7)
    entries = []
    for code, (name, colour) in SURFACES.items():
        rows = np.minimum(hit, 3) == code
        ahead_m, left_m = xyz[rows, :2].T
        panel.plot(-left_m, ahead_m, ",", color=colour, rasterized=True)
        entries.append(style.entry(name, color=colour, marker="o", markersize=3, linestyle=""))
    for i, (name, table) in enumerate(boxes.items()):
        colour = style.INKS[(0, 2, 3)[i % 3]]
        dash = style.DASHES[i]
        lines = list(_outlines(table))
        panel.add_collection(LineCollection(lines, colors=colour, linestyles=[dash], linewidths=1.1))
        entries.append(style.entry(name, color=colour, linestyle=dash))
    panel.plot(0, 0, "k+", markersize=9)
    style.panel(panel, title, "Right [m]", "Ahead [m]")
    panel.set_aspect("equal")
    panel.set_xlim(-far_m, far_m)
    panel.set_ylim(-0.05 * far_m if is_ahead_only else -far_m, far_m)
    style.legend(figure, entries)
    return figure


def _outlines(table: ndarray) -> ndarray:
    """Corners of each box, closed, with a line from the centre to the front, as (right, ahead) [n 7 2]."""
    x, y, length, width, yaw = table[:, :5].T[..., None]
    along = np.array([0.5, 0.5, -0.5, -0.5, 0.5, 0.5, 0.0]) * length
    aside = np.array([0.0, 0.5, 0.5, -0.5, -0.5, 0.0, 0.0]) * width
    cos, sin = np.cos(yaw), np.sin(yaw)
    left = y + sin * along + cos * aside
    ahead = x + cos * along - sin * aside
    return np.stack([-left, ahead], axis=2)
