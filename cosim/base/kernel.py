"""Decorators of compiled functions: cached on disk, run without Python's lock.

None of the functions gets a wrapper for callers in C. No C code calls them, and the wrapper takes a tenth to a quarter
of the time to compile them. Numba's own decorators cannot leave it out.

Inner loops that allocate nothing (`kernel`, `inlined`) are compiled without Numba's reference counts. `_nrt` is private
API of Numba, used in this file alone, because with reference counts the radio's event loop takes 3.3 times as long (20
instead of 6 ms for 1,000 stations with 60 receivers each): arrays are passed from function to function for every pair
of stations.
"""

import fcntl
import hashlib
import os
import pickle
from collections.abc import Iterator
from contextlib import suppress
from enum import EnumType
from functools import cache
from types import CodeType, FunctionType, ModuleType
from typing import Any

from numba import njit
from numba.core import caching
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic
from numpy import dtype, generic, ndarray


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
_key_of_own_code = caching.FunctionCache._index_key


def _key_of_all_code(self: Any, signature: Any, codegen: Any) -> tuple[Any, ...]:
    """The key under which compiled code is kept: Numba's, and a digest of what is compiled into it from other files.

    Numba looks at the function's own file alone. Its machine code also contains the functions that it calls, the
    constants that they read, and the order of the fields of named tuples. After an update of one of these, old code
    would go on computing.
    """
    fields = repr([_fields(kind) for kind in signature])
    digest = _digest_of(self._py_func) + hashlib.sha256(fields.encode()).hexdigest()
    return (*_key_of_own_code(self, signature, codegen), digest)


setattr(caching.FunctionCache, "_index_key", _key_of_all_code)  # noqa: B010  likewise


_LIBRARIES = {"numba", "numpy"}
"""Packages whose functions are not read: Numba compiles code of its own in their place. Some lead to what differs
between processes. A field called `info` led to `numpy.info`, and that to the flags of the interpreter."""
_PLAIN = int | float | complex | tuple | dtype | generic
"""Constants that are told from each other by what they print; not texts, which say nothing to a kernel."""


def _fields(kind: Any) -> Any:
    """Names of the fields of a type that is a named tuple, and of the types in it."""
    return getattr(kind, "fields", ()), [_fields(one) for one in getattr(kind, "types", ())]


@cache
def _digest_of(function: FunctionType) -> str:
    """Digest of a function and of all that it calls."""
    digest, found, left = hashlib.sha256(), {function}, [function]
    while left:
        content, called = _content(left.pop())
        digest.update(content)
        new = [one for one in called if one not in found]
        found.update(new)
        left += dict.fromkeys(new)
    return digest.hexdigest()


@cache
def _content(function: FunctionType) -> tuple[bytes, list[FunctionType]]:
    """Code of a function and the constants that it reads, and the functions that it calls."""
    said: list[str] = []
    called: list[FunctionType] = []
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    for code in _codes(function.__code__):
        constants = [one for one in code.co_consts if isinstance(one, _PLAIN)]
        said.append(repr((code.co_code, code.co_varnames, code.co_names, constants)))
        values = [function.__globals__[name] for name in code.co_names if name in function.__globals__]
        # Of a module, what is read is among the names, too.
        for module in [one for one in values if isinstance(one, ModuleType)]:
            values += [getattr(module, name) for name in code.co_names if hasattr(module, name)]
        for value in (*values, *cells):
            _say(value, said, called)
    return "\n".join(said).encode(), called


def _codes(code: CodeType) -> Iterator[CodeType]:
    """A code object and those of the functions within."""
    yield code
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield from _codes(one)


def _say(value: Any, said: list[str], called: list[FunctionType]) -> None:
    """Add what a name stands for: a function, a tuple of things, or a constant."""
    if isinstance(value, Dispatcher):
        called.append(value.py_func)
        said.append(repr(value.targetoptions))
    elif isinstance(value, _Intrinsic):
        called.append(value._defn)
    elif isinstance(value, FunctionType):
        if str(value.__module__).partition(".")[0] not in _LIBRARIES:
            called.append(value)
    elif isinstance(value, tuple):
        for one in value:
            _say(one, said, called)
    elif isinstance(value, ndarray):
        said.append(f"{value.dtype} {value.shape} {value.tobytes()!r}")
    elif isinstance(value, EnumType):
        said.append(repr(list(value)))
    elif isinstance(value, _PLAIN):
        said.append(repr(value))


_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True}
_COUNTLESS: dict[str, Any] = _OPTIONS | {"_nrt": False}
_COUNTED: dict[str, Any] = _OPTIONS | {"_nrt": True}
"""Where nothing is said, Numba compiles a function as the first of its callers, and others get the same code."""

compiled = njit(**_COUNTED)
"""Decorator: compiled, cached; not for functions that a kernel calls."""
kernel = njit(**_COUNTLESS)
"""Decorator: compiled, cached; must neither allocate nor return arrays, which callers would release once too often."""
dividing = njit(**_COUNTLESS, error_model="numpy")
"""Decorator: as `kernel`; division by zero is infinite, not an error, and many are made at once."""
inlined = njit(**_COUNTLESS, inline="always")
"""Decorator: the same, inlined into its callers."""
