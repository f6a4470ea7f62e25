"""What code of a user's own must leave as it is while it runs: the current folder, and standard output."""

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any


class FolderChanged(Exception):
    """The code has changed the current folder, which names of files refer to. It is as before now."""

    def __init__(self) -> None:
        super().__init__("changed the current folder, which names of files refer to. Use whole paths instead")


class _ToStandardError:
    """Takes the place of standard output: results of a command, such as JSON, must stand there alone."""

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stderr, name)

    def close(self) -> None:
        """Standard output stays open."""
        raise ValueError("standard output is cosim's and stays open")


class _Output:
    """How many threads run such code now, and what standard output was before the first."""

    def __init__(self) -> None:
        self.lock, self.n, self.before = threading.Lock(), 0, sys.stdout

    def divert(self, by: int) -> None:
        """One thread more, or less. A notebook's output, or that of a test, is left alone."""
        with self.lock:
            if self.n == 0 and sys.stdout is sys.__stdout__:
                self.before, sys.stdout = sys.stdout, _ToStandardError()  # type: ignore[assignment]
            self.n += by
            if self.n == 0 and isinstance(sys.stdout, _ToStandardError):
                sys.stdout = self.before


_output = _Output()


@contextmanager
def kept() -> Iterator[None]:
    """Run code of a user's own in it. What it prints goes to standard error.

    Raises
    ------
    FolderChanged
        If it has changed the current folder.
    """
    folder = _folder()
    _output.divert(1)
    try:
        yield
    finally:
        _output.divert(-1)
        changed = _folder() != folder
        if changed and folder:
            os.chdir(folder)
    if changed:
        raise FolderChanged


def _folder() -> str:
    """The current folder; empty if it is gone."""
    with suppress(OSError):
        return os.getcwd()
    return ""
