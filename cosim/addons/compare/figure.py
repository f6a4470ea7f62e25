"""Published values with their bands, and ours with intervals: one panel per fact."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy import ndarray

from results.figures import style

_OUR_INK = {"agrees": style.INKS[0], "undecided": style.INKS[3]}
"""Colour of our values by verdict; that of all other verdicts is `_OFF`."""
_OFF = style.INKS[1]


@dataclass(frozen=True, slots=True)
class Panel:
    """One fact: values by place, an open edge of a band being infinite, and what is not computed NaN."""

    title: str
    unit: str
    at: Sequence[str]
    published: Sequence[float]
    band_low: Sequence[float] | ndarray
    band_high: Sequence[float] | ndarray
    ours: Sequence[float] | ndarray
    low: Sequence[float] | ndarray
    high: Sequence[float] | ndarray
    verdict: str


@style.styled
def draw(panels: Sequence[Panel]) -> Figure:
    """A figure with one panel per fact."""
    figure, axes = style.sheet(len(panels), 1.4)
    for one, ax in zip(panels, axes, strict=True):
        _draw(ax, one)
    entries: list[Artist] = [Patch(facecolor=style.PALE, alpha=0.6, label="published, with its band")]
    for verdict in "agrees", "undecided", "differs":
        colour = _OUR_INK.get(verdict, _OFF)
        entries.append(style.entry(f"ours: {verdict}", color=colour, marker="o", linestyle=""))
    style.legend(figure, entries)
    return figure


def _draw(ax: Axes, one: Panel) -> None:
    place = np.arange(len(one.at))
    columns = one.published, one.band_low, one.band_high, one.ours, one.low, one.high
    published, band_low, band_high, ours, low, high = (np.array(column, float) for column in columns)
    ends = np.concatenate([published, band_low, band_high, ours, low, high])
    ends = ends[np.isfinite(ends)]
    room = 0.15 * max(np.ptp(ends), 0.1 * np.abs(ends).max(), 1e-9)
    bottom, top = ends.min() - room, ends.max() + room
    band_low, band_high = np.maximum(band_low, bottom), np.minimum(band_high, top)
    ax.bar(place, band_high - band_low, 0.7, band_low, color=style.PALE, alpha=0.6, linewidth=0)
    ax.hlines(published, place - 0.35, place + 0.35, color="#444444", linewidth=1.2)
    there = np.isfinite(ours)
    below = np.where(np.isfinite(low), ours - low, 0.0)
    above = np.where(np.isfinite(high), high - ours, 0.0)
    whiskers = np.array([below, above])
    colour = _OUR_INK.get(one.verdict, _OFF)
    ax.errorbar(
        place[there],
        ours[there],
        whiskers[:, there],
        fmt="o",
        color=colour,
        capsize=3,
        linewidth=1.2,
    )
    style.panel(ax, one.title, "", one.unit)
    ax.set_xticks(place, [at.replace(", ", ",\n") for at in one.at], fontsize=style.SMALLEST)
    ax.set_xlim(-0.6, len(place) - 0.4)
    ax.set_ylim(bottom, top)
