"""Metrics that users write: their interface, and the table of their values."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

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


def check_own(table: pd.DataFrame, place: str) -> pd.DataFrame:
    """Rows of a user's metrics; ValueError if a study cannot average them over replicates.

    Parameters
    ----------
    table
        Columns metric and group, of one run.
    place
        What named the metrics, for the message.
    """
    if included := [name for name in table.metric if name in METRICS]:
        raise ValueError(f"{place}: {included[0]} is a metric that cosim has. Give yours another name.")
    n = table.groupby(["metric", "group"], sort=False, dropna=False).size()
    if (n > 1).any():
        metric, group = n.index[n > 1][0]
        of = f'{metric} and group "{group}"' if group else str(metric)
        raise ValueError(
            f"{place}: {n.max()} rows of {of} in one run would count as replicates. Return one row, or name groups."
        )
    return table


def measure_own(run: Run, metrics: Sequence[OwnMetric]) -> pd.DataFrame:
    """Values of users' metrics, in the columns of `measure`."""
    rows = [row for metric in metrics for row in metric.rows(run)]
    table = pd.DataFrame(rows, columns=MetricRow._fields).astype({"value": float})
    defined = table[table.value.notna()]
    return defined.assign(low=np.nan, high=np.nan, n_units=np.nan, note="")[COLUMNS]
