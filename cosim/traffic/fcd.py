"""Reads SUMO's floating car data (`--fcd-output`) timestep by timestep: XML, CSV or Parquet, gzipped or not."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Bool, Float
from numpy import ndarray

from cosim.base.earth import Projection
from cosim.traffic import delimited
from cosim.traffic.frame import TrafficError
from sumo_nets.xml import Attributes, check_regular, feed

SUFFIXES = (".xml", ".xml.gz", ".csv", ".csv.gz", ".parquet")
"""File name endings of traces."""

_COLUMNS = ("x", "y", "angle", "speed")
_SIZES = ("length", "width", "height")
_TEXTS = ("id", "type", "vClass", "lane", "edge")
_READ = ("time", "z", *_TEXTS, *_COLUMNS, *_SIZES)
"""All columns that are read."""
_ON_FOOT_MPS = 5.0
"""Pedestrians are not faster."""
_BLOCK_ROWS = 1 << 16
_READ_BYTES = 1 << 16  # read from a column at once; without a buffer size, a whole column is read


@dataclass(frozen=True, slots=True)
class Timestep:
    """All actors of one timestep of a trace, in the order of the file."""

    time_s: float
    names: list[str]
    types: list[str]
    front_m: Float[ndarray, "n 3"]  # centre of the front bumper
    compass_deg: Float[ndarray, "n"]
    speed_mps: Float[ndarray, "n"]
    is_person: Bool[ndarray, "n"]  # or a container, where its class says so
    vclasses: list[str] | None = None
    """SUMO's vehicle class of each actor, where the trace says it itself, as those of cosim do."""
    lwh_m: Float[ndarray, "n 3"] | None = None
    """Length, width and height, where the trace says them itself."""


def timesteps(path: Path) -> Iterator[Timestep]:
    """Read the timesteps of a trace in the order of time. One block of the file is in memory at a time.

    Persons inside a vehicle are included, at the vehicle's position.

    Raises
    ------
    TrafficError
        The file is damaged, lacks a column, has a number that is not finite, or is not sorted by time.
    """
    _, _, form = path.name.removesuffix(".gz").rpartition(".")
    read = _READERS[form]
    last_s = -np.inf
    for timestep in read(path):
        if not np.isfinite(timestep.time_s):
            raise TrafficError(f"{path}: a time is not a finite number of seconds.")
        if timestep.time_s <= last_s:
            raise TrafficError(
                f"{path}: time {timestep.time_s:g} s comes after {last_s:g} s. The rows of a trace must be sorted by "
                "time. Sort them, or record the trace again."
            )
        last_s = timestep.time_s
        numbers = np.column_stack([timestep.front_m, timestep.compass_deg, timestep.speed_mps])
        is_finite = np.isfinite(numbers).all(axis=1)
        if not is_finite.all():
            bad = timestep.names[int(np.argmin(is_finite))]
            raise TrafficError(f"{path}: {bad!r} at {timestep.time_s:g} s has a number missing or not finite.")
        yield timestep


PROJECTION = b"cosim.projection"
"""Key of the metadata of a Parquet file: latitude and longitude of the middle of a map in metres."""


OBSERVED = b"cosim.observed"
"""Key of the metadata of a trace of `cosim trace`: its actors come into view and leave it, and no timestep is lost."""
OBSERVED_COLUMN = "vehicle_observed"
"""A column that says the same: programs that filter a trace and write it again keep columns, and no metadata."""


def projection_of(path: Path) -> Projection | None:
    """The projection of positions that `cosim trace` was given in degrees. None for any other trace."""
    try:
        text = (_schema(path).metadata or {}).get(PROJECTION)
        return None if text is None else Projection(*map(float, text.decode().split()))
    except (ValueError, TypeError):
        return None


def is_observed(path: Path) -> bool:
    """Whether `cosim trace` made the trace."""
    schema = _schema(path)
    return OBSERVED_COLUMN in schema.names or OBSERVED in (schema.metadata or {})


def _schema(path: Path) -> pa.Schema:
    """Columns and metadata of a Parquet file; an empty schema of any other file."""
    if not path.name.endswith(".parquet"):
        return pa.schema([])
    try:
        return pq.read_schema(path)
    except (pa.ArrowException, OSError):
        return pa.schema([])


def _xml(path: Path) -> Iterator[Timestep]:
    done: list[Timestep] = []
    time_s = np.nan
    names: list[str] = []
    types: list[str] = []
    persons: list[bool] = []
    vclasses: list[str] = []
    poses: list[list[float]] = []
    in_timestep, root, last = False, "", ""

    def start(name: str, attributes: Attributes) -> None:
        nonlocal in_timestep, time_s, root
        root = root or name
        if name == "timestep":
            in_timestep, time_s = True, _seconds(path, attributes.get("time", ""))
        elif in_timestep and name in ("vehicle", "person", "container"):
            try:
                pose = [float(attributes[k]) for k in _COLUMNS]
                pose.append(float(attributes.get("z", 0.0)))
                pose += [float(attributes.get(k, np.nan)) for k in _SIZES]
                names.append(attributes["id"])
            except KeyError as error:
                raise _missing(path, error.args[0]) from None
            except ValueError as error:
                who = attributes.get("id")
                raise TrafficError(f"{path}: {name} {who!r} at {time_s:g} s: {error}.") from None
            types.append(attributes.get("type", ""))
            persons.append(name != "vehicle")
            vclasses.append(attributes.get("vClass", "container" if name == "container" else ""))
            poses.append(pose)

    def end(name: str) -> None:
        nonlocal in_timestep, last
        last = name
        if name == "timestep":
            table = np.array(poses, float).reshape(-1, 8)
            lwh_m = table[:, 5:]
            found = Timestep(
                time_s=time_s,
                names=names[:],
                types=types[:],
                front_m=table[:, [0, 1, 4]],
                compass_deg=table[:, 2],
                speed_mps=table[:, 3],
                is_person=np.array(persons, bool),
                vclasses=vclasses[:] if any(vclasses) else None,
                lwh_m=None if np.isnan(lwh_m).all() else lwh_m,
            )
            done.append(found)
            in_timestep = False
            for rows in (names, types, persons, vclasses, poses):
                rows.clear()

    try:
        for _ in feed(path, start, end):
            yield from done
            done.clear()
    except TrafficError:
        raise
    except ValueError as error:
        is_open = not root or (root == "fcd-export" and last != root)
        if is_open and any(words in str(error) for words in _AT_THE_END):
            at = f" after {time_s:g} s" if np.isfinite(time_s) else ""
            raise TrafficError(f"{path} ends{at}, before </fcd-export>: {delimited.ENDS_EARLY}.") from None
        raise TrafficError(str(error)) from None
    if root != "fcd-export":
        raise TrafficError(
            f"{path}: not a trace: it starts with <{root}>. SUMO's --fcd-output starts with <fcd-export>."
        )
    yield from done


_AT_THE_END = ("no element found", "unclosed token", "unclosed CDATA", "partial character", "end-of-stream")
"""What parsers say of a file whose end is missing."""


def _csv(path: Path) -> Iterator[Timestep]:
    found = delimited.header(path)
    wanted = [name for name in found.names if name in _spelled()]
    delimited.check_header(path, found, wanted)
    return _arrow(path, lambda: delimited.blocks(path, found, wanted))


def _spelled() -> set[str]:
    """All names of columns that are read."""
    return {spelling for name in _READ for spelling in _spellings(name)}


def _spellings(name: str) -> tuple[str, ...]:
    """Names of a column, for any value of SUMO's `--output.column-header`."""
    # SUMO names all columns after the element that it writes first: a vehicle, a person, or a container.
    kinds = ("timestep",) if name == "time" else ("vehicle", "person", "container")
    return *(f"{kind}_{name}" for kind in kinds), name


def _parquet(path: Path) -> Iterator[Timestep]:
    def batches() -> Iterator[pa.Table]:
        check_regular(path)
        with pq.ParquetFile(path, buffer_size=_READ_BYTES) as file:
            if len(set(file.schema_arrow.names)) < len(file.schema_arrow.names):
                raise TrafficError(f"{path}: two of its columns have the same name. Remove one of them.")
            wanted = [name for name in file.schema_arrow.names if name in _spelled()]
            for batch in file.iter_batches(_BLOCK_ROWS, columns=wanted):
                yield pa.Table.from_batches([batch])

    return _arrow(path, batches)


_READERS = {"xml": _xml, "csv": _csv, "parquet": _parquet}


def _arrow(path: Path, blocks: Callable[[], Iterator[pa.Table]]) -> Iterator[Timestep]:
    """Split blocks of rows into timesteps. A timestep that spans two blocks is joined."""
    left, n_rows = None, 0
    try:
        for block in blocks():
            table = _needed(path, block, n_rows)
            n_rows += block.num_rows
            table = table if left is None else pa.concat_tables([left, table])
            times = table.column("time").to_numpy()
            cuts = np.flatnonzero(np.diff(times)) + 1
            begins = [0, *cuts.tolist()]
            for begin, end in pairwise(begins):
                yield _timestep(table.slice(begin, end - begin))
            left = table.slice(begins[-1])
            if left.num_rows > 100 * _BLOCK_ROWS:
                raise TrafficError(f"{path}: more than {left.num_rows} rows of one time. Is its first column the time?")
        if left is not None and left.num_rows:
            yield _timestep(left)
    except TrafficError:
        raise
    except (pa.ArrowException, OSError, ValueError) as error:
        said = str(error) or type(error).__name__
        cause = said.splitlines()[0].removeprefix(f"{path}: ")
        if "magic bytes" in cause or "too small" in cause or "end of file" in cause.lower():
            raise TrafficError(
                f"{path}: damaged, or not a trace: it lacks the end of a Parquet file. {delimited.ENDS_EARLY}."
            ) from None
        raise TrafficError(f"{path}: damaged, or not a trace: {cause}.") from None


def _needed(path: Path, block: pa.Table, first_row: int) -> pa.Table:
    """The columns of a block under plain names: text and numbers. Columns that it lacks are left out."""
    found: dict[str, pa.Array | pa.ChunkedArray] = {}
    for name in _READ:
        spellings = [s for s in _spellings(name) if s in block.column_names]
        if not spellings:
            if name in ("time", "id", *_COLUMNS):
                raise _missing(path, name)
            continue
        columns = [block.column(spelling) for spelling in spellings]
        if name in _TEXTS:
            columns = [delimited.texts(path, name, column) for column in columns]
        elif name == "time":
            columns = [pa.array(delimited.seconds(path, name, column, 1.0, first_row)) for column in columns]
        else:
            numbers = [delimited.numbers(path, name, column, first_row) for column in columns]
            columns = [pa.array(n, from_pandas=True) for n in numbers]
        found[name] = pc.coalesce(*columns)
    if pc.any(pc.is_nan(pc.fill_null(found["time"], np.nan))).as_py():
        raise TrafficError(f"{path}: a row has no time.")
    return pa.table(found | {"is_person": _persons(path, block, found)})


def _persons(
    path: Path,
    block: pa.Table,
    found: dict[str, pa.ChunkedArray],
) -> Bool[ndarray, "n"]:
    """Rows of persons, as far as anything but their type tells.

    SUMO's tool `xml2csv` gives vehicles and persons columns of their own. SUMO itself names all columns after the first
    element; a person is then on an edge, and on no lane.
    """
    n = block.num_rows
    if "vehicle_id" in block.column_names and "person_id" in block.column_names:
        is_no_vehicle = block.column("vehicle_id").is_null().to_numpy()
        is_no_person = block.column("person_id").is_null().to_numpy()
        return is_no_vehicle & ~is_no_person
    if "lane" in found and "edge" in found:
        no_lane, no_edge = _is_empty(found["lane"]), _is_empty(found["edge"])
        if not no_lane.all():  # vehicles of mesoscopic traffic have no lane either
            return no_lane & ~no_edge
    if "type" in found or "person_id" not in block.column_names:
        return np.zeros(n, bool)
    speed = np.nan_to_num(np.asarray(pc.fill_null(found["speed"], 0.0)))
    if n and speed.max() > _ON_FOOT_MPS:
        raise TrafficError(
            f"{path}: its columns are named after a person, no column says a type, and some actors move at "
            f"{speed.max():.3g} m/s: vehicles and persons cannot be told apart. Record it with "
            "--fcd-output.attributes x,y,z,angle,type,speed, or without that option."
        )
    return np.ones(n, bool)


def _is_empty(texts: pa.ChunkedArray) -> Bool[ndarray, "n"]:
    return np.asarray(pc.fill_null(pc.equal(texts, ""), True))


def _timestep(rows: pa.Table) -> Timestep:
    time_s = rows.column("time")[0].as_py()
    rows = rows.filter(rows.column("id").is_valid())
    has = rows.column_names

    def numbers(name: str, default: float) -> ndarray:
        if name not in has:
            return np.full(len(rows), default)
        return pc.fill_null(rows.column(name), default).to_numpy()

    def texts(name: str) -> list[str]:
        if name not in has:
            return [""] * len(rows)
        return pc.fill_null(rows.column(name), "").to_pylist()

    x, y, angle, speed = (numbers(name, np.nan) for name in _COLUMNS)
    lwh_m = None
    if "length" in has:
        lwh_m = np.column_stack([numbers(name, np.nan) for name in _SIZES])
    return Timestep(
        time_s=time_s,
        names=rows.column("id").to_pylist(),
        types=texts("type"),
        front_m=np.column_stack([x, y, numbers("z", 0.0)]),
        compass_deg=angle,
        speed_mps=speed,
        is_person=rows.column("is_person").to_numpy(),
        vclasses=texts("vClass") if "vClass" in has else None,
        lwh_m=lwh_m,
    )


def _seconds(path: Path, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        found = delimited.clock_seconds(text)
        if found is not None:
            return found
        raise TrafficError(f"{path}: time {text!r} is neither a number of seconds nor a time of day.") from None


def _missing(path: Path, column: str) -> TrafficError:
    return TrafficError(
        f"{path}: no {column} of its vehicles. Record it with --fcd-output.attributes x,y,z,angle,type,speed, "
        "or without that option."
    )
