"""The commands of encounters: counted in traces from anywhere, and beside what others have published."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from cosim.cli.console import AsJson, TrustCode, plain, print_facts, print_json, print_note, progress, rows_of
from cosim.cli.help import MORE

if TYPE_CHECKING:
    from cosim.addons.traces.contacts import ContactParams
    from cosim.addons.traces.layouts import PositionColumns
    from results.archive import OpenRun

Pairs = Literal["all", "equipped", "los", "all_los"]

Actor = Annotated[str | None, typer.Option("--id", help="Column with the names of the vehicles.")]
Time = Annotated[str | None, typer.Option("--time", help="Column with times: seconds, or dates.")]
X = Annotated[str | None, typer.Option("--x", help="Column with metres east.")]
Y = Annotated[str | None, typer.Option("--y", help="Column with metres north.")]
Lat = Annotated[str | None, typer.Option("--lat", help="Column with latitudes, in degrees.")]
Lon = Annotated[str | None, typer.Option("--lon", help="Column with longitudes, in degrees.")]
FrameHz = Annotated[
    float | None,
    typer.Option("--frame-hz", rich_help_panel=MORE, help="Frames per second, if the times are frame numbers."),
]
TimeUnit = Annotated[
    Literal["s", "ms", "us", "ns", "min", "h"] | None,
    typer.Option(
        "--time-unit",
        rich_help_panel=MORE,
        help="Unit of times that are numbers. The default is s, or what the trace says.",
    ),
]
LengthUnit = Annotated[
    Literal["m", "ft", "km", "cm", "mm"] | None,
    typer.Option(
        "--length-unit", rich_help_panel=MORE, help="Unit of positions that are no degrees. The default is m."
    ),
]
StepS = Annotated[
    float | None,
    typer.Option("--step-s", rich_help_panel=MORE, help="Length of a step. The default is the interval of the trace."),
]
MaxGapS = Annotated[
    float,
    typer.Option(
        "--max-gap-s",
        rich_help_panel=MORE,
        help="Positions farther apart in time are not joined: observation ends and begins anew.",
    ),
]
MaxSpeedMps = Annotated[
    float,
    typer.Option(
        "--max-speed-mps", rich_help_panel=MORE, help="Positions that ask for a faster motion are not joined either."
    ),
]
Repair = Annotated[
    bool,
    typer.Option(
        "--repair", rich_help_panel=MORE, help="Sort rows, and leave out rows with missing values and repeated rows."
    ),
]


def contacts(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Files of one trace: SUMO's floating car data, CSV, Parquet, lines id;time;POINT(lat lon), or "
            "trajectories from drones. Or a run folder."
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="Folder to write. The default is the next runs/<name>-N.")] = None,
    radius_m: Annotated[
        list[float] | None,
        typer.Option("--radius-m", help="Largest distance of a contact, as encounters.radius_m. Repeatable."),
    ] = None,
    hysteresis_s: Annotated[
        float | None,
        typer.Option(
            "--hysteresis-s", rich_help_panel=MORE, help="A break shorter than this does not end an encounter."
        ),
    ] = None,
    pairs: Annotated[
        Pairs | None, typer.Option(rich_help_panel=MORE, help="Pairs that count, as encounters.pairs.")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(rich_help_panel=MORE, help="Config whose encounters, fleet and seed are used instead."),
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=MORE, help="City or .sumocfg of a trace of SUMO's: sizes of vehicles, and buildings."
        ),
    ] = None,
    actor: Actor = None,
    time: Time = None,
    x: X = None,
    y: Y = None,
    lat: Lat = None,
    lon: Lon = None,
    frame_hz: FrameHz = None,
    time_unit: TimeUnit = None,
    length_unit: LengthUnit = None,
    step_s: StepS = None,
    max_gap_s: MaxGapS = 30.0,
    max_speed_mps: MaxSpeedMps = 70.0,
    appearance: Annotated[
        Literal["ends", "censors"] | None,
        typer.Option(
            rich_help_panel=MORE,
            help="What the first and the last position of a vehicle mean: it enters and leaves the road (ends), or "
            "observation begins and ends (censors). The default is ends for traces that SUMO wrote and runs.",
        ),
    ] = None,
    from_s: Annotated[
        float | None, typer.Option("--from", rich_help_panel=MORE, help="Count from this time of the trace on.")
    ] = None,
    to_s: Annotated[
        float | None, typer.Option("--to", rich_help_panel=MORE, help="Count up to this time of the trace.")
    ] = None,
    repair: Repair = False,
    trust_code: TrustCode = False,
    as_json: AsJson = False,
) -> None:
    """Count encounters in a trace. `measure`, `plot encounters` and `compare encounters` read the folder."""
    from cosim.addons.traces.contacts import ContactParams
    from cosim.addons.traces.contacts import contacts as count
    from cosim.addons.traces.units import LENGTH_M, TIME_S

    params = ContactParams(
        scenario=scenario,
        step_s=step_s,
        max_gap_s=max_gap_s,
        max_speed_mps=max_speed_mps,
        appearance=appearance,
        from_s=from_s,
        to_s=to_s,
        columns=columns_of(actor, time, (x, y), (lat, lon), frame_hz),
        frame_hz=frame_hz,
        repair=repair,
        time_unit_s=TIME_S.get(time_unit or ""),
        length_unit_m=LENGTH_M.get(length_unit or ""),
    )
    params = _with_definitions(params, config, radius_m, hysteresis_s, pairs, trust_code)
    with progress() as advance:
        folder = count(files, params, out, advance)
    _print_counted(folder, as_json)


def _with_definitions(
    params: "ContactParams",
    config: Path | None,
    radius_m: list[float] | None,
    hysteresis_s: float | None,
    pairs: Pairs | None,
    trust_code: bool,
) -> "ContactParams":
    """What is counted, by the config or by the options."""
    from cosim.config.config import load
    from cosim.config.data import validated
    from results.encounters import EncounterParams

    if config is not None:
        if radius_m or hysteresis_s is not None or pairs:
            raise ValueError("--config says what is counted. Leave out --radius-m, --hysteresis-s and --pairs.")
        loaded = load(config, trust_code=trust_code)
        if not loaded.encounters:
            raise ValueError(f"{config} has no [[encounters]]: there is nothing to count. Add a section.")
        return replace(params, encounters=loaded.encounters, config=loaded)
    more: dict[str, Any] = {"pairs": pairs or "all"}
    if hysteresis_s is not None:
        more["hysteresis_s"] = hysteresis_s
    definitions = [more | {"radius_m": r} for r in radius_m] if radius_m else [more]
    checked = []
    for n, data in enumerate(definitions):
        checked.append(validated(EncounterParams, data, f"encounters.{n}", "the command line"))
    return replace(params, encounters=tuple(checked))


def columns_of(
    actor: str | None,
    time: str | None,
    metres: tuple[str | None, str | None],
    degrees: tuple[str | None, str | None],
    frame_hz: float | None,
) -> "PositionColumns | None":
    """Columns named on the command line; None if none is named."""
    from cosim.addons.traces.layouts import PositionColumns

    if not any((actor, time, *metres, *degrees)):
        return None
    if any(metres) and any(degrees):
        raise ValueError("--x and --y are metres, --lat and --lon are degrees: a trace has one of the two. Name two.")
    place = degrees if any(degrees) else metres
    if not all(place):
        raise ValueError("--x and --y go together, and so do --lat and --lon. Name both columns.")
    x, y = (str(name).strip() for name in place)
    if any(degrees) and "lon" in x.lower() and "lat" in y.lower():
        raise ValueError(f"--lat {x} --lon {y}: the names of the columns say the opposite. Exchange the two.")
    actor, time = (actor or "id").strip(), (time or "time").strip()
    return PositionColumns(actor, time, x, y, is_degrees=any(degrees), is_frame=frame_hz is not None)


def _print_counted(folder: Path, as_json: bool) -> None:
    """Print what was counted in a few lines."""
    from cosim.traffic.remarks import trace_remarks
    from results.archive import open_run
    from results.measure import measure

    run = open_run(folder)
    for remark in trace_remarks(run.manifest["summary"]):
        print_note(remark)
    if coarse := _coarse(run):
        print_note(coarse)
    measures = measure(run, topics=("traffic", "encounters"))
    if as_json:
        print_json({"run": str(folder), "summary": run.manifest["summary"], "measures": rows_of(measures)})
        return
    values = {}
    for row in measures.to_dict("records"):
        values[row["metric"], row["group"]] = float(row["value"])
    given = shlex.quote(str(folder))
    lines = {
        "trace": _trace(run, values),
        "encounters": _encounters(values),
        "tables": [str(folder)],
        "next": [f"cosim measure {given}   cosim plot encounters {given}   cosim compare encounters --run {given}"],
    }
    print_facts(lines)
    if repaired := run.manifest["summary"].get("repaired"):
        said = ", ".join(f"{n:,} {reason}" for reason, n in repaired.items())
        print_note(f"note: rows left out or sorted: {said}.")


def _coarse(run: "OpenRun") -> str:
    """A note if two vehicles can drive through the least radius between two steps."""
    radius_m = min(of["radius_m"] for of in run.manifest["config"]["encounters"])
    fast_mps = run.manifest["summary"].get("speed_p95_mps", 0.0)
    closer_m = 2 * fast_mps * run.dt_s
    if closer_m <= 2 * radius_m:
        return ""
    return (
        f"note: two vehicles at {plain(fast_mps)} m/s (95 %) come {plain(closer_m)} m closer in a step of {run.dt_s:g} "
        f"s, so they can pass through a radius of {radius_m:g} m unseen. Use a trace with shorter steps."
    )


def _trace(run: "OpenRun", values: dict[tuple[str, str], float]) -> list[str]:
    """Sentences on the trace and its interpolation."""
    about = run.manifest["summary"]
    lines = [
        f"{plain(values['traffic.duration_s', ''])} s in steps of {run.dt_s:g} s, "
        f"{plain(about['actors_per_step_mean'])} actors in a step on average"
    ]
    if "interpolated_share" in about:
        n_vehicles = sum(about["classes"].values())
        split = "" if n_vehicles == about["actors"] else f" of {n_vehicles:,} vehicles"
        lines.append(
            f"{about['actors']:,} vehicles with {about['positions']:,} positions; "
            f"{about['gaps']:,} gaps and {about['jumps']:,} jumps cut them into {about['tracks']:,} tracks{split}"
        )
        lines.append(
            f"{about['interpolated_share']:.0%} of positions are interpolated, with an error of at most "
            f"{plain(about['error_bound_median_m'])} m (median) and {plain(about['error_bound_p95_m'])} m (95 %) at up "
            "to 20 m/s"
        )
    lines += found_lines(about)
    if run.manifest["config"]["contacts"]["appearance"] == "censors":
        lines.append("the first and the last position of a track begin and end its observation (censoring)")
    return lines


def found_lines(about: dict[str, Any]) -> list[str]:
    """Sentences on what the numbers of a trace were taken for: classes, speeds, extent, and units."""
    lines = []
    if "speed_median_mps" in about:
        classes = [f"{n:,} {name}" for name, n in about["classes"].items()]
        lines.append(
            f"{', '.join(classes)}; "
            f"speeds {plain(about['speed_median_mps'])} m/s (median) and {plain(about['speed_p95_mps'])} m/s (95 %); "
            f"{plain(about['extent_east_m'])} m from west to east, "
            f"{plain(about['extent_north_m'])} m from south to north"
        )
    if read_as := about.get("read_as"):
        lines.append("read as: " + "; ".join(read_as))
    return lines


def _encounters(values: dict[tuple[str, str], float]) -> list[str]:
    lines = []
    for (metric, definition), n in values.items():
        if metric == "encounters.n" and n:
            median_s = values.get(("encounters.duration.km_median_s", definition))
            unseen = values[("encounters.censored_left.share", definition)]
            said = f"; median duration by Kaplan-Meier {plain(median_s)} s" if median_s is not None else ""
            lines.append(f"{plain(n)} ({definition}){said}; the start of {unseen:.0%} was not seen")
    return lines or ["none: no two came within the radius of each other"]
