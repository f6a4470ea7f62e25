"""Reads part files, in which a run keeps the rows of a table block by block. `results.run` decides which are read."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cosim.base.durable import Damaged
from results.tables import schema


def plain(column: pa.Array, labels: Sequence[str]) -> np.ndarray:
    """A column as a plain array.

    Parameters
    ----------
    column
        Column of a part.
    labels
        All labels of the column, in the order of their codes; not used for other columns.

    Returns
    -------
    Codes of labels (int16, -1 for null), or the values; numbers come as floats if some are null, with NaN for null.

    Raises
    ------
    ValueError
        In one line, if the column has a label that is not in `labels`.
    """
    if not pa.types.is_dictionary(column.type):
        return column.to_numpy(zero_copy_only=False)
    found = column.dictionary.to_pylist()
    check_labels(found, labels)
    known = list(labels)
    codes = np.array([*map(known.index, found), -1], np.int16)  # the last one is that of null
    rows = column.indices.fill_null(-1)
    return codes[rows.to_numpy(zero_copy_only=False)]


def as_stored(column: pa.ChunkedArray, kind: pa.DataType) -> pa.ChunkedArray:
    """A column in the type in which `results.tables.schema` stores it; texts become labels if that type has labels."""
    if not pa.types.is_dictionary(kind):
        return column.cast(kind)
    labels = column.combine_chunks().dictionary_encode()
    codes = labels.indices.cast(pa.int8())
    return pa.chunked_array([pa.DictionaryArray.from_arrays(codes, labels.dictionary)])


def check_labels(found: Sequence[str], known: Sequence[str]) -> None:
    """Raise ValueError, with a one-line message, if a column has labels that this cosim does not know."""
    if unknown := [label for label in found if label not in known]:
        raise ValueError(
            f"the run has the labels {', '.join(map(repr, unknown))}, and this cosim knows {', '.join(known)}: another "
            "version of cosim wrote it. Run again."
        )


def read(path: Path, names: Sequence[str], where: pc.Expression | None) -> pa.Table:
    """Columns and rows of a part. ValueError or `Damaged`, in one line, if it cannot be read."""
    with _readable(path, names):
        return pq.read_table(path, columns=list(names), filters=where, partitioning=None)


def read_pieces(path: Path, names: Sequence[str], n_rows: int) -> Iterator[pa.RecordBatch]:
    """Columns of a part, at most `n_rows` rows at once. Errors are those of `read`."""
    with _readable(path, names), pq.ParquetFile(path) as file:
        for rows in file.iter_batches(n_rows, columns=list(names)):
            yield rows.select(list(names))


@contextmanager
def _readable(path: Path, names: Sequence[str]) -> Iterator[None]:
    """Says in one line what is wrong with a part from which these columns cannot be read."""
    try:
        yield
    except (pa.ArrowException, OSError, KeyError) as error:
        missing = set(names) - _columns(path)
        if missing:
            raise ValueError(
                f"{path} has no column {', '.join(sorted(missing))}: another cosim wrote it. Run again."
            ) from error
        reason = str(error).splitlines()[0]
        raise Damaged(f"{path} is damaged ({reason}). Run `cosim verify` on its run.") from error


def _columns(path: Path) -> set[str]:
    """Columns that a part says it has; all, if it cannot even say that."""
    try:
        return set(pq.read_schema(path).names)
    except (pa.ArrowException, OSError):
        return set(schema(path.parent.name).names)
