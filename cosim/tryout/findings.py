"""What trying a class shows."""

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from cosim.door.blame import ExtensionError
from cosim.execution.checkpoint import CannotCheckpoint

_Item = TypeVar("_Item")
MOST_TRIES = 40
"""Attempts at a smaller example, about."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A law, and how it is broken."""

    law: str
    broken: str = ""
    """One sentence or two with the smallest example found; empty where the law holds."""


@dataclass(frozen=True, slots=True)
class Report:
    """What trying a class has shown."""

    kind: str
    name: str
    findings: list[Finding]
    cost_us: float = float("nan")
    """Time of one call per vehicle [us]; NaN where nothing was measured."""

    @property
    def holds(self) -> bool:
        return not any(one.broken for one in self.findings)


def smallest(items: list[_Item], is_broken: Callable[[list[_Item]], bool]) -> list[_Item]:
    """As few items as still break a law: chunks are left out, halves first, while it stays broken."""
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
    """What went wrong, and in which line of which file."""
    reason = " ".join(str(error).split())
    if isinstance(error, ValueError | ExtensionError | CannotCheckpoint) and reason:
        return reason if reason.endswith(".") else f"{reason}."
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {reason} ({last.filename}, line {last.lineno})."
