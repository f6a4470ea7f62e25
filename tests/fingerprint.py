"""Whether two runs have equal tables."""

import hashlib
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from pandas.util import hash_pandas_object

from results.tables import TABLES, schema


def fingerprint(folder: Path) -> dict[str, str]:
    """Hash of the values in each table, independent of row order, blocks and Parquet encoding.

    Two runs have equal tables exactly where their fingerprints are equal.
    """
    folder = Path(folder)
    return {name: _table_hash(name, folder / name) for name in TABLES if (folder / name).is_dir()}


def _table_hash(table: str, folder: Path) -> str:
    """Rows are hashed one by one and summed, so that neither order nor block counts."""
    total, n = np.zeros(1, np.uint64), 0
    nullable = {pa.int32(): pd.Int32Dtype(), pa.int16(): pd.Int16Dtype(), pa.bool_(): pd.BooleanDtype()}
    for part in sorted(folder.glob("part-*.parquet")):
        for batch in pq.ParquetFile(part).iter_batches(1 << 20):
            rows = batch.to_pandas(types_mapper=nullable.get)
            floats = rows.select_dtypes("floating").columns
            rows[floats] = rows[floats] + 0.0  # makes one zero of two
            total += hash_pandas_object(rows, index=False).to_numpy().sum(dtype=np.uint64)
            n += len(rows)
    columns = schema(table).to_string()
    return hashlib.sha256(f"{columns} {n} {total[0]:x}".encode()).hexdigest()[:32]
