"""Fenced blocks of a page: what is shown is what is run."""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[3]
PAGES = ROOT / "cosim" / "docs" / "pages"

_FENCE = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', flags=re.DOTALL | re.MULTILINE)


class Block(NamedTuple):
    """A fenced block: its language, the file that it is the content of, its text."""

    language: str
    title: str
    text: str


def blocks(text: str) -> list[Block]:
    """All fenced blocks of a page, in order."""
    return [Block(*found.groups(default="")) for found in _FENCE.finditer(text)]


def commands(text: str) -> list[str]:
    """Commands of the sh blocks of a page, one line each, comments and what follows a pipe left out."""
    found = []
    for block in blocks(text):
        if block.language == "sh":
            for line in block.text.replace("\\\n", " ").splitlines():
                line = re.sub(r"\s+#.*$", "", line).strip()
                if line and not line.startswith("#"):
                    found.append(line)
    return found


def is_printed(shown: str, printed: str) -> bool:
    """Whether a page's block `output` is what its command before printed.

    Spaces at the ends of lines and the width of gaps do not count. `...` stands for anything inside a line, and alone
    on its line for any lines: times and versions differ from machine to machine.
    """
    pattern = ""
    for line in shown.strip("\n").splitlines():
        if line.strip() == "...":
            pattern += r"(?:.*\n)*?"
        else:
            parts = (re.sub(r"(?:\\ |\s)+", r"[ \\t]+", re.escape(part.strip())) for part in line.split("..."))
            pattern += r"[ \t]*" + r"[^\n]*".join(parts) + r"[ \t]*\n"
    return re.fullmatch(pattern, printed.strip("\n") + "\n") is not None
