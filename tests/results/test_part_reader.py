"""Parts read back: a label that is not known is refused, whichever way the part is read."""

import pyarrow as pa
import pytest

from cosim.base.codes import LookupState, labels
from results import part_reader


def test_labels_of_an_earlier_version_are_refused_in_one_line():
    old = pa.DictionaryArray.from_arrays(pa.array([0, 1, None], pa.int8()), ["judged", "stale"])
    with pytest.raises(ValueError, match=r"labels 'judged', and this cosim knows evaluated, .* Run again\.$"):
        part_reader.plain(old, labels(LookupState))


def test_labels_become_codes():
    new = pa.DictionaryArray.from_arrays(pa.array([0, 1, None], pa.int8()), ["stale", "evaluated"])
    assert part_reader.plain(new, labels(LookupState)).tolist() == [LookupState.STALE, LookupState.EVALUATED, -1]
