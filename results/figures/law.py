"""Predicted and measured distributions of the age of the newest evaluation at lookup, over each other."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from numpy import ndarray

from results.archive import open_run
from results.figures import style
from results.metrics import freshness

_MOST = 6
"""Curves of one panel."""


class Curve(NamedTuple):
    """A distribution of ages."""

    name: str
    age_s: Float[ndarray, "n"]
    weight: Float[ndarray, "n"]
    """Weight of each age, in any unit."""


def measured(folder: Path, found: Sequence[tuple[Any, Any]]) -> list[Curve]:
    """What a run measured, for each predicted trust variant that it has."""
    run = open_run(folder)
    curves = []
    for _, p in found:
        if p.variant in run.variants:
            given = freshness.distribution(run.as_variant(p.variant))
            curves.append(Curve(p.variant, given.age_s.to_numpy()[1:], np.diff(given.share.to_numpy())))
    return curves


@style.styled
def draw(law: Sequence[Curve], simulation: Sequence[Curve] | None = None) -> Figure:
    """Cumulative shares of lookups by age: the law as lines, the simulation as marks."""
    figure, (axes,) = style.sheet(height=4.2)
    longest_s = 1.0
    for i, curve in enumerate(law[:_MOST]):
        share = np.cumsum(curve.weight) / max(float(curve.weight.sum()), 1e-300)
        axes.step(curve.age_s, share, where="post", color=style.ink(i), label=f"{curve.name}: law")
        longest_s = max(longest_s, float(curve.age_s[min(int(np.searchsorted(share, 0.99)), len(share) - 1)]))
        for one in simulation or ():
            if one.name == curve.name:
                total = np.cumsum(one.weight) / one.weight.sum()
                axes.plot(
                    one.age_s, total, linestyle="none", marker=style.marker(i), markerfacecolor="none",
                    color=style.ink(i), label=f"{curve.name}: simulation",
                )  # fmt: skip
    style.panel(axes, "Age of the newest evaluation at lookup", "Age [s]", "Share of values at most this old")
    style.share_axis(axes)
    axes.set_xlim(0, 1.05 * longest_s)
    axes.legend(loc="lower right")
    return figure
