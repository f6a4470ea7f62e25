"""Permission to load the Python code that a config names.

A config that the user names on the command line may name the user's own classes. A config in a run folder or study
folder may not, unless the user allows it, because the author of the folder chose that code.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_UNTRUSTED: ContextVar[str] = ContextVar("untrusted", default="")
"""The untrusted folder or file of the config. Empty if the config may name code."""

_MADE = ("manifest.json", "index.parquet")
"""Files by which run folders and study folders are recognised."""


class CodeNotTrusted(ValueError):
    """A config in a folder names Python code. The option `--trust-code` allows loading it."""


@contextmanager
def loading_code(origin: Path, trusted: bool) -> Iterator[None]:
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


def check_code(place: str) -> None:
    """Raise CodeNotTrusted if the config comes from an untrusted folder. The message is one line and begins with
    `place`."""
    if origin := _UNTRUSTED.get():
        raise CodeNotTrusted(
            f"{place}: {origin} names code of its own, which runs with all your rights. It was not loaded. Read "
            "that code first; in Python, pass trust_code=True."
        )


def is_of_a_folder(file: Path | None) -> bool:
    """Whether a config or study file belongs to a run folder or a study folder."""
    return file is not None and any((file.parent / name).is_file() for name in _MADE)
