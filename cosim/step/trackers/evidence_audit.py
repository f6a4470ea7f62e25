"""Counts how often the same observation enters trust values more than once."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray


@dataclass(frozen=True, slots=True)
class AuditedEvaluations:
    """M evaluations of detections."""

    evaluator: Int[ndarray, "m"]
    """Message row of the evaluator."""
    detection: Int[ndarray, "m"]
    """Row of the detection."""
    evaluation: Float[ndarray, "m"]
    visibility: Float[ndarray, "m"]


@dataclass(frozen=True, slots=True)
class AuditedDetections:
    """D detections with their ground truth."""

    message: Int[ndarray, "d"]
    """Message row of the observer."""
    actor: Int[ndarray, "d"]
    """The true actor; meaningful only if it is real."""
    is_real: Bool[ndarray, "d"]
    is_fabricated: Bool[ndarray, "d"]


def count_looks(evaluator: Int[ndarray, "m"], detection: Int[ndarray, "m"], of: AuditedDetections) -> int:
    """Number of distinct observations behind evaluations: one per evaluator, observer and true actor.

    Parameters
    ----------
    evaluator, detection
        As in `AuditedEvaluations`.
    of
        The detections.
    """
    message, real = of.message, np.flatnonzero(of.is_real)
    key = message[real].astype(np.int64) << 32 | of.actor[real]
    order = np.argsort(key, kind="stable")
    real, key = real[order], key[order]
    begins = np.append(np.flatnonzero(np.diff(key, prepend=-1)), len(key))
    n = np.diff(begins)
    first = np.arange(len(message))  # first row among the detections of the same actor by the same observer
    first[real] = np.repeat(real[begins[:-1]], n)
    repeated = np.zeros(len(message), bool)
    repeated[real] = np.repeat(n > 1, n)
    some = np.flatnonzero(repeated[detection])
    actor = first[detection[some]]
    pairs = evaluator[some].astype(np.int64) * len(message) + actor
    return len(detection) - len(some) + len(np.unique(pairs))


def audit(
    evaluations: AuditedEvaluations, detections: AuditedDetections, attacks: Bool[ndarray, "e"], n_copies: int
) -> dict[str, ndarray]:
    """Columns of the table `evidence`, one row.

    Evaluations with visibility above 0 by others than the observer count. Each identity of a vehicle with several is
    one of its own. An echo is one of these evaluations by which an attacker confirms a fabricated detection.

    Parameters
    ----------
    evaluations, detections
        Evaluations and detections of the step.
    attacks
        Per message row, whether its vehicle carries out an attack.
    n_copies
        Number of received frames whose content the receiver had already.
    """
    counts = (evaluations.visibility > 0) & (evaluations.evaluator != detections.message[evaluations.detection])
    by, of = evaluations.evaluator[counts], evaluations.detection[counts]
    confirms = evaluations.evaluation[counts] > 0
    echoes = attacks[by] & detections.is_fabricated[of] & confirms
    row = {
        "n_copies": n_copies,
        "n_evaluations": len(by),
        "n_looks": count_looks(by, of, detections),
        "n_echoes": np.count_nonzero(echoes),
    }
    return {name: np.array([value]) for name, value in row.items()}
