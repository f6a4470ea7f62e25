"""What the commands print: tables and sentences for people, JSON for programs."""

import json
import math
import os
import sys
import textwrap
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from cosim.cli.help import MORE

if TYPE_CHECKING:
    from rich.table import Table


_PIPED_WIDTH = 160
"""Width of tables, in characters, when standard output is not a terminal."""
_WHOLE = 10_000
"""Width of tables that need not fit anything."""


def clean(text: str) -> str:
    """Text of others as a terminal may get it.

    What a terminal or a reader's eye would obey becomes a replacement character: escape sequences, both sets of control
    characters, and marks that turn the direction of the text. Line breaks and blanks stay.
    """
    return "".join(c if _is_harmless(c) else "\N{REPLACEMENT CHARACTER}" for c in text)


def _is_harmless(c: str) -> bool:
    return c.isprintable() or c == "\n" or unicodedata.category(c) == "Zs"


class _CleanConsole(Console):
    """A console that shows text of others without obeying it. All that the commands print goes through `render`."""

    def render_str(self, text: str, **how: Any) -> Text:  # type: ignore[override]
        """A string before it is measured, so that a table has room for what it shows."""
        return super().render_str(clean(text), **how)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The segments of what is printed; those of the console itself, such as the movements of a bar, are kept."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(clean(segment.text), segment.style)


_is_piped = (sys.stdout is None or not sys.stdout.isatty()) and "COLUMNS" not in os.environ
_PLAIN: dict[str, Any] = {"markup": False, "highlight": False, "emoji": False}
"""Names from the user are shown unchanged."""
screen = _CleanConsole(width=_PIPED_WIDTH if _is_piped else None, **_PLAIN)
notes = _CleanConsole(stderr=True, **_PLAIN)

ConfigPath = Annotated[
    Path | None, typer.Argument(help="Config file (TOML). Without one, the default city is used.", show_default=False)
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Change one key of the config, e.g. radio.range_m=150. Repeatable."
    ),
]
Preset = Annotated[
    str | None, typer.Option(help="Start from these keys: modern or paper. The same as --set preset=NAME.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.", rich_help_panel=MORE)]
TrustCode = Annotated[
    bool,
    typer.Option(
        "--trust-code",
        help="Allow the config in a folder to load its author's classes. Such code runs with all your rights.",
        rich_help_panel=MORE,
    ),
]


def with_preset(preset: str | None, overrides: list[str] | None) -> list[str]:
    """Changes of a config, with the preset as the first of them."""
    return [*([] if preset is None else [f"preset={preset}"]), *(overrides or [])]


def duration(seconds: float) -> str:
    """A rough duration in words."""
    if seconds < 90:
        rounded = round(seconds, -1) if seconds >= 20 else max(1, round(seconds))
        return f"{rounded:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    hours = seconds / 3600
    return f"{hours:.1f} h" if hours < 10 else f"{hours:.0f} h"


@contextmanager
def progress() -> Iterator[Callable[[str, int, int, str], None]]:
    """Progress bars on a terminal, one per phase; nothing is shown elsewhere.

    The function that it yields takes the phase, the work done, the total and a note.
    """
    from rich.progress import (  # imported here because most commands show no progress
        BarColumn,
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
    )

    bar = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"),
        TextColumn("{task.fields[note]}"),
        console=notes,
        disable=not notes.is_terminal,
    )
    tasks: dict[str, Any] = {}
    begun: dict[str, tuple[int, float]] = {}

    def advance(phase: str, done: int, total: int, note: str = "") -> None:
        if phase not in tasks:
            tasks[phase] = bar.add_task(phase, total=total, note=note, left="")
            begun[phase] = done, monotonic()
        left = time_left(begun[phase], done, total, monotonic())
        bar.update(tasks[phase], completed=done, total=total, note=note, left=left)

    with bar:
        yield advance


def time_left(begun: tuple[int, float], done: int, total: int, now_s: float) -> str:
    """How long the rest of some work takes if it goes on as it went since it began; empty as long as nothing is done.

    Runs of a study end several at a time, so the time between the last of them says nothing.
    """
    first, begun_s = begun
    if done <= first:
        return ""
    seconds = round((now_s - begun_s) * (total - done) / (done - first))
    return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02}"


def _as_json(content: object) -> object:
    """Content with None in place of numbers that JSON has no word for: none, and those that are infinite."""
    if isinstance(content, Mapping):
        return {key: _as_json(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [*map(_as_json, content)]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def print_note(text: str) -> None:
    """Print a sentence on standard error; the terminal wraps it."""
    notes.print(text, soft_wrap=True)


def print_line(text: str | Text) -> None:
    """Print text on standard output; the terminal wraps it."""
    screen.print(text, soft_wrap=True)


def print_json(content: object) -> None:
    """JSON on standard output. What a terminal would obey is escaped, so that a program reads it unchanged."""
    text = json.dumps(_as_json(content), indent=1, ensure_ascii=False, default=str, allow_nan=False)
    for character in set(text):
        if not _is_harmless(character):
            escape = json.dumps(character)[1:-1]
            text = text.replace(character, escape)
    sys.stdout.write(text + "\n")


def print_table(table: "Table") -> None:
    """A table with names from the user, which are not cut where standard output is no terminal."""
    if screen.is_terminal:
        screen.print(table)
        return
    width, screen.width = screen.width, _WHOLE  # `print` takes no width beyond the console's
    screen.print(table, crop=False)
    screen.width = width


def print_facts(facts: Mapping[str, Sequence[str]]) -> None:
    """Sentences under names. On a terminal their further lines are indented as the first."""
    for name, sentences in facts.items():
        label = name
        for sentence in sentences:
            lines = [sentence]
            if screen.is_terminal:
                lines = textwrap.wrap(
                    sentence, max(screen.width - 12, 30), break_long_words=False, break_on_hyphens=False
                )
            for line in lines:
                print_line(Text.assemble((f"{label:<12}", "bold"), line))
                label = ""


def print_metrics(as_json: bool) -> None:
    """Print every metric with its unit and definition."""
    from results.metrics.registry import METRICS, TOPICS

    if as_json:
        print_json({name: asdict(metric) for name, metric in METRICS.items()})
        return

    for topic, about in TOPICS.items():
        print_line(Text(f"{topic}: {about}", style="bold"))
        for name, metric in METRICS.items():
            if name.startswith(topic + "."):
                unit = f" [{metric.unit}]" if metric.unit not in ("", "1") else ""
                by = f" By {metric.group}." if metric.group else ""
                print_line(Text(f"  {name}{unit}: {metric.definition}{by}"))


def print_done(done: dict[str, Any], said: str, as_json: bool) -> None:
    """Print what a command has done or found, as JSON or as text."""
    if as_json:
        print_json(done)
    else:
        print_line(said)


def rows_of(table: Any) -> list[dict[str, object]]:
    """Metrics as dictionaries. Values that are not finite become None, such as an unknown upper bound."""
    rows = table.to_dict("records")
    for row in rows:
        for name, value in row.items():
            if isinstance(value, float) and not math.isfinite(value):
                row[name] = None
    return rows  # type: ignore[no-any-return]


def plain(value: float) -> str:
    """A number as text: three significant digits, all digits of a whole number, no exponent."""
    size = abs(value)
    is_whole = size >= 100 or (size >= 2 and value == int(value))
    return f"{value:,.0f}" if is_whole else f"{value:.3g}"


def _interval(row: Mapping[str, Any]) -> str:
    """The confidence interval of a metric as text; empty if it has none."""
    low, high = row.get("low"), row.get("high")
    if low is None or low != low:
        return ""
    return f"{plain(low)} or more" if high is None else f"{plain(low)} to {plain(high)}"


def print_rows(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Metrics on the terminal: the name, and below it a line per group with value, unit, 95 % interval and note.

    A short metric without groups takes one line. The lines fit into 80 columns, but for long notes.
    """
    n_rows = Counter(row["metric"] for row in rows)
    cells: list[tuple[str, ...]] = []
    last = ""
    for row in rows:
        metric, group = str(row["metric"]), str(row["group"] or "")
        is_alone = not group and n_rows[metric] == 1 and len(metric) <= _LABEL
        if last and metric.split(".")[0] != last.split(".")[0]:
            cells.append(("",))
        if metric != last and not is_alone:
            cells.append((metric,))
        label = metric if is_alone else f"  {group}"
        last = metric
        if row["value"] is None:  # the group is a sentence, which would move all values far to the right
            cells.append((label,))
            continue
        unit = "" if row["unit"] == "1" else str(row["unit"])
        note = str(row.get("note") or "")
        cells.append((label, plain(row["value"]), unit, _interval(row), note))
    values = [row for row in cells if len(row) > 1]
    wide = [max(map(len, column), default=0) for column in zip(*values, strict=True)]

    def line_of(name: str, value: str, unit: str, interval: str, note: str) -> str:
        measured = f"{value.rjust(wide[1])} {unit.ljust(wide[2])}"
        columns = [name.ljust(wide[0]), measured, interval.ljust(wide[3]), note]
        return "  ".join(columns).rstrip()

    lines = [line_of(*row) if len(row) > 1 else row[0] for row in cells]
    head = [Text(title, style="bold"), Text("value, unit, 95 % interval", style="dim"), Text()]
    for line in (*head, *map(Text, lines)):
        print_line(line)


_LABEL = 40
"""Letters of the longest metric that shares a line with its value."""
