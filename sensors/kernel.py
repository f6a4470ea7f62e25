"""Decorators for inner loops that allocate nothing.

They are compiled without Numba's reference counts. `_nrt` is private API of Numba, used in this file alone, because
with reference counts the radio's event loop takes 3.3 times as long (20 instead of 6 ms for 1,000 stations with 60
receivers each): arrays are passed from function to function for every pair of stations.

Like all compiled functions here they have no wrapper for callers in C (`no_cfunc_wrapper`), because nobody calls them
from there, and with it compilation takes a tenth to a quarter longer.
"""

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True, "_nrt": False}

kernel = njit(**_OPTIONS)
"""Decorator: compiled, cached, must not allocate."""
inlined = njit(**_OPTIONS, inline="always")
"""Decorator: the same, inlined into its callers."""
