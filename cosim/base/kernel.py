"""Decorators of compiled functions: cached on disk, run without Python's lock.

None of the functions gets a wrapper for callers in C. No C code calls them, and the wrapper takes a tenth to a quarter
of the time to compile them. Numba's own decorators cannot leave it out.

Inner loops that allocate nothing (`kernel`, `inlined`) are compiled without Numba's reference counts. `_nrt` is private
API of Numba, used in this file alone, because with reference counts the radio's event loop takes 3.3 times as long (20
instead of 6 ms for 1,000 stations with 60 receivers each): arrays are passed from function to function for every pair
of stations.
"""

import fcntl
import os
import pickle
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

from numba import njit, threading_layer
from numba.core import caching, lowering
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher
from numba.core.sigutils import normalize_signature


class _ForgivingIndex(caching.IndexDataCacheFile):
    """Numba's index of what is cached of a file. One that cannot be read counts as empty.

    It names the types of arguments. An earlier version of this program in the same folder had types of other names.
    """

    def _load_index(self) -> dict[Any, Any]:
        try:
            return super()._load_index()  # type: ignore[no-any-return]
        except (AttributeError, ImportError, EOFError, pickle.UnpicklingError):
            return {}

    def save(self, key: Any, data: Any) -> None:
        """Write what has been compiled, and then say so in the index.

        Numba writes the index first: another process could load what an earlier version of the code has left under that
        name. And of two processes that save at once, each could name its own types for the file of the other.
        """
        folder = os.open(self._cache_path, os.O_RDONLY)
        try:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(folder, fcntl.LOCK_EX)
            names = self._load_index()
            name = names.setdefault(key, self._data_name(len(names) + 1))
            self._save_data(name, data)
            self._save_index(names)
        finally:
            os.close(folder)


setattr(caching, "IndexDataCacheFile", _ForgivingIndex)  # noqa: B010  private API of Numba: it has no other way

_callee_depth = 0
"""Above 0 while a kernel is compiled because another one calls it. Numba's lock guards it."""
_numba: Any = SimpleNamespace(
    get_call_template=Dispatcher.get_call_template,
    compile=Dispatcher.compile,
    add_overload=Dispatcher.add_overload,
    create_cpython_wrapper=lowering.Lower.create_cpython_wrapper,
    save_overload=caching.FunctionCache.save_overload,
)
"""Methods of Numba that are replaced.

A kernel that another one calls is compiled without the wrapper for callers in Python, which takes a fifth of the time.
It is not kept on disk. A call from Python compiles it again, with the wrapper.
"""


def _get_call_template(self: Any, args: Any, kws: Any) -> Any:
    global _callee_depth
    with global_compiler_lock:
        _callee_depth += 1
        try:
            return _numba.get_call_template(self, args, kws)
        finally:
            _callee_depth -= 1


def _compile(self: Any, sig: Any) -> Any:
    with global_compiler_lock:
        found = None if _callee_depth else self.overloads.pop(tuple(normalize_signature(sig)[0]), None)
        if found is None or not found.library.get_pointer_to_function(found.fndesc.llvm_cpython_wrapper_name):
            return _numba.compile(self, sig)
        self.add_overload(found)
        return found.entry_point


def _add_overload(self: Any, found: Any) -> None:
    if _callee_depth:
        self.overloads[tuple(found.signature.args)] = found  # Python does not find it
    else:
        _numba.add_overload(self, found)


def _create_cpython_wrapper(self: Any, release_gil: bool) -> None:
    if not _callee_depth:
        _numba.create_cpython_wrapper(self, release_gil)


def _save_overload(self: Any, sig: Any, data: Any) -> None:
    if not _callee_depth:
        _numba.save_overload(self, sig, data)


for _of, _method in (
    (Dispatcher, _get_call_template),
    (Dispatcher, _compile),
    (Dispatcher, _add_overload),
    (lowering.Lower, _create_cpython_wrapper),
    (caching.FunctionCache, _save_overload),
):
    setattr(_of, _method.__name__[1:], _method)


_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True}
_COUNTLESS: dict[str, Any] = _OPTIONS | {"_nrt": False}

compiled = njit(**_OPTIONS)
"""Decorator: compiled, cached."""
parallel = njit(**_OPTIONS, parallel=True)
"""Decorator: the same, with `prange` over threads."""
kernel = njit(**_COUNTLESS)
"""Decorator: compiled, cached; must neither allocate nor return arrays, which callers would release once too often."""
dividing = njit(**_COUNTLESS, error_model="numpy")
"""Decorator: as `kernel`; division by zero is infinite, not an error, and many are made at once."""
inlined = njit(**_COUNTLESS, inline="always")
"""Decorator: the same, inlined into its callers."""


def threads_may_meet() -> bool:
    """Whether two threads may run parallel kernels at once: with Numba's layers omp and tbb, and not with workqueue."""
    try:
        return threading_layer() != "workqueue"
    except ValueError:  # no parallel kernel has run yet
        return False
