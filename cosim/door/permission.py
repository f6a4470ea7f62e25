"""Whether code that a config names may be loaded.

A config that the user names on the command line may name classes of the user's own. A config that comes with a run or
study folder may not, unless the user says so: whoever made the folder chose that code.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_UNTRUSTED: ContextVar[str] = ContextVar("untrusted", default="")
"""What a config came with that is not trusted; empty for one that may name code."""

_MADE = ("manifest.json", "index.parquet")
"""Files of run folders and of study folders."""


class CodeNotTrusted(ValueError):
    """A config that came with a folder names code of its own; the command goes on with `--trust-code`."""


@contextmanager
def loading_code(origin: Path, trusted: bool) -> Iterator[None]:
    """While it is entered, code that a config names is loaded only if `trusted`; `origin` is the folder or file that
    the config came with."""
    if trusted:
        yield
        return
    token = _UNTRUSTED.set(str(origin))
    try:
        yield
    finally:
        _UNTRUSTED.reset(token)


def check_code(place: str) -> None:
    """Refuse to load what a config of an untrusted folder names; CodeNotTrusted in one line that `place` begins."""
    if origin := _UNTRUSTED.get():
        raise CodeNotTrusted(
            f"{place}: {origin} names code of its own, which runs with all your rights. It was not loaded. Read "
            "that code first; in Python, pass trust_code=True."
        )


def is_of_a_folder(file: Path | None) -> bool:
    """Whether a config or study file belongs to a run folder or a study folder."""
    return file is not None and any((file.parent / name).is_file() for name in _MADE)
