"""How often one look counts more than once on its way into trust values."""

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray


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
    key = message.astype(np.int64) << 32 | actor
    order = np.flatnonzero(is_real)[np.argsort(key[is_real], kind="stable")]
    same = key[order[1:]] == key[order[:-1]]
    repeated = np.zeros(len(message), bool)  # detections of an object that their observer reports several times
    repeated[order[1:][same]] = repeated[order[:-1][same]] = True
    some = repeated[detection]
    pairs = np.column_stack([evaluator[some], key[detection[some]]])
    return int((~some).sum()) + len(np.unique(pairs, axis=0))


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
    counts = (visibility > 0) & (evaluator != message[detection])
    by, of, e = evaluator[counts], detection[counts], evaluation[counts]
    echoes = attacks[by] & is_fabricated[of] & (e > 0)
    row = {
        "n_copies": n_copies,
        "n_evaluations": len(by),
        "n_looks": count_looks(by, of, message, actor, is_real),
        "n_echoes": int(echoes.sum()),
    }
    return {name: np.array([value]) for name, value in row.items()}
