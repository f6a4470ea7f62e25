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
from typing import Any

from numba import njit, threading_layer
from numba.core import caching


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
