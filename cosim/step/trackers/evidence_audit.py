"""How often one look counts more than once on its way into trust values."""

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from sensors.kernel import compiled


def count_looks(
    evaluator: Int[ndarray, "m"],
    detection: Int[ndarray, "m"],
    message: Int[ndarray, "d"],
    actor: Int[ndarray, "d"],
    is_real: Bool[ndarray, "d"],
) -> int:
    """Distinct looks behind evaluations: one per evaluator, observer and actual object.

    Parameters
    ----------
    evaluator, detection
        Of each evaluation: message row of its evaluator, row of its detection.
    message, actor
        Of each detection: message row of its observer, actual object; read only where `is_real`.
    """
    real = np.flatnonzero(is_real)
    key = message[real].astype(np.int64) << 32 | actor[real]
    order = np.argsort(key, kind="stable")
    real, key = real[order], key[order]
    begins = np.append(np.flatnonzero(np.diff(key, prepend=-1)), len(key))
    n = np.diff(begins)
    first = np.arange(len(message))  # of the detections of an object by one observer
    first[real] = np.repeat(real[begins[:-1]], n)
    repeated = np.zeros(len(message), bool)
    repeated[real] = np.repeat(n > 1, n)
    some = np.flatnonzero(repeated[detection])
    pairs = evaluator[some].astype(np.int64) * len(message) + first[detection[some]]
    return len(detection) - len(some) + len(np.unique(pairs))


def audit(
    evaluator: Int[ndarray, "m"],
    detection: Int[ndarray, "m"],
    evaluation: Float[ndarray, "m"],
    visibility: Float[ndarray, "m"],
    message: Int[ndarray, "d"],
    actor: Int[ndarray, "d"],
    is_real: Bool[ndarray, "d"],
    is_fabricated: Bool[ndarray, "d"],
    attacks: Bool[ndarray, "e"],
    n_copies: int,
) -> dict[str, ndarray]:
    """Columns of the table `evidence`, one row.

    Parameters
    ----------
    attacks
        Message rows whose vehicles carry out an attack.
    """
    by, of, n_echoes = _counting(evaluator, detection, evaluation, visibility, message, is_fabricated, attacks)
    row = {
        "n_copies": n_copies,
        "n_evaluations": len(by),
        "n_looks": count_looks(by, of, message, actor, is_real),
        "n_echoes": n_echoes,
    }
    return {name: np.array([value]) for name, value in row.items()}


@compiled
def _counting(evaluator, detection, evaluation, visibility, message, is_fabricated, attacks):
    """Evaluations by others than the observer that could see; of these, attackers' in favour of what was fabricated."""
    by, of = np.empty(len(detection), np.int32), np.empty(len(detection), np.int32)
    n = n_echoes = 0
    for row in range(len(detection)):
        v, d = evaluator[row], detection[row]
        by[n], of[n] = v, d
        counts = (visibility[row] > 0) & (v != message[d])
        n_echoes += counts & attacks[v] & is_fabricated[d] & (evaluation[row] > 0)
        n += counts
    return by[:n], of[:n], n_echoes
