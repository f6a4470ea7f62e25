"""The command `cosim validate`."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from rich.box import SIMPLE
from rich.table import Column, Table

from cosim.cli.console import AsJson, notes, print_json, progress, screen


def validate(
    only: Annotated[
        list[str] | None,
        typer.Argument(metavar="[FACT|GROUP]...", help="Facts or groups of facts. The default is all."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to write: a page and a picture per group.")] = Path("validation"),
    full: Annotated[bool, typer.Option("--full", help="More and longer runs: hours instead of minutes.")] = False,
    listed: Annotated[bool, typer.Option("--list", help="List the facts and their sources; compute nothing.")] = False,
    as_json: AsJson = False,
) -> None:
    """Compare what cosim computes with published and measured values. Exit status 1 if a stated agreement is lost."""
    from cosim.addons.compare import report
    from cosim.addons.compare.facts import chosen, load
    from cosim.addons.compare.runs import Runs

    facts, plans = load()
    asked = chosen(facts, only or [])
    if listed:
        if as_json:
            print_json([{"id": f.id, "group": f.group, "quantity": f.quantity, "source": f.source} for f in asked])
            return
        table = Table(Column("fact", no_wrap=True), "quantity", "source", box=SIMPLE)
        for fact in asked:
            table.add_row(fact.id, fact.quantity, fact.source)
        screen.print(table)
        return
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file. Give a folder.")
    with TemporaryDirectory(prefix="cosim-validate-") as scratch, progress() as advance:
        runs = Runs(Path(scratch), plans, full, lambda what, done, total: advance(what, done, total, ""))
        judged = report.judge(asked, runs, lambda what, done, total: advance(what, done, total, ""))
        files = report.write(judged, runs, out)
    if as_json:
        print_json(report.as_data(judged, runs))
    else:
        table = Table(Column("fact", no_wrap=True), "quantity", "verdict", "stated", box=SIMPLE)
        for one in judged:
            table.add_row(one.fact.id, one.fact.quantity, one.verdict, one.fact.verdict)
        screen.print(table)
        screen.print(report.summary(judged), soft_wrap=True)
        screen.print(f"written: {files[0]}", soft_wrap=True)
    for line in report.gained(judged):
        notes.print(line, soft_wrap=True)
    for line in (missing := report.lost(judged)):
        notes.print(f"lost: {line}", soft_wrap=True)
    if missing:
        raise typer.Exit(1)
