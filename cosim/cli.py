"""The commands."""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.box import SIMPLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from cosim.screen import conclude, notes, print_json, rows_of, screen, table_of

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Co-simulation of cooperative perception under trust at city scale.",
)
nets = typer.Typer(no_args_is_help=True, help="The cities that ship.")
app.add_typer(nets, name="nets")

ConfigPath = Annotated[Path | None, typer.Argument(help="TOML file; without one, the shipped city.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="Change one key, e.g. radio.reach_m=150. Repeatable.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Answer in JSON on standard output.")]
RunPaths = Annotated[list[Path], typer.Argument(help="Folders that `cosim run` wrote.")]
Picture = Literal["trust", "encounters", "freshness", "radio", "detection", "map", "contacts"]


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
    conclude(folder, as_json)


@app.command()
def check(config: ConfigPath = None, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Say whether a config would run, and print it resolved."""
    import tomli_w

    from cosim import run as running
    from cosim.config import load

    experiment = load(config, overrides)
    running.check(experiment)
    if as_json:
        print_json(experiment.to_dict())
    else:
        screen.print(tomli_w.dumps(running.without_nulls(experiment.to_dict())), highlight=False, markup=False)


@app.command()
def measure(runs: RunPaths, as_json: AsJson = False) -> None:
    """Print the figures that every study needs."""
    from results.archive import open_run
    from results.measure import measure as measured

    tables = {str(folder): measured(open_run(folder)) for folder in runs}
    if as_json:
        print_json({name: rows_of(table) for name, table in tables.items()})
        return
    for name, table in tables.items():
        screen.print(table_of(name, rows_of(table)))


@app.command()
def plot(
    what: Annotated[Picture, typer.Argument(help="Which figure.")],
    runs: RunPaths,
    out: Annotated[Path | None, typer.Option(help="File to write: .png, .svg or .pdf.")] = None,
    vehicle: Annotated[list[int] | None, typer.Option(help="trust only: draw this vehicle too. Repeatable.")] = None,
) -> None:
    """Draw a figure of one or several runs."""
    from results.archive import open_run
    from results.figures import style
    from results.figures.catalogue import FIGURES

    if vehicle and what != "trust":
        raise ValueError(f"--vehicle goes with `cosim plot trust` only, not with {what}. Leave it out.")
    opened = [open_run(folder) for folder in runs]
    figure = FIGURES[what](opened, vehicle) if vehicle else FIGURES[what](opened)
    path = style.save(figure, out or runs[0] / f"{what}.png")
    screen.print(f"wrote {path}", highlight=False, soft_wrap=True)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Run folder.")],
    out: Annotated[Path | None, typer.Option(help="File to write; by default report.html in the run folder.")] = None,
) -> None:
    """Write one self-contained HTML page about a run."""
    from results.archive import open_run
    from results.report import write

    path = write(open_run(folder), out or folder / "report.html")
    screen.print(f"wrote {path}", highlight=False, soft_wrap=True)


@app.command()
def reproduce(
    scenario: Annotated[Literal["scenario-1", "scenario-2"], typer.Argument(help="Which scenario of the paper.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the pictures; by default runs/<scenario>.")] = None,
    as_json: AsJson = False,
) -> None:
    """Play a scenario of the paper, and hold it against the paper."""
    from cosim.reproduce import SCENARIOS

    folder = out or Path("runs") / scenario
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--out {folder} cannot be a folder: {error.strerror}. Give another one.") from None
    answer = SCENARIOS[scenario](folder)
    if as_json:
        print_json({"scenario": scenario} | asdict(answer))
        return
    table = Table(*answer.rows[0], title=scenario, title_justify="left", box=SIMPLE)
    for row in answer.rows:
        table.add_row(*("-" if v is None else f"{v:.3f}" if isinstance(v, float) else v for v in row.values()))
    screen.print(table)
    for line in answer.notes + [f"drawn in {path}" for path in answer.pictures]:
        screen.print(line, highlight=False, soft_wrap=True)


@app.command()
def bench(
    only: Annotated[list[str] | None, typer.Argument(help="sensors, trust, v2x, cycle; all by default.")] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the speed of every room on this machine."""
    from cosim.bench import BENCHES, machine, run

    if unknown := set(only or ()) - set(BENCHES):
        raise ValueError(f"cosim bench {' '.join(unknown)}: no such benchmark. There are {', '.join(BENCHES)}.")
    rows = [
        {"topic": name, "figure": figure, "of": "", "value": value, "unit": unit}
        for name in only or BENCHES for figure, value, unit in run(name)
    ]  # fmt: skip
    if as_json:
        print_json({"machine": machine(), "figures": rows})
    else:
        screen.print(table_of(machine(), rows))


@nets.command("list")
def nets_list(as_json: AsJson = False) -> None:
    """List the cities that ship."""
    from sumo_nets import catalogue

    found = [catalogue.find(name) for name in catalogue.names()]
    if as_json:
        print_json([{"name": n.name, "description": n.description, "licence": n.licence} for n in found])
        return
    table = Table("name", "what", "licence")
    for net in found:
        table.add_row(net.name, net.description, f"{net.licence}; {net.attribution}")
    screen.print(table)


def main() -> None:
    """Run a command; a user's mistake is one line on standard error and exit status 2."""
    try:
        status = app(standalone_mode=False)
    except typer.TyperException as error:
        if message := error.format_message():
            notes.print(f"error: {message}", highlight=False, markup=False, soft_wrap=True)
        status = 2
    except (typer.Abort, KeyboardInterrupt):
        notes.print("interrupted")
        status = 130
    except ValueError as error:
        notes.print(f"error: {' '.join(str(error).split())}", highlight=False, markup=False, soft_wrap=True)
        status = 2
    sys.exit(status)
