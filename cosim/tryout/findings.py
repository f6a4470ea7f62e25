"""What trying a class shows."""

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

_Item = TypeVar("_Item")


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
    size = len(items) // 2
    while size:
        at = 0
        while at < len(items):
            fewer = items[:at] + items[at + size :]
            if fewer and is_broken(fewer):
                items = fewer
            else:
                at += size
        size = min(size // 2, len(items) // 2) if size > 1 else 0
    return items


def in_one_line(error: Exception) -> str:
    """What went wrong, and in which line of which file."""
    reason = " ".join(str(error).split())
    if isinstance(error, ValueError) and reason:
        return reason
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {reason} ({last.filename}, line {last.lineno})."
