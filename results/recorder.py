"""Writing a run: one Parquet dataset per table, a block of steps at a time."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from numpy import ndarray

from cosim.base import durable
from cosim.base.codes import BASE_VARIANT, Role, labels
from cosim.base.durable import Damaged
from results import inventory
from results.columns import Level
from results.inventory import CHECKPOINT, Block, Inventory
from results.part_encoder import PartEncoder, Rows
from results.stored_columns import given_rows, stored_columns
from results.tables import TABLES, kept

Columns = Mapping[str, ndarray | None]
"""Columns of a table by name, masks included."""
RowsByTable = Mapping[str, Sequence[Columns]]
Files = Mapping[str, Sequence[bytes | memoryview]]
"""Files of a checkpoint by name, piece by piece."""

_MOST_LABELS = 127
"""Codes of a category are int8."""
_ENCODERS = 2
"""Threads that encode rows."""
_WRITERS = 8
"""Files that are synced at once: a disk that is asked for many together takes a tenth of the time."""


class Recorder:
    """Collects the rows of a run, table by table, and writes them to disk block by block.

    Block `i` holds what was appended in steps `i * block_steps` up to `(i + 1) * block_steps`. Its parts
    `<folder>/<table>/part-<i>.parquet` are synced first, then what is open, then the checkpoint, and the line of the
    inventory last: before that line the block was never there. A crash loses at most the block in memory.

    Parameters
    ----------
    folder
        Run folder; must exist.
    level
        Which tables are kept; the others are ignored without being checked.
    block_steps
        Steps per block.
    resume_at
        First step to come, at the end of a committed block; what was recorded from there on is dropped. 0 starts anew.
    variants
        Names of the run's trust variants: labels of the columns `variant`, in the order of their codes.
    roles
        Roles of the run's vehicles: labels of the column `role`, in the order of their codes.
    """

    def __init__(
        self,
        folder: Path,
        level: Level,
        block_steps: int = 60,
        resume_at: int = 0,
        variants: Sequence[str] = (BASE_VARIANT,),
        roles: Sequence[str] = labels(Role),
    ) -> None:
        if block_steps < 1:
            raise ValueError(f"block_steps = {block_steps}: a block needs at least one step.")
        if resume_at % block_steps:
            raise ValueError(
                f"resume_at = {resume_at} lies inside a block of {block_steps} steps. Resume at step "
                f"{resume_at - resume_at % block_steps}, where the last whole block ends."
            )
        self.folder = Path(folder)
        self.labels = {"variants": tuple(variants), "roles": tuple(roles)}
        """Labels of this run; they belong into its manifest."""
        for what, given in self.labels.items():
            n = len(given)
            if not 0 < n <= _MOST_LABELS or len(set(given)) < n:
                raise ValueError(f"{what} = {list(given)}: 1 to {_MOST_LABELS} names, each once.")
        self.tables = kept(level)
        self._columns = {name: stored_columns(name, self.labels) for name in self.tables}
        self.block_steps = block_steps
        self._block, self._last_step = resume_at // block_steps, resume_at - 1
        self._pool = ThreadPoolExecutor(_ENCODERS, thread_name_prefix="encoder")
        self._parts = {name: self._part("part", name) for name in self.tables}
        blocks = [block for block in _committed(self.folder).blocks if block.end_step <= resume_at]
        opened = blocks[-1].open if blocks else ()
        if not all((self.folder / part.name).exists() for part in opened):
            blocks[-1] = replace(blocks[-1], open=())  # those of a part of a block took their place
        self.inventory = Inventory(tuple(blocks))
        """What is on disk."""
        if (folder / inventory.FILE).exists():
            self.inventory = inventory.rewrite(self.folder, self.inventory)
        for name in self.tables:
            (self.folder / name).mkdir(exist_ok=True)
        self._tidy()
        durable.sync_folder(self.folder)

    def append(self, table: str, step: int, columns: Mapping[str, ndarray | None]) -> None:
        """Add rows of one step.

        Parameters
        ----------
        table
            Name of the table. The rows of a table that is not kept are ignored.
        step
            Step of the rows; not before the block in memory.
        columns
            An array for every column, by name; `step` may be left out. A column that may be null is given with a
            boolean mask `<name>__valid`, or as None if all its values are null. Categories are given as labels or
            integer codes.

        Raises
        ------
        ValueError
            If there is no such table, or `stored_columns.given_rows` refuses the columns. Values that cannot be
            stored are refused later, before their block is committed.
        """
        if table not in TABLES:
            raise ValueError(f"There is no table {table!r}. The tables are {', '.join(TABLES)}.")
        if step // self.block_steps != self._block:
            assert step >= self._block * self.block_steps, f"step {step} lies in a block that is on disk"
        self.reach(step)
        if table not in self.tables:
            return
        self._parts[table].append(given_rows(table, step, columns, self._columns[table]))

    def reach(self, step: int) -> None:
        """Say that a step is done, with or without rows."""
        if step // self.block_steps != self._block:
            self.flush()
            self._block = step // self.block_steps
        if step > self._last_step:
            for rows_of in self._parts.values():
                rows_of.end_step()
        self._last_step = max(self._last_step, step)

    def is_block_end(self, step: int) -> bool:
        """Whether a step is the last one of its block."""
        return (step + 1) % self.block_steps == 0

    def flush(
        self,
        open_rows: RowsByTable | None = None,
        checkpoint: Files | None = None,
    ) -> None:
        """Commit the block in memory.

        Parameters
        ----------
        open_rows
            By table, rows of what is not over yet, as they would be if the run ended here.
        checkpoint
            By name, the files from which a resumed run goes on, piece by piece; those named `state-...` replace
            earlier ones.
        """
        if self._last_step >= self.inventory.end_step:
            self._commit(open_rows or {}, checkpoint or {})

    def _commit(
        self,
        open_rows: RowsByTable,
        checkpoint: Files,
        is_last: bool = False,
    ) -> None:
        """Commit a block. The last one has a file for each table without any row, so that all tables can be read."""
        begun = {part.table for part in self.inventory.parts} if is_last else set(self._parts)
        opening = [self._part("open", *rows) for rows in self._made(open_rows).items()]
        opening = [part for part in opening if len(part)]
        for waiting in sorted((*self._parts.values(), *opening), key=len, reverse=True):
            waiting.end_block()
        files = {f"{CHECKPOINT}/{name}": content for name, content in checkpoint.items()}
        if files:
            (self.folder / CHECKPOINT).mkdir(exist_ok=True)
        number = f"{self._block:05d}.parquet"
        with ThreadPoolExecutor(_WRITERS) as disk:
            to_write = disk.map(
                lambda p: p.finish(f"part-{number}"),
                [of for name, of in self._parts.items() if len(of) or name not in begun],
            )
            to_open = disk.map(lambda p: p.finish(f"open-{number}"), opening)
            to_keep = disk.map(self._keep, files.items())
            parts, opened = tuple(to_write), tuple(to_open)
            kept_as = dict(zip(files, to_keep, strict=True))
            names = {part.table for part in (*parts, *opened)}
            if files:
                names.add(CHECKPOINT)
            tuple(disk.map(durable.sync_folder, [self.folder / name for name in sorted(names)]))
        is_whole = self.is_block_end(self._last_step)
        block = Block(self._block, self._last_step + 1, is_whole, parts, opened, kept_as)
        before = self.inventory
        self.inventory = inventory.commit(self.folder, before, block)
        self._parts = {name: self._part("part", name) for name in self._parts}
        if before.blocks:
            for part in before.blocks[-1].open:
                (self.folder / part.name).unlink(missing_ok=True)
        if files:
            for block in before.blocks[-1:]:
                for name in filter(is_state, block.checkpoint):
                    (self.folder / name).unlink(missing_ok=True)

    def close(self, final_rows: RowsByTable | None = None) -> None:
        """Commit what is left, and the rows of what ends with the run (`final_rows`, by table)."""
        is_committed = self._last_step < self.inventory.end_step
        for name, rows in self._made(final_rows or {}).items():
            for columns in rows:
                self._parts[name].append(columns)
        if is_committed and any(len(part) for part in self._parts.values()):
            self._block += 1
        elif is_committed:
            return
        self._commit({}, {}, is_last=True)

    def _part(self, kind: str, table: str, rows: Sequence[Rows] = ()) -> PartEncoder:
        partial = self.folder / table / f"{kind}-next{durable.PARTIAL}"
        return PartEncoder(partial, table, self._columns[table], self._pool, rows)

    def _keep(self, file: tuple[str, Sequence[bytes | memoryview]]) -> str:
        """Write a file of a checkpoint and return its checksum."""
        name, content = file
        return durable.write(self.folder / name, *content)

    def _made(self, given: RowsByTable) -> dict[str, list[Rows]]:
        """Rows at the last step, by table, as `given_rows` returns them, without those of tables that are not kept."""
        step = self._last_step
        made = {}
        for name, several in given.items():
            if name in self.tables:
                stored = self._columns[name]
                made[name] = [given_rows(name, step, columns, stored) for columns in several]
        return made

    def _tidy(self) -> None:
        """Remove what belongs to no committed block."""
        known = {part.name for part in self.inventory.parts}
        known |= {name for block in self.inventory.blocks for name in block.checkpoint}
        for folder in (*self.tables, CHECKPOINT):
            for path in sorted((self.folder / folder).glob("*")):
                is_ours = path.name.startswith(("part-", "open-", "state-", "commands-"))
                if is_ours and f"{folder}/{path.name}" not in known:
                    path.unlink()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:  # after an error the last step may be incomplete; a resumed run repeats the block
            self.close()


def is_state(name: str) -> bool:
    """Whether a file of a checkpoint is replaced by that of the next block."""
    return Path(name).name.startswith("state-")


def _committed(folder: Path) -> Inventory:
    try:
        return inventory.read(folder)
    except Damaged as error:
        raise Damaged(f"{error} Nothing can be added to this run.") from None
