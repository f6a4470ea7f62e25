"""Excluding senders by a threshold on trust: how many of the excluded are attackers, and how many attackers are out."""

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from numpy import ndarray

from results.metrics import misbehaviour
from results.metrics.trust import HONEST
from results.run import Run


def curve(run: Run) -> pd.DataFrame:
    """Precision and recall of exclusion for every threshold on trust, in ascending order.

    Returns
    -------
    threshold; precision: share of attackers among the excluded; recall: share of attackers that are excluded; of values
    of watched subjects (`misbehaviour.scored`), pooled over subjects and time. A subject is excluded while its value
    rests on an evaluation and is below the threshold. Attackers are all that are not honest. The precision of the
    lowest threshold, which excludes nobody, is NaN.

    Raises
    ------
    ValueError
        If the run has no attacker or no evaluated value.
    """
    found = misbehaviour.scored(run)
    attacks = found.role != run.role_labels.index(HONEST)
    rated = found.rated & ~np.isnan(found.trust)
    if not attacks.any() or not rated.any():
        raise ValueError(
            f"{run.path} has no attacker, or no trust that rests on an evaluation: nobody can be excluded."
        )
    threshold = np.append(np.unique(found.trust[rated]), np.inf)
    n_attackers = np.searchsorted(np.sort(found.trust[rated & attacks]), threshold)
    n_honest = np.searchsorted(np.sort(found.trust[rated & ~attacks]), threshold)
    n = n_attackers + n_honest
    precision = np.where(n > 0, n_attackers / np.maximum(n, 1), np.nan)
    return pd.DataFrame({"threshold": threshold, "precision": precision, "recall": n_attackers / attacks.sum()})


def at(found: pd.DataFrame, threshold: float) -> tuple[float, float] | None:
    """Recall and precision at a threshold, from a result of `curve`; None if it excludes nobody."""
    row = int(np.searchsorted(found.threshold.to_numpy(), threshold))
    precision = float(found.precision.iloc[row])
    return None if np.isnan(precision) else (float(found.recall.iloc[row]), precision)


def is_on_front(recall: Float[ndarray, "n"], precision: Float[ndarray, "n"]) -> Bool[ndarray, "n"]:
    """Which points no other point beats: none has more of one and at least as much of the other (Pareto)."""
    order = np.lexsort((-precision, -recall))
    best = np.maximum.accumulate(np.r_[-np.inf, precision[order]])[:-1]
    front = np.zeros(len(recall), bool)
    front[order] = precision[order] > best
    return front
