"""Positions of vehicles in traces from elsewhere: tables with columns, taxi logs, trajectories from drones."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.addons.traces import units
from cosim.base.earth import Projection
from cosim.base.rows import Rows
from cosim.traffic import delimited
from cosim.traffic.frame import LARGEST_COORDINATE_M, TrafficError
from cosim.traffic.source import SHAPE_OF_CLASS
from sensors.scene import Shape
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
_KINDS = ("class", "type", "vehicle_class", "vehicle_type", "agent_type", "category")
"""Columns with classes, if a table has one of them and none is named."""
_NGSIM_CLASS = {"1": "motorcycle", "2": "car", "3": "truck"}
_POINT = r"POINT\s*\(\s*(?P<lat>[-+0-9.eE]+)\s+(?P<lon>[-+0-9.eE]+)\s*\)"
_CRAWDAD = re.compile(r"^[^;]+;[^;]+;\s*" + _POINT.replace("?P<lat>", "").replace("?P<lon>", "") + r"\s*$")
_PNEUMA = ["track_id", "type", "traveled_d", "avg_speed", "lat", "lon", "speed", "lon_acc", "lat_acc", "time"]
"""Header of pNEUMA: four values of a vehicle, then six for each of its instants."""
_META = re.compile(r"^(\d+)_tracks\.csv(\.gz)?$")
_MOST_DEGREES = (90.0, 180.0)
_CRAWL_MPS = 0.05
"""If something moves, and nothing faster than this, coordinates are not metres."""
_LONG_S, _FASTEST_MPS = 30.0, 70.0
"""An id that comes back as another class after a longer time, or by a faster way, is another actor."""
_DAY_S, _ZIGZAG = 86400.0, 1.5
"""Times of day are at most a day, and rows of two actors, sorted by time, are a way that is longer by this factor."""
_LEAST_SIZE_M = 0.05
"""Smaller sizes, such as the zeros of pedestrians in inD, say nothing."""


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
    own_lw_m: Float[ndarray, "a 2"] | None = None
    """Length and width of each actor, not a number where the trace does not say. None if it says none."""
    projection: Projection | None = None
    """From degrees to the metres. None if positions were metres, or if the projection is that of a network."""
    read_as: tuple[str, ...] = ()
    """How the numbers of the trace were understood, where that is not metres and seconds."""
    source: str = ""
    """Its files, for error messages."""
    is_front: bool = False
    """Whether positions are those of the front bumper. They are centres otherwise."""

    @property
    def types(self) -> list[vtypes.VehicleType]:
        """SUMO's class of each actor, and its size: that of the trace, or that of the class; a car without a class."""
        found = [vtypes.guess(kind) for kind in self.kinds]
        if self.own_lw_m is None:
            return found
        own = []
        for guessed, (length_m, width_m) in zip(found, self.own_lw_m.tolist(), strict=True):
            usual_length_m, usual_width_m, height_m = guessed.lwh_m
            length_m = length_m if length_m > _LEAST_SIZE_M else usual_length_m
            width_m = width_m if width_m > _LEAST_SIZE_M else usual_width_m
            own.append(vtypes.VehicleType(guessed.vclass, (length_m, width_m, height_m)))
        return own

    @property
    def shape(self) -> UInt8[ndarray, "a"]:
        """Shape code of each actor; a car where its class is not on the road."""
        classes = [vtypes.guess(kind).vclass for kind in self.kinds]
        return np.array([SHAPE_OF_CLASS.get(vclass, Shape.CAR) for vclass in classes], np.uint8)


@dataclass(frozen=True, slots=True)
class _Rows(Rows):
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


@dataclass(frozen=True, slots=True)
class _Readings(Rows):
    """Where actors were, of all files: number of the actor, time, position, and what the row says of it."""

    actor: Int[ndarray, "n"]
    time_s: Float[ndarray, "n"]
    xy: Float[ndarray, "n 2"]
    speed: Float[ndarray, "n"]
    """NaN if the file has none."""
    kind: Int[ndarray, "n"]
    """Number of the class; 0 for none."""
    lw_m: Float[ndarray, "n 2"]
    """Length and width; NaN if the file has none."""


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
        if set(_needed(columns.spelled(names))) <= set(names):
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


def read(
    paths: Sequence[Path],
    columns: PositionColumns | None = None,
    frame_hz: float | None = None,
    repair: bool = False,
    time_unit_s: float | None = None,
    length_unit_m: float | None = None,
    to_net: Projection | None = None,
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
    time_unit_s, length_unit_m
        Seconds and metres per unit. None takes those of the layout, or those that the names of columns and the size of
        the times say.
    to_net
        Projection of degrees. None projects them around their median.

    Raises
    ------
    TrafficError
        In one line: the file, and what is wrong with it.
    """
    names: dict[str, int] = {}
    kind_codes = {"": 0}
    parts: list[_Readings] = []
    repaired, read_as = {"missing": 0, "repeated": 0, "unordered": 0}, dict[str, None]()
    degrees = False
    for path in paths:
        rows = _rows(path, columns, frame_hz, time_unit_s, length_unit_m)
        if parts and rows.is_degrees != degrees:
            raise TrafficError(f"{path}: not in the units of {paths[0]}. Count contacts of each in its own command.")
        degrees = rows.is_degrees
        read_as |= dict.fromkeys(rows.read_as)
        if frame_hz is not None and not rows.is_frame:
            raise TrafficError(f"{path}: its times are no frame numbers, so --frame-hz has no effect. Leave it out.")
        good = _good(path, rows, repair)
        repaired["missing"] += int((~good).sum())
        rows = rows.take(good)
        values, code = np.unique(rows.actors.astype(str), return_inverse=True)
        numbers = [names.setdefault(name, len(names)) for name in values.tolist()]
        n = len(code)
        kind_names = np.full(n, "") if rows.kinds is None else rows.kinds.astype(str)
        parts.append(
            _Readings(
                actor=np.array(numbers, np.int64)[code],
                time_s=rows.time_s,
                xy=rows.xy,
                speed=np.full(n, np.nan) if rows.speed is None else rows.speed,
                kind=_numbered(kind_names, kind_codes),
                lw_m=np.full((n, 2), np.nan) if rows.lw_m is None else rows.lw_m,
            )
        )
    read = _Readings.concat(parts)
    if not len(read.actor):
        raise TrafficError(f"{paths[0]}: no position in it. Give a trace with at least one row.")
    where = ", ".join(map(str, paths))
    _check_order(where, list(names), read, repaired, repair)
    read = read.take(np.lexsort((read.time_s, read.actor)))
    read = read.take(_without_copies(where, list(names), read, repaired, repair))
    time_s, xy = read.time_s, read.xy
    projection = to_net
    if degrees and projection is None:
        projection = Projection(*np.median(xy, axis=0).tolist())
    xy_m = xy if projection is None or not degrees else _projected(where, xy, projection)
    if not degrees:
        _check_metres(where, read.actor, time_s, xy_m)
    is_said = time_unit_s is not None and length_unit_m is not None
    units.check_speeds(where, read.actor, time_s, xy_m, read.speed, is_said)
    name_of, actor, n_again = _reused(list(names), read.actor, time_s, xy_m, read.kind)
    read = replace(read, actor=actor, xy=xy_m)
    if n_again:
        read_as[f"{n_again} ids come back elsewhere or later as another class: they are other actors"] = None
        read = read.take(np.argsort(actor, kind="stable"))
    kind, n_several = _classes(read.actor, read.kind, len(name_of))
    if n_several:
        read_as[f"classes of {n_several} actors change: each has its most frequent one"] = None
    kinds = [list(kind_codes)[code] for code in kind.tolist()]
    if guessed := sorted({kind for kind in kinds if kind and not vtypes.is_plain(kind)}):
        few = [f"{kind} as {vtypes.guess(kind).vclass}" for kind in guessed[:5]]
        more = f" and {len(guessed) - 5} more" if len(guessed) > 5 else ""
        read_as[f"classes guessed from their names: {', '.join(few)}{more}"] = None
    if off_road := sorted({kind for kind in kinds if vtypes.guess(kind).vclass not in SHAPE_OF_CLASS}):
        read_as[f"{', '.join(off_road)} as cars here; a run leaves them out, because they are not on the road"] = None
    begin = float(read.time_s.min())
    lw_m = pd.DataFrame(read.lw_m).groupby(read.actor).median().to_numpy()
    return Fixes(
        names=name_of,
        kinds=kinds,
        actor=read.actor,
        time_s=read.time_s - begin,
        xy_m=read.xy,
        begin=f"{begin:.6f}".rstrip("0").rstrip("."),
        repaired={reason: n for reason, n in repaired.items() if n},
        own_lw_m=None if np.isnan(lw_m).all() else lw_m,
        projection=projection if degrees and to_net is None else None,
        read_as=tuple(read_as),
        source=where,
        is_front=rows.is_front,
    )


def _numbered(names: ndarray, codes: dict[str, int]) -> Int[ndarray, "n"]:
    """The number of each name; names without a number get the next ones in `codes`."""
    row, found = pd.factorize(names)
    number = [codes.setdefault(name, len(codes)) for name in found.tolist()]
    return np.array(number, np.int64)[row]


def _reused(
    names: list[str],
    actor: Int[ndarray, "n"],
    time_s: Float[ndarray, "n"],
    xy_m: Float[ndarray, "n 2"],
    kind: Int[ndarray, "n"],
) -> tuple[list[str], Int[ndarray, "n"], int]:
    """Names and numbers of actors, where an id that is given again is another actor: its class changes, and it has not
    been seen for long, or cannot have driven there. And how many there are."""
    took_s = np.diff(time_s)
    way_m = np.hypot(*np.diff(xy_m, axis=0).T)
    away = (took_s > _LONG_S) | (way_m > _FASTEST_MPS * took_s)
    is_known = (kind[1:] > 0) & (kind[:-1] > 0)
    changes = is_known & (np.diff(kind) != 0)
    again = np.flatnonzero(away & changes & (np.diff(actor) == 0)) + 1
    taken, names, actor = set(names), list(names), actor.copy()
    for row in again.tolist():
        of, n = actor[row], 2
        while (name := f"{names[of]}/{n}") in taken:
            n += 1
        taken.add(name)
        names.append(name)
        actor[row:][actor[row:] == of] = len(names) - 1
    return names, actor, len(again)


def _classes(
    actor: Int[ndarray, "n"],
    kind: Int[ndarray, "n"],
    n_actors: int,
) -> tuple[Int[ndarray, "a"], int]:
    """The most frequent class of each actor, 0 without any, and the number of actors that have several."""
    said = pd.DataFrame({"actor": actor, "kind": kind})[kind > 0]
    counts = said.groupby(["actor", "kind"]).size().sort_values(ascending=False, kind="stable").reset_index()
    first = counts.drop_duplicates("actor")
    found = np.zeros(n_actors, np.int64)
    found[first.actor.to_numpy()] = first.kind.to_numpy()
    return found, int((counts.actor.value_counts() > 1).sum())


def _rows(
    path: Path,
    columns: PositionColumns | None,
    frame_hz: float | None,
    time_unit_s: float | None,
    length_unit_m: float | None,
) -> _Rows:
    """The rows of one file."""
    is_parquet = path.name.removesuffix(".gz").endswith(".parquet")
    layout = layout_of(path) if columns is None else ""
    if layout == "crawdad":
        return _crawdad(path)
    if layout == "pneuma":
        return _pneuma(path)
    if is_parquet:
        names = _parquet_names(path)
    else:
        header = delimited.header(path)
        names = header.names
        if names[: len(_PNEUMA)] == _PNEUMA:
            raise TrafficError(
                f"{path}: pNEUMA, with rows of any length, is read by itself. Leave out --id, --time, --lat and --lon."
            )
        delimited.check_header(path, header, ())
    if columns is None:
        if not layout:
            raise TrafficError(
                f"{path}: no layout that is known by its columns ({_said(path)}). Name the columns with --id, "
                "--time and --x and --y in metres, or --lat and --lon in degrees."
            )
        columns = LAYOUTS[layout].spelled(names)
    columns = replace(
        columns,
        time_unit_s=time_unit_s or columns.time_unit_s,
        length_unit_m=length_unit_m or columns.length_unit_m,
    )
    if not layout and columns.kind and columns.kind not in names:
        raise TrafficError(f"{path}: no column {columns.kind}, which --class names. It has {', '.join(names[:20])}.")
    columns = _with_optional(columns, names)
    _check_units(path, columns, time_unit_s, length_unit_m)
    table = _table(path, columns, names)
    read_as = [f"layout {layout}"] if layout not in ("", "table", "degrees") else []
    try:
        unit_m, said = units.length_unit(columns.x, columns.y, columns.length_unit_m)
    except ValueError as error:
        raise TrafficError(f"{path}: {error}") from None
    read_as += [said] if said and not columns.is_degrees else []

    def numbers(name: str) -> Float[ndarray, "n"]:
        return delimited.numbers(path, name, table.column(name))

    x, y = numbers(columns.x), numbers(columns.y)
    if columns.corner is not None:
        length, width = columns.corner
        x = x + numbers(length) / 2
        y = y + numbers(width) / 2
    if columns.y_down:
        y = -y
        read_as.append("y of the image, which points down, is turned")
    xy = np.column_stack([x, y]) * (1.0 if columns.is_degrees else unit_m)
    time = table.column(columns.time)
    if columns.is_frame:
        time_s = numbers(columns.time) / (frame_hz or _frame_hz(path))
    elif units.is_number(time):
        raw = numbers(columns.time)
        unit_s, said = units.time_unit(columns.time, raw, columns.time_unit_s)
        read_as += [said] if said else []
        time_s = raw * unit_s
    else:
        time_s = delimited.seconds(path, columns.time, time)
    _check_site(path, columns, table)
    actors = delimited.texts(path, columns.actor, table.column(columns.actor))
    if columns.repeat:
        again = delimited.texts(path, columns.repeat, table.column(columns.repeat))
        actors = pc.binary_join_element_wise(actors, again, ":")
    actors = actors.to_numpy()
    kinds, lw_m = _kinds_and_sizes(path, table, columns, actors, unit_m)
    if kinds is None and layout in ("highd", "ind"):
        read_as.append("no tracksMeta file beside it says the classes: all are cars")
    speed = units.speeds(path, table)
    if unread := [name for name in names if name.lower().startswith(_DIRECTIONS)]:
        read_as.append(f"{', '.join(unread)} not read: actors look where they go, and north before they move")
    if flat := [name for name in names if name.lower().split("_")[0] in _HEIGHTS]:
        read_as.append(f"{', '.join(flat)} not read: the road is flat")
    return _Rows(
        actors=actors,
        time_s=time_s,
        xy=xy,
        is_degrees=columns.is_degrees,
        is_frame=columns.is_frame,
        kinds=kinds,
        lw_m=lw_m,
        speed=speed,
        read_as=tuple(read_as),
        is_front=columns.is_front,
    )


def _with_optional(columns: PositionColumns, names: Sequence[str]) -> PositionColumns:
    """The columns with those of classes and sizes that the table has, where none is named."""
    kinds = [name for name in (columns.kind, *_KINDS) if name in names]
    length, width = columns.size if set(columns.size) <= set(names) else ("length", "width")
    if length not in names:
        length = width = ""
    elif width not in names:
        width = ""
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
                lw_m[:, axis] = unit_m * delimited.numbers(path, name, table.column(name))
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


def _crawdad(path: Path) -> _Rows:
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
    return _Rows(table.column("id").to_numpy(), time_s, xy, is_degrees=True, read_as=("layout crawdad",))


def _pneuma(path: Path) -> _Rows:
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
    return _Rows(
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


def _good(path: Path, rows: _Rows, repair: bool) -> Bool[ndarray, "n"]:
    """Rows with an actor, a time and a position that are there and finite."""
    good = np.isfinite(rows.time_s) & np.isfinite(rows.xy).all(axis=1)
    good &= ~pd.isna(rows.actors)
    bad = np.flatnonzero(~good)
    if len(bad) and not repair:
        row = int(bad[0])
        raise TrafficError(
            f"{path}: row {row + 1} ({rows.actors[row]!r}) has a value missing or not finite, and "
            f"{len(bad)} of {len(good)} rows do. Correct them, or leave them out with --repair."
        )
    return good


def _check_order(where: str, names: list[str], read: _Readings, repaired: dict[str, int], repair: bool) -> None:
    """Refuse an actor whose rows go back in time; sorting does not help where it is two actors, or at midnight."""
    actor, time_s = read.actor, read.time_s
    order = np.argsort(actor, kind="stable")
    is_same = np.diff(actor[order]) == 0
    back = is_same & (np.diff(time_s[order]) < 0)
    if not back.any():
        return
    row = order[int(np.flatnonzero(back)[0]) + 1]
    said = (
        f"{where}: the rows of {names[actor[row]]!r} are not in the order of time, as {int(back.sum())} of "
        f"{len(actor)} rows are not."
    )
    mine = np.flatnonzero(actor == actor[row])
    fall_s = -np.diff(time_s[mine]).min()
    if time_s.max() <= _DAY_S < 2 * fall_s and not time_s.min() < 0:
        raise TrafficError(
            f"{said} Its times fall by {fall_s:g} s: are they times of day, and midnight is between? Write dates with "
            "times, or count hours on from 24. If not, sort the rows."
        )
    xy = read.xy[mine]
    sorted_xy = xy[np.argsort(time_s[mine], kind="stable")]
    if _way(sorted_xy) > _ZIGZAG * _way(xy):
        raise TrafficError(
            f"{said} Sorted, they jump to and fro: is it the id of several vehicles at once? Give each its own."
        )
    if not repair:
        raise TrafficError(f"{said} Sort them, or let --repair do it.")
    repaired["unordered"] += int(back.sum())


def _way(xy: Float[ndarray, "n 2"]) -> float:
    """Length of a way, in the unit of the positions."""
    return float(np.hypot(*np.diff(xy, axis=0).T).sum())


def _without_copies(
    where: str, names: list[str], read: _Readings, repaired: dict[str, int], repair: bool
) -> Bool[ndarray, "n"]:
    """Rows of an actor that are the first of their time."""
    again = (np.diff(read.actor) == 0) & (np.diff(read.time_s) == 0)
    moves = (np.diff(read.xy, axis=0) != 0).any(axis=1)
    other = np.flatnonzero(again & moves) + 1
    if len(other) and not repair:
        row = int(other[0])
        raise TrafficError(
            f"{where}: {names[read.actor[row]]!r} has two positions at the time "
            f"{read.time_s[row]:.10g} s, and there are {len(other)} such rows. Are these recordings of their own? "
            "Then count each in its own command; or keep the first of such rows with --repair."
        )
    repaired["repeated"] += int(again.sum())
    return np.append(True, ~again)


def _projected(where: str, degrees: Float[ndarray, "n 2"], to_world: Projection) -> Float[ndarray, "n 2"]:
    """East and north of latitudes and longitudes, on a transverse Mercator map."""
    most = np.abs(degrees).max(axis=0)
    if most[0] > _MOST_DEGREES[0] or most[1] > _MOST_DEGREES[1]:
        hint = " Are they the other way round?" if most[0] <= 180 and most[1] <= 90 else " Are they metres?"
        raise TrafficError(
            f"{where}: latitudes reach {most[0]:g} and longitudes {most[1]:g} degrees; at most 90 and 180 can be.{hint}"
        )
    xy_m = to_world.to_world(degrees[:, 0], degrees[:, 1])
    from_m = xy_m - np.median(xy_m, axis=0)
    if not np.isfinite(xy_m).all() or np.abs(from_m).max() > 2e6:
        raise TrafficError(
            f"{where}: positions reach {np.nanmax(np.abs(from_m)) / 1000:,.0f} km from their median: no map without "
            "distortion shows all of them. Leave out those far away."
        )
    return xy_m


def _check_metres(where: str, actor: ndarray, time_s: ndarray, xy_m: Float[ndarray, "n 2"]) -> None:
    """Refuse degrees that are given as metres, and coordinates that are nowhere on Earth."""
    if np.abs(xy_m).max() > LARGEST_COORDINATE_M:
        raise TrafficError(f"{where}: coordinates reach {np.abs(xy_m).max():g} m, which is no place on Earth.")
    gone_m = np.hypot(*np.diff(xy_m, axis=0).T)
    moved = (np.diff(actor) == 0) & (gone_m > 0)
    speeds_mps = gone_m[moved] / np.diff(time_s)[moved]
    fastest = speeds_mps.max(initial=0.0)
    if len(speeds_mps) and fastest < _CRAWL_MPS:
        is_small = np.abs(xy_m).max() <= _MOST_DEGREES[1]
        said = "x and y look like degrees or kilometres" if is_small else "x and y look like kilometres"
        raise TrafficError(
            f"{where}: nothing is faster than {fastest:.2g} m/s, so {said}, or the times like milliseconds. Name "
            "degrees with --lat and --lon, or set --length-unit or --time-unit."
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
