"""Compiles the kernels of a run in a second process, from the last that a run needs to the first.

The first run after an installation compiles for more than a minute in one thread. Meanwhile the second process compiles
from the other end, and Numba's cache hands over what it has compiled: Numba looks there before it compiles. The process
ends with the run. If it fails, the run compiles all kernels itself.

`kernels.txt` lists kernels and types of arguments in the order in which a run of the default world needs them.
`python -m tests.kernels` writes it. An old list costs time and does no harm.
"""

import fcntl
import hashlib
import importlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core import types

import cosim.base.kernel  # noqa: F401  whose cache two processes may write
from cosim.base.threads import CORES
from cosim.runs import process
from cosim.runs.source import code_digest

LIST = Path(__file__).with_name("kernels.txt")


def listed(path: Path = LIST) -> list[tuple[str, str, str]]:
    """Module, name and types of arguments of the kernels in a list, in the order of their first calls."""
    return [tuple(line.split(" ", 2)) for line in path.read_text().splitlines()]  # type: ignore[misc]


def kernel_of(module: str, name: str) -> Any:
    """A kernel by its name."""
    return getattr(importlib.import_module(module), name)


def types_of(text: str) -> tuple[types.Type, ...]:
    """Numba's types of arguments, from a text of the list."""
    return tuple(eval(text, vars(types) | {"named": _named, "record": _record}))


def _named(module: str, name: str, *of: types.Type) -> types.Type:
    return types.BaseTuple.from_types(of, getattr(importlib.import_module(module), name))


def _record(fields: list[Any]) -> types.Type:
    return numba.from_dtype(np.dtype(fields))


@contextmanager
def compiling(n_threads: int, path: Path = LIST) -> Iterator[subprocess.Popen[bytes] | None]:
    """Within the block, a second process compiles kernels if a core is free for it and no earlier one has done so.

    `n_threads` is the number of threads that the config allows, 0 for all. The block gets the process, or None. `path`
    is the list of kernels.
    """
    child = None
    if n_threads != 1 and CORES > 1:
        with suppress(Exception):  # kernels are not cached, another run's process is at it, or the list is old
            child = _start(path)
    try:
        yield child
    finally:
        if child is not None:
            child.kill()
            child.communicate()


def _start(path: Path) -> subprocess.Popen[bytes] | None:
    """The process; None if an earlier one has compiled all kernels.

    The file `compiled` in the folder of the first kernel's cache says which kernels have been compiled.
    """
    kernels = listed(path)
    first = kernel_of(*kernels[0][:2])
    digest = hashlib.sha256(path.read_bytes() + code_digest().encode())
    digest.update(repr((numba.__version__, first.targetctx.codegen().magic_tuple())).encode())
    marker = Path(first.stats.cache_path) / f"compiled.{sys.implementation.cache_tag}"
    handle = os.open(marker, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the process keeps the lock as long as it runs
        if os.pread(handle, 100, 0) == digest.hexdigest().encode():
            return None
        return subprocess.Popen(
            process.command(__name__, str(path), str(handle), digest.hexdigest()),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(handle,),
            env=process.environment(),
        )
    finally:
        os.close(handle)


def _compile(path: Path, handle: int, digest: str) -> None:
    process.end_with_parent()
    for module, name, text in reversed(listed(path)):
        with suppress(Exception):  # the list is old
            kernel_of(module, name).compile(types_of(text))
    os.pwrite(handle, digest.encode(), 0)


if __name__ == "__main__":
    _, folder, number, parent = sys.argv
    _compile(Path(folder), int(number), parent)
