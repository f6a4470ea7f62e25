"""The command `trace`: positions from elsewhere become traffic."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
from cosim.cli.console import AsJson, print_done, print_note
from cosim.traffic.params import SHORTEST_STEP_S

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

    from cosim.addons.traces import layouts, positions, tracks
    from cosim.addons.traces.from_positions import write_trace
    from cosim.addons.traces.units import LENGTH_M, TIME_S

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
        if columns is None and layouts.is_sumo(path):
            raise ValueError(
                f"{path} is a trace of SUMO's already. Drive it with --set traffic.scenario={path}. If its positions "
                "are centres, or its angles others, name --x and --y."
            )
    fixes = positions.read(
        files,
        columns,
        frame_hz,
        repair,
        TIME_S.get(time_unit or ""),
        LENGTH_M.get(length_unit or ""),
        _projection(scenario),
    )
    if step_s is None:
        fixes, step_s = tracks.on_own_steps(fixes)
    report = write_trace(fixes, tracks.TrackParams(step_s, max_gap_s, max_speed_mps), out)
    if fixes.repaired:
        said = [f"{n:,} {reason}" for reason, n in fixes.repaired.items()]
        print_note(f"note: rows left out or sorted: {', '.join(said)}.")
    drive = f"traffic.scenario={out}" if scenario is None else f"traffic.scenario={scenario} --set traffic.trace={out}"
    size = f"{report['actors']:,} vehicles, {report['steps']:,} steps of {step_s:g} s"
    begin = "" if fixes.begin == "0" else f" from {fixes.begin} s of the positions on, which is time 0"
    text = (
        f"wrote {out}: {size}{begin}, "
        f"{100 * report['interpolated_share']:.0f} % of the positions interpolated{_left_out(report, step_s)}; "
        f"{report['tracks']:,} tracks after {report['gaps']:,} gaps and {report['jumps']:,} jumps; "
        f"{'; '.join(found_lines(report))}. A run takes who comes into view for one that enters the road. Run it with: "
        f"cosim run --set {drive}{_steps(step_s)}"
    )
    print_done({"out": str(out), "step_s": step_s, "begin": fixes.begin, **report}, text, as_json)


def _left_out(report: dict[str, Any], step_s: float) -> str:
    """What is said if most positions lie between two steps."""
    median_s = report["interval_median_s"]
    if not 0 < median_s < step_s / 2:
        return ""
    return f", of positions {median_s:g} s apart (median) the others left out: a smaller --step-s keeps them"


def _steps(step_s: float) -> str:
    """Options of a run with steps of the trace, or the least multiple that a run can have."""
    from cosim.config.config import load

    n_joined = max(1, math.ceil(SHORTEST_STEP_S / step_s - 1e-9))
    run_step_s = float(f"{n_joined * step_s:.12g}")
    usual_s = load(None, []).sensing_interval_s
    n = max(1, round(usual_s / run_step_s))
    interval_s = n * run_step_s
    sensing = "" if abs(usual_s / run_step_s - n) < 1e-9 else f" --set sensing_interval_s={interval_s:.12g}"
    # Vehicles cannot sense at moments of their own if a step is as long as their interval.
    phase = " --set sensing_phase=common" if n == 1 else ""
    return f" --set traffic.step_s={run_step_s:.12g}{sensing}{phase}"


def _projection(scenario: str | None) -> Projection | None:
    """The projection of a city, which must have one."""
    from cosim.traffic.scenario import find

    if scenario is None:
        return None
    location = find(scenario).location()
    if location is None or location.projection is None:
        raise ValueError(
            f"--scenario {scenario}: its network has no transverse Mercator projection of WGS84, such as UTM. "
            "No other one is read. Leave it out."
        )
    return location.projection
