"""A row for each (holder, subject): the index of a trust model that keeps its state in NumPy columns."""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.base.ragged import rows_of
from trust.tables import int64, pair_key, unpaired


class PairIndex:
    """Rows 0, 1, ... for pairs, in the order of first use. Rows of dropped pairs are given to new pairs."""

    def __init__(self) -> None:
        self._keys = np.empty(0, np.int64)  # ascending
        self._rows = np.empty(0, np.int64)  # of each key
        self._free = np.empty(0, np.int64)  # rows of dropped pairs

    def __len__(self) -> int:
        """Rows given so far, those of dropped pairs included: the length of a column of state."""
        return self._rows.size + self._free.size

    def rows(
        self,
        holder: Int[ndarray, "n"],
        subject: Int[ndarray, "n"],
    ) -> Int[ndarray, "n"]:
        """Row of each pair. A pair without a row gets one.

        Parameters
        ----------
        holder, subject
            Numbers in [0, 2^31); a pair may occur several times.

        Returns
        -------
        Row of each pair. New pairs get rows in the order of (holder, subject), first the rows of dropped pairs.
        """
        keys = pair_key(int64(holder), int64(subject))
        at, found = rows_of(keys, self._keys)
        if not found.all():
            new = np.unique(keys[~found])
            n_again = min(new.size, self._free.size)
            n_more = new.size - n_again
            more = np.arange(len(self), len(self) + n_more)
            rows = np.concatenate([self._free[:n_again], more])
            self._free = self._free[n_again:]
            self._rows = np.insert(self._rows, np.searchsorted(self._keys, new), rows)
            self._keys = merged(self._keys, new)
            at = np.searchsorted(self._keys, keys)
        return self._rows[at]

    def find(
        self, holder: Int[ndarray, "n"], subject: Int[ndarray, "n"]
    ) -> tuple[Int[ndarray, "n"], Bool[ndarray, "n"]]:
        """Row of each pair, without giving rows to new pairs.

        Returns
        -------
        Row of each pair, and whether it has one. Where it has none, the row is meaningless.
        """
        at, found = rows_of(pair_key(int64(holder), int64(subject)), self._keys)
        return self._rows[at] if self._rows.size else at, found

    def sorted(
        self,
    ) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"], Int[ndarray, "p"]]:
        """All pairs that have a row.

        Returns
        -------
        Holder, subject and row of every pair, sorted by (holder, subject).
        """
        return *unpaired(self._keys), self._rows

    def drop(self, unused: Bool[ndarray, "rows"]) -> None:
        """Forget pairs. Their rows are given to new pairs later.

        Parameters
        ----------
        unused
            Rows whose pairs are forgotten, as a mask over all rows given so far.
        """
        kept = ~unused[self._rows]
        self._free = np.concatenate([self._free, self._rows[~kept]])
        self._keys, self._rows = self._keys[kept], self._rows[kept]


def with_rows(column: ndarray, n: int) -> ndarray:
    """A column with room for at least n rows; it grows by doubling.

    Returns
    -------
    `column` itself if it is long enough, else a longer copy in which the new rows are zero.
    """
    if len(column) >= n:
        return column
    n_new = max(n, 2 * len(column)) - len(column)
    new = np.zeros((n_new, *column.shape[1:]), column.dtype)
    return np.concatenate([column, new])


def merged(
    ascending: Int[ndarray, "m"],
    new: Int[ndarray, "n"],
) -> Int[ndarray, "m+n"]:
    """Two ascending arrays as one; a value of both occurs twice."""
    return np.insert(ascending, np.searchsorted(ascending, new), new)
