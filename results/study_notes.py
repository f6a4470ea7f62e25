"""What a reader must know about means of a study: replicates without a value, and runs with few independent units."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

MISSING = "replicates have a value"

_OF_RUN = r"too few: (?P<n>\d+) of \d+ (?P<units>[^;]+)"
"""The warning of `results.measure` on a value of a run."""

IDLE = "has not attacked"
"""The note of `results.measure` on a role of a run of which no vehicle has attacked."""

_OF_MEAN = r"few (?P<units>[^;:]+): (?P<least>\d+)(?: to (?P<most>\d+))?"
"""The warning of `few` on a mean."""


def counted(n: int, noun: str) -> str:
    """A number of things, such as "1 run" or "2 runs"."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def missing(n: int, asked: float) -> str:
    """What is said if fewer replicates than asked have a value."""
    return f"{n} of {asked:.0f} {MISSING}" if n < asked else ""


def few(measures: pd.DataFrame, by: Sequence[str]) -> list[str]:
    """A warning for each mean if most of its replicates rest on few units, such as one attacker.

    Parameters
    ----------
    measures
        Rows with a column note, those of runs.
    by
        Columns whose values name a mean.

    Returns
    -------
    A text for each group of these columns, in the order of their first rows; empty if there is nothing to warn of.
    """
    if measures.empty:
        return []
    found = measures.note.astype(str).str.extract(_OF_RUN)
    named = measures.assign(n=found.n.astype(float), units=found.units)
    of_means = named.groupby(list(by), sort=False, dropna=False)
    means = of_means.agg(runs=("note", "size"), few=("n", "count"), least=("n", "min"), most=("n", "max"))
    where = np.where(means.few < means.runs, "in most runs", "per run")
    units = of_means.units.first()
    spans = list(map(_span, means.least, means.most))
    texts: pd.Series = "few " + units + ": " + spans + " " + where
    are_most = means.few > means.runs / 2
    return list(texts.where(are_most, ""))


def idle(measures: pd.DataFrame, by: Sequence[str]) -> list[str]:
    """For each mean as in `few`, what is said if its vehicles have not attacked in some of the runs."""
    if measures.empty:
        return []
    is_idle = measures.note.astype(str).str.startswith(IDLE)
    of_means = measures.assign(idle=is_idle).groupby(list(by), sort=False, dropna=False).idle
    texts = []
    for n, of in zip(of_means.sum(), of_means.size(), strict=True):
        texts.append(f"{IDLE} in {n:.0f} of {counted(of, 'run')}" if n else "")
    return texts


def _span(least: float, most: float) -> str:
    return f"{least:.0f} to {most:.0f}" if most > least else f"{least:.0f}"


def lines(frame: pd.DataFrame, keys: Sequence[str]) -> list[str]:
    """The warnings on these means in short: a line for metrics with the same units and points, and one for those of
    vehicles that have not attacked.

    Parameters
    ----------
    frame
        Rows with metric (and its group), note, and a text for each key: what the key is at this point.
    keys
        Swept keys. Those that make no difference to a warning are not named.
    """
    found = frame.assign(**frame.note.astype(str).str.extract(_OF_MEAN))
    alike: dict[tuple[str, str], list[pd.DataFrame]] = {}
    for _, of_metric in found.groupby("metric", sort=False):
        for units, rows in of_metric.groupby("units"):
            places = _places(rows, of_metric.drop(rows.index), keys)
            alike.setdefault((str(units), places), []).append(rows)
    lines = [_line(*said, pd.concat(rows)) for said, rows in alike.items()]
    are_idle = frame.note.astype(str).str.contains(IDLE)
    if are_idle.any():
        names = ", ".join(filter(None, frame.metric[are_idle].unique()))
        said = "in some runs vehicles have not attacked, and behave as honest ones"
        lines.append(f"{said}: {names}" if names else said)
    return lines


def _line(units: str, places: str, rows: pd.DataFrame) -> str:
    n = rows[["least", "most"]].astype(float).to_numpy()
    span = _span(np.nanmin(n), np.nanmax(n))
    names = ", ".join(filter(None, rows.metric.unique()))
    said = f"few {units} ({span} in a run), read as examples{': ' if names else ''}{names}"
    return f"{said}, at {places}" if places else said


def _places(rows: pd.DataFrame, others: pd.DataFrame, keys: Sequence[str]) -> str:
    """What the keys are at these rows, with as few keys as set them apart from others; empty if there are no others."""
    named = list(keys)
    for key in keys:
        rest = [one for one in named if one != key]
        if _texts(rows, rest).keys().isdisjoint(_texts(others, rest)):
            named = rest
    return "; ".join(_texts(rows, named))


def _texts(rows: pd.DataFrame, keys: Sequence[str]) -> dict[str, None]:
    return dict.fromkeys(map(", ".join, rows[[*keys]].to_numpy()))
