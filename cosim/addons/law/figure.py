"""The law of freshness and simulations over each other: distributions of ages, and points of studies."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter
from numpy import ndarray

from results.archive import open_run
from results.figures import style
from results.metrics import freshness

_MOST = 6
"""Curves, or groups of points, of one panel."""


class Curve(NamedTuple):
    """A distribution of ages."""

    name: str
    age_s: Float[ndarray, "n"]
    weight: Float[ndarray, "n"]
    """Weight of each age, in any unit."""


class Points(NamedTuple):
    """Predicted and measured ages of points of a study."""

    name: str
    law_s: Float[ndarray, "n 2"]
    """Median and 90th percentile."""
    measured_s: Float[ndarray, "n 2"]


def measured(folder: Path, variants: Sequence[str]) -> list[Curve]:
    """What a run measured, for those of these trust variants that it has."""
    run = open_run(folder)
    curves = []
    for variant in variants:
        if variant in run.variants:
            given = freshness.distribution(run.as_variant(variant))
            weight = np.diff(given.share.to_numpy())
            curves.append(Curve(variant, given.age_s.to_numpy()[1:], weight))
    return curves


@style.styled
def draw(law: Sequence[Curve], simulation: Sequence[Curve] = (), points: Sequence[Points] = ()) -> Figure:
    """Cumulative shares of lookups by age, the law as lines and the simulation as marks; and points of studies, the
    law over the simulation."""
    figure, panels = style.sheet(max(bool(law) + bool(points), 1), 3.0)
    if law:
        _curves(panels[0], law, simulation)
    if points:
        _points(panels[-1], points)
    return figure


def _curves(axes: Axes, law: Sequence[Curve], simulation: Sequence[Curve]) -> None:
    longest_s = 1.0
    for i, curve in enumerate(law[:_MOST]):
        share = np.cumsum(curve.weight) / max(float(curve.weight.sum()), 1e-300)
        axes.step(curve.age_s, share, where="post", color=style.ink(i), label=f"{curve.name}: law")
        nearly_all = min(int(np.searchsorted(share, 0.99)), len(share) - 1)
        longest_s = max(longest_s, float(curve.age_s[nearly_all]))
        for one in simulation:
            if one.name == curve.name:
                axes.plot(
                    one.age_s,
                    np.cumsum(one.weight) / one.weight.sum(),
                    linestyle="none",
                    marker=style.marker(i),
                    markerfacecolor="none",
                    color=style.ink(i),
                    label=f"{curve.name}: simulation",
                )
    some = f", first {_MOST} of {len(law)}" if len(law) > _MOST else ""
    style.panel(axes, f"Age of the newest evaluation at lookup{some}", "Age [s]", "Share at most this old")
    style.share_axis(axes)
    axes.set_xlim(0, 1.05 * longest_s)
    axes.legend(loc="lower right")


def _points(axes: Axes, points: Sequence[Points]) -> None:
    every = np.concatenate([ages for p in points for ages in (p.law_s, p.measured_s)])
    every = every[np.isfinite(every) & (every > 0)]
    ends = np.array([0.8 * every.min(initial=1.0), 1.25 * every.max(initial=10.0)])
    for k, share in enumerate((0.0, 0.1, 0.2)):
        for sign in (1, -1) if share else (1,):
            off = ends * (1 + sign * share)
            axes.plot(ends, off, color=style.PALE, linestyle=style.dash(k), linewidth=0.9)
    for i, p in enumerate(points[:_MOST]):
        ink = style.ink(i)
        for k, (what, fill) in enumerate((("median", ink), ("90th percentile", "none"))):
            axes.plot(
                p.measured_s[:, k],
                p.law_s[:, k],
                linestyle="none",
                marker=style.marker(i),
                color=ink,
                markerfacecolor=fill,
                label=f"{p.name}, {what}",
            )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(*ends)
    axes.set_ylim(*ends)
    style.panel(axes, "Law over simulation (dashes: 10, 20 %)", "Age by simulation [s]", "Age by the law [s]")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FormatStrFormatter("%g"))
    entries = []
    for i, p in enumerate(points[:_MOST]):
        entries.append(style.entry(p.name, **style.look(i, are_joined=False)))
    for fill, what in (("grey", "median"), ("none", "90th percentile")):
        entries.append(style.entry(what, linestyle="none", marker="o", color="grey", markerfacecolor=fill))
    axes.legend(handles=entries, loc="upper left", fontsize=style.SMALLEST)


def points_of(
    name: str,
    law: Sequence[dict[str, Any]],
    measured: Sequence[dict[str, Any]],
) -> Points:
    """Points from the metrics of each, for those that were measured."""
    metrics = [f"freshness.newest_evaluation_age.{what}" for what in ("median_s", "p90_s")]
    law_s, measured_s = [], []
    for predicted, found in zip(law, measured, strict=True):
        if metrics[0] in found:
            law_s.append([predicted[metric] for metric in metrics])
            measured_s.append([found[metric] for metric in metrics])
    return Points(
        name,
        np.array(law_s, float).reshape(-1, 2),
        np.array(measured_s, float).reshape(-1, 2),
    )
