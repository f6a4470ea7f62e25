"""Decorators for inner loops that allocate nothing.

They are compiled without Numba's reference counts. `_nrt` is private API of Numba, used in this file alone: with
reference counts, passing arrays from function to function costs more per pair of stations than the work in between.
"""

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "_nrt": False}

kernel = njit(**_OPTIONS)
"""Decorator: compiled, cached, must not allocate."""
inlined = njit(**_OPTIONS, inline="always")
"""Decorator: the same, inlined into its callers."""
