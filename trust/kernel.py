"""Decorators of compiled functions: cached on disk, run without Python's lock.

None has a wrapper for callers in C: no C code calls them, and to compile it takes a tenth to a quarter of the
time. Numba's own annotations leave that option out.
"""

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True}

_COUNTLESS: dict[str, Any] = _OPTIONS | {"_nrt": False}

compiled = njit(**_OPTIONS)
"""Decorator: compiled, cached."""
kernel = njit(**_COUNTLESS)
"""Decorator: the same without reference counts, which cost a call more than its work; must neither allocate nor return
arrays. `_nrt` is private API of Numba, as in `sensors.kernel`."""
inlined = njit(**_OPTIONS, inline="always")
"""Decorator: compiled, cached, inlined into its callers."""
parallel = njit(**_OPTIONS, parallel=True)
"""Decorator: the same, with `prange` over threads."""
