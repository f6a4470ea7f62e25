"""Settings of the C library's allocator for a run, which makes and drops the same large arrays step after step."""

import ctypes
import os

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
"""`mallopt(3)` of glibc."""
_MAPPED_ALONE_BYTES = 4 << 20
_KEPT_FREE_BYTES = 256 << 20


def keep_freed_memory() -> None:
    """Use freed memory again instead of giving it back to the system, which clears every page it hands out anew.

    Clearing was a tenth of the processor time of a run with 5,000 vehicles. One arena, because what a thread frees in
    its own no other thread can use. Nothing is done where the C library is not glibc, or where the environment has
    settings of the user's own.
    """
    if any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ):
        return
    if mallopt := _of_libc("mallopt"):
        mallopt(_M_ARENA_MAX, 1)
        mallopt(_M_MMAP_THRESHOLD, _MAPPED_ALONE_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_FREE_BYTES)


def give_back_freed_memory() -> None:
    """Now and then, so that gaps between arrays that stay do not add up over a long run."""
    if malloc_trim := _of_libc("malloc_trim"):
        malloc_trim(0)


def _of_libc(name: str) -> "ctypes._NamedFuncPointer | None":
    return getattr(ctypes.CDLL(None), name, None) if os.name == "posix" else None
