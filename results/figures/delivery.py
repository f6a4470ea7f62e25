"""How long contacts last, and how many messages arrive meanwhile."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from results.figures import style
from results.metrics import contact_delivery
from results.metrics.survival import kaplan_meier
from results.run import Run

_LEAST = 50
"""Steps in contact below which a bin is not drawn."""


@style.styled
def draw(runs: Sequence[Run], radius_m: float | None = None) -> Figure:
    """Survival of contacts of equipped vehicles (Kaplan and Meier), and over it the delivery of messages at each age.

    Delivery is the share of steps and directions in which a collective perception message arrived. It needs the table
    `receptions`; a run without it has the survival alone.
    """
    runs = style.arranged(runs, most=6)
    figure, (axes,) = style.sheet()
    longest_s, without = 0.0, []
    for i, run in enumerate(runs):
        met = contact_delivery.contacts(run, radius_m)
        curve = kaplan_meier(met.duration_s.to_numpy(np.float64), met.end_seen.to_numpy(bool))
        look: dict[str, Any] = {"color": style.inks(runs)[i], "marker": style.marker(i)}
        axes.plot(curve.duration_s, curve.survival, drawstyle="steps-post", markevery=0.12, **look)
        longest_s = max(longest_s, float(curve.duration_s[curve.survival.shift(fill_value=1.0) >= 0.02].max()))
        if "receptions" not in run.tables:
            without.append(run.name)
            continue
        delivered = contact_delivery.by_age(run, radius_m)
        delivered = delivered[delivered.n >= _LEAST]
        axes.plot(delivered.age_s, delivered.share, linestyle=style.dash(1), markerfacecolor="white", **look)
    if without:
        text = 'no delivery: record.level = "full" is needed'
        axes.text(0.98, 0.95, text, ha="right", va="top", transform=axes.transAxes, fontsize=style.SMALL)
    chosen = contact_delivery.definition(runs[0], radius_m)
    title = f"Contacts within {chosen['radius_m']:g} m, and messages in them"
    style.panel(axes, title, "Time since the contact began [s]", "Share")
    style.share_axis(axes)
    axes.set_xlim(0, max(longest_s, 1.0) * 1.02)
    kinds = [
        Line2D([], [], color="black", label="contacts that last longer"),
        Line2D([], [], color="black", linestyle=style.dash(1), label="steps in which a message arrived"),
    ]
    style.legend(figure, kinds, style.series_entries(runs, lines=False))
    return figure
