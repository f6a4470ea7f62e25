"""Part files read back: columns, rows, pieces."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from results.durable import Damaged
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
        If the column has a label that is not in `labels`.
    """
    if not pa.types.is_dictionary(column.type):
        return column.to_numpy(zero_copy_only=False)
    if "evaluated" in labels:
        column = _present(column)
    code = np.array([*map(list(labels).index, column.dictionary.to_pylist()), -1], np.int16)
    return code[column.indices.fill_null(-1).to_numpy(zero_copy_only=False)]


def write_apart(file: Path, rows: pa.Table, variants: Sequence[str]) -> None:
    """The rows of each variant as a batch of its own, in the order of `variants`."""
    number = plain(rows.column("variant").combine_chunks(), variants)
    order = np.argsort(number, kind="stable")
    ends = np.searchsorted(number[order], np.arange(len(variants) + 1))
    (ordered,) = rows.take(pa.array(order)).combine_chunks().to_batches() or [
        pa.RecordBatch.from_pylist([], rows.schema)
    ]
    with pa.ipc.new_file(file, ordered.schema) as out:
        for begin, end in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
            out.write_batch(ordered.slice(begin, end - begin))


EARLIER_LABELS: Mapping[str, str] = {"judged": "evaluated", "unjudged": "unevaluated", "default": "no_value"}
"""Present labels of columns named `state`, by the labels that runs of earlier versions have."""


def read(path: Path, names: Sequence[str], where: pc.Expression | None) -> pa.Table:
    """Columns and rows of a part. ValueError or `Damaged`, in one line, if it cannot be read."""
    with _readable(path, names):
        rows = pq.read_table(path, columns=list(names), filters=where, partitioning=None)
    for number, field in enumerate(rows.schema):
        if field.name.startswith("state") and pa.types.is_dictionary(field.type):
            chunks = [_present(chunk) for chunk in rows.column(number).chunks]
            rows = rows.set_column(number, field, pa.chunked_array(chunks, field.type))
    return rows


def _present(column: pa.DictionaryArray) -> pa.DictionaryArray:
    """A column of states with the present labels. It says once that a run has earlier ones."""
    labels = column.dictionary.to_pylist()
    if not EARLIER_LABELS.keys() & set(labels):
        return column
    _say_earlier_labels()
    return pa.DictionaryArray.from_arrays(
        column.indices, pa.array([EARLIER_LABELS.get(label, label) for label in labels], column.dictionary.type)
    )


@cache
def _say_earlier_labels() -> None:
    now = ", ".join(f"{old} is now {new}" for old, new in EARLIER_LABELS.items())
    logging.getLogger(__name__).warning("The run has states under the names of an earlier version: %s.", now)


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
