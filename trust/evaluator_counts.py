"""How many different vehicles evaluated a subject within a window: exact, at one table access per report."""

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from trust.kernel import compiled
from trust.step_evidence import find_slot

_EVALUATOR = 31  # bits for a pseudonym
NEVER = -1


@compiled
def _note(keys, newest, n_used, row, evaluator, step):
    for i in range(row.size):
        key = (row[i] << _EVALUATOR) | evaluator[i]
        s = find_slot(keys, key)
        if keys[s] == -1:
            keys[s] = key
            newest[s] = step
            n_used += 1
        elif newest[s] < step:
            newest[s] = step
    return n_used


@compiled
def _count(keys, newest, after, beside, out):
    """Add, per row, the evaluators with an evaluation after a step that are not in the table of keys `beside`."""
    for i in range(keys.size):
        if keys[i] != -1 and newest[i] > after and beside[find_slot(beside, keys[i])] == -1:
            out[keys[i] >> _EVALUATOR] += 1


@compiled
def _without_old(keys, newest, horizon, size):
    new_keys = np.full(size, -1, np.int64)
    new_newest = np.zeros(size, np.int32)
    n = 0
    for i in range(keys.size):
        if keys[i] != -1 and newest[i] > horizon:
            s = find_slot(new_keys, keys[i])
            new_keys[s] = keys[i]
            new_newest[s] = newest[i]
            n += 1
    return new_keys, new_newest, n


class EvaluatorTable:
    """Step of the newest evaluation with visibility above 0 by every (row of a pair, evaluator).

    An evaluator counts in a window if its newest evaluation does, so that one number per evaluator serves windows of
    any length, in whatever order evaluations arrive.
    """

    def __init__(self) -> None:
        self.keys = np.full(64, -1, np.int64)
        self.newest = np.zeros(64, np.int32)
        self._n_used = 0

    def note(self, row: Int[ndarray, "n"], evaluator: Int[ndarray, "n"], step: int, horizon: int = NEVER) -> None:
        """Add the evaluators of a step; what is as old as `horizon` may be forgotten."""
        if 2 * (self._n_used + row.size) > self.keys.size:
            n_kept = int(np.count_nonzero((self.keys != -1) & (self.newest > horizon)))
            size = 1 << (4 * (n_kept + row.size) - 1).bit_length()
            self.keys, self.newest, self._n_used = _without_old(self.keys, self.newest, horizon, size)
        self._n_used = _note(self.keys, self.newest, self._n_used, row, evaluator, step)

    def count(self, n_rows: int, after: int, beside: "EvaluatorTable | None" = None) -> Int[ndarray, "rows"]:
        """Per row: evaluators with an evaluation after a step, those left out that are in the table `beside`."""
        out = np.zeros(n_rows, np.int64)
        _count(self.keys, self.newest, after, _NOTHING if beside is None else beside.keys, out)
        return out

    @property
    def nbytes(self) -> int:
        """Memory [B]."""
        return self.keys.nbytes + self.newest.nbytes


_NOTHING = np.full(1, -1, np.int64)
