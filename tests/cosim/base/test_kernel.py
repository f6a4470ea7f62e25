"""Compiled functions lie in a cache. What an earlier version of the program has left there does no harm."""

import fcntl
import importlib
import os
import pickle
import pkgutil
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache

import pytest
from numba.core import caching
from numba.core.dispatcher import Dispatcher

import cosim
import results
import sensors
import sumo_nets
import trust
from cosim.base import kernel  # which gives Numba its index
from tests.drive import python

PACKAGES = cosim, results, sensors, sumo_nets, trust

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


def test_an_index_with_types_of_an_earlier_version_counts_as_empty(tmp_path):
    mine = tmp_path / "mine.py"
    mine.write_text(MINE)
    assert python("import mine; print(mine.summed(mine.Pair(1, 2)))", cwd=tmp_path) == "3\n"
    indexes = list(tmp_path.rglob("*.nbi"))
    assert indexes, "it is cached"
    mine.write_text(MINE.replace("Pair", "Couple"))
    assert python("import mine; print(mine.summed(mine.Couple(1, 2)))", cwd=tmp_path) == "3\n"
    with indexes[0].open("rb") as file:
        assert pickle.load(file), "the index is written anew, after the version of Numba"


def test_the_index_names_what_has_been_written_already(tmp_path):
    """A process that reads between the two finds nothing, not what an earlier version has left there."""
    stale, fresh = (caching.IndexDataCacheFile(str(tmp_path), "f", stamp) for stamp in ("old", "new"))
    stale.save("key", "old code")
    fresh.save("key", "new code")
    data, index = tmp_path / "f.1.nbc", tmp_path / "f.nbi"
    assert data.stat().st_mtime_ns <= index.stat().st_mtime_ns
    assert fresh.load("key") == "new code" and stale.load("key") is None


def test_processes_save_one_after_the_other(tmp_path):
    """Otherwise both would use one file for two types of arguments."""
    one, other = (caching.IndexDataCacheFile(str(tmp_path), "f", "stamp") for _ in range(2))
    folder = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(folder, fcntl.LOCK_EX)
    with ThreadPoolExecutor() as threads:
        both = [threads.submit(file.save, key, key) for file, key in ((one, "a"), (other, "b"))]
        time.sleep(0.05)
        assert not any(saved.done() for saved in both) and not [*tmp_path.iterdir()]
        os.close(folder)
    assert [one.load("a"), one.load("b")] == ["a", "b"]


THEIRS = """
from cosim.base.kernel import inlined, kernel

SHIFT = 1.0


@inlined
def copied(x):
    return x + 1.0


@kernel
def linked(x):
    return x + 1.0
"""
CALLING = """
import theirs
from theirs import SHIFT, copied

from cosim.base.kernel import kernel


@kernel
def all_of(x, pair):
    return copied(x), theirs.linked(x), x + SHIFT, pair.a
"""
PAIR = """
from typing import NamedTuple


class Pair(NamedTuple):
    a: int
    b: int
"""


@pytest.mark.verify
def test_what_a_cached_function_calls_may_change_in_other_files(tmp_path):
    """Functions that are copied into it or called by it, constants that it reads, and the order of fields."""
    hits = "sum(calling.all_of.stats.cache_hits.values())"
    asked = f"import calling, pairs; print(calling.all_of(1.0, pairs.Pair(7, 8)), {hits})"
    theirs, pairs = tmp_path / "theirs.py", tmp_path / "pairs.py"
    (tmp_path / "calling.py").write_text(CALLING)
    theirs.write_text(THEIRS)
    pairs.write_text(PAIR)
    assert python(asked, cwd=tmp_path) == "(2.0, 2.0, 2.0, 7) 0\n"
    assert python(asked, cwd=tmp_path) == "(2.0, 2.0, 2.0, 7) 1\n"
    theirs.write_text(THEIRS.replace("1.0", "10.0"))
    assert python(asked, cwd=tmp_path) == "(11.0, 11.0, 11.0, 7) 0\n"
    # One character more: Python tells versions of a file by whole seconds and by size.
    pairs.write_text(PAIR.replace("a: int\n    b", "b: int\n    a") + "\n")
    assert python(asked, cwd=tmp_path) == "(11.0, 11.0, 11.0, 8) 0\n"
    assert python(asked, cwd=tmp_path) == "(11.0, 11.0, 11.0, 8) 1\n"


@cache
def compiled_functions():
    """All compiled functions of the program, by what they compile."""
    functions = {}
    for root in PACKAGES:
        for module in pkgutil.walk_packages(root.__path__, f"{root.__name__}."):
            with suppress(ImportError):  # an extra that is not installed
                found = vars(importlib.import_module(module.name)).values()
                functions |= {one.py_func: one for one in found if isinstance(one, Dispatcher)}
    return functions


def test_no_kernel_calls_a_function_with_reference_counts():
    """A kernel does not release what such a function returns. And Numba, asked for neither, compiles a function as its
    first caller is: once, and for all callers. Arrays were then released twice, if the first one was a kernel."""
    counts = {function: one.targetoptions["_nrt"] for function, one in compiled_functions().items()}
    assert len(counts) > 100
    for function, counted in counts.items():
        _, called = kernel._content(function)
        wrong = [one.__name__ for one in called if counts.get(one)]
        assert counted or not wrong, f"{function.__name__} calls {', '.join(wrong)}"


def test_keys_of_the_cache_depend_on_the_programs_own_code():
    """Those of libraries read what differs between processes: the run and the process beside it would compile twice."""
    ours = {root.__name__ for root in PACKAGES}
    for function in compiled_functions():
        for called in kernel._content(function)[1]:
            assert called.__module__.split(".")[0] in ours, f"{function.__name__}: {called.__module__}"
