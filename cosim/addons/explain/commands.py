"""The commands `explain` and `cite`."""

from dataclasses import asdict
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from cosim.cli.console import AsJson, print_json, print_line, screen

if TYPE_CHECKING:
    from cosim.addons.explain.lookup import Explanation

MOST_SHOWN = 8
"""Number of meanings that are printed in full; of more, the names are printed."""


def explain(
    context: typer.Context,
    words: Annotated[list[str], typer.Argument(help="A key, metric, column, model, attack, command or term.")],
    as_json: AsJson = False,
) -> None:
    """Say what a key, metric, column, model, command or term means."""
    from cosim.addons.explain.lookup import commands, look_up

    program = context.find_root().command
    found = look_up(" ".join(words), lambda: commands(program))
    if as_json:
        print_json([asdict(entry) for entry in found])
        return
    if len(found) > MOST_SHOWN:
        print_line(f"{len(found)} names contain {' '.join(words)!r}:")
    for entry in found:
        _print(entry, in_full=len(found) <= MOST_SHOWN)


def _print(entry: "Explanation", in_full: bool) -> None:
    print_line(Text.assemble((entry.name, "bold"), f"  {entry.kind}"))
    if not in_full:
        return
    width = min(screen.width, 100)
    if entry.kind == "command":
        print_line(entry.meaning)
    else:
        indent = "  "
        print_line(fill(entry.meaning, width, initial_indent=indent, subsequent_indent=indent))
    if entry.where:
        print_line(f"  {entry.where}")


def cite(
    run: Annotated[Path, typer.Argument(help="Folder of a run or a study.")],
    as_bibtex: Annotated[bool, typer.Option("--bibtex", help="Print BibTeX.")] = False,
    as_json: AsJson = False,
) -> None:
    """Print references of exactly the parts that a run or study used."""
    from cosim.addons.explain.cite import bibtex, parts_of_all, references, text
    from results.archive import open_run
    from results.study import runs_of

    used = parts_of_all([open_run(folder, unfinished=True).manifest for folder in runs_of(run)])
    if as_bibtex:
        print_line(bibtex(used))
        return
    known = references()
    found = []
    for part in used:
        entries = [part.entry] if part.entry else [known[key] for key in part.references]
        found.append((part.what, [text(entry) for entry in entries]))
    if as_json:
        print_json([{"part": what, "references": lines} for what, lines in found])
        return
    for what, lines in found:
        print_line(Text(what, style="bold"))
        for line in lines or ["no publication"]:
            print_line(f"  {line}")
