"""The command `cite`: references of exactly the parts that a run used."""

from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from cosim.cli.console import AsJson, print_json, screen


def add_to(app: typer.Typer) -> None:
    """Add the command `cite`."""
    app.command()(cite)


def cite(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    as_bibtex: Annotated[bool, typer.Option("--bibtex", help="Print BibTeX.")] = False,
    as_json: AsJson = False,
) -> None:
    """Print references of exactly the parts that a run used."""
    from results.archive import open_run
    from results.cite import bibtex, parts, references, text

    manifest = open_run(run, unfinished=True).manifest
    if as_bibtex:
        screen.print(bibtex(manifest), soft_wrap=True)
        return
    known = references()
    found = []
    for part in parts(manifest):
        entries = [part.entry] if part.entry else [known[key] for key in part.references]
        found.append((part.what, [text(entry) for entry in entries]))
    if as_json:
        print_json([{"part": what, "references": lines} for what, lines in found])
        return
    for what, lines in found:
        screen.print(Text(what, style="bold"), soft_wrap=True)
        for line in lines or ["no publication"]:
            screen.print(f"  {line}", soft_wrap=True)
