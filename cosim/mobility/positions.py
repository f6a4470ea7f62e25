"""Positions of vehicles in traces from elsewhere: tables with columns, taxi logs, trajectories from drones."""

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.mobility.frame import LARGEST_COORDINATE_M, TrafficError
from results.export.earth import Projection
from sumo_nets.xml import check_regular, open_input


@dataclass(frozen=True, slots=True)
class Columns:
    """Names of the columns of a table of positions."""

    actor: str
    time: str
    x: str
    """East [m], or latitude [degrees] if `is_degrees`."""
    y: str
    """North [m], or longitude [degrees] if `is_degrees`."""
    is_degrees: bool = False
    kind: str = ""
    """Class of the vehicle; empty if the table has none."""
    corner: tuple[str, str] | None = None
    """Columns with the extents of a box, if x and y are its corner with the smallest x and y [m]."""
    time_unit_s: float = 1.0
    """Seconds per unit of a time that is a number. Ignored for frames."""
    is_frame: bool = False
    """Whether the time is the number of a video frame."""


LAYOUTS: dict[str, Columns] = {
    "highd": Columns("id", "frame", "x", "y", corner=("width", "height"), is_frame=True),
    "ind": Columns("trackId", "frame", "xCenter", "yCenter", is_frame=True),
    "opendd": Columns("OBJID", "TIMESTAMP", "UTM_X", "UTM_Y", kind="CLASS"),
    "interaction": Columns("track_id", "timestamp_ms", "x", "y", kind="agent_type", time_unit_s=1e-3),
    "table": Columns("id", "time", "x", "y"),
    "degrees": Columns("id", "time", "lat", "lon", is_degrees=True),
}
"""Layouts that are recognised by their columns, in this order. `ind` is also that of rounD, exiD and uniD."""

_POINT = r"POINT\s*\(\s*(?P<lat>[-+0-9.eE]+)\s+(?P<lon>[-+0-9.eE]+)\s*\)"
_CRAWDAD = re.compile(r"^[^;]+;[^;]+;\s*" + _POINT.replace("?P<lat>", "").replace("?P<lon>", "") + r"\s*$")
_DATE = r"^\d{4}-\d\d-\d\d[ T]\d\d:\d\d"
_META = re.compile(r"^(\d+)_tracks\.csv(\.gz)?$")
_SEPARATORS = ";,\t|"
_MOST_DEGREES = (90.0, 180.0)
_CRAWL_MPS = 0.05
"""If something moves, and nothing faster than this, coordinates are not metres."""


@dataclass(frozen=True, slots=True)
class Fixes:
    """N positions of actors, sorted by actor and time, no two of an actor at one time."""

    names: list[str]
    """Name of each actor, as in the trace."""
    kinds: list[str]
    """Class of each actor, as in the trace; empty if it does not say."""
    actor: Int[ndarray, "n"]
    """Row of `names`."""
    time_s: Float[ndarray, "n"]
    """Seconds since `begin`."""
    xy_m: Float[ndarray, "n 2"]
    begin: str = "0"
    """What time 0 is in the trace."""
    repaired: dict[str, int] = field(default_factory=dict)
    """Rows that were left out or sorted, by reason."""


def layout_of(path: Path) -> str:
    """The layout of a file: `crawdad`, a name of `LAYOUTS`, or empty if its columns are none of these."""
    if path.name.removesuffix(".gz").endswith(".parquet"):
        names = _parquet_names(path)
    else:
        line = _first_line(path)
        if _CRAWDAD.match(line):
            return "crawdad"
        names = _split(line)
    return next((name for name, columns in LAYOUTS.items() if set(_needed(columns)) <= set(names)), "")


def is_sumo(path: Path) -> bool:
    """Whether a file has the columns, or the form, of SUMO's floating car data."""
    name = path.name.removesuffix(".gz")
    if name.endswith(".xml"):
        return True
    if name.endswith(".parquet"):
        names = _parquet_names(path)
    elif name.endswith(".csv"):
        names = _split(_first_line(path))
    else:
        return False
    return "timestep_time" in names or {"time", "id", "x", "y", "angle", "speed"} <= set(names)


def read(
    paths: Sequence[Path],
    columns: Columns | None = None,
    frame_hz: float | None = None,
    repair: bool = False,
) -> Fixes:
    """Read the pieces of one trace.

    Parameters
    ----------
    paths
        Files of one layout.
    columns
        Names of the columns. None recognises the layout.
    frame_hz
        Frames per second, if the time is a frame number. None reads it from the `recordingMeta` file beside.
    repair
        Sort rows that are not in the order of time, and leave out rows with missing values and repeated rows.
        Otherwise these are errors, except that exact copies of a row are always left out.

    Raises
    ------
    TrafficError
        In one line: the file, and what is wrong with it.
    """
    names: dict[str, int] = {}
    kinds: list[str] = []
    parts: list[tuple[ndarray, ndarray, ndarray]] = []
    degrees, repaired = False, {"missing": 0, "repeated": 0, "unordered": 0}
    for path in paths:
        found, actors, kind, time_s, xy = _rows(path, columns, frame_hz)
        if parts and found.is_degrees != degrees:
            raise TrafficError(f"{path}: not in the units of {paths[0]}. Count contacts of each in its own command.")
        degrees = found.is_degrees
        if frame_hz is not None and not found.is_frame:
            raise TrafficError(f"{path}: its times are no frame numbers, so --frame-hz has no effect. Leave it out.")
        good = _good(path, actors, time_s, xy, repair)
        repaired["missing"] += int((~good).sum())
        texts = actors[good]
        values, code = np.unique(texts.astype(str), return_inverse=True)
        first = np.zeros(len(values), np.int64)
        first[code[::-1]] = np.arange(len(code))[::-1]
        of = np.empty(len(values), np.int64)
        for row, name in enumerate(values.tolist()):
            if name not in names:
                names[name] = len(names)
                kinds.append(str(kind[good][first[row]]) if kind is not None else "")
            of[row] = names[name]
        parts.append((of[code], time_s[good], xy[good]))
    actor, time_s, xy = (np.concatenate([part[i] for part in parts]) for i in range(3))
    if not len(actor):
        raise TrafficError(f"{paths[0]}: no position in it. Give a trace with at least one row.")
    where = ", ".join(map(str, paths))
    _check_order(where, list(names), actor, time_s, repaired, repair)
    order = np.lexsort((time_s, actor))
    actor, time_s, xy = actor[order], time_s[order], xy[order]
    keep = _without_copies(where, list(names), actor, time_s, xy, repaired, repair)
    actor, time_s, xy = actor[keep], time_s[keep], xy[keep]
    xy_m = _projected(where, xy) if degrees else xy
    if not degrees:
        _check_metres(where, actor, time_s, xy_m)
    begin = float(time_s.min())
    return Fixes(
        list(names), kinds, actor, time_s - begin, xy_m, f"{begin:.6f}".rstrip("0").rstrip("."),
        {reason: n for reason, n in repaired.items() if n},
    )  # fmt: skip


def _rows(
    path: Path, columns: Columns | None, frame_hz: float | None
) -> tuple[Columns, ndarray, ndarray | None, Float[ndarray, "n"], Float[ndarray, "n 2"]]:
    """Columns of one file: names and classes of actors, times [s] and positions, in the order of the file."""
    try:
        if columns is None and layout_of(path) == "crawdad":
            return _crawdad(path)
        if columns is None:
            layout = layout_of(path)
            if not layout:
                raise TrafficError(
                    f"{path}: no layout that is known by its columns ({_said(path)}). Name the columns with --id, "
                    "--time and --x and --y in metres, or --lat and --lon in degrees."
                )
            columns = LAYOUTS[layout]
        table = _table(path, columns)
    except TrafficError:
        raise
    except (pa.ArrowException, OSError, EOFError, zlib.error, ValueError, UnicodeDecodeError) as error:
        cause = (str(error) or type(error).__name__).splitlines()[0].removeprefix(f"{path}: ")
        raise TrafficError(f"{path}: cannot be read as a table: {cause}.") from None
    x, y = (_numbers(path, table, name) for name in (columns.x, columns.y))
    if columns.corner is not None:
        x, y = (v + _numbers(path, table, name) / 2 for v, name in zip((x, y), columns.corner, strict=True))
    time = table.column(columns.time)
    if columns.is_frame:
        time_s = _numbers(path, table, columns.time) / (frame_hz or _frame_hz(path))
    elif _is_text(time.type) or pa.types.is_timestamp(time.type):
        time_s = _instants(path, columns.time, time)
    else:
        time_s = _numbers(path, table, columns.time) * columns.time_unit_s
    actors = table.column(columns.actor).cast(pa.string()).to_numpy(zero_copy_only=False)
    has_kind = bool(columns.kind) and columns.kind in table.column_names
    kind = table.column(columns.kind).cast(pa.string()).fill_null("").to_numpy() if has_kind else None
    return columns, actors, kind, time_s, np.column_stack([x, y])


def _table(path: Path, columns: Columns) -> pa.Table:
    """The needed columns of a CSV or Parquet file."""
    is_parquet = path.name.removesuffix(".gz").endswith(".parquet")
    names = _parquet_names(path) if is_parquet else _split(_first_line(path))
    wanted = _needed(columns)
    if missing := [name for name in wanted if name not in names]:
        raise TrafficError(
            f"{path}: no column {', '.join(missing)}. It has {', '.join(names[:20]) or 'none'}. Name its columns with "
            "--id, --time and --x and --y in metres, or --lat and --lon in degrees."
        )
    if twice := sorted({name for name in wanted if names.count(name) > 1}):
        raise TrafficError(f"{path}: its header has the column {twice[0]} twice. Remove one of them.")
    more = [columns.kind] if columns.kind and columns.kind in names else []
    if is_parquet:
        check_regular(path)
        return pq.read_table(path, columns=[*wanted, *more], partitioning=None)
    text = {columns.actor: pa.string(), **dict.fromkeys(more, pa.string())}
    with open_input(path) as source:
        return pcsv.read_csv(
            pa.PythonFile(source, mode="r"),
            parse_options=pcsv.ParseOptions(delimiter=_separator(_first_line(path))),
            convert_options=pcsv.ConvertOptions(
                include_columns=[*wanted, *more], column_types=text, strings_can_be_null=True
            ),
        )


def _crawdad(path: Path) -> tuple[Columns, ndarray, None, Float[ndarray, "n"], Float[ndarray, "n 2"]]:
    """Lines `id;time;POINT(latitude longitude)`, as in the CRAWDAD data set roma/taxi."""
    with open_input(path) as source:
        table = pcsv.read_csv(
            pa.PythonFile(source, mode="r"),
            pcsv.ReadOptions(column_names=["id", "time", "point"]),
            pcsv.ParseOptions(delimiter=";"),
            pcsv.ConvertOptions(column_types=dict.fromkeys(("id", "time", "point"), pa.string())),
        )
    places = pc.extract_regex(table.column("point"), _POINT).combine_chunks()
    if places.null_count:
        line = 1 + int(np.flatnonzero(np.asarray(places.is_null()))[0])
        raise TrafficError(f"{path}: line {line} has no POINT(latitude longitude). Remove or correct it.")
    xy = np.column_stack([places.field(name).cast(pa.float64()).to_numpy() for name in ("lat", "lon")])
    time_s = _instants(path, "time", table.column("time"))
    actors = table.column("id").to_numpy()
    return Columns("id", "time", "lat", "lon", is_degrees=True), actors, None, time_s, xy


def _instants(path: Path, name: str, column: pa.ChunkedArray) -> Float[ndarray, "n"]:
    """Seconds since 1970 of dates with times. A time without a zone is taken as UTC."""
    if _is_text(column.type) and not pc.all(pc.match_substring_regex(column, _DATE)).as_py():
        bad = next(text for text in column.to_pylist() if text is not None and not re.match(_DATE, text))
        raise TrafficError(
            f"{path}: column {name} holds {bad[:40]!r}, which is neither a number of seconds nor a date with a time, "
            "such as 2014-02-01 00:00:00. Correct it, or name another column."
        )
    try:
        parsed = pd.to_datetime(column.to_pandas(), utc=True, format="ISO8601", errors="raise")
    except (ValueError, TypeError) as error:
        raise TrafficError(f"{path}: column {name}: {' '.join(str(error).split())[:120]}.") from None
    microseconds = parsed.dt.tz_localize(None).dt.as_unit("us").to_numpy()
    return np.where(np.isnat(microseconds), np.nan, microseconds.astype(np.int64) / 1e6)


def _numbers(path: Path, table: pa.Table, name: str) -> Float[ndarray, "n"]:
    try:
        return table.column(name).cast(pa.float64()).to_numpy()
    except pa.ArrowException:
        raise TrafficError(f"{path}: column {name} holds something that is not a number.") from None


def _frame_hz(path: Path) -> float:
    """Frames per second from the `recordingMeta` file of a drone's recording."""
    named = _META.match(path.name)
    meta = path.with_name(f"{named[1]}_recordingMeta.csv") if named else path
    if named and meta.is_file():
        table = pcsv.read_csv(meta)
        if "frameRate" in table.column_names and table.num_rows and (hz := float(table["frameRate"][0].as_py())) > 0:
            return hz
    raise TrafficError(
        f"{path}: its times are frame numbers, and no recordingMeta file beside it says how many there are in a "
        "second. Set --frame-hz."
    )


def _good(
    path: Path, actors: ndarray, time_s: Float[ndarray, "n"], xy: Float[ndarray, "n 2"], repair: bool
) -> Bool[ndarray, "n"]:
    """Rows with an actor, a time and a position that are there and finite."""
    good = np.isfinite(time_s) & np.isfinite(xy).all(axis=1) & ~pd.isna(actors)
    if not repair and not good.all():
        row = int(np.flatnonzero(~good)[0])
        raise TrafficError(
            f"{path}: row {row + 1} ({actors[row]!r}) has a value missing or not finite, and {int((~good).sum())} of "
            f"{len(good)} rows do. Correct them, or leave them out with --repair."
        )
    return good


def _check_order(
    where: str, names: list[str], actor: ndarray, time_s: ndarray, repaired: dict[str, int], repair: bool
) -> None:
    """Refuse an actor whose rows go back in time."""
    order = np.argsort(actor, kind="stable")
    back = (np.diff(time_s[order]) < 0) & (np.diff(actor[order]) == 0)
    if not back.any():
        return
    if not repair:
        row = order[int(np.flatnonzero(back)[0]) + 1]
        raise TrafficError(
            f"{where}: the rows of {names[actor[row]]!r} are not in the order of time, as {int(back.sum())} of "
            f"{len(actor)} rows are not. Sort them, or let --repair do it."
        )
    repaired["unordered"] += int(back.sum())


def _without_copies(
    where: str, names: list[str], actor: ndarray, time_s: ndarray, xy: ndarray, repaired: dict[str, int], repair: bool
) -> Bool[ndarray, "n"]:
    """Rows of an actor that are the first of their time."""
    again = np.r_[False, (np.diff(actor) == 0) & (np.diff(time_s) == 0)]
    other = again & np.r_[False, (np.diff(xy, axis=0) != 0).any(axis=1)]
    if other.any() and not repair:
        row = int(np.flatnonzero(other)[0])
        raise TrafficError(
            f"{where}: {names[actor[row]]!r} has two positions at the time {time_s[row]:.10g} s, and there are "
            f"{int(other.sum())} such rows. Are these recordings of their own? Then count each in its own command; or "
            "keep the first of such rows with --repair."
        )
    repaired["repeated"] += int(again.sum())
    return ~again


def _projected(where: str, degrees: Float[ndarray, "n 2"]) -> Float[ndarray, "n 2"]:
    """East and north of latitudes and longitudes, on a transverse Mercator map around their median."""
    most = np.abs(degrees).max(axis=0)
    if most[0] > _MOST_DEGREES[0] or most[1] > _MOST_DEGREES[1]:
        hint = " Are they the other way round?" if most[0] <= 180 and most[1] <= 90 else " Are they metres?"
        raise TrafficError(
            f"{where}: latitudes reach {most[0]:g} and longitudes {most[1]:g} degrees; at most 90 and 180 can be.{hint}"
        )
    lat, lon = np.median(degrees, axis=0).tolist()
    xy_m = Projection(lat, lon).to_world(degrees[:, 0], degrees[:, 1])
    if not np.isfinite(xy_m).all() or np.abs(xy_m).max() > 2e6:
        raise TrafficError(
            f"{where}: positions reach {np.nanmax(np.abs(xy_m)) / 1000:,.0f} km from their median: no map without "
            "distortion shows all of them. Leave out those far away."
        )
    return xy_m


def _check_metres(where: str, actor: ndarray, time_s: ndarray, xy_m: Float[ndarray, "n 2"]) -> None:
    """Refuse degrees that are given as metres, and coordinates that are nowhere on Earth."""
    if np.abs(xy_m).max() > LARGEST_COORDINATE_M:
        raise TrafficError(f"{where}: coordinates reach {np.abs(xy_m).max():g} m, which is no place on Earth.")
    same = np.diff(actor) == 0
    gone_m, took_s = np.hypot(*np.diff(xy_m, axis=0)[same].T), np.diff(time_s)[same]
    moved = gone_m > 0
    is_small = np.abs(xy_m).max(axis=0).max() <= _MOST_DEGREES[1]
    if is_small and moved.any() and (gone_m[moved] / took_s[moved]).max() < _CRAWL_MPS:
        fastest = (gone_m[moved] / took_s[moved]).max()
        raise TrafficError(
            f"{where}: nothing is faster than {fastest:.2g} m/s, so x and y look like degrees. Name them with --lat "
            "and --lon instead."
        )


def _needed(columns: Columns) -> list[str]:
    return [columns.actor, columns.time, columns.x, columns.y, *(columns.corner or ())]


def _is_text(kind: pa.DataType) -> bool:
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def _first_line(path: Path) -> str:
    try:
        with open_input(path) as source:
            return source.read(1 << 16).partition(b"\n")[0].decode(errors="replace").strip().lstrip("\ufeff")
    except (OSError, EOFError, zlib.error) as error:
        raise TrafficError(f"{path}: cannot be read ({error}).") from None
    except ValueError as error:
        raise TrafficError(str(error)) from None


def _parquet_names(path: Path) -> list[str]:
    try:
        check_regular(path)
        return list(pq.read_schema(path).names)
    except (pa.ArrowException, OSError) as error:
        raise TrafficError(f"{path}: not a Parquet file: {str(error).splitlines()[0]}.") from None


def _separator(line: str) -> str:
    return next((s for s in _SEPARATORS if s in line), ",")


def _split(line: str) -> list[str]:
    return [name.strip() for name in line.replace('"', "").split(_separator(line))]


def _said(path: Path) -> str:
    names = _parquet_names(path) if path.name.endswith(".parquet") else _split(_first_line(path))
    return f"columns {', '.join(names[:12])}" if any(names) else "empty"
