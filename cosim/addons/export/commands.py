"""Commands that write a run for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.console import AsJson, print_done, print_note, progress


def export(
    form: Annotated[
        str,
        typer.Argument(
            metavar="FORMAT",
            help="kitti, trupercept, opv2v, veremi-nextgen, pcap, mcap, nuscenes, fcd, reports, or your own, "
            "mine.py:Name.",
        ),
    ],
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    out: Annotated[
        Path, typer.Option(help="New folder to write. Name the folder of an interrupted export to continue it.")
    ],
    vehicles: Annotated[
        str | None,
        typer.Option(
            help="Vehicles with a LiDAR, such as 3,17,20-25. The default is all of them. For trupercept, the first "
            "one is the ego."
        ),
    ] = None,
    steps: Annotated[str | None, typer.Option(help="Steps, such as 0-59. The default is all of them.")] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", help="Set a parameter of the exporter, such as images=false for kitti. Repeatable."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a run in a format that other tools read."""
    from cosim.addons.export.export import export as write
    from results.archive import open_run

    with progress() as advance:
        done = write(
            open_run(folder),
            form,
            out,
            vehicles,
            steps,
            sets or (),
            lambda what, n, total: advance(f"{form}, {what}", n, total, ""),
        )
    written = f"{done['files']:,} files, {done['bytes'] / 1e6:,.1f} MB"
    print_done(done, f"wrote {written}, in {done['out']}", as_json)
    for remark in done["remarks"]:
        print_note(f"note: {remark}")


def view(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    out: Annotated[Path | None, typer.Option(help="File to write (.rrd). `rerun FILE.rrd` opens it.")] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Follow a run that is computed now, in the viewer, or in the file of --out.")
    ] = False,
    vehicles: Annotated[
        list[int] | None,
        typer.Option(
            "--vehicle", help="Show this vehicle's point clouds, detections and believed objects. Repeatable."
        ),
    ] = None,
    from_s: Annotated[float, typer.Option("--from", help="First simulated second to show.")] = 0.0,
    to_s: Annotated[float | None, typer.Option("--to", help="Show what is before this simulated second.")] = None,
    clouds: Annotated[bool, typer.Option(help="Include point clouds of the chosen vehicles.")] = True,
    as_json: AsJson = False,
) -> None:
    """Write a run as a recording for the Rerun viewer. It has a map, the city in 3D and trust over time."""
    from cosim.addons.export.view import follow
    from cosim.addons.export.view import view as write
    from results.archive import open_run

    if live:
        if from_s or to_s is not None:
            raise ValueError("--from and --to go with a run that has ended. Leave them out, or leave --live out.")
        with progress() as advance:
            done = follow(
                folder, out, tuple(vehicles or ()), progress=lambda what, n, total: advance(what, n, total, "")
            )
        print_done(done, f"showed {done['steps']} steps of {folder}, status {done['status']}", as_json)
        return
    if out is None:
        raise ValueError("Say where the recording goes: --out FILE.rrd. A run that is computed now: --live.")
    with progress() as advance:
        done = write(
            open_run(folder),
            out,
            tuple(vehicles or ()),
            from_s,
            to_s,
            clouds,
            lambda what, n, total: advance(what, n, total, ""),
        )
    print_done(done, f"wrote {out}, {done['bytes'] / 1e6:,.1f} MB; open it with: rerun {out}", as_json)
