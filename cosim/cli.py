"""The commands."""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.box import SIMPLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from cosim.console import notes, print_json, print_metrics, print_run_summary, rows_of, screen, table_of
from cosim.nets import nets
from cosim.studies import commands as studies

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Co-simulation of cooperative perception under trust at city scale.",
)
app.add_typer(nets, name="nets")
studies.add_to(app)

ConfigPath = Annotated[Path | None, typer.Argument(help="TOML file; without one, the shipped city.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="Change one key, e.g. radio.range_m=150. Repeatable.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")]
RunPaths = Annotated[list[Path], typer.Argument(help="Folders that `cosim run` wrote.")]
Picture = Literal[
    "trust", "misbehaviour", "encounters", "freshness", "radio", "detection", "map", "contacts", "safety", "sweep"
]


@app.command()
def run(
    config: ConfigPath = None,
    overrides: Overrides = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write; by default the next runs/<city>-N.")] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate traffic, sensors, messages and trust; write a run folder."""
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
    print_run_summary(folder, as_json)
    for remark in running.remarks(folder):
        notes.print(remark, highlight=False, markup=False, soft_wrap=True)


@app.command()
def check(config: ConfigPath = None, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Check whether a config would run, and print it resolved."""
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
def measure(
    runs: Annotated[list[Path] | None, typer.Argument(help="Folders that `cosim run` wrote.")] = None,
    explain: Annotated[bool, typer.Option("--explain", help="List all metrics with their definitions.")] = False,
    metrics: Annotated[
        list[str] | None, typer.Option("--metric", help="study: show this metric, or METRIC:GROUP. Repeatable.")
    ] = None,
    variant: Annotated[str, typer.Option(help="Trust variant of the runs.")] = "base",
    threshold: Annotated[float, typer.Option(min=0, max=1, help="Trust below which a vehicle is suspected.")] = 0.25,
    fresh_s: Annotated[float, typer.Option(help="Oldest age at which trust counts as fresh, in seconds.")] = 10.0,
    false_positives: Annotated[float, typer.Option(min=0, max=1, help="False positive rate to compare at.")] = 0.05,
    as_json: AsJson = False,
) -> None:
    """Print the metrics of runs; of a study, means over replicates with 95 % intervals and paired differences."""
    if explain:
        print_metrics(as_json)
        return
    if not runs:
        raise ValueError("There is no run to measure. Name at least one run folder, or ask with --explain.")
    if studies.is_study(runs):
        studies.measure(runs[0], metrics or [], as_json)
        return
    if metrics:
        raise ValueError("--metric goes with a study. Leave it out, or give the folder of a `cosim sweep`.")
    from results.archive import open_run
    from results.measure import measure as measured

    tables = {
        str(folder): measured(open_run(folder).as_variant(variant), threshold, fresh_s, false_positives)
        for folder in runs
    }
    if as_json:
        print_json({name: rows_of(table) for name, table in tables.items()})
        return
    for name, table in tables.items():
        screen.print(table_of(name, rows_of(table)))


@app.command()
def plot(
    what: Annotated[Picture, typer.Argument(help="Which figure.")],
    runs: RunPaths,
    out: Annotated[
        Path | None, typer.Option(help="File to write: .png, .svg, .pdf; sweep: or .ply, .pcd, .pcd.txt, .bin, .npy.")
    ] = None,
    vehicles: Annotated[
        list[int] | None,
        typer.Option("--vehicle", help="trust: draw this vehicle too. Repeatable. sweep: whose point cloud."),
    ] = None,
    step: Annotated[int | None, typer.Option(help="sweep: of which step.")] = None,
    over: Annotated[
        str | None, typer.Option(help="Key on the axis, e.g. trust.freshness_s; of a study, or of runs by freshness.")
    ] = None,
    by: Annotated[str | None, typer.Option(help="study: swept key as colour.")] = None,
    metrics: Annotated[
        list[str] | None, typer.Option("--metric", help="study: draw this metric, or METRIC:GROUP. Repeatable.")
    ] = None,
    where: Annotated[
        list[str] | None, typer.Option(help="study: hold a swept key at a value, KEY=VALUE. Repeatable.")
    ] = None,
    fresh_s: Annotated[float | None, typer.Option(help="freshness: oldest that is fresh, in seconds.")] = None,
    radius_m: Annotated[float | None, typer.Option(help="map, contacts: which of the radii, in metres.")] = None,
    pairs: Annotated[str | None, typer.Option(help="map, contacts: which of the kinds of pairs.")] = None,
) -> None:
    """Draw a figure of one or several runs, or of a study over a swept key."""
    if studies.is_study(runs):
        studies.plot(what, runs[0], out, over, by, metrics or [], where or [])
        return
    if by or metrics or where:
        raise ValueError("--by, --metric and --where go with a study. Leave them out.")
    from inspect import signature

    from results.archive import open_run
    from results.figures import style
    from results.figures.catalogue import FIGURES

    if what == "sweep":
        from cosim.replay_lidar import write

        if len(runs) != 1 or step is None or not vehicles or len(vehicles) != 1:
            raise ValueError("cosim plot sweep shows one sweep: cosim plot sweep RUN --vehicle V --step S")
        screen.print(f"wrote {write(open_run(runs[0]), vehicles[0], step, out)}", highlight=False, soft_wrap=True)
        return
    if step is not None:
        raise ValueError(f"--step goes with `cosim plot sweep`, not with {what}. Leave it out.")
    options = {"vehicles": vehicles, "over": over, "fresh_s": fresh_s, "radius_m": radius_m, "pairs": pairs}
    given = {name: value for name, value in options.items() if value}
    for name in given:
        takers = [figure for figure, draw in FIGURES.items() if name in signature(draw).parameters]
        if what not in takers:
            flag = "vehicle" if name == "vehicles" else name.replace("_", "-")
            raise ValueError(f"--{flag} goes with `cosim plot {' or '.join(takers)}`, not with {what}. Leave it out.")
    path = style.save(FIGURES[what]([open_run(folder) for folder in runs], **given), out or runs[0] / f"{what}.png")
    screen.print(f"wrote {path}", highlight=False, soft_wrap=True)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of a run or of a study.")],
    out: Annotated[Path | None, typer.Option(help="File to write; by default report.html in the folder.")] = None,
) -> None:
    """Write one self-contained HTML page about a run or a study."""
    if studies.is_study([folder]):
        studies.report(folder, out)
        return
    from results.archive import open_run
    from results.report import write

    path = write(open_run(folder), out or folder / "report.html")
    screen.print(f"wrote {path}", highlight=False, soft_wrap=True)


@app.command()
def export(
    form: Annotated[str, typer.Argument(metavar="FORMAT", help="kitti, trupercept, opv2v, veremi, veremi-nextgen.")],
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    out: Annotated[Path, typer.Option(help="New folder to write; an export that was interrupted goes on in its own.")],
    vehicles: Annotated[
        str | None,
        typer.Option(help="Vehicles with a LiDAR, such as 3,17,20-25; all by default. trupercept: ego first."),
    ] = None,
    steps: Annotated[str | None, typer.Option(help="Steps, such as 0-59; all by default.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write a run in the layout that other tools read."""
    from cosim.export import export as write
    from results.archive import open_run

    bar = Progress(
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TimeRemainingColumn(), console=notes, disable=not notes.is_terminal,
    )  # fmt: skip
    with bar:
        task = bar.add_task(form, total=None)
        done = write(
            open_run(folder), form, out, vehicles, steps,
            lambda what, n, total: bar.update(task, description=f"{form}, {what}", completed=n, total=total),
        )  # fmt: skip
    if as_json:
        print_json(done)
        return
    said = f"wrote {done['files']:,} files, {done['bytes'] / 1e6:,.1f} MB, in {done['out']}"
    screen.print(said, highlight=False, markup=False, soft_wrap=True)


@app.command()
def reproduce(
    scenario: Annotated[Literal["scenario-1", "scenario-2"], typer.Argument(help="Which scenario of the paper.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the pictures; by default runs/<scenario>.")] = None,
    as_json: AsJson = False,
) -> None:
    """Play a scenario of the paper, and compare it with the paper."""
    from cosim.reproduce import SCENARIOS

    folder = out or Path("runs") / scenario
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--out {folder} cannot be a folder: {error.strerror}. Give another one.") from None
    compared = SCENARIOS[scenario](folder)
    if as_json:
        print_json({"scenario": scenario} | asdict(compared))
        return
    table = Table(*compared.rows[0], title=scenario, title_justify="left", box=SIMPLE)
    for row in compared.rows:
        table.add_row(*("-" if v is None else f"{v:.3f}" if isinstance(v, float) else v for v in row.values()))
    screen.print(table)
    for line in compared.notes + [f"drawn in {path}" for path in compared.pictures]:
        screen.print(line, highlight=False, soft_wrap=True)


@app.command()
def bench(
    only: Annotated[list[str] | None, typer.Argument(help="sensors, trust, radio, mobility, results, cycle.")] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the speed of every room on this machine."""
    from cosim.bench import BENCHES, machine, run

    if unknown := set(only or ()) - set(BENCHES):
        raise ValueError(f"cosim bench {' '.join(unknown)}: no such benchmark. There are {', '.join(BENCHES)}.")
    rows = [
        {"metric": f"{name}.{figure}", "group": "", "value": value, "unit": unit, "label": ""}
        for name in only or BENCHES for figure, value, unit in run(name)
    ]  # fmt: skip
    if as_json:
        print_json({"machine": machine(), "figures": rows})
    else:
        screen.print(table_of(machine(), rows))


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
