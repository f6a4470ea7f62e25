"""Metrics that users write: their interface, and the table of their values."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import pandas as pd

from results.metrics.registry import METRICS
from results.run import Run


class MetricRow(NamedTuple):
    """One value of a user's metric."""

    metric: str
    """Identifier, such as `headway.median_s`."""
    value: float
    """NaN if the metric is not defined; no row is shown then."""
    group: str = ""
    """What the value belongs to, such as a role."""
    unit: str = "1"
    label: str = ""


class OwnMetric(Protocol):
    """Computes values from a run."""

    def rows(self, run: Run) -> list[MetricRow]:
        """One row for each metric and group.

        Raises
        ------
        ValueError
            If the run does not have the tables that the metric needs (`run.require(...)`); the message is one line.
        """
        ...


COLUMNS = ["metric", "group", "value", "low", "high", "n_units", "unit", "label", "note"]
"""Of a table of metrics."""


LARGEST = 1e100
"""Largest size of a value: intervals are made of squares, and the square of a far larger value is not finite."""


def is_value(value: Any) -> bool:
    """Whether a value can be shown and averaged: a number of at most `LARGEST` in size, or NaN if there is none."""
    is_number = isinstance(value, int | float | np.integer | np.floating)
    return is_number and not isinstance(value, bool) and not abs(value) > LARGEST


def check_own(table: Any, place: str) -> pd.DataFrame:
    """Rows of a user's metrics, in the columns of `MetricRow`; ValueError if a study cannot average them.

    Parameters
    ----------
    table
        What the function returned for one run.
    place
        What named the metrics, for the message.
    """
    columns = list(MetricRow._fields)
    if not isinstance(table, pd.DataFrame) or not set(columns) <= set(table.columns):
        raise ValueError(f"{place}: it must return a DataFrame with the columns {', '.join(columns)}.")
    table = table[columns]
    texts = table.drop(columns="value")
    if not texts.map(lambda text: isinstance(text, str)).all(axis=None):
        raise ValueError(f"{place}: a value of {', '.join(texts.columns)} is no text. Return texts there.")
    for value in table.value.tolist():
        if not is_value(value):
            said = f"{place}: value = {repr(value)[:40]} is no number of at most {LARGEST:g} in size."
            raise ValueError(f"{said} Return NaN if there is none.")
    if included := [name for name in table.metric if name in METRICS]:
        raise ValueError(f"{place}: {included[0]} is a metric that cosim has. Give yours another name.")
    n = table.groupby(["metric", "group"], sort=False).size()
    if (n > 1).any():
        metric, group = n.index[n > 1][0]
        of = f'{metric} and group "{group}"' if group else str(metric)
        raise ValueError(
            f"{place}: {n.max()} rows of {of} in one run would count as replicates. Return one row, or name groups."
        )
    return table.astype({"value": float})


def measure_own(run: Run, metrics: Sequence[OwnMetric]) -> pd.DataFrame:
    """Values of users' metrics, in the columns of `measure`."""
    rows = [row for metric in metrics for row in metric.rows(run)]
    table = pd.DataFrame(rows, columns=MetricRow._fields).astype({"value": float})
    defined = table[table.value.notna()]
    return defined.assign(low=np.nan, high=np.nan, n_units=np.nan, note="")[COLUMNS]
