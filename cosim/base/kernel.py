"""Decorators of compiled functions: cached on disk, run without Python's lock.

None of the functions gets a wrapper for callers in C. No C code calls them, and the wrapper takes a tenth to a quarter
of the time to compile them. Numba's own decorators cannot leave it out.

Inner loops that allocate nothing (`kernel`, `inlined`) are compiled without Numba's reference counts. `_nrt` is private
API of Numba, used in this file alone, because with reference counts the radio's event loop takes 3.3 times as long (20
instead of 6 ms for 1,000 stations with 60 receivers each): arrays are passed from function to function for every pair
of stations.
"""

import gc
from typing import Any

from numba import njit, threading_layer
from numba.core.registry import CPUDispatcher

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


def load_cached() -> int:
    """Load every compiled function of the imported modules that lies in the cache; return how many.

    Otherwise each is loaded when it is first called. Functions with `prange` are left out, because loading one starts
    OpenMP, and a process with OpenMP must not fork.
    """
    functions: list[Any] = [known for known in gc.get_objects() if isinstance(known, CPUDispatcher)]
    n_loaded = 0
    for function in functions:
        cache = function._cache  # private API of Numba, which has no other list of what is cached
        if hasattr(cache, "_cache_file") and not function.targetoptions.get("parallel"):
            for key in cache._cache_file._load_index():
                if key == cache._index_key(key[0], function.targetctx.codegen()):  # not of another processor
                    function.compile(key[0])
                    n_loaded += 1
    return n_loaded
