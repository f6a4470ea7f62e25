"""Metrics of the user's own: what one is, and the table that they make."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import pandas as pd

from results.run import Run


class MetricRow(NamedTuple):
    """A value of a metric of the user's own."""

    metric: str
    """Identifier, such as `headway.median_s`."""
    value: float
    """NaN where it is not defined: no row is shown then."""
    group: str = ""
    """What the value is of, such as a role."""
    unit: str = "1"
    label: str = ""


class Metric(Protocol):
    """Measures something on a run."""

    def rows(self, run: Run) -> list[MetricRow]:
        """One row for each metric and group.

        Raises
        ------
        ValueError
            In one line, where the run does not hold what it takes (`run.require(...)`).
        """
        ...


COLUMNS = ["metric", "group", "value", "low", "high", "n_units", "unit", "label", "note"]
"""Of a table of metrics."""


def measure_own(run: Run, metrics: Sequence[Metric]) -> pd.DataFrame:
    """Metrics of the user's own, in the columns of `measure`."""
    rows = [row for metric in metrics for row in metric.rows(run)]
    table = pd.DataFrame(
        [(row.metric, row.group, float(row.value), row.unit, row.label) for row in rows if row.value == row.value],
        columns=["metric", "group", "value", "unit", "label"],
    )
    return table.assign(low=np.nan, high=np.nan, n_units=np.nan, note="")[COLUMNS]
