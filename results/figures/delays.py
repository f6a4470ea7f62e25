"""How soon trust finds attackers out: Kaplan-Meier curves of all trust variants."""

from collections.abc import Sequence

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from results.codes import BASE_VARIANT
from results.figures import style
from results.metrics import misbehaviour, security
from results.run import Run


@style.styled
def draw(runs: Sequence[Run], threshold: float = 0.25) -> Figure:
    """Share of attackers found out, over the time since their first attack: at the server, at the first vehicle that
    looks up a value below the threshold, and where receivers drop their messages because they are revoked.

    One line per trust variant (the acting one alone revokes); those who leave before are censored.
    """
    style.need(runs)
    variants = [run.as_variant(name) for run in runs for name in run.variants]
    figure, panels = style.sheet(columns=3, width=10.4, height=3.9)
    colours = [mpl.colors.to_hex(c) for c in mpl.colormaps["viridis"]([i / max(1, len(variants) - 1) for i in
               range(len(variants))])]  # fmt: skip
    for i, run in enumerate(variants):
        _curve(panels[0], misbehaviour.detection_delay(run, threshold, "server"), colours[i], i)
        if "trust_lookups" in run.tables:
            _curve(panels[1], misbehaviour.detection_delay(run, threshold, "vehicles"), colours[i], i)
        if run.variant == BASE_VARIANT and run.config.get("pseudonyms", {}).get("revocation", "none") != "none":
            _curve(panels[2], security.exclusion_delay(run), colours[i], i)
    titles = (f"Below {threshold:g} at the server", "First vehicle that knows it", "Revoked")
    for axes, title in zip(panels, titles, strict=True):
        style.panel(axes, title, "Time since the first attack [s]", "Share of attackers" if axes is panels[0] else "")
        style.share_axis(axes)
        axes.set_xlim(left=0)
        if not axes.lines:
            axes.text(0.5, 0.5, "not in this run", ha="center", transform=axes.transAxes)
    names = [run.variant if len(runs) == 1 else f"{run.path.name}, {run.variant}" for run in variants]
    style.legend(figure, [
        Line2D([], [], color=colours[i], linestyle=style.dash(i), label=name) for i, name in enumerate(names)
    ])  # fmt: skip
    return figure


def _curve(axes: Axes, delays: pd.DataFrame, colour: str, i: int) -> None:
    attackers = delays[delays.role != misbehaviour.HONEST]
    curve = misbehaviour.waiting(attackers)
    axes.plot(curve.duration_s, 1 - curve.survival, drawstyle="steps-post", color=colour, linestyle=style.dash(i))
