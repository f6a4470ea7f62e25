"""Settings of the C library's allocator. A run allocates and frees the same large arrays in every step."""

import ctypes
import os

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
"""Numbers of the settings of glibc's `mallopt(3)`."""
_MAPPED_ALONE_BYTES = _KEPT_FREE_BYTES = 1 << 30
"""Arrays above the first size have memory of their own, which is returned when they are freed. Free memory at the end
of the arena is returned above the second size."""
_MOST_OF_OLD_GLIBC = 32 << 20
"""Largest first size that an older glibc accepts [B]."""


def share_one_arena() -> None:
    """Let all threads use one arena, because a thread cannot use memory that is free in another arena.

    A thread keeps the arena that it once has, and later threads share the arenas that exist. So this is called before
    the process has a second thread.
    """
    if mallopt := _of_allocator():
        mallopt(_M_ARENA_MAX, 1)


def keep_freed_memory() -> None:
    """Let the process reuse freed memory instead of returning it to the system.

    The system clears every page before it hands it out again. That took a tenth of the processor time of a run with
    5,000 vehicles, and a quarter of that of the process of a run with 53,000.
    """
    if mallopt := _of_allocator():
        if not mallopt(_M_MMAP_THRESHOLD, _MAPPED_ALONE_BYTES):  # refused
            mallopt(_M_MMAP_THRESHOLD, _MOST_OF_OLD_GLIBC)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_FREE_BYTES)


def give_back_freed_memory() -> None:
    """Return freed memory to the system. Done at times, this keeps a long run from fragmenting its memory."""
    if malloc_trim := _of_libc("malloc_trim"):
        malloc_trim(0)


def _of_allocator() -> "ctypes._NamedFuncPointer | None":
    """`mallopt`; None if the C library is not glibc, or if the environment has settings of its own."""
    if any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ):
        return None
    return _of_libc("mallopt")


def _of_libc(name: str) -> "ctypes._NamedFuncPointer | None":
    """A function of the C library; None if it has no such function."""
    return getattr(ctypes.CDLL(None), name, None) if os.name == "posix" else None
