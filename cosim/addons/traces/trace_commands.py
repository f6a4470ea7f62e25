"""The command `trace`: positions from elsewhere become traffic."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.addons.traces.commands import (
    Actor,
    FrameHz,
    Lat,
    LengthUnit,
    Lon,
    MaxGapS,
    MaxSpeedMps,
    Repair,
    StepS,
    Time,
    TimeUnit,
    X,
    Y,
    columns_of,
    found_lines,
)
from cosim.cli.console import AsJson, notes, print_done

if TYPE_CHECKING:
    from cosim.base.earth import Projection


def trace(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Files of one trace: CSV or Parquet with a row per vehicle and time, lines id;time;POINT(lat lon), or "
            "trajectories from drones."
        ),
    ],
    out: Annotated[Path, typer.Option(help="File to write (.parquet).")],
    actor: Actor = None,
    time: Time = None,
    x: X = None,
    y: Y = None,
    kind: Annotated[str | None, typer.Option("--class", help="Column with the classes of the vehicles.")] = None,
    lat: Lat = None,
    lon: Lon = None,
    frame_hz: FrameHz = None,
    time_unit: TimeUnit = None,
    length_unit: LengthUnit = None,
    scenario: Annotated[
        str | None,
        typer.Option(help="City or .sumocfg whose projection places degrees. The default is around their median."),
    ] = None,
    step_s: StepS = None,
    max_gap_s: MaxGapS = 30.0,
    max_speed_mps: MaxSpeedMps = 70.0,
    repair: Repair = False,
    as_json: AsJson = False,
) -> None:
    """Make a trace that `cosim run` drives from recorded positions.

    These are logs, recordings of drones, or the output of other simulators.
    """
    from dataclasses import replace

    from cosim.addons.traces import positions, tracks
    from cosim.addons.traces.from_positions import write_trace
    from cosim.addons.traces.units import LENGTH_M, TIME_S
    from cosim.config.config import load

    if out.suffix != ".parquet":
        raise ValueError(f"--out {out}: the trace is a Parquet file. Give a name that ends in .parquet.")
    if out.exists():
        raise ValueError(f"--out {out} exists. Give the name of a new file.")
    tracks.check_options(step_s, max_gap_s, max_speed_mps, frame_hz)
    columns = columns_of(actor, time, (x, y), (lat, lon), frame_hz)
    if kind is not None:
        if columns is None:
            raise ValueError(f"--class {kind} goes with --x and --y, or --lat and --lon. Name these columns, too.")
        columns = replace(columns, kind=kind)
    for path in files:
        if positions.is_sumo(path):
            raise ValueError(f"{path} is a trace of SUMO's already. Drive it with --set traffic.scenario={path}.")
    fixes = positions.read(
        files, columns, frame_hz, repair, TIME_S.get(time_unit or ""), LENGTH_M.get(length_unit or ""),
        _projection(scenario),
    )  # fmt: skip
    step_s = step_s or tracks.own_step_s(fixes)
    report = write_trace(fixes, tracks.TrackParams(step_s, max_gap_s, max_speed_mps), out)
    if fixes.repaired:
        said = ", ".join(f"{n:,} {reason}" for reason, n in fixes.repaired.items())
        notes.print(f"note: rows left out or sorted: {said}.", soft_wrap=True)
    # Vehicles cannot sense at moments of their own if a step is as long as their interval.
    phase = "" if step_s < load(None, []).sensing_interval_s else " --set sensing_phase=common"
    text = (
        f"wrote {out}: {report['actors']:,} vehicles, {report['steps']:,} steps of {step_s:g} s, "
        f"{100 * report['interpolated_share']:.0f} % of the positions interpolated; {report['tracks']:,} tracks after "
        f"{report['gaps']:,} gaps and {report['jumps']:,} jumps; {'; '.join(found_lines(report))}. Run it with: cosim "
        f"run --set traffic.scenario={out} --set traffic.step_s={step_s:g}{phase}"
    )
    print_done({"out": str(out), "step_s": step_s, **report}, text, as_json)


def _projection(scenario: str | None) -> Projection | None:
    """The projection of a city, which must have one."""
    from cosim.traffic.scenario import find

    if scenario is None:
        return None
    location = find(scenario).location()
    if location is None or location.projection is None:
        raise ValueError(f"--scenario {scenario}: its network has no projection that places degrees. Leave it out.")
    return location.projection
