"""Predictions beside what runs and studies measured."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.addons.law.prediction import METRICS, Prediction
from results.archive import open_run
from results.measure import measure
from results.study import is_study, open_study


def measured_by(frame: pd.DataFrame) -> dict[str, float]:
    """Values of the predicted metrics in the measures of one run: columns metric, group, value."""
    found = {}
    for name in METRICS:
        metric, _, state = name.partition(":")
        rows = frame[frame.metric == metric]
        if state:
            rows = rows[rows.group == f"{state}, all"]
        elif (rows.group == "all").any():
            rows = rows[rows.group == "all"]
        if len(rows):
            found[name] = float(rows.value.iloc[0])
    return found


def measured_in(folder: Path, predictions: Sequence[tuple[Mapping[str, Any], Prediction]]) -> list[dict[str, float]]:
    """What a run, or a study, measured for each prediction; empty where there is nothing.

    Parameters
    ----------
    folder
        Folder of a run with the predicted trust variants, or of a study with the predicted points.
    predictions
        Swept keys (none for a run) and prediction.
    """
    if not is_study(folder):
        run = open_run(folder)
        there = set(run.variants)
        return [measured_by(measure(run.as_variant(p.variant))) if p.variant in there else {} for _, p in predictions]
    measures = open_study(folder).measures
    measures = measures[measures.replicate == 0]
    found = []
    for keys, _ in predictions:
        rows = pd.Series(True, index=measures.index)
        for key, value in keys.items():
            if key in measures:
                column = measures[key]
                rows &= column == (
                    value if column.dtype.kind in "fbiu" or isinstance(value, str) else json.dumps(value)
                )
        found.append(measured_by(measures[rows]))
    return found


def rows_of(
    predictions: Sequence[tuple[Mapping[str, Any], Prediction]], measured: Sequence[Mapping[str, float]] | None = None
) -> list[dict[str, Any]]:
    """One row per prediction and metric: keys, variant, metric, label, value, low, high, and what was measured."""
    rows = []
    for number, (keys, p) in enumerate(predictions):
        got = {} if measured is None else measured[number]
        for name, label in METRICS.items():
            row = {**keys, "variant": p.variant, "metric": name, "label": label, "value": p.metrics[name]}
            row |= {"low": p.low.get(name), "high": p.high.get(name), "closed_form": p.closed.get(name)}
            if measured is not None:
                row["measured"] = got.get(name)
            rows.append(without_nan(row))
    return rows


def without_nan(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same values, with None for those that do not exist, as JSON knows no NaN."""
    return {name: None if isinstance(v, float) and math.isnan(v) else v for name, v in values.items()}


def as_json(predictions: Sequence[tuple[Mapping[str, Any], Prediction]]) -> list[dict[str, Any]]:
    """The predictions as plain data, with the distribution of the age of the newest evaluation."""
    found = []
    for keys, p in predictions:
        total, there = p.newest.sum(), p.newest > 1e-9 * max(p.newest.max(initial=0.0), 1e-300)
        found.append({
            "keys": dict(keys), "variant": p.variant, "server_period_s": p.period_s,
            "metrics": without_nan(p.metrics), "low": p.low, "high": p.high, "closed_form": without_nan(p.closed),
            "newest_evaluation_age": {
                "age_s": [round(float(a), 6) for a in p.age_s[there]],
                "share": [round(float(n / total), 9) for n in p.newest[there]],
            },
        })  # fmt: skip
    return found
