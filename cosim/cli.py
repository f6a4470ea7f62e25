"""The commands."""

import json
import sys
from pathlib import Path
from typing import Annotated, Literal

import click
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Co-simulation of cooperative perception under trust at city scale.",
)
nets = typer.Typer(no_args_is_help=True, help="The cities that ship.")
app.add_typer(nets, name="nets")

screen = Console()
notes = Console(stderr=True)

ConfigPath = Annotated[Path | None, typer.Argument(help="TOML file; without one, the shipped city.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="Change one key, e.g. radio.reach_m=150. Repeatable.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Answer in JSON on standard output.")]
RunPath = Annotated[Path, typer.Argument(help="Folder that `cosim run` wrote.")]


@app.command()
def run(
    config: ConfigPath = None,
    overrides: Overrides = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write; by default the next runs/<city>-N.")] = None,
    as_json: AsJson = False,
) -> None:
    """Drive, sense, talk and trust; write a run folder."""
    from cosim import run as running
    from cosim.config import load

    experiment = load(config, overrides)
    bar = Progress(
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TimeRemainingColumn(), TextColumn("{task.fields[note]}"), console=notes, disable=not notes.is_terminal,
    )  # fmt: skip
    with bar:
        tasks: dict[str, object] = {}

        def advance(phase: str, done: int, total: int, note: str = "") -> None:
            if phase not in tasks:
                tasks[phase] = bar.add_task(phase, total=total, note=note)
            bar.update(tasks[phase], completed=done, note=note)  # type: ignore[arg-type]

        folder = running.run(experiment, out, advance)
    _show_measures(folder, as_json)


@app.command()
def check(config: ConfigPath = None, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Say whether a config would run, and print it resolved."""
    import tomli_w

    from cosim import run as running
    from cosim.config import load

    experiment = load(config, overrides)
    running.check(experiment)
    if as_json:
        _print_json(experiment.to_dict())
    else:
        screen.print(tomli_w.dumps(running.without_nulls(experiment.to_dict())), highlight=False, markup=False)


@app.command()
def measure(runs: Annotated[list[Path], typer.Argument(help="Run folders.")], as_json: AsJson = False) -> None:
    """Print the figures that every study needs."""
    for folder in runs:
        _show_measures(folder, as_json)


@app.command()
def plot(
    what: Annotated[str, typer.Argument(help="trust, encounters, freshness, radio, detection or map.")],
    runs: Annotated[list[Path], typer.Argument(help="Run folders, overlaid.")],
    out: Annotated[Path | None, typer.Option(help="File to write: .png, .svg or .pdf.")] = None,
) -> None:
    """Draw a figure of one or several runs."""
    from results import figures
    from results.archive import open_run

    path = figures.plot(what, [open_run(folder) for folder in runs], out)
    screen.print(f"wrote {path}", highlight=False, soft_wrap=True)


@nets.command("list")
def nets_list(as_json: AsJson = False) -> None:
    """List the cities that ship."""
    from sumo_nets import catalogue

    found = [catalogue.find(name) for name in catalogue.names()]
    if as_json:
        _print_json([{"name": n.name, "description": n.description, "licence": n.licence} for n in found])
        return
    table = Table("name", "what", "licence")
    for net in found:
        table.add_row(net.name, net.description, f"{net.licence}; {net.attribution}")
    screen.print(table)


def _show_measures(folder: Path, as_json: bool) -> None:
    from results.archive import open_run
    from results.metrics import measure as measured

    figures = measured(open_run(folder))
    if as_json:
        _print_json({"run": str(folder)} | figures)
        return
    screen.print(folder, figures)


def _print_json(content: object) -> None:
    sys.stdout.write(json.dumps(content, indent=1, ensure_ascii=False, default=str) + "\n")


def main() -> None:
    """Run a command; a user's mistake is one line on standard error and exit status 2."""
    try:
        status = app(standalone_mode=False)
    except click.exceptions.Exit as stop:
        status = stop.exit_code
    except click.ClickException as error:
        notes.print(f"error: {error.format_message()}", highlight=False, markup=False, soft_wrap=True)
        status = 2
    except (click.Abort, KeyboardInterrupt):
        notes.print("interrupted")
        status = 130
    except ValueError as error:
        notes.print(f"error: {' '.join(str(error).split())}", highlight=False, markup=False, soft_wrap=True)
        status = 2
    sys.exit(status)
