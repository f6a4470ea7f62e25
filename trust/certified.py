"""Evaluations by observers whose certificates say that they belong to an authority."""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from trust.claims import MISSING
from trust.open_steps import MAX_DETECTIONS
from trust.params import KINDS
from trust.tables import EvaluationMessages


def upheld(
    messages: EvaluationMessages,
    is_certified: Bool[ndarray, "v"],
    certified: Int[ndarray, "c"],
    are_claims: bool = False,
) -> EvaluationMessages:
    """The evaluations that count beside those of certified observers.

    Parameters
    ----------
    messages
        Evaluations of one step.
    is_certified
        Whether each message is of a certified observer.
    certified
        Pseudonyms of all certified observers.
    are_claims
        Whether the numbers of what is evaluated are those of claims (`trust.claims.claim_number`).

    Returns
    -------
    The messages without two kinds of evaluations: those of detections of certified observers, because their word is
    taken; and those by others of a detection that a certified observer could see (visibility above 0) and evaluates
    itself. What one certified observer says does not replace what another one says. That a message withholds nothing is
    one claim here: each evaluator numbers the objects that it misses by itself, so the numbers of two have nothing to
    do with each other.

    Notes
    -----
    The rule is ours. It is the hardest form of "known class of certificate": whoever can turn a server that adds up
    evaluations cannot turn it where a certified observer looks. It says nothing about what none of them sees.
    """
    if not len(certified):
        return messages
    by_certified = np.repeat(is_certified, np.diff(messages.ptr))
    number = messages.detection_index
    if are_claims:
        number = np.where(number % len(KINDS) == MISSING, MISSING, number)
    key = messages.observer.astype(np.int64) * MAX_DETECTIONS + number
    if messages.detection_step is not None:
        _, step = np.unique(messages.detection_step, return_inverse=True)
        step_and_key = np.column_stack([step.reshape(-1), key])
        _, number_of_both = np.unique(step_and_key, axis=0, return_inverse=True)
        key = number_of_both.reshape(-1)
    decided = np.unique(key[by_certified & (messages.visibility > 0)])
    is_undecided = by_certified | ~np.isin(key, decided)
    keep = is_undecided & ~np.isin(messages.observer, certified)
    return messages if keep.all() else messages.rows(keep)
