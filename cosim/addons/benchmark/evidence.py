"""The evidence set of the benchmark: what trust models receive in recorded worlds, without and under each attack.

A *world* is a city, a penetration and a seed. A *case* of a world is the same traffic and the same honest detections
under one attack; case 0 is without attack. The set stores case 0 completely, and of every other case the rows that
differ. Scores, evaluations and visibilities are stored in percent, the resolution of the confidences of a collective
perception message (ETSI TS 103 324).
"""

import hashlib
import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.base.durable import open_regular

HONEST = "none"
"""Name of case 0."""
MANIFEST = "benchmark.json"
SHIPPED = Path(__file__).parent / "set"
"""Folder of the set that ships with this package."""

Rows = Mapping[str, ndarray]
"""Columns of a table, sorted by its key."""


class EvidenceTable(NamedTuple):
    """A table of the set. `evidence.toml` says what the columns mean."""

    keys: tuple[str, ...]
    """The columns that identify a row of one case, which come first."""
    columns: Mapping[str, type]
    """Type of each column in memory."""


TABLES: dict[str, EvidenceTable] = {}
for _name, _table in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")).items():
    _columns = {column: np.dtype(kind).type for column, kind in _table["columns"].items()}
    TABLES[_name] = EvidenceTable(tuple(_table["keys"]), _columns)
_BITS = {"step": 12, "detection_step": 12, "detection_index": 12}
"""Bits of a key column in a packed key; the others are pseudonyms and have `_PSEUDONYM_BITS`."""
_PSEUDONYM_BITS = 13
MOST_PSEUDONYMS = 1 << _PSEUDONYM_BITS
_MOST_BYTES, _MOST_FILE_BYTES, _MOST_ROWS, _MOST_BYTES_OF_ROW = 1_000_000, 1_000_000_000, 20_000_000, 100
"""Largest manifest, file and table that are read, and bytes of a column per row: the folder may be a stranger's."""


@dataclass(frozen=True, slots=True)
class EvidencePlace:
    """Where evidence was recorded."""

    city: str
    penetration_p: float
    seed: int


@dataclass(frozen=True, slots=True)
class EvidenceRules:
    """What holds for all worlds of a set."""

    dt_s: float
    n_steps: int
    start_step: int
    """First step of every attack."""
    server_period_s: float
    eta: float
    """As `trust.params.eta_of`."""
    freshness_s: float
    """`trust.freshness_s` of all models."""
    cases: tuple[str, ...]
    """Names of the attacks; the first is `HONEST`."""


_RULES: Mapping[str, tuple[Any, float, float]] = {
    "dt_s": (int | float, 1e-3, 3600),
    "n_steps": (int, 1, 1 << _BITS["step"]),
    "start_step": (int, 0, np.inf),
    "server_period_s": (int | float, 1e-3, 1e6),
    "eta": (int | float, -1, 1),
    "freshness_s": (int | float, 1e-3, 1e9),
}
"""Type, smallest and largest value of each rule that is a number."""


def _limits(rules: EvidenceRules, n_worlds: int) -> Mapping[str, tuple[int, int]]:
    """Smallest and largest value of each column that is no pseudonym; a column means the same in every table."""
    return {
        "world": (0, n_worlds - 1),
        "case": (0, len(rules.cases) - 1),
        "gone": (0, 1),
        "attacks": (0, 1),
        **dict.fromkeys(("step", "detection_step", "message_step"), (0, rules.n_steps - 1)),
        "broadcast_step": (-1, rules.n_steps - 1),
        "arrival_step": (-1, (1 << 15) - 1),
        "detection_index": (0, (1 << _BITS["detection_index"]) - 1),
        "score": (0, 100),
        "evaluation": (-100, 100),
        "visibility": (0, 100),
    }


_REFERENCES: Sequence[tuple[str, tuple[str, ...], str]] = (
    ("detections", ("observer",), "pseudonyms"),
    ("reports", ("evaluator",), "pseudonyms"),
    ("pseudonyms", ("vehicle",), "pseudonyms"),
    ("lookups", ("receiver",), "pseudonyms"),
    ("lookups", ("message_step", "sender"), "reports"),
    ("evaluations", ("step", "evaluator"), "reports"),
    ("evaluations", ("detection_step", "observer", "detection_index"), "detections"),
)
"""Columns of a table that name a row of another table: table, columns, and the table that has their values as keys."""


@dataclass(frozen=True, slots=True)
class EvidenceStream:
    """The evidence of one case of one world: a table of rows for each of `TABLES`."""

    detections: Rows
    reports: Rows
    evaluations: Rows
    lookups: Rows
    pseudonyms: Rows

    def attackers(self) -> Bool[ndarray, "p"]:
        """Ground truth: whether the vehicle of each pseudonym attacks, by pseudonym."""
        found = np.zeros(MOST_PSEUDONYMS, bool)
        found[self.pseudonyms["pseudonym"]] = self.pseudonyms["attacks"] > 0
        return found


@dataclass(frozen=True, slots=True)
class EvidenceSet:
    """All worlds and cases of a version of the benchmark."""

    version: str
    rules: EvidenceRules
    worlds: tuple[EvidencePlace, ...]
    tables: Mapping[str, Rows]
    """Each table with the columns world, case and gone before its own; sorted by world, case and key. Of case 0 all
    rows; of the others rows that replace or join those of case 0, or, if `gone` is 1, take them away."""

    def stream(self, world: int, case: int) -> EvidenceStream:
        """The evidence of a case of a world, by their numbers."""
        return EvidenceStream(**{name: self._rows(name, world, case) for name in TABLES})

    def _rows(self, name: str, world: int, case: int) -> Rows:
        table, rows = TABLES[name], self.tables[name]
        base, change = (_slice(rows, world, c) for c in (0, case))
        columns = {column: rows[column][base] for column in table.columns}
        if not case:
            return columns
        changed = {column: rows[column][change] for column in table.columns}
        stays = ~np.isin(packed(name, columns), packed(name, changed))
        new = rows["gone"][change] == 0
        return merged(name, joined([taken(columns, stays), taken(changed, new)]))

    @property
    def checksum(self) -> str:
        """SHA-256 over the content: rules, worlds and every column of every table."""
        digest = hashlib.sha256(json.dumps(self._head(), sort_keys=True).encode())
        for name, table in TABLES.items():
            for column in ("world", "case", "gone", *table.columns):
                values = self.tables[name][column]
                digest.update(f"{name}.{column}:{len(values)}:".encode())
                digest.update(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes())
        return digest.hexdigest()

    def _head(self) -> dict[str, Any]:
        rules = {name: getattr(self.rules, name) for name in EvidenceRules.__slots__}
        worlds = [[w.city, w.penetration_p, w.seed] for w in self.worlds]
        return {"version": self.version, "rules": rules | {"cases": list(self.rules.cases)}, "worlds": worlds}

    def write(self, folder: Path) -> None:
        """Write the set into a folder: one Parquet file per table, and the manifest with the checksum."""
        folder.mkdir(parents=True, exist_ok=True)
        for name in TABLES:
            pq.write_table(
                pa.table(dict(self.tables[name])),
                folder / f"{name}.parquet",
                compression="zstd",
                compression_level=19,
                use_dictionary=False,
                column_encoding="DELTA_BINARY_PACKED",
            )
        text = json.dumps(self._head() | {"sha256": self.checksum}, indent=1)
        (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")


def _slice(rows: Rows, world: int, case: int) -> slice:
    """Rows of a case of a world; they are sorted by (world, case)."""
    of_world = slice(*np.searchsorted(rows["world"], [world, world + 1]))
    begin, end = np.searchsorted(rows["case"][of_world], [case, case + 1])
    return slice(of_world.start + begin, of_world.start + end)


def packed(name: str, rows: Rows) -> Int[ndarray, "n"]:
    """The key of each row of a table as one integer, whose order is that of the keys."""
    found = np.zeros(len(next(iter(rows.values()))), np.int64)
    for column in TABLES[name].keys:
        found = found << _BITS.get(column, _PSEUDONYM_BITS) | rows[column]
    return found


def merged(name: str, rows: Rows) -> Rows:
    """The rows of a table, sorted by key, in the dtypes of the table."""
    for c in TABLES[name].keys:
        values, most = rows[c], 1 << _BITS.get(c, _PSEUDONYM_BITS)
        fits = (values >= 0) & (values < most)
        assert fits.all(), f"{name}.{c} has more than {most} values"
    order = np.argsort(packed(name, rows), kind="stable")
    ordered = taken(rows, order)
    dtypes = TABLES[name].columns
    return {column: ordered[column].astype(dtype) for column, dtype in dtypes.items()}


def taken(rows: Rows, chosen: Int[ndarray, "k"] | Bool[ndarray, "n"]) -> Rows:
    """Some of the rows."""
    return {column: values[chosen] for column, values in rows.items()}


def joined(parts: Sequence[Rows]) -> Rows:
    """The rows of all parts, which have the same columns, one part after another."""
    return {column: np.concatenate([rows[column] for rows in parts]) for column in parts[0]}


def difference(name: str, base: Rows, case: Rows) -> Rows:
    """The rows of a case that differ from those of case 0, with the column `gone`."""
    old, new = packed(name, base), packed(name, case)
    at = np.minimum(np.searchsorted(old, new), max(len(old) - 1, 0))
    same = np.isin(new, old)
    for column in TABLES[name].columns:
        was = base[column][at[same]]
        same[same] = was == case[column][same]
    came, gone = ~same, ~np.isin(old, new)
    changed = {c: case[c][came] for c in TABLES[name].columns}
    rows = joined([changed, taken(base, gone)])
    order = np.argsort(packed(name, rows), kind="stable")
    n_rows = [came.sum(), gone.sum()]
    flag = np.array([0, 1], np.int8).repeat(n_rows)
    return {"gone": flag[order], **taken(rows, order)}


def assembled(
    version: str,
    rules: EvidenceRules,
    worlds: tuple[EvidencePlace, ...],
    streams: Iterator[tuple[int, int, EvidenceStream]],
) -> EvidenceSet:
    """A set from the streams of all (world, case), in their order."""
    parts: dict[str, list[Rows]] = {name: [] for name in TABLES}
    base: EvidenceStream | None = None
    for world, case, stream in streams:
        base = stream if case == 0 else base
        for name in TABLES:
            changed: Rows = getattr(stream, name)
            if case:
                changed = difference(name, getattr(base, name), changed)
            n = len(next(iter(changed.values())))
            place = {
                "world": np.full(n, world, np.int8),
                "case": np.full(n, case, np.int8),
                "gone": np.zeros(n, np.int8),
            }
            parts[name].append({**place, **changed})
    return EvidenceSet(version, rules, worlds, {name: joined(of) for name, of in parts.items()})


def load(folder: Path = SHIPPED) -> EvidenceSet:
    """Read a set and check it.

    Raises
    ------
    ValueError
        In one line, if there is no set, or it is not what was written.
    """
    try:
        with open_regular(folder / MANIFEST) as file:
            head = json.loads(file.read(_MOST_BYTES))
        rules = _rules(head["rules"])
        worlds = tuple(_place(number, one) for number, one in enumerate(head["worlds"]))
        if not isinstance(head["version"], str) or not 1 <= len(worlds) <= _MOST_NUMBERS:
            raise ValueError(f"version should be a text, and worlds 1 to {_MOST_NUMBERS} places")
        tables = {name: _read(folder, name) for name in TABLES}
        found = EvidenceSet(head["version"], rules, worlds, tables)
        checksum, expected = found.checksum, head["sha256"]
    except FileNotFoundError as error:
        raise ValueError(f"{error.filename}: no such file. Record a set: cosim benchmark --make.") from None
    except (OSError, KeyError, TypeError, ValueError, pa.ArrowException) as error:
        raise ValueError(f"{folder}: this is no evidence set, or it is damaged ({error}).") from None
    if checksum != expected:
        raise ValueError(
            f"{folder}: this evidence set was altered: its content has the checksum {checksum[:12]}, and "
            f"{MANIFEST} says {str(expected)[:12]}. Install cosim again, or record the set with cosim benchmark --make."
        )
    try:
        _check(found)
    except ValueError as error:
        raise ValueError(f"{folder}: this evidence set cannot be true: {error}.") from None
    return found


_MOST_NUMBERS = 1 << 7
"""Worlds, and cases, whose numbers fit into a column."""


def _rules(about: Any) -> EvidenceRules:
    """The rules in a manifest; ValueError if one cannot be."""
    cases = about["cases"]
    if not isinstance(cases, list):
        raise ValueError("cases should be names of attacks")
    if not all(isinstance(name, str) and name for name in cases):
        raise ValueError("cases should be names of attacks")
    are_different = len(set(cases)) == len(cases)
    has_attacks = 2 <= len(cases) <= _MOST_NUMBERS
    if cases[:1] != [HONEST] or not are_different or not has_attacks:
        raise ValueError(f"cases should be {HONEST!r} and 1 to {_MOST_NUMBERS - 1} attacks, each once")
    for name, (kind, least, most) in _RULES.items():
        value = about[name]
        is_number = isinstance(value, kind) and not isinstance(value, bool)
        if not is_number or not least <= value <= most:
            said = str(value)[:40]
            raise ValueError(f"{name} = {said!r} should be a number from {least:g} to {most:g}")
    return EvidenceRules(**{**about, "cases": tuple(cases)})


def _place(number: int, about: Any) -> EvidencePlace:
    """A world in a manifest; ValueError if it cannot be."""
    place = EvidencePlace(*about)
    is_share = isinstance(place.penetration_p, int | float) and 0 <= place.penetration_p <= 1
    if not isinstance(place.city, str) or not is_share or not isinstance(place.seed, int):
        raise ValueError(f"world {number} should be a city, a penetration from 0 to 1 and a seed")
    return place


def _read(folder: Path, name: str) -> Rows:
    """The columns of a table, and no others. What a file says of its size is checked before it is read."""
    wanted: dict[str, type] = {"world": np.int8, "case": np.int8, "gone": np.int8}
    wanted |= TABLES[name].columns
    with open_regular(folder / f"{name}.parquet") as opened:
        content = opened.read(_MOST_FILE_BYTES + 1)
    if len(content) > _MOST_FILE_BYTES:
        raise ValueError(f"{name} has more than {_MOST_FILE_BYTES:,} bytes")
    with pq.ParquetFile(pa.BufferReader(content)) as file:  # threads that read a Python file may outlive a refusal
        about, schema = file.metadata, file.schema_arrow
        if about.num_rows > _MOST_ROWS:
            raise ValueError(f"{name} has {about.num_rows:,} rows, more than {_MOST_ROWS:,}")
        for column, dtype in wanted.items():
            if schema.field(column).type != pa.from_numpy_dtype(dtype):
                raise ValueError(f"{name}.{column} has the type {schema.field(column).type}")
        n_bytes = 0
        for number in range(about.num_row_groups):
            group = about.row_group(number)
            chunks = [group.column(place) for place in range(about.num_columns)]
            n_bytes += sum(chunk.total_uncompressed_size for chunk in chunks if chunk.path_in_schema in wanted)
        if n_bytes > len(wanted) * (about.num_rows + 1000) * _MOST_BYTES_OF_ROW:
            raise ValueError(f"{name} has {n_bytes:,} bytes for {about.num_rows:,} rows")
        table = file.read(columns=list(wanted), use_threads=False)
    rows = {column: table[column].to_numpy() for column in wanted}
    for column, dtype in wanted.items():
        if rows[column].dtype != dtype:
            raise ValueError(f"{name}.{column} has empty cells")
    return rows


def _check(found: EvidenceSet) -> None:
    """Check every value of a set against its meaning, and the rows of every stream against each other.

    Raises
    ------
    ValueError
        In part of a line: which value of which table cannot be, and why.
    """
    rules, limits = found.rules, _limits(found.rules, len(found.worlds))
    if rules.start_step >= rules.n_steps:
        raise ValueError(f"attacks start in step {rules.start_step} of {rules.n_steps}")
    for name, rows in found.tables.items():
        for column, values in rows.items():
            least, most = limits.get(column, (0, MOST_PSEUDONYMS - 1))
            odd = (values < least) | (values > most)
            _refuse(name, rows, odd, f"{column} should be {least} to {most}")
        of = rows["world"].astype(np.int64) << 8 | rows["case"]
        key, same = packed(name, rows), np.diff(of) == 0
        unsorted = (np.diff(of) < 0) | (same & (np.diff(key) <= 0))
        _refuse(name, rows, np.append(False, unsorted), "it should come after the row before it, and be there once")
        _refuse(name, rows, (rows["gone"] > 0) & (rows["case"] == 0), "gone goes with another case than 0")
    for world in range(len(found.worlds)):
        for case in range(len(rules.cases)):
            _check_stream(found.stream(world, case))


def _check_stream(stream: EvidenceStream) -> None:
    """Check the rows of a stream against each other."""
    for name, columns, of in _REFERENCES:
        rows, named = getattr(stream, name), getattr(stream, of)
        keys = TABLES[of].keys
        given = {key: rows[column] for key, column in zip(keys, columns, strict=True)}
        strange = ~np.isin(packed(of, given), packed(of, named))
        _refuse(name, rows, strange, f"{' and '.join(columns)} should name a row of {of}")
    reports, asked, who = stream.reports, stream.lookups, stream.pseudonyms
    early = (reports["arrival_step"] >= 0) & (reports["arrival_step"] < reports["step"])
    _refuse("reports", reports, early, "it arrives before it is sent")
    _refuse("lookups", asked, asked["broadcast_step"] > asked["step"], "the broadcast is of a later step")
    _refuse("lookups", asked, asked["receiver"] == asked["sender"], "a vehicle looks itself up")
    differs = stream.attackers()[who["vehicle"]] != (who["attacks"] > 0)
    _refuse("pseudonyms", who, differs, "pseudonyms of one vehicle should attack together")


def _refuse(name: str, rows: Rows, wrong: Bool[ndarray, "n"], why: str) -> None:
    """ValueError about the first row that is wrong, if there is one."""
    if wrong.any():
        row = int(np.argmax(wrong))
        said = [f"{column} {values[row]}" for column, values in rows.items()]
        raise ValueError(f"{name} has a row with {', '.join(said)}: {why}")
