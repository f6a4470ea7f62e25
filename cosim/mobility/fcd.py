"""Reads SUMO's floating car data (`--fcd-output`) timestep by timestep: XML, CSV or Parquet, gzipped or not."""

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
from jaxtyping import Float
from numpy import ndarray

from cosim.mobility.frame import TrafficError
from sumo_nets.xml import Attributes, check_regular, feed, open_input

SUFFIXES = (".xml", ".xml.gz", ".csv", ".csv.gz", ".parquet")
"""File name endings of traces."""

_COLUMNS = ("x", "y", "angle", "speed")
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


def timesteps(path: Path) -> Iterator[Timestep]:
    """Read the timesteps of a trace in the order of time. One block of the file is in memory at a time.

    Persons inside a vehicle are included, at the vehicle's position.

    Raises
    ------
    TrafficError
        The file is damaged, lacks a column, has a number that is not finite, or is not sorted by time.
    """
    read = next(reader for suffix, reader in _READERS.items() if path.name.removesuffix(".gz").endswith(suffix))
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
        if not np.isfinite(numbers).all():
            bad = timestep.names[int(np.flatnonzero(~np.isfinite(numbers).all(axis=1))[0])]
            raise TrafficError(f"{path}: {bad!r} at {timestep.time_s:g} s has a number missing or not finite.")
        yield timestep


def _xml(path: Path) -> Iterator[Timestep]:
    done: list[Timestep] = []
    time_s = np.nan
    names: list[str] = []
    types: list[str] = []
    poses: list[list[float]] = []
    in_timestep, root = False, ""

    def start(name: str, attributes: Attributes) -> None:
        nonlocal in_timestep, time_s, root
        root = root or name
        if name == "timestep":
            in_timestep, time_s = True, _seconds(path, attributes.get("time", ""))
        elif in_timestep and name in ("vehicle", "person"):
            try:
                pose = [float(attributes[k]) for k in _COLUMNS]
                pose.append(float(attributes.get("z", 0.0)))
                names.append(attributes["id"])
            except KeyError as error:
                raise _missing(path, error.args[0]) from None
            except ValueError as error:
                raise TrafficError(f"{path}: {name} {attributes.get('id')!r} at {time_s:g} s: {error}.") from None
            types.append(attributes.get("type", ""))
            poses.append(pose)

    def end(name: str) -> None:
        nonlocal in_timestep
        if name == "timestep":
            table = np.array(poses, float).reshape(-1, 5)
            done.append(Timestep(time_s, names[:], types[:], table[:, [0, 1, 4]], table[:, 2], table[:, 3]))
            in_timestep = False
            for rows in (names, types, poses):
                rows.clear()

    try:
        for _ in feed(path, start, end):
            yield from done
            done.clear()
    except TrafficError:
        raise
    except ValueError as error:
        raise TrafficError(str(error)) from None
    if root != "fcd-export":
        raise TrafficError(
            f"{path}: not a trace: it starts with <{root}>. SUMO's --fcd-output starts with <fcd-export>."
        )
    yield from done


def _csv(path: Path) -> Iterator[Timestep]:
    def batches() -> Iterator[pa.RecordBatch]:
        with open_input(path) as source:
            head = source.read(1 << 16).partition(b"\n")[0].decode(errors="replace").strip()
        separator = next((s for s in ";,\t|" if s in head), ";")
        columns = head.replace('"', "").split(separator)
        if twice := sorted({name for name in columns if columns.count(name) > 1}):
            raise TrafficError(f"{path}: its header has the column {twice[0]} twice. Remove one of them.")
        text = {n: pa.string() for n in columns if n.endswith(("id", "type"))}
        with open_input(path) as source:
            yield from pcsv.open_csv(
                pa.PythonFile(source, mode="r"),
                pcsv.ReadOptions(block_size=1 << 22),
                pcsv.ParseOptions(delimiter=separator),
                pcsv.ConvertOptions(column_types=text, strings_can_be_null=True, quoted_strings_can_be_null=False),
            )

    return _arrow(path, batches)


def _parquet(path: Path) -> Iterator[Timestep]:
    def batches() -> Iterator[pa.RecordBatch]:
        check_regular(path)
        with pq.ParquetFile(path, buffer_size=_READ_BYTES) as file:
            if len(set(file.schema_arrow.names)) < len(file.schema_arrow.names):
                raise TrafficError(f"{path}: two of its columns have the same name. Remove one of them.")
            yield from file.iter_batches(_BLOCK_ROWS)

    return _arrow(path, batches)


_READERS: dict[str, Callable[[Path], Iterator[Timestep]]] = {".xml": _xml, ".csv": _csv, ".parquet": _parquet}


def _arrow(path: Path, batches: Callable[[], Iterator[pa.RecordBatch]]) -> Iterator[Timestep]:
    """Split blocks of rows into timesteps. A timestep that spans two blocks is joined."""
    left = None
    try:
        for batch in batches():
            table = pa.Table.from_batches([_needed(path, batch)])
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
    except (pa.ArrowException, OSError, EOFError, zlib.error, ValueError) as error:
        cause = (str(error) or type(error).__name__).splitlines()[0].removeprefix(f"{path}: ")
        raise TrafficError(f"{path}: damaged, or not a trace: {cause}.") from None


def _needed(path: Path, batch: pa.RecordBatch) -> pa.RecordBatch:
    """Select the needed columns and give them plain names, for any value of SUMO's `--output.column-header`."""
    found = {}
    for name in ("time", "id", "type", "z", *_COLUMNS):
        # SUMO names the columns after the element that it writes first: a vehicle, a person, or a container.
        kinds = ("timestep",) if name == "time" else ("vehicle", "person", "container")
        spellings = [s for s in (*(f"{kind}_{name}" for kind in kinds), name) if s in batch.schema.names]
        if not spellings:
            if name not in ("type", "z"):
                raise _missing(path, name)
            continue
        wanted = pa.string() if name in ("id", "type") else pa.float64()
        try:
            found[name] = pc.coalesce(*(batch.column(s).cast(wanted) for s in spellings))
        except pa.ArrowException as error:
            raise TrafficError(f"{path}: column {name}: {str(error).splitlines()[0]}.") from None
    n = len(batch)
    found.setdefault("type", pa.array([""] * n, pa.string()))
    found.setdefault("z", pa.array(np.zeros(n)))
    if found["time"].null_count:
        raise TrafficError(f"{path}: a row has no time.")
    return pa.RecordBatch.from_pydict(dict(sorted(found.items())))


def _timestep(rows: pa.Table) -> Timestep:
    time_s = rows.column("time")[0].as_py()
    rows = rows.filter(rows.column("id").is_valid())

    def numbers(name: str, default: float) -> ndarray:
        return pc.fill_null(rows.column(name), default).to_numpy()

    x, y, angle, speed = (numbers(name, np.nan) for name in _COLUMNS)
    return Timestep(
        time_s, rows.column("id").to_pylist(), pc.fill_null(rows.column("type"), "").to_pylist(),
        np.column_stack([x, y, numbers("z", 0.0)]), angle, speed,
    )  # fmt: skip


def _seconds(path: Path, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise TrafficError(
            f"{path}: time {text!r} is not a number of seconds. Record it without --human-readable-time."
        ) from None


def _missing(path: Path, column: str) -> TrafficError:
    return TrafficError(
        f"{path}: no {column} of its vehicles. Record it with --fcd-output.attributes x,y,z,angle,type,speed, "
        "or without that option."
    )
