"""How much of the evidence behind a trust value is the same observation heard again.

Evaluations count that are sent with visibility above 0, of detections of another vehicle that belong to an actor. One
*witness* is a vehicle that evaluates, under any of its pseudonyms, one object of one subject. What it says again is no
independent observation: a witness keeps its line of sight, its detector and its errors from step to step. Not all
agreement is error: everybody denies a box that its sender has displaced, in every step.

References
----------
.. [1] Stata Technical Bulletin 60, insert sts18, 2001, after Kish 1965: with intraclass correlation k, the variance of
   m observations of a cluster is 1 + (m - 1) k times as large: they count as m / (1 + (m - 1) k) independent ones.
"""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.addons.evidence.evaluations import of_blocks
from results.run import Run

WINDOW_S = 10.0


class Said(NamedTuple):
    """N evaluations."""

    step: Int[ndarray, "n"]
    evaluator: Int[ndarray, "n"]
    """The vehicle, whichever pseudonym it used."""
    subject: Int[ndarray, "n"]
    """Pseudonym that the trust value is about."""
    actor: Int[ndarray, "n"]
    """What the evaluated detection really is."""
    denies: Bool[ndarray, "n"]
    detection_step: Int[ndarray, "n"]
    """Step of the evaluated detection. Where vehicles sense in turns, others evaluate it in several later steps."""


def repeats(run: Run) -> pd.DataFrame:
    """A row per group with the columns distinct, kappa and effective; NaN where there is nothing to count."""
    return run.once_for_all("evidence.repeats", lambda: of_evaluations(_said(run), run.dt_s))


def of_evaluations(said: Said, dt_s: float) -> pd.DataFrame:
    """What `repeats` returns, of these evaluations."""
    witness = _numbers(said.evaluator, said.subject, said.actor)
    slot = np.floor(said.step * dt_s / WINDOW_S + 1e-9).astype(np.int64)
    look, first = np.unique(_numbers(witness, said.step), return_index=True)
    distinct = {
        "step": look,
        f"{WINDOW_S:g} s": np.unique(_numbers(witness, slot)),
        "run": np.unique(witness),
    }
    rows: list[dict[str, Any]] = []
    for name, of in distinct.items():
        share = len(of) / len(witness) if len(witness) else np.nan
        rows.append({"group": name, "distinct": share})
    _, evaluator, subject, actor, denies, detection_step = (column[first] for column in said)
    groups = {
        "same evaluator, object": witness[first],
        "same evaluator": _numbers(evaluator, subject),
        "same object, step": _numbers(subject, actor, detection_step),
    }
    for name, group in groups.items():
        _, group = np.unique(group, return_inverse=True)
        n, denied = np.bincount(group), np.bincount(group, denies)
        kappa = agreement(n, denied)
        alike = np.clip(kappa, 0, 1)
        independent = n / (1 + (n - 1) * alike)
        effective = np.sum(independent) / n.sum() if len(n) else np.nan
        rows.append({"group": name, "kappa": kappa, "effective": effective})
    return pd.DataFrame(rows)


def agreement(n: Int[ndarray, "g"], denied: Int[ndarray, "g"]) -> float:
    """Agreement of two evaluations of one group beyond chance (kappa): 0 by chance, 1 if groups are of one mind.

    Parameters
    ----------
    n, denied
        Evaluations of each group, and those of them that deny.

    Returns
    -------
    (A - C) / (1 - C): A is the share of the ordered pairs within a group that agree, C is the same for two evaluations
    drawn from all pairs. NaN if no group has two evaluations, or all evaluations are alike.
    """
    pairs = float(np.sum(n * (n - 1)))
    if not pairs:
        return float("nan")
    others = n - denied
    alike = denied * (denied - 1) + others * (others - 1)
    agree = float(np.sum(alike)) / pairs
    share = float(np.sum(denied * (n - 1))) / pairs
    chance = share**2 + (1 - share) ** 2
    return (agree - chance) / (1 - chance) if chance < 1 else float("nan")


def _said(run: Run) -> Said:
    found = of_blocks(run, _QUERY)
    names = ["step", "evaluator", "subject", "actor", "detection_step"]
    step, evaluator, subject, actor, detection_step = found[names].to_numpy(np.int64).T
    return Said(step, evaluator, subject, actor, found.denies.to_numpy(bool), detection_step)


_QUERY = """
SELECT e.step, coalesce(s.vehicle, -1 - e.evaluator) AS evaluator, e.observer AS subject, d.truth_actor AS actor,
    e.evaluation < 0 AS denies, e.detection_step
FROM evaluations e
JOIN (
    SELECT * FROM detections WHERE step BETWEEN $first AND $last AND transmitted AND truth_actor IS NOT NULL
) d ON d.step = e.detection_step AND d.observer = e.observer AND d.detection_index = e.detection_index
LEFT JOIN subjects s ON s.pseudonym = e.evaluator
JOIN subjects o ON o.pseudonym = e.observer
WHERE e.step BETWEEN $begin AND $last AND e.visibility > 0 AND e.kind = 'detection' AND e.observer % $every = 0
    AND coalesce(s.vehicle, -1 - e.evaluator) IS DISTINCT FROM o.vehicle
ORDER BY e.step, e.evaluator, e.observer, e.detection_index, e.detection_step
"""
"""Evaluations of other vehicles' detections that belong to an actor. A roadside unit, which is no vehicle, evaluates
under a number of its own."""


def _numbers(*columns: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """A number for each row; equal rows have equal numbers."""
    number = np.zeros(len(columns[0]), np.int64)
    for column in columns:
        known, code = np.unique(column, return_inverse=True)
        both = number * max(len(known), 1) + code
        _, number = np.unique(both, return_inverse=True)
    return number
