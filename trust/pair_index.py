"""A row for each (holder, subject): the index of a trust model that keeps its state in NumPy columns."""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from trust.tables import int64, pair_key


class PairIndex:
    """Rows 0, 1, ... given to pairs in the order of first use."""

    def __init__(self) -> None:
        self._keys = np.empty(0, np.int64)  # ascending
        self._rows = np.empty(0, np.int64)  # of each key

    def __len__(self) -> int:
        return self._keys.size

    def rows(self, holder: Int[ndarray, "n"], subject: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
        """Row of each pair; pairs not seen before get new ones, in the order of (holder, subject)."""
        keys = pair_key(int64(holder), int64(subject))
        at, found = self._find(keys)
        if not found.all():
            new = np.unique(keys[~found])
            before = np.searchsorted(self._keys, new)
            rows = np.arange(len(self), len(self) + new.size)
            self._keys, self._rows = np.insert(self._keys, before, new), np.insert(self._rows, before, rows)
            at = np.searchsorted(self._keys, keys)
        return self._rows[at]

    def find(
        self, holder: Int[ndarray, "n"], subject: Int[ndarray, "n"]
    ) -> tuple[Int[ndarray, "n"], Bool[ndarray, "n"]]:
        """Row of each pair, and whether it has one (else the row is meaningless)."""
        at, found = self._find(pair_key(int64(holder), int64(subject)))
        return self._rows[at] if len(self) else at, found

    def sorted(self) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"], Int[ndarray, "p"]]:
        """Holder, subject and row of every pair, by (holder, subject)."""
        return self._keys >> 31, self._keys & (1 << 31) - 1, self._rows

    def drop(self, unused: Bool[ndarray, "p"]) -> Int[ndarray, "k"]:
        """Remove the pairs of these rows; returns the old row of each row that remains."""
        kept = np.flatnonzero(~unused)
        new_row = np.cumsum(~unused) - 1
        remain = ~unused[self._rows]
        self._keys, self._rows = self._keys[remain], new_row[self._rows[remain]]
        return kept

    def _find(self, keys: Int[ndarray, "n"]) -> tuple[Int[ndarray, "n"], Bool[ndarray, "n"]]:
        if not len(self):
            return np.zeros(keys.shape, np.int64), np.zeros(keys.shape, bool)
        at = np.minimum(np.searchsorted(self._keys, keys), len(self) - 1)
        return at, self._keys[at] == keys


def with_rows(column: ndarray, n: int) -> ndarray:
    """The column with at least n rows, the new ones zero; grows by doubling."""
    if len(column) >= n:
        return column
    new = np.zeros((max(n, 2 * len(column)) - len(column), *column.shape[1:]), column.dtype)
    return np.concatenate([column, new])
