"""How many different vehicles evaluated a subject within a window, exactly and for windows of any length."""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.base.ragged import rows_of
from trust.pair_index import merged
from trust.tables import pair_key, unpaired

NEVER = -1
"""Before the first step."""


class EvaluatorTable:
    """Newest step in which each evaluator evaluated a subject for a holder and could see it (visibility above 0).

    An evaluator counts in a window if its newest evaluation lies in the window. One number per evaluator therefore
    serves windows of any length, in whatever order evaluations arrive.
    """

    def __init__(self) -> None:
        self.keys = np.empty(0, np.int64)  # `pair_key` of a pair's row in the store and an evaluator, ascending
        self.newest = np.empty(0, np.int32)  # step

    def note(self, row: Int[ndarray, "n"], evaluator: Int[ndarray, "n"], step: int) -> None:
        """Add evaluators of a step.

        Parameters
        ----------
        row, evaluator
            Row of (holder, subject) in the evidence store, and pseudonym of an evaluator. No such pair may be there
            twice.
        step
            Step of the detections. It may be older than steps noted before.
        """
        keys = np.sort(pair_key(row, evaluator))
        at, known = rows_of(keys, self.keys)
        again = at[known]
        self.newest[again] = np.maximum(self.newest[again], step)
        new = keys[~known]
        self.newest = np.insert(self.newest, np.searchsorted(self.keys, new), step)
        self.keys = merged(self.keys, new)

    def forget(self, horizon: int, unused: Bool[ndarray, "rows"]) -> None:
        """Drop old evaluators, and rows that are not used any more.

        Parameters
        ----------
        horizon
            Evaluators whose newest evaluation is of this step or an earlier one are dropped; with `NEVER` none is.
        unused
            Rows of the evidence store to drop, as a mask.
        """
        kept = (self.newest > horizon) & ~unused[unpaired(self.keys)[0]]
        self.keys, self.newest = self.keys[kept], self.newest[kept]

    def count(self, n_rows: int, after: int) -> Int[ndarray, "rows"]:
        """How many evaluators of each row have an evaluation of a later step than `after`.

        Parameters
        ----------
        n_rows
            Number of rows of the evidence store.
        after
            Step; with `NEVER` all evaluators count.

        Returns
        -------
        Number for each row of the evidence store; 0 for a row without evaluators.
        """
        return np.bincount(unpaired(self.keys[self.newest > after])[0], minlength=n_rows)
