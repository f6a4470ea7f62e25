"""Durations of encounters, or ages of trust at lookup, of a study: pooled over replicates, by a swept key."""

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from results.figures import style
from results.figures.study import MOST_PANELS, held, label_of
from results.study import (
    StudyResults,
    apart,
    at_first,
    distinct,
    for_axes,
    held_at,
    said,
    that_matter,
    with_short_names,
)
from results.study_curves import AGES, ENCOUNTERS, pooled, samples

_TITLES: Mapping[str, tuple[str, str, str]] = {
    ENCOUNTERS: ("Encounters that last longer than a duration", "Duration [s]", "Share that lasts longer"),
    AGES: (
        "Trust at lookup that is older, or without evaluation",
        "Age of the newest evaluation [s]",
        "Share older, or without",
    ),
}
_LEFT = 0.01
"""Share of its fall that every curve has left at most where the axis ends."""


def keys_of(study: StudyResults, what: str) -> list[str]:
    """The swept keys on which a distribution depends, numbers first; none if the study has not kept it."""
    frame = study.curves[study.curves.what == what]
    return _keys_of(study, frame) if len(frame) else []


def _colour_and_panel(study: StudyResults, frame: pd.DataFrame, what: str, by: str | None) -> list[str]:
    """At most two keys: the one whose values have a colour each, and the one whose values have a panel each."""
    matter = _keys_of(study, frame)
    study.check_swept(*filter(None, [by]))
    if by is not None:
        others = apart(frame, list(dict.fromkeys([by, *matter])))
        matter = [by, *(key for key in others if key != by)]
    if what == ENCOUNTERS and frame.group.nunique() > 1:
        matter = [*matter[:1], "group", *matter[1:]]
    if len(matter) > 2:
        rest = " ".join(f"--where {key}=VALUE" for key in matter[2:])
        raise ValueError(
            f"{what} depend on {', '.join(matter)}: this figure shows two. Hold others, such as {rest}, or see all of "
            "them with `cosim report`."
        )
    return matter


def _keys_of(study: StudyResults, frame: pd.DataFrame) -> list[str]:
    return for_axes(study.points, that_matter(samples(frame, study.keys), study.keys))


@style.styled
def draw(
    study: StudyResults,
    what: str,
    by: str | None = None,
    where: Mapping[str, Any] | None = None,
) -> Figure:
    """Kaplan-Meier curves of the encounters, or shares of lookups with older evidence, one for each value of a key.

    Replicates are pooled. A band spans the curves of the single replicates; there is none for one replicate. The axis
    stops where every curve ends or has done all but 1 % of its fall: of durations to 0, of ages to the share of lookups
    without evaluation.

    Parameters
    ----------
    what
        `encounters` or `ages`.
    by
        Swept key whose values have a colour each; left out, the first that changes the curves, numbers before words. A
        second one gives a panel for each of its values.
    where
        Values at which other keys are held, which the legend says; `group` is a definition of an encounter.
    """
    if what not in _TITLES:
        raise ValueError(f"what = {what!r}: there is no such figure. There are {', '.join(_TITLES)}.")
    frame = study.curves[study.curves.what == what]
    if frame.empty:
        raise ValueError(
            f"{study.name} has kept no {_TITLES[what][1].lower()}. Measure the topics encounters and freshness "
            "(keep.topics), and sweep into another folder."
        )
    where = dict(where or {})
    if group := where.pop("group", ""):
        frame = held_at(frame, "group", group)
    if not np.isfinite(frame.value_s).any():
        raise ValueError(f"{study.name} has no value that rests on an evaluation: there is no age to draw.")
    frame = held(study, frame, study.keys, where)
    first = with_short_names(frame, study.keys).iloc[0]
    labels = {key: label_of(key, study.keys) for key in ("", "group", *study.keys)}
    at = [f"{labels[key]} = {said(first[key])}" for key in where]
    places = ", ".join([group, *at] if group else at)
    matter = _colour_and_panel(study, frame, what, by)
    free = [key for key in apart(frame, study.keys) if key not in matter]
    frame = at_first(frame, free, matter)
    frame = with_short_names(frame, study.keys)
    colour, column, *_ = (*matter, "", "")
    columns = distinct(frame[column]) if column else [None]
    if len(columns) > MOST_PANELS:
        raise ValueError(f"{column} has {len(columns)} values: too many panels. Choose with --by and --where.")
    across = min(2, len(columns))
    hues = distinct(frame[colour]) if colour else [None]
    below = max(0, len(hues) + bool(places) - 3)  # a row of panels leaves room for few entries of the legend
    height = 2.4 if across == 1 else 2.1
    if len(columns) <= across:
        height += 0.25 * below
    figure, panels = style.sheet(len(columns), height, across)
    longest_s = 0.0
    until_s = float(frame.value_s[np.isfinite(frame.value_s)].max())
    for axes, value in zip(panels, columns, strict=True):
        part = frame if value is None else frame[frame[column] == value]
        for i, hue in enumerate(hues):
            of_hue = part if hue is None else part[part[colour] == hue]
            if of_hue.empty:  # keys that change together need not have each value with each
                continue
            curve = pooled(of_hue, until_s)
            level = 0.0 if what == ENCOUNTERS else float(curve.survival.iloc[-1])
            longest_s = max(longest_s, _line(axes, curve, i, level))
    title, x, y = _TITLES[what]
    for n, (axes, value) in enumerate(zip(panels, columns, strict=True)):
        name = str(value) if column == "group" else f"{labels[column]} = {said(value)}"
        if value is None:
            style.panel(axes, title, x, y)
        else:
            is_lowest = n + across >= len(columns)
            style.panel(axes, name, x if is_lowest else "", "")
            axes.tick_params(labelleft=n % across == 0)
        style.share_axis(axes)
        axes.set_xlim(0, max(longest_s, 1.0) * 1.02)
    if len(columns) > 1:
        figure.supylabel(y, fontsize=mpl.rcParams["axes.labelsize"])
    names = [f"{labels[colour]} = {said(hue)}" for hue in hues] if colour else []
    entries: list[Artist] = []
    for i, name in enumerate(names):
        entries.append(style.entry(name, **style.look(i)))
    if places:
        entries.append(style.held_entry(places))
    if (n := frame.replicate.nunique()) > 1:
        entries.append(Patch(label=f"pooled; band: {n} single replicates", color=style.ink(0), alpha=0.18, linewidth=0))
    style.legend(figure, entries)
    return figure


def _line(axes: Axes, curve: pd.DataFrame, i: int, level: float) -> float:
    """Curve `i` with its band; the time where it ends, or has done all but `_LEFT` of its fall to a level [s]."""
    known = curve[~np.isnan(curve.survival)]
    axes.plot(known.value_s, known.survival, drawstyle="steps-post", markevery=0.12, **style.look(i))
    band: dict[str, Any] = {"step": "post", "color": style.ink(i), "alpha": 0.18, "linewidth": 0}
    axes.fill_between(known.value_s, known.low, known.high, **band)
    falling = known.survival - level > _LEFT * (1 - level)
    before = falling.shift(fill_value=True)
    return float(known.value_s[before].max())
