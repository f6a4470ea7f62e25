"""Parts of earlier versions: states under their earlier labels are read under the present ones."""

import logging

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from results import part_reader
from results.codes import LookupState, labels


def test_states_of_earlier_versions(tmp_path, caplog):
    part_reader._say_earlier_labels.cache_clear()
    old = ["judged", "unjudged", "stale", "default"]
    column = pa.DictionaryArray.from_arrays(pa.array([3, 0, 2, 1, None], pa.int8()), old)
    source = pa.DictionaryArray.from_arrays(pa.array([0, 0, 0, 0, 0], pa.int8()), ["default"])
    part = tmp_path / "trust_lookups" / "part.parquet"
    part.parent.mkdir()
    pq.write_table(pa.table({"state": column, "source": source}), part)
    with caplog.at_level(logging.WARNING):
        rows = part_reader.read(part, ["state", "source"], None)
    assert rows.column("state").to_pylist() == ["no_value", "evaluated", "stale", "unevaluated", None]
    assert rows.column("source").to_pylist() == ["default"] * 5, "the source of a value keeps its label"
    assert "judged is now evaluated" in caplog.text
    (batch,) = part_reader.read_pieces(part, ["state", "source"], 10)
    states = part_reader.plain(batch.column("state"), labels(LookupState))
    np.testing.assert_array_equal(states, [LookupState.NO_VALUE, LookupState.EVALUATED, LookupState.STALE, 1, -1])
    np.testing.assert_array_equal(part_reader.plain(batch.column("source"), ["server", "own", "default"]), [2] * 5)
    assert caplog.text.count("earlier version") == 1, "said once"
