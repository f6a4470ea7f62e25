"""Decorator of compiled functions: cached on disk, run without Python's lock, and without a wrapper for callers in C.

No C code calls them, and to compile the wrapper takes a tenth to a quarter of the time. Numba's own annotations leave
that option out.
"""

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True}

compiled = njit(**_OPTIONS)
"""Decorator: compiled, cached."""
