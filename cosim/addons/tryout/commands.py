"""Commands for authors of extensions: `new` writes an example, `try` checks a class."""

import shlex
import sys
from importlib.metadata import packages_distributions
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

import typer

from cosim.cli.console import AsJson, plain, print_json, print_line

Kind = Literal["trust", "attack", "policy", "medium", "detector", "driver", "exporter", "metric"]


_PACKAGES = ("cosim", "sensors", "trust", "results", "sumo_nets")


def new(
    kind: Annotated[Kind, typer.Argument(help="The kind of extension.")],
    path: Annotated[Path, typer.Argument(metavar="NAME.py", help="File to write.")],
) -> None:
    """Write a small working example of a class, which you then change."""
    if path.suffix != ".py":
        raise ValueError(f"{path}: the file of a class ends in .py. Write for example cosim new {kind} mine.py.")
    if path.stem in {*_PACKAGES, *sys.stdlib_module_names, *packages_distributions()}:
        raise ValueError(f"{path}: a file of this name would hide the package {path.stem}. Give another name.")
    example = files("cosim.addons.tryout.templates").joinpath(f"{kind}.py").read_text(encoding="utf-8")
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(example)
    except FileExistsError:
        raise ValueError(f"{path} is there already. Give another name.") from None
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error.strerror or error}. Give another name.") from None
    name = f"{path}:My{kind.capitalize()}"
    print_line(f"wrote {path}")
    print_line(f"check it:  cosim try {shlex.quote(name)}")
    print_line(f"use it:    {_use(kind, name)}")


def _use(kind: str, name: str) -> str:
    """The command or the lines of a config that use a class."""
    from cosim.door.kinds import KINDS

    if kind == "exporter":
        return f"cosim export {shlex.quote(name)} RUN --out FOLDER"
    if kind == "metric":
        return f"cosim measure RUN --metric {shlex.quote(name)}"
    section = KINDS[kind].section
    head, share = ("[[attacks]]", "\n           share_p = 0.2") if kind == "attack" else (f"[{section}]", "")
    return f'in the config\n           {head}\n           {KINDS[kind].key} = "{name}"{share}'


def try_(
    name: Annotated[
        str, typer.Argument(metavar="FILE:CLASS", help="A class such as mine.py:Beta, or the name of a shipped one.")
    ],
    kind: Annotated[
        Kind | None, typer.Option(help="The kind of the class. Needed only if its methods do not tell.")
    ] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", help="Set one of its parameters, key=value. Repeatable.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check on a tiny scene whether your class keeps its rules. Exit status 1 if it does not."""
    from cosim.addons.tryout.tryout import try_class

    report = try_class(name, kind, sets or [])
    if as_json:
        print_json(
            {
                "class": report.name,
                "kind": report.kind,
                "holds": report.holds,
                "laws": [{"law": one.law, "holds": not one.broken, "found": one.broken} for one in report.findings],
                "cost_us_per_vehicle": None if report.cost_us != report.cost_us else report.cost_us,
                "note": report.note,
            }
        )
    else:
        for one in report.findings:
            print_line(f"{'broken' if one.broken else 'ok':<8}{one.law}")
            if one.broken:
                print_line(f"        {one.broken}")
        if report.cost_us == report.cost_us:
            print_line(f"cost    {plain(report.cost_us)} microseconds per vehicle and call")
        if report.note:
            print_line(f"note    {report.note}")
    if not report.holds:
        raise typer.Exit(1)
