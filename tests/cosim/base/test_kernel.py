"""Compiled functions lie in a cache. What an earlier version of the program has left there does no harm."""

import pickle
import subprocess
import sys

MINE = """
from typing import NamedTuple

from cosim.base.kernel import kernel


class Pair(NamedTuple):
    a: int
    b: int


@kernel
def summed(pair):
    return pair.a + pair.b
"""


def run(folder, code):
    """Run code in a process that can import the module `mine`."""
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); {code}"
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


def test_an_index_with_types_of_an_earlier_version_counts_as_empty(tmp_path):
    mine = tmp_path / "mine.py"
    mine.write_text(MINE)
    assert run(tmp_path, "import mine; print(mine.summed(mine.Pair(1, 2)))") == "3\n"
    indexes = list(tmp_path.rglob("*.nbi"))
    assert indexes, "it is cached"
    mine.write_text(MINE.replace("Pair", "Couple"))
    assert run(tmp_path, "import mine; print(mine.summed(mine.Couple(1, 2)))") == "3\n"
    with indexes[0].open("rb") as file:
        assert pickle.load(file), "the index is written anew, after the version of Numba"
