"""A run on disk: its tables as pandas DataFrames, read when they are first used.

`results.archive.open_run` opens a run. A table on disk is a folder of part files, one per block of steps, and the
inventory of the run lists them (`results.inventory`). Every read takes the same way: `_paths` compares the parts of a
table with the inventory, `_check` verifies the checksum of a part, `results.part_reader` reads its columns, and
`_in_bounds` refuses numbers that no run writes. Metrics read large tables block after block (`parts`, `pieces`).
"""

import copy
import os
import shlex
import shutil
import tempfile
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Self, TypeVar

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from cosim.base.codes import BASE_VARIANT
from cosim.base.durable import Damaged
from results import inventory, part_reader
from results.columns import LEVELS, WHOLE, Of
from results.inventory import Inventory
from results.manifest import status_of
from results.part_checks import content_problem, problems_of
from results.tables import TABLES, kept, schema

if TYPE_CHECKING:
    from results.sql import Database

T = TypeVar("T")
R = TypeVar("R", pa.Table, pa.RecordBatch)

ENDED = ("finished", "interrupted")
"""Statuses of a run that ended with everything written."""
WINDOW_S = "floor(step * $dt_s / $every_s + 1e-9) * $every_s"
"""In SQL: when the window of `$every_s` begins in which a step lies [s]. A little is added, because 43 x 0.1 / 0.1 is
below 43 in binary numbers."""
_ATTEMPTS = 20
"""How often the program tries to read a run that is being written."""
_PAUSE_S = 0.05
_NULLABLE = {
    pa.int32(): pd.Int32Dtype(),
    pa.int16(): pd.Int16Dtype(),
    pa.bool_(): pd.BooleanDtype(),
}
"""Types of pandas for columns that may be null."""


class HeldParts:
    """A temporary folder that exists as long as this object."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="cosim-open-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


class Run:
    """A run on disk.

    Every table of the dictionary is an attribute (`run.trust`, `run.encounters`) with the rows of all trust variants;
    columns are as in `results/TABLES.md`, nulls are pandas' NA, rows are sorted by key within a step. A table is kept
    once it was read. Each use gives a frame of its own: what you change in it, neither metrics nor later uses see.
    Numbers have the types of the dictionary, and int16 and uint8 overflow: `hops - 2` is 255 where hops are 1. Convert
    such a column first: `astype("int64")`.
    """

    def __init__(self, path: Path, manifest: dict[str, Any], variant: str = BASE_VARIANT) -> None:
        self.path = path
        """The run folder, as it was named. It is read where it was, even if the working directory changes."""
        self._folder = Path(os.path.abspath(path))
        self.manifest = manifest
        self.variant = variant
        """Trust variant that metrics and figures use. The tables as attributes have the rows of all variants."""
        self.damage: list[str] = []
        """Damage found while tables were read. Commands that show figures must report it."""
        self._sound: set[str] = set()
        """Parts whose checksums were verified."""
        self._common: dict[str, Any] = {}
        """Results that all trust variants have in common, once computed."""
        self._held: HeldParts | None = None
        """Copies of the parts that the writing process will remove; None if no process writes the run."""
        self._own: dict[str, Any] = {}
        """Results of this trust variant, once computed."""

    def __getstate__(self) -> dict[str, Any]:
        """What another process is given: all but the results, among them the connection to DuckDB."""
        return self.__dict__ | {"_common": {}, "_own": {}}

    @cached_property
    def inventory(self) -> Inventory:
        """What the run folder should contain."""
        return inventory.read(self._folder)

    @property
    def status(self) -> str:
        """Status when the run was opened, see `results.manifest.status_of`."""
        return "running" if self._held is not None else status_of(self._folder, self.manifest)

    def hold_open_parts(self) -> None:
        """Keep the run as it is now, even if another process goes on writing it.

        Parts of whole blocks stay on disk. The files `open-NNNNN.parquet` are replaced with every block, so they are
        copied.
        """
        for _ in range(_ATTEMPTS):
            held, found = HeldParts(), inventory.read(self._folder).whole()
            try:
                for part in found.blocks[-1].open if found.blocks else ():
                    (held.path / part.table).mkdir(exist_ok=True)
                    shutil.copyfile(self._folder / part.name, held.path / part.name)
            except FileNotFoundError:  # two blocks were written meanwhile
                time.sleep(_PAUSE_S)
                continue
            self._held = held
            self.__dict__["inventory"] = found  # in place of what the cached property would read
            return
        raise ValueError(f"{self.path} is being written and changes too fast to be read. Try again in a moment.")

    @property
    def variants(self) -> tuple[str, ...]:
        """Names of the trust variants; `base` acts in the simulation."""
        return tuple(self.manifest.get("variants", (BASE_VARIANT,)))

    def as_variant(self, name: str) -> Self:
        """This run, with metrics and figures of one of its trust variants, and its rows in `variant_table`.

        `table`, attributes such as `run.trust`, and `sql` go on to give the rows of all variants, and `run.encounters`
        the trust of `base`.

        Raises
        ------
        ValueError
            If the run has no such variant.
        """
        if name not in self.variants:
            raise ValueError(f"{self.path} has no trust variant {name!r}. It has {', '.join(self.variants)}.")
        other = type(self)(self.path, self.manifest, name)
        other._folder = self._folder
        other.damage, other._sound = self.damage, self._sound
        other._common = self._common
        other._held = self._held
        other.__dict__["inventory"] = self.inventory
        return other

    def once(self, name: str, make: Callable[[], T]) -> T:
        """A result that several metrics of this variant use, computed once. Callers must not change it."""
        if name not in self._own:
            self._own[name] = make()
        return self._own[name]

    def once_for_all(self, name: str, make: Callable[[], T]) -> T:
        """A result that does not depend on the trust variant, computed once for all variants."""
        if name not in self._common:
            self._common[name] = make()
        return self._common[name]

    @property
    def name(self) -> str:
        """Name of the run folder."""
        return self._folder.name

    @property
    def dt_s(self) -> float:
        """Seconds per step."""
        return float(self.manifest["dt_s"])

    @property
    def config(self) -> dict[str, Any]:
        """A copy of the resolved configuration, with the section [trust] of the run's `variant`."""
        config = copy.deepcopy(self.manifest["config"])
        if self.variant == BASE_VARIANT:
            return config
        (mine,) = (v for v in config["trust_variant"] if v["name"] == self.variant)
        changes = {key: value for key, value in mine.items() if key not in ("name", "fused")}
        return config | {"trust": config["trust"] | changes}

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of the tables that the run has."""
        return self.once_for_all("tables", self._tables_there)

    def _tables_there(self) -> tuple[str, ...]:
        recorded = self.manifest.get("inventory", {}).get("tables", ())
        dropped = self.manifest.get("dropped", ())
        found = []
        for name in TABLES:
            has_files = (self._folder / name).is_dir() or self.inventory.of(name)
            if (has_files or name in recorded) and name not in dropped:
                found.append(name)
        return tuple(found)

    def table(
        self, name: str, columns: Iterable[str] | None = None, where: pc.Expression | None = None
    ) -> pd.DataFrame:
        """Read a table from disk, or some of its columns and rows: those of all trust variants.

        Parameters
        ----------
        name
            Name of the table.
        columns
            Columns to read; all by default.
        where
            Condition on rows, as in `run.table("fused", where=pyarrow.compute.field("score") > 0.5)`. A label that the
            table does not have meets no row.

        Raises
        ------
        ValueError
            If the run does not have the table, if the table does not have a column, or if the condition cannot be met.
        Damaged
            If the table does not match the inventory.
        """
        wanted = self._schema_of(name, columns)
        _check_condition(name, where)
        parts = [self._with_virtual(path, wanted.names, where) for path in self._paths(name)]
        return self._pandas(pa.concat_tables([wanted.empty_table(), *parts]), name)

    def _with_virtual(self, path: Path, columns: Sequence[str], where: pc.Expression | None) -> pa.Table:
        """Columns and rows of a part file. Virtual columns, which are not on disk, are added.

        Rows of `fused` name detections, and its virtual columns are columns of the detections named.
        """
        table = TABLES[path.parent.name]
        virtual = table.virtual(columns, where)
        if not virtual:
            return self._part(path, columns, where)
        from results.sql import LINKS

        filters_late = bool(table.virtual((), where))  # the condition needs a virtual column
        stored = [name for name in table.stored if name in columns or name in LINKS or filters_late]
        rows = self._part(path, stored, None if filters_late else where)
        detections = self._files_of_steps([rows.column(name) for name in ("source_step", "pose_step")])
        found = self._database().columns_of_detections(rows.select(LINKS), virtual, detections)
        if len(found) != len(rows):
            names = "it names detections that do not exist, or more than one by one name"
            raise Damaged(f"{path} is damaged: {names}. Run `cosim verify` on its run.")
        for name in virtual:
            field = schema(path.parent.name, whole=True).field(name)
            rows = rows.append_column(field, part_reader.as_stored(found.column(name), field.type))
        return (rows.filter(where) if filters_late else rows).select(list(columns))

    def _files_of_steps(self, steps: Sequence[pa.ChunkedArray]) -> list[Path]:
        """Part files of the detections of the steps in these columns, after their checksums were verified.

        There is one at least, because its columns are needed even if no row is.
        """
        ends = [end for column in steps for end in _ends(column)]
        found = self.files("detections", (min(ends), max(ends))) if ends else []
        if not found:
            found = self._paths("detections")[:1]
            self._check(found[0])
        return found

    def parts(
        self, name: str, columns: Iterable[str] | None = None, where: pc.Expression | None = None
    ) -> Iterator[pd.DataFrame]:
        """Like `table`, but one block of steps after another, for tables larger than memory."""
        wanted = self._schema_of(name, columns)
        _check_condition(name, where)
        for path in self._paths(name):
            yield self._pandas(self._with_virtual(path, wanted.names, where), name)

    def variant_table(
        self, name: str, columns: Iterable[str] | None = None, where: pc.Expression | None = None
    ) -> pd.DataFrame:
        """Like `table`, but only rows of the run's `variant`. `encounters` gets the trust columns of that variant."""
        if name == "encounters" and self.variant != BASE_VARIANT:
            return self._variant_encounters(columns, where)
        return self.table(name, columns, self._of_variant(name, where))

    def _variant_encounters(self, columns: Iterable[str] | None, where: pc.Expression | None) -> pd.DataFrame:
        """Encounters, whose columns about trust come from the table `encounter_trust`."""
        wanted, key = self._schema_of("encounters", columns).names, TABLES["encounters"].key
        of_trust = [c for c in TABLES["encounter_trust"].columns if c != "variant"]
        trust = self.table("encounter_trust", of_trust, self._of_variant("encounter_trust", None))
        read = wanted if where is None else TABLES["encounters"].columns  # the condition may be on any of them
        others = [c for c in read if c not in of_trust]
        on = [c for c in of_trust if c in key]
        found = self.table("encounters", on + others).merge(trust, on=on, how="left")
        if where is not None:
            _check_condition("encounters", where)
            numbered = found.assign(row=np.arange(len(found)))
            rows = pa.Table.from_pandas(numbered, preserve_index=False).filter(where).column("row")
            found = found.iloc[rows.to_numpy()].reset_index(drop=True)
        return found[wanted]

    def variant_parts(
        self, name: str, columns: Iterable[str] | None = None, where: pc.Expression | None = None
    ) -> Iterator[pd.DataFrame]:
        """Like `parts`, but only rows of the run's `variant`. Of another variant than `base`, `encounters` is one part,
        because its trust columns come from another table."""
        if name == "encounters" and self.variant != BASE_VARIANT:
            return iter([self._variant_encounters(columns, where)])
        return self.parts(name, columns, self._of_variant(name, where))

    def pieces(
        self, name: str, columns: Sequence[str], n_rows: int = 1_000_000
    ) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """Like `parts`, but as arrays, and in pieces of at most `n_rows` rows of one block.

        Parameters
        ----------
        name
            Name of the table.
        columns
            Columns to read; they must be on disk.
        n_rows
            Largest number of rows of a piece.

        Returns
        -------
        The number of the block and its columns, piece by piece. Labels become codes (-1 for null), and numbers that may
        be null become floats.
        """
        assert not TABLES[name].virtual(columns, None), "columns that are on disk"
        wanted = self._schema_of(name, columns).names
        labels = {column: TABLES[name].columns[column].labels(self.manifest) for column in wanted}
        for number, path in enumerate(self._paths(name)):
            self._check(path)
            for rows in part_reader.read_pieces(path, columns, n_rows):
                self._in_bounds(path, rows)
                arrays = {column: part_reader.plain(rows.column(column), labels[column]) for column in columns}
                yield number, arrays

    def sql(self, query: str, **values: Any) -> pd.DataFrame:
        """Ask the tables a question in SQL: `run.sql("SELECT role, count(*) AS n FROM vehicles GROUP BY role")`.

        Parameters
        ----------
        query
            One SELECT, as DuckDB understands it. Only whole blocks of the run are seen. Tables have the rows of all
            trust variants, and `encounters` the trust of `base`. Beside the tables there is `subjects`: `pseudonyms`
            with the role and the first attack of the vehicle.
        values
            Values of `$name` in the query. `$dt_s`, `$steps` and `$variant`, the run's own, need not be given.

        Raises
        ------
        ValueError
            In one line, if the query is wrong.
        """
        return self._database().answer(query, self._own_values() | values)

    def sql_of_steps(self, query: str, first: int, last: int, **values: Any) -> pd.DataFrame:
        """Like `sql`, of the blocks that have any of some steps. So a long run can be asked stretch by stretch.

        Parameters
        ----------
        query
            As for `sql`. Blocks have further steps: it must say itself which steps count.
        first, last
            The steps, `$first` and `$last` in the query.
        """
        steps = {"first": first, "last": last}
        return self._database().answer(query, self._own_values() | steps | values, (first, last))

    def _own_values(self) -> dict[str, Any]:
        """Values of names that a query may use without being given them."""
        return {"dt_s": self.dt_s, "steps": self.manifest["steps"], "variant": self.variant}

    def _database(self) -> "Database":
        from results.sql import Database  # here, because DuckDB takes its time

        return self.once_for_all("database", lambda: Database(self.tables, self.files, self.require, self._folders()))

    def files(self, name: str, steps: tuple[int, int] | None = None) -> list[Path]:
        """Part files of a table, after their checksums were verified.

        Parameters
        ----------
        name
            Name of the table.
        steps
            First and last step that are asked for. A table without steps has all of its parts.
        """
        self.require(name)
        paths = self._paths(name)
        if steps is not None and TABLES[name].key[0] == "step":
            first, last = steps
            parts = zip(self.inventory.of(name), paths, strict=True)
            paths = [path for part, path in parts if part.has_any_of(first, last)]
        for path in paths:
            self._check(path)
        return paths

    def _folders(self) -> list[Path]:
        """Folders of the part files."""
        folders = [self._folder] if self._held is None else [self._folder, self._held.path]
        return [folder.resolve() for folder in folders]

    def _of_variant(self, name: str, where: pc.Expression | None) -> pc.Expression | None:
        """The condition on rows, and that they are the variant's."""
        if len(self.variants) == 1 or name not in TABLES or "variant" not in TABLES[name].columns:
            return where
        mine = pc.field("variant") == self.variant
        return mine if where is None else mine & where

    def n_blocks(self, name: str) -> int:
        """Number of parts of a table that have rows."""
        return sum(part.n_rows > 0 for part in self.inventory.of(name))

    def n_rows(self, name: str) -> int:
        """Number of rows of a table, over all variants."""
        return sum(part.n_rows for part in self.inventory.of(name))

    def require(self, *names: str) -> None:
        """Raise ValueError, with a one-line message, if the run does not have these tables."""
        for name in names:
            if name not in TABLES:
                raise ValueError(f"There is no table {name!r}. The tables are {', '.join(TABLES)}.")
            if name not in self.tables:
                raise ValueError(f"{self.path} holds no table {name}: {self._why_absent(name)}")

    def lacks(self, what: str, why: str) -> ValueError:
        """The error that there is nothing of a kind to measure or draw, and why. Without sensing, nothing else is why.

        Parameters
        ----------
        what
            What vehicles have because they sense, such as "trust lookups".
        why
            Sentences for a run in which vehicles sense.
        """
        if not self.config.get("sensing", True):
            why = "sensing = false, so no vehicle senses or sends. Set sensing = true, and run again."
        of = "" if self.variant == BASE_VARIANT else f", trust variant {self.variant},"
        return ValueError(f"{self.path}{of} holds no {what}: {why}")

    def _why_absent(self, name: str) -> str:
        """Why the run does not have a table, and what to do."""
        record = self.manifest["config"].get("record")
        level = record.get("level") if isinstance(record, dict) else None
        is_dropped = name in self.manifest.get("dropped", ())
        if level in LEVELS and name in kept(level) and not is_dropped:
            return "an earlier cosim wrote the run, which did not have this table. Run again."
        return f'it is kept at record.level = "{TABLES[name].level}" and above. Set record.level and run again.'

    def _schema_of(self, name: str, columns: Iterable[str] | None) -> pa.Schema:
        """Names and types of the columns asked for; all if that is None. ValueError if the run does not have them."""
        self.require(name)
        known = list(TABLES[name].columns)
        wanted = known if columns is None else _named(columns, known)
        if unknown := [str(c) for c in wanted if c not in known]:
            raise ValueError(f"Table {name} has no column {', '.join(unknown)}. The columns are {', '.join(known)}.")
        if not wanted or len(set(wanted)) < len(wanted):
            raise ValueError(f"columns = {wanted} of table {name} should name each column once, and at least one.")
        if TABLES[name].virtual(wanted, None):
            self.require("detections")
        whole = schema(name, whole=True)
        return pa.schema([whole.field(c) for c in wanted])

    def _paths(self, name: str) -> list[Path]:
        """The parts of a table. Raises Damaged if they differ from the inventory."""
        return self.once_for_all(f"parts of {name}", lambda: self._checked_paths(name))

    def _checked_paths(self, name: str) -> list[Path]:
        held = self._held
        in_run = self.inventory if held is None else self.inventory.closed()  # without the parts that were copied
        has_ended = self.manifest["status"] in ENDED
        if problem := next(problems_of(self._folder, name, in_run, has_ended, held is not None), None):
            self._found_damaged(problem)
        copied = self.inventory.parts[len(in_run.parts) :]  # open parts come last
        paths = []
        for part in self.inventory.of(name):
            folder = held.path if held is not None and part in copied else self._folder
            paths.append(folder / part.name)
        return paths

    def _part(self, path: Path, names: Sequence[str], where: pc.Expression | None) -> pa.Table:
        """Columns of a part, after its checksum was verified."""
        self._check(path)
        return self._in_bounds(path, part_reader.read(path, names, where))

    def _check(self, path: Path) -> None:
        """Raise Damaged if the checksum of a part is wrong; each part is checked once."""
        name = f"{path.parent.name}/{path.name}"
        if name in self._sound:
            return
        part = self.inventory.by_name.get(name)
        if part is None:
            self._found_damaged(f"{name} is not in the inventory")
        if problem := content_problem(path.parent.parent, part):
            self._found_damaged(problem)
        self._sound.add(name)

    def _in_bounds(self, path: Path, rows: R) -> R:
        """The rows as they are. Raises Damaged if a whole number names what the run does not have, or a real one is
        infinite.

        The first may become an index, and no run writes the second.
        """
        table = path.parent.name
        for name in rows.schema.names:
            column, values = TABLES[table].columns[name], rows.column(name)
            if pa.types.is_floating(values.type) and pc.any(pc.is_inf(values)).as_py():
                self._found_damaged(f"{table}/{path.name} has an infinite {name}", "Run again.")
            if column.type in WHOLE and (wrong := self._numbers_out_of_bounds(values, column.of)):
                what = f"no number of the table {column.of}" if column.of in TABLES else "out of bounds"
                said = f"{name} = {wrong[0]}, which is {what}"
                self._found_damaged(f"{table}/{path.name} has {said}", "Run again.")
        return rows

    def _numbers_out_of_bounds(self, values: pa.ChunkedArray | pa.Array, of: Of) -> list[int]:
        """Some of the numbers of a column that name nothing that the run has; empty if all do."""
        ends, limit = _ends(values), self._limit(of)
        wrong = [end for end in ends if not 0 <= end < limit]
        if wrong or not ends or of != "pseudonyms" or not len(self._pseudonyms()):
            return wrong
        named = values.drop_null().to_numpy()
        return named[~np.isin(named, self._pseudonyms())].tolist()

    def _limit(self, of: Of) -> int:
        """One more than the largest number that a column of this kind may have."""
        if of == "vehicles" and "vehicles" in self.tables and (n := self.n_rows("vehicles")):
            return n
        return int(self.manifest["steps"]) + 1 if of == "steps" else 2**31

    def _pseudonyms(self) -> np.ndarray:
        """All pseudonyms of the run; none if it does not say."""
        if "pseudonyms" not in self.tables:
            return np.zeros(0, np.int32)
        return self.once_for_all(
            "pseudonyms by number", lambda: self.table("pseudonyms", ["pseudonym"]).pseudonym.to_numpy()
        )

    def _found_damaged(self, problem: str, then: str = "") -> NoReturn:
        then = then or f"`cosim verify {shlex.quote(str(self.path))}` lists all that is wrong."
        message = f"{self.path} is damaged: {problem}. {then}"
        if message not in self.damage:
            self.damage.append(message)
        raise Damaged(message)

    def _pandas(self, table: pa.Table, name: str) -> pd.DataFrame:
        """pandas with null-aware integers and booleans where a column may be null, and all categories known."""
        frame = table.combine_chunks().to_pandas()
        for field in table.schema:
            categories = TABLES[name].columns[field.name].labels(self.manifest)
            if categories:
                part_reader.check_labels(frame[field.name].cat.categories, categories)
                frame[field.name] = frame[field.name].cat.set_categories(list(categories))
            elif field.nullable and field.type in _NULLABLE:
                frame[field.name] = table.column(field.name).to_pandas(types_mapper=_NULLABLE.get)
        return frame

    def __getattr__(self, name: str) -> pd.DataFrame:
        if name not in TABLES:
            raise AttributeError(f"A run has no {name!r}. The tables are {', '.join(TABLES)}.")
        return self.once_for_all(name, lambda: self.table(name)).copy(deep=False)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.tables]

    def __repr__(self) -> str:
        steps, tables = self.manifest["steps"], ", ".join(self.tables)
        variant = "" if self.variant == BASE_VARIANT else f", variant {self.variant}"
        status = "" if self.status == "finished" else f", {self.status}"
        return f"Run({str(self.path)!r}{variant}{status}: {steps} steps, tables {tables})"

    @property
    def roles(self) -> pd.Series:
        """Role by actor number, equipped vehicles only."""
        return self.once_for_all("roles of vehicles", self._roles).copy(deep=False)

    def _roles(self) -> pd.Series:
        vehicles = self.table("vehicles", ["vehicle", "equipped", "role"])
        return vehicles[vehicles.equipped].set_index("vehicle").role

    @property
    def subjects(self) -> pd.DataFrame:
        """Pseudonyms by number: vehicle, role, from_step and to_step of use, attack_start_step of the vehicle.

        Only this table joins pseudonyms, which trust knows, with true identities.
        """
        return self.once_for_all("roles of pseudonyms", self._subjects).copy(deep=False)

    def _subjects(self) -> pd.DataFrame:
        vehicles = self.table("vehicles", ["vehicle", "role", "attack_start_step"]).set_index("vehicle")
        found = self.table("pseudonyms").set_index("pseudonym").join(vehicles, on="vehicle")
        return found[found.role.notna()]  # roadside units are no subjects

    @property
    def role_labels(self) -> tuple[str, ...]:
        """Labels of the roles of this run, in the order of their codes."""
        return TABLES["vehicles"].columns["role"].labels(self.manifest)


def _named(columns: Iterable[str], known: Sequence[str]) -> list[str]:
    """The names of columns that were asked for. ValueError if they are no list of names."""
    if isinstance(columns, str) or not isinstance(columns, Iterable):
        example = columns if isinstance(columns, str) else known[0]
        raise ValueError(f"columns = {columns!r} should be a list of names, such as [{example!r}].")
    return list(columns)


def _check_condition(name: str, where: pc.Expression | None) -> None:
    """Raise ValueError for a condition that rows of a table can neither meet nor fail."""
    if where is None:
        return
    why = f"it is a {type(where).__name__}"
    try:
        if isinstance(where, pc.Expression):
            schema(name, whole=True).empty_table().filter(where)
            return
    except pa.ArrowException as error:
        why = str(error).splitlines()[0].partition(" in ")[0]
    known = list(TABLES[name].columns)
    raise ValueError(
        f"where is no condition on rows of table {name} ({why}). Write it as pyarrow.compute.field({known[0]!r}) > 3. "
        f"The columns are {', '.join(known)}."
    )


def _ends(values: pa.ChunkedArray | pa.Array) -> list[int]:
    """Smallest and largest value; empty if there is none."""
    ends = pc.min_max(values).as_py().values()
    return [end for end in ends if end is not None]
