"""How soon trust finds attackers out: Kaplan-Meier curves of all trust variants."""

from collections.abc import Sequence

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cosim.base.codes import BASE_VARIANT
from results.figures import style
from results.metrics import misbehaviour, security
from results.metrics.trust import suspect_below
from results.run import Run


@style.styled
def draw(runs: Sequence[Run], threshold: float | None = None) -> Figure:
    """Share of attackers found out, over the time since their first attack: at the server, at the first vehicle that
    looks up a value below the threshold, and where receivers drop their messages because they are revoked.

    One line per trust variant (the acting one alone revokes); those who leave before are censored.
    """
    variants, names = style.variants_of(runs)
    threshold = suspect_below(variants[0], threshold)
    panels = {f"Below {threshold:g} at the server": [(i, misbehaviour.detection_delay(run, threshold, "server"))
              for i, run in enumerate(variants)]}  # fmt: skip
    if all("trust_lookups" in run.tables for run in variants):
        panels["First vehicle that knows it"] = [
            (i, misbehaviour.detection_delay(run, threshold, "vehicles")) for i, run in enumerate(variants)
        ]
    if revoking := [(i, security.exclusion_delay(run)) for i, run in enumerate(variants) if _revokes(run)]:
        panels["Revoked"] = revoking
    figure, all_axes = style.sheet(len(panels))
    colours = style.inks(variants)
    for axes, (title, curves) in zip(all_axes, panels.items(), strict=True):
        for i, delays in curves:
            _curve(axes, delays, colours[i], i)
        style.panel(axes, title, "Time since the first attack [s]", "Share of attackers")
        style.share_axis(axes)
        axes.set_xlim(left=0)
    style.legend(figure, [
        Line2D([], [], color=colours[i], linestyle=style.dash(i), label=name) for i, name in enumerate(names)
    ])  # fmt: skip
    return figure


def _revokes(run: Run) -> bool:
    return run.variant == BASE_VARIANT and run.config.get("pseudonyms", {}).get("revocation", "none") != "none"


def _curve(axes: Axes, delays: pd.DataFrame, colour: str, i: int) -> None:
    attackers = delays[delays.role != misbehaviour.HONEST]
    curve = misbehaviour.waiting(attackers)
    axes.plot(curve.duration_s, 1 - curve.survival, drawstyle="steps-post", color=colour, linestyle=style.dash(i))
