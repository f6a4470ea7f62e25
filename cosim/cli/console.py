"""What the commands print: tables and sentences for people, JSON for programs."""

import json
import math
import os
import shlex
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

    from results.run import Run

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


screen = _CleanConsole(  # without markup, so that names from the user are shown unchanged
    markup=False, highlight=False, emoji=False,
    width=None if (sys.stdout is not None and sys.stdout.isatty()) or "COLUMNS" in os.environ else _PIPED_WIDTH,
)  # fmt: skip
notes = _CleanConsole(stderr=True, markup=False, highlight=False, emoji=False)

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

Get = Callable[[str], Mapping[str, float]]
"""Values of a metric by group; empty if the metric has no value."""
GetRows = Callable[[str], Mapping[str, Mapping[str, Any]]]
"""Rows of `measure` of a metric by group: value, low, high, note."""

SUMMARY_METRICS = (
    "traffic.duration_s", "traffic.actors.mean", "traffic.equipped.n", "encounters.n",
    "encounters.duration.km_median_s", "encounters.duration.km_mean_s", "trust.final.median",
    "misbehaviour.at_lookup.auc", "misbehaviour.auc", "freshness.lookup_state.share",
    "freshness.newest_evaluation_age.mean_s", "freshness.newest_evaluation_age.p90_s", "radio.pdr.all",
    "radio.lost.expired", "radio.clouds_complete.share", "radio.cbr.mean", "radio.pir.mean_s",
)  # fmt: skip
"""Metrics that the summary at the end of a run uses."""


def with_preset(preset: str | None, overrides: list[str] | None) -> list[str]:
    """Changes of a config, with the preset as the first of them."""
    return [*([] if preset is None else [f"preset={preset}"]), *(overrides or [])]


def duration(seconds: float) -> str:
    """A rough duration in words."""
    if seconds < 90:
        return f"{max(1, round(seconds, -1) if seconds >= 20 else round(seconds)):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 36000 else f"{seconds / 3600:.0f} h"


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
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"), TextColumn("{task.fields[note]}"), console=notes,
        disable=not notes.is_terminal,
    )  # fmt: skip
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


def print_json(content: object) -> None:
    """JSON on standard output. What a terminal would obey is escaped, so that a program reads it unchanged."""
    text = json.dumps(_as_json(content), indent=1, ensure_ascii=False, default=str, allow_nan=False)
    for character in set(text):
        if not _is_harmless(character):
            escape = json.dumps(character)[1:-1]
            text = text.replace(character, escape)
    sys.stdout.write(text + "\n")


def print_run_summary(folder: Path, as_json: bool) -> "Run":
    """Print a summary of a run in a few lines, and draw trust over time into its folder.

    Returns
    -------
    The run. Its attribute `damage` lists what could not be shown.
    """
    from results.archive import open_run
    from results.figures import style, trust
    from results.measure import measure

    run = open_run(folder)
    try:
        picture = f"picture {style.save(trust.draw([run]), folder / 'trust.png')}"
    except ValueError:  # there is no trust to draw
        picture = "no picture of trust"
    manifest = run.manifest
    spent_s = sum(manifest["timings_s"].values())
    if as_json:
        measures = rows_of(measure(run, max_frames=200))
        print_json({"run": str(folder), "summary": manifest["summary"], "seconds": spent_s, "measures": measures})
        return run
    topics = tuple(dict.fromkeys(name.split(".")[0] for name in SUMMARY_METRICS))
    frame = measure(run, topics=topics)
    by_metric: dict[str, dict[str, Any]] = {}
    for row in frame.to_dict("records"):
        by_metric.setdefault(row["metric"], {})[row["group"]] = row

    def rows(metric: str) -> Mapping[str, Mapping[str, Any]]:
        assert metric in SUMMARY_METRICS, metric
        return by_metric.get(metric, {})

    resumed_at = manifest.get("resumed_at", [])
    n_steps = manifest["steps"] - (resumed_at[-1] if resumed_at else 0)
    speed = plain(n_steps * run.dt_s / spent_s)
    since = f" since step {resumed_at[-1]:,}, where it was resumed" if resumed_at else ""
    given = shlex.quote(str(folder))
    print_facts(
        _summary(rows, manifest.get("net", {}).get("name", "the network"), run.config["sensing"])
        | {
            "time": [f"{spent_s:.1f} s of computing{since}, {speed} times real time; wrote {folder}, {picture}"],
            "next": [f"cosim report {given}   cosim measure {given}" + _pictures(rows, given)],
        }
    )
    return run


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
                screen.print(Text.assemble((f"{label:<12}", "bold"), line), soft_wrap=True)
                label = ""


def _pictures(rows: GetRows, given: str) -> str:
    """A command that draws a figure of this run; empty if the run has nothing to draw."""
    for picture, metric in (("radio", "radio.pdr.all"), ("encounters", "encounters.n")):
        if rows(metric):
            return f"   cosim plot {picture} {given}"
    return ""


def _summary(rows: GetRows, city: str, has_sensing: bool = True) -> dict[str, list[str]]:
    """Sentences of the summary by topic."""

    def get(metric: str) -> Mapping[str, float]:
        return {group: row["value"] for group, row in rows(metric).items()}

    apart = _told_apart(rows)
    moved = {"traffic": _traffic(get, city), "encounters": _encounters(get, rows)}
    if not has_sensing:
        return moved | {"sensing": ["false: no vehicle senses or sends, and no trust is computed"]}
    return moved | {
        "trust": _trust(rows),
        **({"told apart": apart} if apart else {}),
        "freshness": _freshness(get),
        "radio": _radio(get),
    }


def _traffic(get: Get, city: str) -> list[str]:
    actors, roles = get("traffic.actors.mean"), get("traffic.equipped.n")
    n_actors = plain(round(actors.get("all", 0.0)))
    line = f"{n_actors} actors on the road of {city} for {plain(get('traffic.duration_s')[''])} s"
    n_equipped = sum(roles.values())
    if not n_equipped:
        return [f"{line}; no vehicle with LiDAR and radio"]
    by_role = [f"{plain(n)} {role}" for role, n in roles.items()]
    return [f"{line}; {plain(n_equipped)} vehicles with LiDAR and radio ({', '.join(by_role)})"]


def _encounters(get: Get, rows: GetRows) -> list[str]:
    median_s, mean_s = get("encounters.duration.km_median_s"), rows("encounters.duration.km_mean_s")
    lines = []
    for definition, n in get("encounters.n").items():
        said = f"{plain(n)} ({definition})"
        if definition in median_s:
            said += f": half of them last longer than {plain(median_s[definition])} s"
        elif definition in mean_s and mean_s[definition]["note"]:
            said += f": {mean_s[definition]['note']}"
        lines.append(said)
    return lines or ["none: the config defines no [[encounters]]"]


def _trust(rows: GetRows) -> list[str]:
    final = rows("trust.final.median")
    if not final:
        return ["no trust was computed"]
    medians = [f"{row['value']:.2f} {role}" for role, row in final.items()]
    return [f"{', '.join(medians)}: medians of last values, from 0 to 1"]


def _told_apart(rows: GetRows) -> list[str]:
    """How often an honest vehicle has more trust than one of another role, in one line."""
    at_lookup = rows("misbehaviour.at_lookup.auc")
    found = at_lookup or rows("misbehaviour.auc")
    parts: list[str] = []
    for role, row in found.items():
        parts.append(_comparison(role, row, is_first=not parts))
    if parts:
        parts[-1] += ", when trust is looked up" if at_lookup else ", over the run"
    idle = [role for role, row in rows("trust.final.median").items() if row["note"].startswith("has not attacked")]
    if idle:
        parts.append(f"no {' or '.join(idle)} vehicle has attacked: until then they behave as honest ones")
    return ["; ".join(parts)] if parts else []


def _a(word: str) -> str:
    """A role with its article: an honest vehicle, a malicious one."""
    return f"{'an' if word.startswith(('a', 'e', 'i', 'o', 'u', 'honest')) else 'a'} {word}"


def _comparison(role: str, row: Mapping[str, Any], is_first: bool) -> str:
    """The area under the ROC curve in words. If its interval contains 0.5, it is no better than chance."""
    low, high = row["low"], row["high"]
    known = low == low and high == high
    chance = ": no better than chance" if known and low <= 0.5 <= high else ""
    interval = f" ({'95 % interval ' if is_first else ''}{low:.0%} to {high:.0%}{chance})" if known else ""
    who = "an honest vehicle has more trust than " if is_first else "than "
    return f"{row['value']:.0%} of the time {who}{_a(role)} one{interval}"


def _freshness(get: Get) -> list[str]:
    state = {name.removesuffix(", all"): x for name, x in get("freshness.lookup_state.share").items()}
    if not state:
        return ["no vehicle looked up a trust value"]
    mean_s, p90_s = (get(f"freshness.newest_evaluation_age.{name}").get("all") for name in ("mean_s", "p90_s"))
    parts = []
    if mean_s is not None:
        tail = "" if p90_s is None else f", and one in ten is older than {p90_s:.1f} s"
        parts.append(f"{mean_s:.1f} s old is the newest evaluation behind a trust value that is used{tail}")
    parts.append(f"{state['evaluated']:.0%} of lookups find a value that rests on evaluations that still count")
    return ["; ".join(parts)]


def _radio(get: Get) -> list[str]:
    if "" not in get("radio.pdr.all"):
        return ["nothing was sent within range of another vehicle"]
    parts = [f"{get('radio.pdr.all')['']:.0%} of frames received by vehicles in range"]
    expired = get("radio.lost.expired").get("", 0.0)
    if expired > 0.01:
        parts.append(f"{expired:.0%} expired before they could be sent")
    if "" in get("radio.clouds_complete.share"):
        parts.append(f"{get('radio.clouds_complete.share')['']:.0%} of point clouds arrive whole")
    if "" in get("radio.cbr.mean"):
        parts.append(f"{get('radio.cbr.mean')['']:.1%} of the time the channel is busy")
    if "" in get("radio.pir.mean_s"):
        parts.append(f"{get('radio.pir.mean_s')['']:.1f} s between messages of a pair")
    return ["; ".join(parts)]


def print_metrics(as_json: bool) -> None:
    """Print every metric with its unit and definition."""
    from results.metrics.registry import METRICS, TOPICS

    if as_json:
        print_json({name: asdict(metric) for name, metric in METRICS.items()})
        return

    for topic, about in TOPICS.items():
        screen.print(Text(f"{topic}: {about}", style="bold"), soft_wrap=True)
        for name, metric in METRICS.items():
            if name.startswith(topic + "."):
                unit = f" [{metric.unit}]" if metric.unit not in ("", "1") else ""
                by = f" By {metric.group}." if metric.group else ""
                screen.print(Text(f"  {name}{unit}: {metric.definition}{by}"), soft_wrap=True)


def print_done(done: dict[str, Any], said: str, as_json: bool) -> None:
    """Print what a command has done or found, as JSON or as text."""
    if as_json:
        print_json(done)
    else:
        screen.print(said, soft_wrap=True)


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
        value = "" if row["value"] is None else plain(row["value"])
        unit = "" if row["unit"] == "1" else str(row["unit"])
        note = str(row.get("note") or "")
        cells.append((label, value, unit, _interval(row), note))
        last = metric
    values = [row for row in cells if len(row) > 1]
    wide = [max(map(len, column), default=0) for column in zip(*values, strict=True)]

    def line_of(name: str, value: str, unit: str, interval: str, note: str) -> str:
        measured = f"{value.rjust(wide[1])} {unit.ljust(wide[2])}"
        columns = [name.ljust(wide[0]), measured, interval.ljust(wide[3]), note]
        return "  ".join(columns).rstrip()

    lines = [line_of(*row) if len(row) > 1 else row[0] for row in cells]
    head = [Text(title, style="bold"), Text("value, unit, 95 % interval", style="dim"), Text()]
    for line in (*head, *map(Text, lines)):
        screen.print(line, soft_wrap=True)


_LABEL = 40
"""Letters of the longest metric that shares a line with its value."""
