"""Survival curves of encounters, with censoring in mind."""

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from results.figures import style
from results.metrics import encounters
from results.run import Run
from results.tables import axis_label


@style.styled
def draw(runs: Sequence[Run], departure: encounters.Departure = "ends") -> Figure:
    """Kaplan-Meier curves by definition, with their 95 % bands; the axis ends where 1 % is left."""
    runs = style.arranged(runs, most=4)
    figure, (axes,) = style.sheet()
    curves = [encounters.survival(run, departure) for run in runs]
    kinds = sorted({
        kind for curve in curves for kind in zip(curve.radius_m, curve.pairs, curve.hysteresis_s, strict=True)
    })  # fmt: skip
    longest_s = 0.0
    for i, curve in enumerate(curves):
        for kind, one in curve.groupby(["radius_m", "pairs", "hysteresis_s"], observed=True):
            code = kinds.index((kind[0], kind[1], kind[2]))
            axes.plot(
                one.duration_s, one.survival, drawstyle="steps-post", color=style.ink(code), linestyle=style.dash(i),
                marker=style.marker(code), markevery=0.08,
            )  # fmt: skip
            axes.fill_between(
                one.duration_s, one.low, one.high, step="post", color=style.ink(code), alpha=0.15, linewidth=0
            )
            longest_s = max(longest_s, float(one.duration_s[one.survival.shift(fill_value=1.0) >= 0.01].max()))
    style.panel(
        axes, "Encounters that last longer", axis_label("encounters", "duration_s", "Duration"), "Share of encounters"
    )
    style.share_axis(axes)
    axes.set_xlim(0, max(longest_s, 1.0) * 1.02)
    entries = [
        Line2D([], [], color=style.ink(code), marker=style.marker(code), label=_label(kind, kinds))
        for code, kind in enumerate(kinds)
    ]
    style.legend(figure, entries, style.run_entries(runs))
    return figure


def _label(kind: tuple[float, str, float], kinds: Sequence[tuple[float, str, float]]) -> str:
    """Name of a definition, with the hysteresis where it alone tells two apart."""
    radius_m, pairs, hysteresis_s = kind
    alone = sum(other[:2] == kind[:2] for other in kinds) == 1
    return f"{pairs}, within {radius_m:g} m" + ("" if alone else f", breaks below {hysteresis_s:g} s bridged")
