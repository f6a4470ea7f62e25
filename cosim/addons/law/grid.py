"""A grid for a study, chosen by prediction: values between which freshness changes."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cosim.addons.law.freshness import predict_study
from cosim.addons.law.prediction import Prediction
from cosim.config.config import Config
from cosim.runs.drive import Advance
from cosim.studies.study import Head, Keep, Keys, Limits, Measuring, Study

PENETRATIONS = (0.05, 0.1, 0.2, 0.4, 0.8)
PERIODS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
WINDOWS_S = (5.0, 10.0, 20.0, 50.0, 100.0)
"""Values from which a grid is chosen."""
_AGE, _SHARE = 0.1, 0.05
"""Two values are apart if some age differs by this part of it, or some share of the lookups by this much."""
_AGES = ("freshness.newest_evaluation_age.median_s", "freshness.newest_evaluation_age.p90_s")
_STATES = ("freshness.lookup_state.share:evaluated", "freshness.lookup_state.share:no value")


def propose(
    config: Config,
    name: str,
    advance: Advance,
) -> tuple[Study, list[tuple[Keys, Prediction]]]:
    """Choose penetrations, server periods and windows for a study of a config.

    Every combination of `PENETRATIONS`, `PERIODS_S` and `WINDOWS_S` is predicted from one replay of the traffic. On
    each axis, a value is kept if freshness differs from the last value that was kept, at some combination of the
    others.

    Parameters
    ----------
    config
        The experiment. Its own trust variants are left out, because a study makes variants itself.
    name
        Name of the study.
    advance
        Called with progress.

    Returns
    -------
    The study, and the predictions for its points.
    """
    base = json.loads(json.dumps(config.to_dict()))  # plain lists, as a file has them
    del base["trust_variant"]
    values = {
        "fleet.penetration_p": PENETRATIONS,
        "trust.server_period_s": tuple(p for p in PERIODS_S if p >= config.sensing_interval_s),
        "trust.freshness_s": WINDOWS_S,
    }
    full = _study(name, base, values)
    predicted = predict_study(full, name, advance)
    kept = {key: _apart(predicted, key, given) for key, given in values.items()}
    chosen = []
    for keys, p in predicted:
        if all(keys[key] in some for key, some in kept.items()):
            chosen.append((keys, p))
    return _study(name, base, kept), chosen


def _study(
    name: str,
    base: dict[str, Any],
    values: Mapping[str, Sequence[float]],
) -> Study:
    question = "Does the law of freshness hold here? cosim predict freshness chose the grid."
    axes = []
    for key, given in values.items():
        axes.append(tuple({key: value} for value in given))
    return Study(
        Head(name=name, question=question),
        Limits(),
        Keep(topics=("traffic", "freshness", "radio")),
        Measuring(),
        base,
        tuple(axes),
    )


def _apart(
    predicted: Sequence[tuple[Keys, Prediction]],
    key: str,
    values: Sequence[float],
) -> tuple[float, ...]:
    """The values of one axis between which freshness changes, the first one included."""

    def at(value: float, names: Sequence[str]) -> np.ndarray:
        found = [p.metrics for keys, p in predicted if keys[key] == value]
        return np.array([[metrics[name] for name in names] for metrics in found])

    kept = [values[0]]
    for value in values[1:]:
        ages, before = at(value, _AGES), at(kept[-1], _AGES)
        shares, earlier = at(value, _STATES), at(kept[-1], _STATES)
        known = np.isfinite(ages) & np.isfinite(before)
        is_other_age = np.abs(ages - before)[known] >= _AGE * before[known]
        is_other_share = np.abs(shares - earlier) >= _SHARE
        if is_other_age.any() or is_other_share.any():
            kept.append(value)
    return tuple(kept)
