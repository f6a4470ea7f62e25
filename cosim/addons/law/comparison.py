"""Predictions beside what runs and studies measured."""

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.addons.law.prediction import METRICS, Prediction
from cosim.config.config import Config
from cosim.config.data import read_toml
from cosim.studies.study import Study
from results.archive import open_run
from results.measure import measure
from results.metrics.compare import flat
from results.study import is_study, open_study


def measured_by(frame: pd.DataFrame, definition: str) -> dict[str, float]:
    """Values of the predicted metrics in the measures of one run: columns metric, group, value.

    Of encounters, they are those of the definition of this name.
    """
    found = {}
    for name in METRICS:
        metric, _, state = name.partition(":")
        groups = [f"{state}, all"] if state else ["", "all", definition]
        rows = frame[(frame.metric == metric) & frame.group.isin(groups)]
        if len(rows):
            found[name] = float(rows.value.iloc[0])
    return found


def differences(folder: Path, predicted: Config | Study) -> list[str]:
    """What a run, or the base of a study, has set otherwise than what is predicted: "KEY = VALUE instead of VALUE".

    Raises
    ------
    ValueError
        If the folder is none of a run for a config, or none of a study that varies the same keys for a study.
    """
    is_config = isinstance(predicted, Config)
    if is_config == is_study(folder):
        raise ValueError(
            f"--against {folder}: a config is compared with a run, and a study with a study. Give the folder of a "
            f"{'run' if is_config else 'study'}."
        )
    if isinstance(predicted, Config):
        ours, theirs = _keys_of(predicted.to_dict()), _keys_of(open_run(folder).config)
    else:
        varied = open_study(folder).keys
        if set(varied) != set(predicted.keys):
            raise ValueError(
                f"--against {folder}: it varies {', '.join(varied)}, and what is predicted varies "
                f"{', '.join(predicted.keys)}. Give a study that varies the same keys."
            )
        ours = _keys_of(tomllib.loads(predicted.to_toml()).get("base", {}))
        theirs = _keys_of(read_toml(folder / "study.toml", "study file").get("base", {}))
    found = []
    for key in sorted(ours.keys() | theirs.keys()):
        mine, measured = (of.get(key, "default") for of in (ours, theirs))
        is_of_both = key in ours and key in theirs
        if mine != measured and (is_of_both or not key.startswith("trust_variant.")):
            found.append(f"{key} = {json.dumps(measured)} instead of {json.dumps(mine)}")
    return found


def _keys_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """Keys and values that matter to what is predicted. Those of trust variants have their names in them."""
    variants = {str(one["name"]): one for one in config.get("trust_variant", ())}
    leaves = flat(json.loads(json.dumps({**config, "trust_variant": variants})))
    return {key: value for key, value in leaves if not key.startswith(("preset", "record.", "compute."))}


Predictions = Sequence[tuple[Mapping[str, Any], Prediction]]
"""Swept keys (none for a run) and prediction."""


def measured_in(folder: Path, predictions: Predictions) -> list[dict[str, float]]:
    """What a run, or a study, measured for each prediction; empty where there is nothing.

    Parameters
    ----------
    folder
        Folder of a run with the predicted trust variants, or of a study with the predicted points.
    predictions
        Those of the run, or of some points of the study.
    """
    found = []
    if not is_study(folder):
        run = open_run(folder)
        there = set(run.variants)
        for _, p in predictions:
            of_variant = {}
            if p.variant in there:
                of_variant = measured_by(measure(run.as_variant(p.variant)), p.definition)
            found.append(of_variant)
        return found
    measures = open_study(folder).measures
    measures = measures[measures.replicate == 0]
    for keys, p in predictions:
        rows = pd.Series(True, index=measures.index)
        for key, value in keys.items():
            if key in measures:
                column = measures[key]
                rows &= column == (
                    value if column.dtype.kind in "fbiu" or isinstance(value, str) else json.dumps(value)
                )
        found.append(measured_by(measures[rows], p.definition))
    return found


def rows_of(
    predictions: Predictions,
    measured: Sequence[Mapping[str, float]] | None = None,
) -> list[dict[str, Any]]:
    """One row per prediction and metric: keys, variant, metric, label, value, low, high, and what was measured."""
    rows = []
    for number, (keys, p) in enumerate(predictions):
        got = {} if measured is None else measured[number]
        for name, label in METRICS.items():
            row = {**keys, "variant": p.variant, "metric": name, "label": label, "value": p.metrics[name]}
            row |= {
                "low": p.low.get(name),
                "high": p.high.get(name),
                "closed_form": p.closed.get(name),
            }
            if measured is not None:
                row["measured"] = got.get(name)
            rows.append(without_nan(row))
    return rows


def without_nan(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values with None for those that do not exist, as JSON knows no NaN."""
    found = dict(values)
    for name, value in values.items():
        if isinstance(value, float) and math.isnan(value):
            found[name] = None
    return found


def as_json(predictions: Predictions) -> list[dict[str, Any]]:
    """The predictions as plain data, with the distribution of the age of the newest evaluation."""
    found = []
    for keys, p in predictions:
        total = p.newest.sum()
        there = p.newest > 1e-9 * max(p.newest.max(initial=0.0), 1e-300)
        found.append(
            {
                "keys": dict(keys),
                "variant": p.variant,
                "server_period_s": p.period_s,
                "metrics": without_nan(p.metrics),
                "low": p.low,
                "high": p.high,
                "closed_form": without_nan(p.closed),
                "newest_evaluation_age": {
                    "age_s": [round(float(a), 6) for a in p.age_s[there]],
                    "share": [round(float(n / total), 9) for n in p.newest[there]],
                },
            }
        )
    return found
