"""The metrics of a run in one tidy table."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import wraps
from inspect import isfunction, signature
from itertools import groupby
from numbers import Real
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args, get_origin

import numpy as np
import pandas as pd

from cosim.base.addons import Choices, loaded
from cosim.base.durable import Damaged
from results.metrics import (
    encounters,
    freshness,
    misbehaviour,
    radio,
    registry,
    trust,
)
from results.metrics.intervals import FEW, ClusteredEstimate, columns
from results.metrics.registry import METRICS, Metric
from results.own_metrics import COLUMNS
from results.run import Run

if TYPE_CHECKING:
    from results.figures.style import Figure

TOPICS: Mapping[str, ModuleType] = Choices(
    "topic",
    {
        "encounters": encounters,
        "trust": trust,
        "misbehaviour": misbehaviour,
        "freshness": freshness,
        "radio": radio,
    },
)
"""Modules of metrics by topic, as `run.measure.<topic>`."""

_BOUNDS: Mapping[str, tuple[float, float]] = {
    "threshold": (0.0, 1.0),
    "false_positives": (0.0, 1.0),
    "fresh_s": (0.0, math.inf),
    "max_frames": (1.0, math.inf),
    "every_s": (1e-3, math.inf),
    "cell_m": (1e-3, math.inf),
    "range_m": (1e-3, math.inf),
    "min_score": (0.0, 1.0),
    "n_thresholds": (2, math.inf),
}
"""Smallest and largest value of options that are numbers."""


class MeasuredRow(NamedTuple):
    """A metric's value; rows of a run without interval have none."""

    name: str
    """Identifier of the metric."""
    group: str
    value: float
    low: float = float("nan")
    high: float = float("nan")
    n_units: float = float("nan")
    """Number of vehicles (or other independent units) that the value rests on."""
    note: str = ""
    """What the reader must know about the value."""


def measure(
    run: Run,
    threshold: float | None = None,
    fresh_s: float = 10.0,
    false_positives: float = 0.05,
    max_frames: int = 4000,
    topics: Sequence[str] = tuple(registry.TOPICS),
) -> pd.DataFrame:
    """Every metric that the run's record level allows, for the run's `variant`.

    Parameters
    ----------
    run
        An opened run.
    threshold
        Trust below which a subject is suspected; by default `trust.suspect_below` of the run.
    fresh_s
        Largest age of an evaluation that counts as fresh [s].
    false_positives
        False positive rate at which recall is computed, see `results.metrics.misbehaviour`.
    max_frames
        Size of the sample for detection quality, see `cosim.addons.perception.detection.precision`.
    topics
        Topics to measure.

    Returns
    -------
    Columns metric (an identifier of `results.metrics.registry.METRICS`), group, value, low and high (95 % interval,
    null if the metric has none), n_units (number of units that the interval is clustered by), unit, label, note.
    Where the run has no data for metrics of a topic, a row `<topic>.not_measured` has the reason as group and no
    value, each reason once. A metric that is not defined, such as a median that was not reached, has no row.

    Raises
    ------
    ValueError
        If a topic does not exist, or if an option is out of bounds.
    """
    options = {
        "threshold": threshold,
        "fresh_s": fresh_s,
        "false_positives": false_positives,
        "max_frames": max_frames,
    }
    for name, value in options.items():
        _check_bounds(name, value)
    rows: list[MeasuredRow] = []
    for topic in [topics] if isinstance(topics, str) else topics:
        if topic not in registry.TOPICS:
            raise ValueError(f"There is no topic {topic!r}. The topics are {', '.join(registry.TOPICS)}.")
        rows += _measured(run, topic, options)
    lines = []
    for row in rows:
        metric, values = METRICS[row.name], row[:-1]
        lines.append((*values, metric.unit, metric.label, _note(row)))
    return pd.DataFrame(lines, columns=COLUMNS)


def _measured(run: Run, topic: str, options: Mapping[str, Any]) -> list[MeasuredRow]:
    """The values of a topic, one function of `results.metrics` after the other, and why some have none.

    What one function cannot answer says nothing about the next: nobody finds trust, so trust has no age, but the share
    of lookups that find some is 0.
    """
    of_topic = [name for name in METRICS if name.startswith(f"{topic}.")]
    mine = [name for name in of_topic if METRICS[name].source]
    rows: list[MeasuredRow] = []
    reasons: dict[str, None] = {}
    for _, same in groupby(mine, lambda name: (METRICS[name].source, METRICS[name].options)):
        of_source = list(same)
        metric = METRICS[of_source[0]]
        try:
            found = _answer(run, metric, options) if _has_value(run, metric) else ()
        except ValueError as reason:
            if isinstance(reason, Damaged) and str(reason) not in run.damage:
                run.damage.append(str(reason))
            reasons[str(reason)] = None
            continue
        for name in of_source:
            rows += _rows(name, METRICS[name], found)
    return rows + [MeasuredRow(f"{topic}.not_measured", reason, np.nan) for reason in reasons]


def _has_value(run: Run, metric: Metric) -> bool:
    """Whether the run has the tables that a metric needs, with rows unless none of them counts as 0."""
    if not all(table in run.tables for table in metric.needs):
        return False
    return metric.counts or all(run.n_rows(table) for table in metric.needs)


def _answer(
    run: Run,
    metric: Metric,
    options: Mapping[str, Any],
) -> Sequence[Mapping[Any, Any]]:
    """The rows among which those of a metric are."""
    ask = loaded(metric.source)
    wanted = signature(ask).parameters
    mine = {key: value for key, value in options.items() if key in wanted}
    found = ask(run, **mine | dict(metric.options))
    if isinstance(found, pd.DataFrame):
        return found.to_dict("records")
    if isinstance(found, pd.Series):
        return [found.to_dict()]
    return [columns(found, "value") if isinstance(found, ClusteredEstimate) else {"value": found}]


def _rows(name: str, metric: Metric, found: Iterable[Mapping[Any, Any]]) -> Iterator[MeasuredRow]:
    """The rows of a metric, the first of each group. Its interval is in the columns of `intervals.columns`, or in those
    of `intervals.plain_columns` if it is clustered by something."""
    groups = set()
    for row in found:
        value = row.get(metric.column, np.nan)
        group = metric.named.format_map(row)
        where = {key: row[key] for key in metric.where}
        is_here = where == dict(metric.where)
        if is_here and group not in groups and pd.notna(value):
            groups.add(group)
            own = f"{metric.column}_"
            keys = ["low", "high", "n_units"]
            if f"{own}low" in row:
                keys = [f"{own}low", f"{own}high", f"{own}units"]
            low = high = n_units = np.nan
            if metric.unit_of_chance:
                low, high, n_units = (row.get(key, np.nan) for key in keys)
            note = row.get(f"{own}note", row.get("note", ""))
            yield MeasuredRow(name, group, float(value), low, high, n_units, note)


def _note(row: MeasuredRow) -> str:
    """The note on a value, with a warning if it rests on too few units."""
    few = ""
    if 0 < row.n_units < FEW:
        units = METRICS[row.name].unit_of_chance or "units"
        few = f"too few: {row.n_units:.0f} of {FEW} {units}"
    return "; ".join(filter(None, (row.note, few)))


class Measures:
    """The metrics of one run. A call gives all of them; each topic has functions that give tidy frames and a figure."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def __call__(self, **options: Any) -> pd.DataFrame:
        """As `measure`."""
        return measure(self._run, **options)

    def value(self, metric: str, group: str = "", **options: Any) -> float:
        """One metric: `run.measure.value("trust.final.median", "malicious")`; NaN if it is not defined.

        The group may also be part of the name, as studies write it: `"trust.final.median:malicious"`.

        Raises
        ------
        ValueError
            If there is no such metric, or if it has other groups. A role without a vehicle is a group without a value.
        """
        metric, _, of = metric.partition(":")
        group = group or of
        if metric not in METRICS:
            raise ValueError(f"There is no metric {metric!r}. `cosim measure --explain` lists them.")
        found = measure(self._run, topics=(metric.split(".")[0],), **options)
        values = found[found.metric == metric].set_index("group").value
        if group in values.index:
            return float(values[group])
        is_of_role = not set(group.split(", ")).isdisjoint(self._run.role_labels)
        is_misspelt = len(values) > 0 and not is_of_role
        if is_misspelt or bool(group) != bool(METRICS[metric].group):
            there = "; ".join(values.index) or METRICS[metric].group or "none"
            raise ValueError(f"{metric} has no group {group!r}. Its groups are {there}.")
        return math.nan

    def __getattr__(self, topic: str) -> "Topic":
        if topic not in TOPICS:
            raise AttributeError(f"There is nothing to measure called {topic!r}. The topics are {', '.join(TOPICS)}.")
        return Topic(self._run, topic)

    def __dir__(self) -> list[str]:
        return [*TOPICS, "value"]


class Topic:
    """The functions of one module of `results.metrics`, applied to the run, and `plot`."""

    def __init__(self, run: Run, topic: str) -> None:
        self._run, self._topic = run, topic

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name not in dir(self):
            raise AttributeError(f"{self._topic} has no {name!r}. It has {', '.join(dir(self))}.")
        function = getattr(TOPICS[self._topic], name)

        @wraps(function)  # so help() shows what it says
        def ask(*args: Any, **options: Any) -> Any:
            return _asked(function, self._run, *args, **options)

        whole = signature(function)
        _run, *others = whole.parameters.values()
        ask.__signature__ = whole.replace(parameters=others)  # type: ignore[attr-defined]
        return ask

    def __dir__(self) -> list[str]:
        module = TOPICS[self._topic]
        names = []
        for name, function in vars(module).items():
            if isfunction(function) and function.__module__ == module.__name__ and name[0] != "_":
                first = next(iter(signature(function).parameters), "")
                if first == "run":
                    names.append(name)
        return [*names, "plot"]

    def plot(self, **options: Any) -> "Figure":
        """The figure of the topic."""
        from results.figures.catalogue import FIGURES  # here, because measuring needs no Matplotlib

        return FIGURES[self._topic]([self._run], **options)


def _asked(function: Callable[..., Any], run: Run, *args: Any, **options: Any) -> Any:
    """What a function of a topic returns. A misspelt choice would count as any other one, so it is refused here."""
    asked = signature(function).bind(run, *args, **options).arguments
    for name, value in asked.items():
        annotation = signature(function).parameters[name].annotation
        known = _choices(annotation)
        is_list = get_origin(annotation) is tuple
        if is_list and isinstance(value, str):
            raise ValueError(f"{name} = {value!r} should be a list of names, such as [{value!r}].")
        for one in value if is_list else [value]:
            if known and isinstance(one, str) and one not in known:
                raise ValueError(f"{name} = {one!r}: there is no such choice. There are {', '.join(known)}.")
        _check_bounds(name, value)
    found = function(run, *args, **options)
    return found.copy(deep=False) if isinstance(found, pd.DataFrame | pd.Series) else found  # the run may keep it


def _choices(annotation: Any) -> tuple[str, ...]:
    """The words that an argument may be; none if it may be any."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return tuple(word for one in get_args(annotation) for word in _choices(one))


def _check_bounds(name: str, value: Any) -> None:
    """Raise ValueError for an option that is a number out of bounds."""
    if name not in _BOUNDS or value is None:
        return
    low, high = _BOUNDS[name]
    if not isinstance(value, Real) or isinstance(value, bool):  # numbers of NumPy are real, too
        raise ValueError(f"{name} = {value!r} is no number. Give one between {low:g} and {high:g}.")
    if not low <= float(value) <= high:
        raise ValueError(f"{name} = {value:g} is not between {low:g} and {high:g}.")
