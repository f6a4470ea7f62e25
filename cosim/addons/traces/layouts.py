"""Layouts of positions: tables with columns, taxi logs, trajectories from drones; and the rows of one file."""

import re
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.traces import units
from cosim.base.rows import Rows
from cosim.traffic import delimited
from cosim.traffic.frame import TrafficError
from sumo_nets import vtypes
from sumo_nets.xml import check_regular, open_input


@dataclass(frozen=True, slots=True)
class PositionColumns:
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
    size: tuple[str, str] = ("", "")
    """Length and width of the vehicle; empty if the table has none. There is no width without a length."""
    corner: tuple[str, str] | None = None
    """Columns with the extents of a box, if x and y are its corner with the smallest x and y [m]."""
    time_unit_s: float | None = None
    """Seconds per unit of a time that is a number. Ignored for frames. None asks the numbers."""
    length_unit_m: float | None = None
    """Metres per unit of positions and sizes. None asks the names."""
    is_frame: bool = False
    """Whether the time is the number of a video frame."""
    y_down: bool = False
    """Whether y points down, as in an image."""
    is_front: bool = False
    """Whether positions are those of the front bumper. They are centres otherwise."""
    repeat: str = ""
    """Column that tells vehicles of one name apart, if names are given several times."""
    site: str = ""
    """Column with the place of the recording: those of several places have coordinates and names of their own."""

    def spelled(self, names: Sequence[str]) -> "PositionColumns":
        """With the capitals and small letters of a header."""
        of = {name.lower(): name for name in names} | {name: name for name in names}

        def own(name: str) -> str:
            return of.get(name) or of.get(name.lower(), name)

        length, width = self.size
        return replace(
            self,
            actor=own(self.actor),
            time=own(self.time),
            x=own(self.x),
            y=own(self.y),
            kind=own(self.kind),
            size=(own(length), own(width)),
            repeat=own(self.repeat),
            site=own(self.site),
        )


LAYOUTS: dict[str, PositionColumns] = {
    "highd": PositionColumns(
        "id", "frame", "x", "y", size=("width", "height"), corner=("width", "height"), is_frame=True, y_down=True
    ),
    "ind": PositionColumns("trackId", "frame", "xCenter", "yCenter", size=("length", "width"), is_frame=True),
    "opendd": PositionColumns(
        "OBJID", "TIMESTAMP", "UTM_X", "UTM_Y", kind="CLASS", size=("LENGTH", "WIDTH"), time_unit_s=1.0
    ),
    "interaction": PositionColumns(
        "track_id", "timestamp_ms", "x", "y", kind="agent_type", size=("length", "width"), time_unit_s=1e-3
    ),
    "ngsim": PositionColumns(
        "Vehicle_ID",
        "Global_Time",
        "Local_X",
        "Local_Y",
        kind="v_Class",
        size=("v_Length", "v_Width"),
        time_unit_s=1e-3,
        length_unit_m=0.3048,
        is_front=True,
        repeat="Total_Frames",
        site="Location",
    ),
    "table": PositionColumns("id", "time", "x", "y"),
    "degrees": PositionColumns("id", "time", "lat", "lon", is_degrees=True),
}
"""Layouts that are recognised by their columns, in this order. `ind` is also that of rounD, exiD and uniD."""
_DIRECTIONS = ("heading", "yaw", "angle", "psi", "course", "bearing")
"""Beginnings of the names of columns with directions, which are not read."""
_HEIGHTS = ("z", "alt", "altitude", "elevation")
"""First words of the names of columns with heights above sea or ground, which are not read either."""
_SIZES = {"length", "width", "height"}
"""Words of the names of columns with sizes. `length` and `width` are read, also with a unit, such as `length_m`."""
_KINDS = ("class", "type", "vehicle_class", "vehicle_type", "agent_type", "object_type", "object_class", "category")
"""Columns with classes, in any case, if a table has one of them and none is named."""
_KIND_WORDS = {"class", "type", "category"}
_NGSIM_CLASS = {"1": "motorcycle", "2": "car", "3": "truck"}
_POINT = r"POINT\s*\(\s*(?P<lat>[-+0-9.eE]+)\s+(?P<lon>[-+0-9.eE]+)\s*\)"
_CRAWDAD = re.compile(r"^[^;]+;[^;]+;\s*" + _POINT.replace("?P<lat>", "").replace("?P<lon>", "") + r"\s*$")
_PNEUMA = ["track_id", "type", "traveled_d", "avg_speed", "lat", "lon", "speed", "lon_acc", "lat_acc", "time"]
"""Header of pNEUMA: four values of a vehicle, then six for each of its instants."""
_META = re.compile(r"^(\d+)_tracks\.csv(\.gz)?$")


@dataclass(frozen=True, slots=True)
class FileRows(Rows):
    """Rows of one file, in its order: names, classes and sizes of actors, times [s], and metres or degrees."""

    actors: ndarray
    time_s: Float[ndarray, "n"]
    xy: Float[ndarray, "n 2"]
    is_degrees: bool
    is_frame: bool = False
    kinds: ndarray | None = None
    lw_m: Float[ndarray, "n 2"] | None = None
    speed: Float[ndarray, "n"] | None = None
    """In a unit that is not known."""
    read_as: tuple[str, ...] = ()
    is_front: bool = False


def layout_of(path: Path) -> str:
    """The layout of a file: `crawdad`, `pneuma`, a name of `LAYOUTS`, or empty if its columns are none of these."""
    if path.name.removesuffix(".gz").endswith(".parquet"):
        names = _parquet_names(path)
    else:
        if _CRAWDAD.match(delimited.first_line(path)):
            return "crawdad"
        names = delimited.header(path).names
        if names[: len(_PNEUMA)] == _PNEUMA:
            return "pneuma"
    for name, columns in LAYOUTS.items():
        is_other = name == "highd" and "length" in map(str.lower, names)  # whose width is the length along the road
        if set(_needed(columns.spelled(names))) <= set(names) and not is_other:
            return name
    return ""


def is_sumo(path: Path) -> bool:
    """Whether a file has the columns, or the form, of SUMO's floating car data."""
    name = path.name.removesuffix(".gz")
    if name.endswith(".xml"):
        return True
    if name.endswith(".parquet"):
        names = _parquet_names(path)
    elif name.endswith(".csv"):
        names = delimited.header(path).names
    else:
        return False
    return "timestep_time" in names or {"time", "id", "x", "y", "angle", "speed"} <= set(names)


def rows_of_file(
    path: Path,
    columns: PositionColumns | None,
    frame_hz: float | None,
    time_unit_s: float | None,
    length_unit_m: float | None,
) -> FileRows:
    """The rows of one file."""
    layout = layout_of(path) if columns is None else ""
    if layout == "crawdad":
        return _crawdad(path)
    if layout == "pneuma":
        return _pneuma(path)
    names = _names_of(path)
    columns = _columns_of(path, names, layout, columns)
    columns = replace(
        columns,
        time_unit_s=time_unit_s or columns.time_unit_s,
        length_unit_m=length_unit_m or columns.length_unit_m,
    )
    _check_units(path, columns, time_unit_s, length_unit_m)
    table = _table(path, columns, names)
    _check_site(path, columns, table)
    read_as = [f"layout {layout}"] if layout not in ("", "table", "degrees") else []
    try:
        unit_m, said = units.length_unit(columns.x, columns.y, columns.length_unit_m)
    except ValueError as error:
        raise TrafficError(f"{path}: {error}") from None
    read_as += [said] if said and not columns.is_degrees else []
    xy = _positions(path, columns, table) * (1.0 if columns.is_degrees else unit_m)
    if columns.y_down:
        read_as.append("y of the image, which points down, is turned")
    time_s, said = _times(path, columns, table, frame_hz)
    read_as += [said] if said else []
    actors = _actors(path, columns, table)
    kinds, lw_m = _kinds_and_sizes(path, table, columns, actors, unit_m)
    if kinds is None and layout in ("highd", "ind"):
        read_as.append("no tracksMeta file beside it says the classes: all are cars")
    return FileRows(
        actors=actors,
        time_s=time_s,
        xy=xy,
        is_degrees=columns.is_degrees,
        is_frame=columns.is_frame,
        kinds=kinds,
        lw_m=lw_m,
        speed=units.speeds(path, table),
        read_as=(*read_as, *_not_read(columns, names)),
        is_front=columns.is_front,
    )


def _names_of(path: Path) -> list[str]:
    """The names of a file's columns."""
    if path.name.removesuffix(".gz").endswith(".parquet"):
        return _parquet_names(path)
    header = delimited.header(path)
    if header.names[: len(_PNEUMA)] == _PNEUMA:
        raise TrafficError(
            f"{path}: pNEUMA, with rows of any length, is read by itself. Leave out --id, --time, --lat and --lon."
        )
    delimited.check_header(path, header, ())
    return header.names


def _columns_of(path: Path, names: Sequence[str], layout: str, named: PositionColumns | None) -> PositionColumns:
    """The columns of a layout, or those that the user named, with the optional ones that the file has."""
    if named is not None:
        if named.kind and named.kind not in names:
            raise TrafficError(f"{path}: no column {named.kind}, which --class names. It has {', '.join(names[:20])}.")
        return _with_optional(named, names)
    if not layout:
        raise TrafficError(
            f"{path}: no layout that is known by its columns ({_said(path)}). Name the columns with --id, "
            "--time and --x and --y in metres, or --lat and --lon in degrees."
        )
    return _with_optional(LAYOUTS[layout].spelled(names), names)


def _positions(path: Path, columns: PositionColumns, table: pa.Table) -> Float[ndarray, "n 2"]:
    """Middles or fronts of the actors in the file's unit, y to the north."""

    def numbers(name: str) -> Float[ndarray, "n"]:
        return delimited.numbers(path, name, table.column(name))

    x, y = numbers(columns.x), numbers(columns.y)
    if columns.corner is not None:
        length, width = columns.corner
        x = x + numbers(length) / 2
        y = y + numbers(width) / 2
    return np.column_stack([x, -y if columns.y_down else y])


def _times(
    path: Path, columns: PositionColumns, table: pa.Table, frame_hz: float | None
) -> tuple[Float[ndarray, "n"], str]:
    """Times [s], and what is said of their unit."""
    time = table.column(columns.time)
    if columns.is_frame:
        frames = delimited.numbers(path, columns.time, time)
        return frames / (frame_hz or _frame_hz(path)), ""
    if not units.is_number(time):
        return delimited.seconds(path, columns.time, time), ""
    raw = delimited.numbers(path, columns.time, time)
    unit_s, said = units.time_unit(columns.time, raw, columns.time_unit_s)
    return raw * unit_s, said


def _actors(path: Path, columns: PositionColumns, table: pa.Table) -> ndarray:
    """The name of each row's actor."""
    actors = delimited.texts(path, columns.actor, table.column(columns.actor))
    if columns.repeat:
        again = delimited.texts(path, columns.repeat, table.column(columns.repeat))
        actors = pc.binary_join_element_wise(actors, again, ":")
    return actors.to_numpy()


def _not_read(columns: PositionColumns, names: Sequence[str]) -> Iterator[str]:
    """What is said of columns that a user might expect to be read."""
    if not columns.kind and (unread := _named(names, _KIND_WORDS)):
        yield f"{', '.join(unread)} not read: all are cars. A column of classes is named class"
    if turned := [name for name in names if name.lower().startswith(_DIRECTIONS)]:
        yield f"{', '.join(turned)} not read: actors look where they go, and north before they move"
    if not columns.is_degrees and (degrees := list(filter(units.degrees_by_name, names))):
        yield f"{', '.join(degrees)} not read: {columns.x} and {columns.y} are the positions"
    if flat := [name for name in names if name.lower().split("_")[0] in _HEIGHTS]:
        yield f"{', '.join(flat)} not read: the road is flat"
    used = *columns.size, *(columns.corner or ())
    if sizes := [name for name in _named(names, _SIZES) if name not in used]:
        yield f"{', '.join(sizes)} not read: such a size is that of the class"


def _named(names: Sequence[str], words: Set[str]) -> list[str]:
    """The columns whose names have one of these words."""
    return [name for name in names if words & set(units.words(name))]


def _with_optional(columns: PositionColumns, names: Sequence[str]) -> PositionColumns:
    """The columns with those of classes and sizes that the table has, where none is named."""
    of = {name.lower(): name for name in names} | {name: name for name in names}
    kinds = [of[name] for name in (columns.kind, *_KINDS) if name in of]
    length, width = columns.size
    if not {length, width} <= set(names):
        length = units.of_size("length", names)
        width = units.of_size("width", names) if length else ""
    repeat = columns.repeat if columns.repeat in names else ""
    site = columns.site if columns.site in names else ""
    return replace(columns, kind=kinds[0] if kinds else "", size=(length, width), repeat=repeat, site=site)


def _check_site(path: Path, columns: PositionColumns, table: pa.Table) -> None:
    """Refuse recordings of several places in one file."""
    sites = pc.unique(table.column(columns.site)).drop_null().to_pylist() if columns.site else []
    if len(sites) > 1:
        raise TrafficError(
            f"{path}: {columns.site} says {', '.join(map(str, sites[:4]))}: each has coordinates and numbers of its "
            "own. Keep the rows of one."
        )


def _check_units(path: Path, columns: PositionColumns, time_unit_s: float | None, length_unit_m: float | None) -> None:
    """Refuse units that have no effect, and columns whose names say another meaning."""
    if columns.is_frame and time_unit_s is not None:
        raise TrafficError(f"{path}: its times are frame numbers, so --time-unit has no effect. Leave it out.")
    if columns.is_degrees and length_unit_m is not None:
        raise TrafficError(f"{path}: its positions are degrees, so --length-unit has no effect. Leave it out.")
    if not columns.is_degrees and length_unit_m is None and (bad := units.degrees_by_name(columns.x, columns.y)):
        raise TrafficError(
            f"{path}: the column {bad} is named as degrees, and --x and --y are metres. Name degrees with --lat and "
            "--lon, or set --length-unit m."
        )
    if not columns.is_frame and time_unit_s is None and columns.time_unit_s is None and units.is_frame(columns.time):
        raise TrafficError(
            f"{path}: the column {columns.time} is named as frame numbers. Set --frame-hz to the frames or steps per "
            "second, or --time-unit s if they are seconds."
        )


def _kinds_and_sizes(
    path: Path, table: pa.Table, columns: PositionColumns, actors: ndarray, unit_m: float
) -> tuple[ndarray | None, Float[ndarray, "n 2"] | None]:
    """Class, length and width of each row, from the table or from the `tracksMeta` file beside."""
    kinds = lw_m = None
    if columns.kind:
        texts = delimited.texts(path, columns.kind, table.column(columns.kind))
        kinds = pc.fill_null(texts, "").to_numpy()
        if columns.kind.lower() == "v_class":
            kinds = np.array([_NGSIM_CLASS.get(kind, kind) for kind in kinds.tolist()], object)
    if any(columns.size):
        lw_m = np.full((len(actors), 2), np.nan)
        for axis, name in enumerate(columns.size):
            if name:
                size = delimited.numbers(path, name, table.column(name))
                lw_m[:, axis] = units.size_unit(name, unit_m) * size
    named = _META.match(path.name)
    meta = path.with_name(f"{named[1]}_tracksMeta.csv") if named else path
    if kinds is None and named and meta.is_file():
        found = delimited.header(meta)
        actor = next((name for name in ("trackId", "id") if name in found.names), None)
        if actor is not None and "class" in found.names:
            rows = pa.concat_tables(delimited.blocks(meta, found, (actor, "class")))
            of = dict(zip(rows.column(actor).to_pylist(), rows.column("class").to_pylist(), strict=True))
            kinds = np.array([of.get(name) or "" for name in actors.tolist()], object)
    if lw_m is not None:
        largest_m = vtypes.LARGEST_M["length"], vtypes.LARGEST_M["width"]
        for row, axis in np.argwhere(lw_m > largest_m).tolist():
            name, size_m = columns.size[axis], lw_m[row, axis]
            raise TrafficError(f"{path}: {actors[row]!r} has {name} = {size_m:g} m, which no vehicle has. Correct it.")
    return kinds, lw_m


def _table(path: Path, columns: PositionColumns, names: Sequence[str]) -> pa.Table:
    """The needed columns of a CSV or Parquet file; those of a CSV file are text."""
    wanted = _needed(columns)
    if missing := [name for name in wanted if name not in names]:
        raise TrafficError(
            f"{path}: no column {', '.join(missing)}. It has {', '.join(names[:20]) or 'none'}. Name its columns with "
            "--id, --time and --x and --y in metres, or --lat and --lon in degrees."
        )
    if twice := sorted({name for name in wanted if names.count(name) > 1}):
        raise TrafficError(f"{path}: its header has the column {twice[0]} twice. Remove one of them.")
    optional = columns.kind, *columns.size, columns.repeat, columns.site, *units.SPEEDS
    wanted += [name for name in optional if name and name in names]
    wanted = list(dict.fromkeys(wanted))
    if path.name.removesuffix(".gz").endswith(".parquet"):
        check_regular(path)
        try:
            return pq.read_table(path, columns=wanted, partitioning=None)
        except (pa.ArrowException, OSError) as error:
            raise TrafficError(f"{path}: cannot be read as a table: {str(error).splitlines()[0]}.") from None
    empty = pa.table({name: pa.array([], pa.string()) for name in wanted})
    return pa.concat_tables([empty, *delimited.blocks(path, delimited.header(path), wanted)])


def _crawdad(path: Path) -> FileRows:
    """Lines `id;time;POINT(latitude longitude)`, as in the CRAWDAD data set roma/taxi."""
    header = delimited.Header(["id", "time", "point"], ";")
    table = pa.concat_tables(delimited.blocks(path, header, header.names, has_header=False))
    places = pc.extract_regex(table.column("point"), _POINT).combine_chunks()
    if places.null_count:
        line = 1 + int(np.flatnonzero(np.asarray(places.is_null()))[0])
        raise TrafficError(f"{path}: line {line} has no POINT(latitude longitude). Remove or correct it.")
    degrees = [places.field(name).cast(pa.float64()) for name in ("lat", "lon")]
    xy = np.column_stack([column.to_numpy() for column in degrees])
    time_s = delimited.seconds(path, "time", table.column("time"))
    return FileRows(table.column("id").to_numpy(), time_s, xy, is_degrees=True, read_as=("layout crawdad",))


def _pneuma(path: Path) -> FileRows:
    """A row per vehicle: four values of the vehicle, then latitude, longitude, speed, two accelerations, and time."""
    names: list[str] = []
    kinds: list[str] = []
    tables: list[ndarray] = []
    for n, line in enumerate(_lines(path), 2):
        values = line.rstrip("; \t\r").split(";")
        try:
            if len(values) < 10 or (len(values) - 4) % 6:
                raise ValueError
            tables.append(np.array(values[4:], float).reshape(-1, 6))
        except ValueError:
            raise TrafficError(
                f"{path}: row {n - 1} has {len(values)} values, which are not 4 of a vehicle and 6 for each instant, "
                "or one is not a number. Correct it."
            ) from None
        names.append(values[0].strip())
        kinds.append(values[1].strip())
    if not tables:
        raise TrafficError(f"{path}: no position in it. Give a trace with at least one row.")
    lengths = [len(table) for table in tables]
    rows = np.concatenate(tables)
    return FileRows(
        actors=np.repeat(np.array(names, object), lengths),
        time_s=rows[:, 5],
        xy=rows[:, :2],
        is_degrees=True,
        kinds=np.repeat(np.array(kinds, object), lengths),
        speed=rows[:, 2],
        read_as=("layout pneuma",),
    )


def _lines(path: Path) -> Iterator[str]:
    """The lines of a text file after the header that are not empty."""
    try:
        with open_input(path) as source:
            source.readline()
            for line in source:
                text = line.decode(errors="replace").strip()
                if text:
                    yield text
    except (OSError, EOFError) as error:
        raise TrafficError(f"{path}: cannot be read ({error}).") from None


def _frame_hz(path: Path) -> float:
    """Frames per second from the `recordingMeta` file of a drone's recording."""
    named = _META.match(path.name)
    meta = path.with_name(f"{named[1]}_recordingMeta.csv") if named else path
    if named and meta.is_file() and "frameRate" in (found := delimited.header(meta)).names:
        for table in delimited.blocks(meta, found, ("frameRate",)):
            hz = delimited.numbers(meta, "frameRate", table.column("frameRate"))
            if len(hz) and hz[0] > 0:
                return float(hz[0])
    raise TrafficError(
        f"{path}: its times are frame numbers, and no recordingMeta file beside it says how many there are in a "
        "second. Set --frame-hz."
    )


def _needed(columns: PositionColumns) -> list[str]:
    return [columns.actor, columns.time, columns.x, columns.y, *(columns.corner or ())]


def _parquet_names(path: Path) -> list[str]:
    try:
        check_regular(path)
        return list(pq.read_schema(path).names)
    except (pa.ArrowException, OSError) as error:
        if "magic bytes" in str(error):
            raise TrafficError(f"{path}: it lacks the end of a Parquet file. {delimited.ENDS_EARLY}.") from None
        raise TrafficError(f"{path}: not a Parquet file: {str(error).splitlines()[0]}.") from None


def _said(path: Path) -> str:
    names = _parquet_names(path) if path.name.endswith(".parquet") else delimited.header(path).names
    return f"columns {', '.join(names[:12])}" if any(names) else "empty"
