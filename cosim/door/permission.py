"""Permission to load the Python code that a config names.

A config that the user names on the command line may name the user's own classes. A config that is part of a run folder
or study folder may not, unless the user allows it, because the author of the folder chose that code.
"""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

_UNTRUSTED: ContextVar[str] = ContextVar("untrusted", default="")
"""The untrusted folder or file of the config. Empty if the config may name code."""

_MARKS = frozenset({"manifest.json", "inventory.jsonl", "index.parquet"})
"""Names by which run folders and study folders are recognised, in any case, whatever has such a name."""
_OF_STUDIES = frozenset({"runs", "jobs"})
"""Folders of a study, whose items have names of 16 hexadecimal digits."""
_ID = re.compile("[0-9a-f]{16}", re.IGNORECASE)
_MOST_LINKS = 40


class CodeNotTrusted(ValueError):
    """A config in a folder names Python code. The option `--trust-code` allows loading it."""


@contextmanager
def loading_code(origin: Path | str, trusted: bool) -> Iterator[None]:
    """Within this context, code that a config names is loaded only if `trusted`. `origin` is the folder or file of the
    config."""
    if trusted:
        yield
        return
    token = _UNTRUSTED.set(str(origin))
    try:
        yield
    finally:
        _UNTRUSTED.reset(token)


@contextmanager
def loading_code_of(file: Path, trust_code: bool) -> Iterator[None]:
    """Within this context, code that a file names is loaded unless the file is part of a folder whose author chose it.

    `trust_code` is the user's permission.
    """
    origin = untrusted(file, trust_code)
    with loading_code(origin, not origin):
        yield


def untrusted(file: Path, trust_code: bool) -> str:
    """A file and the folder whose author chose its code, in words; empty if code that the file names may be loaded."""
    folder = None if trust_code else part_of(file)
    return "" if folder is None else f"{file} (part of {folder})"


def check_code(place: str) -> None:
    """Raise CodeNotTrusted if the config comes from an untrusted folder. The message is one line and begins with
    `place`."""
    if origin := _UNTRUSTED.get():
        raise CodeNotTrusted(
            f"{place}: {origin} names code of its own, which runs with all your rights. It was not loaded. Read "
            "that code first; in Python, pass trust_code=True."
        )


def part_of(file: Path) -> Path | None:
    """The run folder or study folder that a file is part of, at any depth; None if there is none.

    If the file is a link, this includes the folders of what it leads to.
    """
    for place in _places(file):
        if (found := next(filter(_is_of_a_run, Path(place).parents), None)) is not None:
            return found
    return None


def _places(file: Path) -> Iterator[str]:
    """Absolute paths of a file: as it is named, of each link that it leads to, and without any link."""
    place = os.path.abspath(file)
    yield os.path.realpath(place)
    for _ in range(_MOST_LINKS):
        yield place
        if not os.path.islink(place):
            return
        target = os.path.join(os.path.dirname(place), os.readlink(place))
        place = os.path.abspath(target)


def _is_of_a_run(folder: Path) -> bool:
    """Whether a folder is that of a run or a study, or was one before something was taken out of it."""
    names: list[str] = []
    with suppress(OSError):  # a folder that cannot be listed
        names = os.listdir(folder)
    if not _MARKS.isdisjoint(map(str.casefold, names)):
        return True
    if any(os.path.lexists(folder / mark) for mark in _MARKS):
        return True
    for name in names:
        if name.casefold() in _OF_STUDIES:
            with suppress(OSError):
                if any(map(_ID.fullmatch, os.listdir(folder / name))):
                    return True
    return False
