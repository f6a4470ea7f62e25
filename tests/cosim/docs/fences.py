"""Fenced blocks of a page: what is shown is what is run.

A block without a reason before it, `<!-- not run: it needs a scheduler -->`, is run, written to its file, read as a
config or compared with what the block before printed. Blocks of the languages in `SHOWN` are for the eye alone.
"""

import re
from difflib import SequenceMatcher
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[3]
PAGES = ROOT / "cosim" / "docs" / "pages"
SOURCES = {
    path.relative_to(ROOT).as_posix(): path
    for path in sorted(
        [*ROOT.glob("*.md"), *(p for room in ("cosim", "results", "sensors", "sumo_nets", "trust")
                               for p in (ROOT / room).rglob("*.md"))]
    )
}  # fmt: skip
"""All pages, wherever they are in the repository."""
SHOWN = ("text", "math")

_FENCE = re.compile(
    r'(?:^<!-- not run: ([^\n]+) -->\n\n?)?^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', flags=re.DOTALL | re.MULTILINE
)


class Block(NamedTuple):
    """A fenced block: why it is not run, its language, the file that it is the content of, its text."""

    excuse: str
    language: str
    title: str
    text: str


def blocks(text: str) -> list[Block]:
    """All fenced blocks of a page, in order."""
    return [Block(*found.groups(default="")) for found in _FENCE.finditer(text)]


def with_texts(text: str, texts: dict[int, str]) -> str:
    """The page with other texts in the blocks of these numbers."""
    for number, found in reversed(list(enumerate(_FENCE.finditer(text)))):
        if number in texts:
            text = text[: found.start(4)] + texts[number] + text[found.end(4) :]
    return text


def commands(text: str) -> list[str]:
    """Commands of the sh blocks of a page, also of those that are not run, one line each, without comments."""
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
            pattern += _line(line) + r"\n"
    return re.fullmatch(pattern, printed.strip("\n") + "\n") is not None


def _line(shown: str) -> str:
    parts = (re.sub(r"(?:\\ |\s)+", r"[ \\t]+", re.escape(part.strip())) for part in shown.split("..."))
    return r"[ \t]*" + r"[^\n]*".join(parts) + r"[ \t]*"


def recorded(shown: str, printed: str) -> str:
    """What a block `output` shows after its command has printed something else.

    A line with `...` stays if it still fits a printed line. Lines between two `...` that stand alone are printed lines
    from the one that is most like the first of them to the one that is most like the last.
    """
    old, new = shown.strip("\n").splitlines(), [line.rstrip() for line in printed.strip("\n").splitlines()]
    holes = [line for line in old if "..." in line and line.strip() != "..."]
    kept = [next((hole for hole in holes if re.fullmatch(_line(hole), line)), line) for line in new]
    alone = [n for n, line in enumerate(old) if line.strip() == "..."]
    found, at = [], 0
    for begin, end in pairwise([-1, *alone, len(old)]):
        part = old[begin + 1 : end]
        if part:
            first = 0 if begin < 0 else at + _most_like(part[0], kept[at:])
            at = len(kept) if end == len(old) else first + _most_like(part[-1], kept[first:]) + 1
            found += kept[first:at]
        found += old[end : end + 1]
    return "\n".join(found) + "\n"


def _most_like(line: str, lines: list[str]) -> int:
    """Number of the line that is most like another one, the first of several."""
    return max(range(len(lines)), key=lambda n: SequenceMatcher(None, line, lines[n]).ratio(), default=0)
