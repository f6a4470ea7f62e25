"""Commands that write a run for other programs: data sets of other formats, a recording for a viewer."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.console import print_json, progress, screen

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")]


def add_to(app: typer.Typer) -> None:
    """The commands `export` and `view`."""
    for command in (export, view):
        app.command()(command)


def export(
    form: Annotated[
        str,
        typer.Argument(
            metavar="FORMAT", help="kitti, trupercept, opv2v, veremi, veremi-nextgen, or your own: mine.py:Name."
        ),
    ],
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    out: Annotated[Path, typer.Option(help="New folder to write; an export that was interrupted goes on in its own.")],
    vehicles: Annotated[
        str | None,
        typer.Option(help="Vehicles with a LiDAR, such as 3,17,20-25; all by default. trupercept: ego first."),
    ] = None,
    steps: Annotated[str | None, typer.Option(help="Steps, such as 0-59; all by default.")] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", help="A parameter of your own exporter, key=value. Repeatable.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a run in the layout that other tools read."""
    from cosim.offline.export import export as write
    from results.archive import open_run

    with progress() as advance:
        done = write(
            open_run(folder), form, out, vehicles, steps, sets or (),
            lambda what, n, total: advance(f"{form}, {what}", n, total, ""),
        )  # fmt: skip
    if as_json:
        print_json(done)
        return
    said = f"wrote {done['files']:,} files, {done['bytes'] / 1e6:,.1f} MB, in {done['out']}"
    screen.print(said, highlight=False, markup=False, soft_wrap=True)


def view(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    out: Annotated[Path, typer.Option(help="File to write, .rrd; open it with `rerun FILE.rrd`.")],
    vehicles: Annotated[
        list[int] | None, typer.Option("--vehicle", help="Show its clouds, detections and beliefs. Repeatable.")
    ] = None,
    from_s: Annotated[float, typer.Option("--from", help="Begin, in seconds.")] = 0.0,
    to_s: Annotated[float | None, typer.Option("--to", help="End, in seconds.")] = None,
    clouds: Annotated[bool, typer.Option(help="Point clouds of the vehicles shown.")] = True,
    as_json: AsJson = False,
) -> None:
    """Write a run as a recording for the Rerun viewer: map, city in 3D, trust over time."""
    from cosim.offline.view import view as write
    from results.archive import open_run

    with progress() as advance:
        done = write(
            open_run(folder), out, tuple(vehicles or ()), from_s, to_s, clouds,
            lambda what, n, total: advance(what, n, total, ""),
        )  # fmt: skip
    if as_json:
        print_json(done)
        return
    said = f"wrote {out}, {done['bytes'] / 1e6:,.1f} MB; open it with: rerun {out}"
    screen.print(said, highlight=False, markup=False, soft_wrap=True)
