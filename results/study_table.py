"""A study's metrics as a table for the eye: a row per metric, a column for each value of one swept key."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from results import study_notes
from results.metrics.registry import CORE
from results.study import (
    StudyResults,
    apart,
    as_column,
    at_first,
    chosen,
    distinct,
    held_at,
    said,
    short_keys,
    that_matter,
    with_short_names,
)

_SAME = 1e-9
"""An interval that is narrower is one of equal values, and says nothing of what other replicates would have."""


def core(study: StudyResults, whole: bool = True) -> list[str]:
    """The core metrics that the study has measured, as `identifier:group`.

    Parameters
    ----------
    whole
        Whether all definitions of an encounter are named, or the first of each metric alone.
    """
    pairs = study.summary[["metric", "group"]].drop_duplicates()
    found = []
    for name in CORE:
        metric, _, group = name.partition(":")
        groups = sorted(pairs.group[pairs.metric == metric])
        if group:
            groups = [one for one in groups if one == group]
        if not whole and not metric.startswith("trust."):
            groups = groups[:1]
        found += [f"{metric}:{one}" if one else metric for one in groups]
    return found


def pivot(
    study: StudyResults,
    frame: pd.DataFrame,
    metrics: Sequence[str],
    over: str | None = None,
    where: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """Mean and 95 % interval in each cell, as text.

    Parameters
    ----------
    frame
        `study.summary` or `study.differences`.
    over
        Swept key whose values are the columns; left out, the first that varies.
    where
        Values at which swept keys are held.

    Returns
    -------
    A column for each value of `over`, after the metric with its unit, its group, and the other keys on which it
    depends, or at one value of which alone it has a value. Other keys are empty in its rows. Keys that are the same in
    all rows are left out, and so are groups that say no more than "all". `attrs` holds the key of the columns (`over`),
    and the labels of metrics that have values elsewhere alone (`missing`).

    Raises
    ------
    ValueError
        In one line, if a key, a value or a metric does not exist.
    """
    study.check_swept(*(where or {}), *([over] if over else []))
    whole, measures = frame, study.measures
    for key, text in (where or {}).items():
        frame, measures = held_at(frame, key, text), held_at(measures, key, text)
    varied = apart(frame, study.keys)
    over = over or (varied[0] if varied else study.keys[0])
    heads = list(dict.fromkeys(with_short_names(frame, study.keys)[over].map(said)))
    others = [key for key in varied if key != over]
    rows: list[dict[str, str]] = []
    elsewhere: dict[str, None] = {}
    here: dict[str, None] = {}
    for name in metrics:
        of_metric = frame.loc[frame.index.intersection(chosen(whole, [name]).index)]
        if of_metric.empty:  # it is there at other values of the keys alone
            elsewhere |= dict.fromkeys(chosen(whole, [name]).label)
            continue
        here |= dict.fromkeys(of_metric.label)
        matter = that_matter(chosen(measures, [name]), study.keys)
        n_values = of_metric[others].nunique(dropna=False)
        # A key of which the metric has one value alone is said: it has none at the others.
        free = [key for key in others if key not in matter and n_values[key] > 1]
        beside = [key for key in others if key not in free]
        of_metric = at_first(of_metric, free, [over, *beside])
        short = with_short_names(of_metric, study.keys)
        for at, one in short.groupby(["metric", "group", *beside], sort=False, dropna=False):
            first = one.iloc[0]
            unit = "" if first.unit in ("", "1") else f" [{first.unit}]"
            row = {"": f"{first.label}{unit}", "group": str(first.group)}
            row |= dict.fromkeys(others, "")
            row |= dict(zip(beside, map(said, at[2:]), strict=True))
            cells = {said(of[over]): cell(of) for of in one.to_dict("records")}
            rows.append(row | {head: cells.get(head, "") for head in heads})
    table = pd.DataFrame(rows, columns=["", "group", *others, *heads])
    constant = [name for name in others if table[name].nunique() < 2]
    if set(table.group) <= {"", "all"}:  # any other group says of whom the values are
        constant.append("group")
    table = table.drop(columns=constant)
    table.attrs |= {"over": over, "missing": [label for label in elsewhere if label not in here]}
    return table


def cautions(
    study: StudyResults,
    frame: pd.DataFrame,
    metrics: Sequence[str],
    where: Mapping[str, str] | None = None,
    are_named: bool = True,
) -> list[str]:
    """Lines to write below `pivot`: which of its means rest on runs with few subjects, such as one attacker, and which
    depend on the window by their definition.

    Without `are_named`, lines do not name the metrics.
    """
    whole = frame
    for key, text in (where or {}).items():
        frame = held_at(frame, key, text)
    rows = frame.index.intersection(chosen(whole, metrics).index)
    shown = with_short_names(frame, study.keys).loc[rows]
    keys = apart(shown, study.keys)
    names = short_keys(study.keys)
    for key in keys:
        shown[key] = f"{names[key]} = " + shown[key].map(said)
    is_capped = shown.metric.str.startswith("freshness.capped_age.").any()
    lines = [_CAPPED] if is_capped and "trust.freshness_s" in keys else []
    shown["metric"] += (":" + shown.group).where(shown.group != "", "")
    if not are_named:
        shown["metric"] = ""
    return lines + study_notes.lines(shown, keys)


_CAPPED = (
    "freshness.capped_age counts a lookup without an evaluation as the window: compare it at equal trust.freshness_s"
)


def together(study: StudyResults) -> list[str]:
    """Lines on keys that are not named because they change together with another one, with their values."""
    named = apart(study.points, study.keys)
    shown = with_short_names(study.points, study.keys)
    lines = []
    for key in study.keys:
        if key in named or shown[key].nunique(dropna=False) < 2:
            continue
        for other in named:
            rows = shown[[other, key]].drop_duplicates()
            if len(rows) == shown[other].nunique(dropna=False):
                pairs = zip(rows[key].map(said), rows[other].map(said), strict=True)
                values = ", ".join(" at ".join(pair) for pair in pairs)
                lines.append(f"{key} changes with {other}: {values}")
                break
    return lines


def unpaired(
    study: StudyResults,
    metrics: Sequence[str],
    where: Mapping[str, str] | None = None,
) -> list[str]:
    """Lines on values of the baseline's keys at which these metrics have a value, and no difference to the baseline."""
    if not study.baseline or not metrics:
        return []
    rows = chosen(study.summary, metrics)
    names = set(zip(rows.metric, rows.group, strict=True))
    for key, text in (where or {}).items():
        rows = study.held(rows, key, text)
    pairs = study.differences
    is_asked = [name in names for name in zip(pairs.metric, pairs.group, strict=True)]
    lines = []
    for key, value in study.baseline.items():
        compared = pairs.loc[is_asked, key] if is_asked else ()
        known = {*compared, as_column(rows[key], value)}
        if lacking := [said(one) for one in distinct(rows[key]) if one not in known]:
            lines.append(
                f"no difference at {key} = {', '.join(lacking)}: what is measured there has no counterpart at the "
                "baseline. A group of encounters names its radius, for example."
            )
    return lines


def cell(row: Mapping[Any, Any]) -> str:
    """A mean with its interval, and with the number of replicates that have a value if that is not all."""
    mean, low, high = (float(row[name]) for name in ("mean", "low", "high"))
    text = number(mean)
    if low == low and high - low < _SAME * max(1.0, abs(mean)):
        text += " (each the same)"
    elif low == low:
        text += f" ({number(low)} to {number(high)})"
    return f"{text}, n = {row['n']}" if study_notes.MISSING in row.get("note", "") else text


def number(value: float) -> str:
    """Three significant digits; all digits of a whole part."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
