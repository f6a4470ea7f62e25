"""The command `cosim compare`."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE
from rich.table import Column, Table

from cosim.cli.console import AsJson, print_json, print_line, print_note, progress, screen

if TYPE_CHECKING:
    from cosim.addons.compare.facts import Fact


def compare(
    only: Annotated[
        list[str] | None,
        typer.Argument(metavar="[FACT|GROUP]...", help="Facts or groups of facts. The default is all."),
    ] = None,
    own: Annotated[
        list[Path] | None,
        typer.Option("--run", help="Measure in this run instead, which is a replicate. Repeatable."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to write: a page, its table, and JSON.")] = Path("compare"),
    full: Annotated[bool, typer.Option("--full", help="More and longer runs: hours instead of minutes.")] = False,
    listed: Annotated[bool, typer.Option("--list", help="List the facts and their sources; compute nothing.")] = False,
    as_json: AsJson = False,
) -> None:
    """Put published and measured values beside what cosim computes. Exit status 1 if a stated agreement is lost."""
    from cosim.addons.compare import report
    from cosim.addons.compare.facts import chosen, load
    from cosim.addons.compare.runs import GivenRuns, PlannedRuns

    facts, plans = load()
    asked = chosen(facts, only or [])
    if listed:
        _list(asked, as_json)
        return
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file. Give a folder.")
    if own and full:
        raise ValueError("--full makes runs, and --run names them. Choose one.")
    with TemporaryDirectory(prefix="cosim-compare-") as scratch, progress() as advance:
        runs = GivenRuns.opened(own, plans) if own else PlannedRuns(Path(scratch), plans, full, advance)
        if own:
            asked = [fact for fact in asked if len(fact.runs) == 1]
        compared = report.compare(asked, runs, advance)
    files = report.write(compared, runs, out)
    if as_json:
        print_json(report.as_data(compared, runs))
    else:
        table = Table(Column("fact", no_wrap=True), *report.COLUMNS[1:], box=SIMPLE)
        for one in compared:
            table.add_row(*report.cells(one))
        screen.print(table)
        print_line(report.summary(compared))
        print_line(f"written: {files[0]}")
    if own:
        n = sum(bool(one.unlike) for one in compared)
        print_note(
            f"note: {n} facts are stated for runs with keys that these runs set otherwise; the page names them. "
            "Whether the conditions of the other facts hold is for you to say."
        )
        return
    for line in report.gained(compared):
        print_note(line)
    for line in (missing := report.lost(compared)):
        print_note(f"lost: {line}")
    if missing:
        raise typer.Exit(1)


def _list(facts: "Sequence[Fact]", as_json: bool) -> None:
    if as_json:
        keys = "id", "group", "quantity", "source"
        print_json([{key: getattr(fact, key) for key in keys} for fact in facts])
        return
    table = Table(Column("fact", no_wrap=True), "quantity", "source", box=SIMPLE)
    for fact in facts:
        table.add_row(fact.id, fact.quantity, fact.source)
    screen.print(table)
