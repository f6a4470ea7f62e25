"""Results of the test of a class."""

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from cosim.door.blame import ExtensionError
from cosim.runs.checkpoint import CannotCheckpoint

_Item = TypeVar("_Item")
MOST_TRIES = 40
"""Approximate number of attempts to find a smaller example."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A law, and how the class breaks it."""

    law: str
    broken: str = ""
    """One or two sentences with the smallest example that was found. Empty if the law holds."""


@dataclass(frozen=True, slots=True)
class Report:
    """The results of the test of a class."""

    kind: str
    name: str
    findings: list[Finding]
    cost_us: float = float("nan")
    """Processing time of one call per vehicle [us]. NaN if it was not measured."""
    note: str = ""
    """What says less about the class than it seems. Empty if there is nothing to say."""

    @property
    def holds(self) -> bool:
        return not any(one.broken for one in self.findings)


def smallest(
    items: list[_Item],
    is_broken: Callable[[list[_Item]], bool],
) -> list[_Item]:
    """A small subset of items that still breaks a law. Chunks are removed, halves first, while the law stays broken."""
    size, n_tries = len(items) // 2, 0
    while size and n_tries < MOST_TRIES:
        at = 0
        while at < len(items):
            fewer = items[:at] + items[at + size :]
            n_tries += 1
            if fewer and is_broken(fewer):
                items = fewer
            else:
                at += size
        size = min(size // 2, len(items) // 2) if size > 1 else 0
    return items


def in_one_line(error: Exception) -> str:
    """The message of an exception in one line, with its file and line."""
    reason = " ".join(str(error).split())
    if isinstance(error, ValueError | ExtensionError | CannotCheckpoint) and reason:
        return reason if reason.endswith(".") else f"{reason}."
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {reason} ({last.filename}, line {last.lineno})."
