"""The inventory of a run folder: every part, block by block, with its rows, steps and checksum.

`inventory.jsonl` has one line per committed block. A line is written only after all files that it lists are on disk.
Each line contains a checksum of itself and of the line before, so that no line can be changed, removed or moved
unnoticed. A line that a crash cut off does not count.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from cosim.base import durable
from cosim.base.durable import Damaged
from results.tables import TABLES

FILE = "inventory.jsonl"
CHECKPOINT = "checkpoint"
"""Folder of the files from which a resumed run goes on; a finished run has none."""


@dataclass(frozen=True, slots=True)
class Part:
    """One Parquet file."""

    table: str
    file: str
    """Name in the folder of the table."""
    n_rows: int
    n_bytes: int
    sha256: str
    first_step: int
    last_step: int

    @property
    def name(self) -> str:
        """Path in the run folder."""
        return f"{self.table}/{self.file}"

    def has_any_of(self, first: int, last: int) -> bool:
        """Whether its steps are among those from `first` to `last`, or between two of them."""
        return self.first_step <= last and first <= self.last_step


@dataclass(frozen=True, slots=True)
class Block:
    """One committed block of steps, all tables together."""

    number: int
    end_step: int
    """One past its last step."""
    is_whole: bool
    """False for the last steps of a run that was interrupted inside a block. A resumed run computes them again."""
    parts: tuple[Part, ...]
    open: tuple[Part, ...] = ()
    """What is not over at the end of the block, as it would be if the run ended there; replaces that of the block
    before."""
    checkpoint: Mapping[str, str] = field(default_factory=dict)
    """Checksums by path of the files from which a resumed run goes on."""
    chain: str = ""
    """Checksum of this line and of all before."""

    def line(self, before: str) -> tuple["Block", bytes]:
        """The block with its checksum, and the line that says it."""
        text = json.dumps(asdict(self) | {"chain": before}, separators=(",", ":"))
        chained = replace(self, chain=hashlib.sha256(text.encode()).hexdigest())
        return chained, json.dumps(asdict(chained), separators=(",", ":")).encode()


@dataclass(frozen=True)
class Inventory:
    """All committed blocks of a run."""

    blocks: tuple[Block, ...] = ()

    @property
    def end_step(self) -> int:
        """Steps committed."""
        return self.blocks[-1].end_step if self.blocks else 0

    @property
    def chain(self) -> str:
        """Checksum of the whole."""
        return self.blocks[-1].chain if self.blocks else ""

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Every part that counts, in the order of steps."""
        closed = [part for block in self.blocks for part in block.parts]
        return (*closed, *(self.blocks[-1].open if self.blocks else ()))

    @cached_property
    def by_name(self) -> Mapping[str, Part]:
        """The parts by their paths in the run folder."""
        return {part.name: part for part in self.parts}

    @cached_property
    def _by_table(self) -> Mapping[str, tuple[Part, ...]]:
        of_tables: dict[str, list[Part]] = {}
        for part in self.parts:
            of_tables.setdefault(part.table, []).append(part)
        return {table: tuple(parts) for table, parts in of_tables.items()}

    def of(self, table: str) -> tuple[Part, ...]:
        """The parts of a table."""
        return self._by_table.get(table, ())

    def whole(self) -> "Inventory":
        """Only the whole blocks."""
        return Inventory(tuple(block for block in self.blocks if block.is_whole))

    def to_go_on(self) -> "Inventory":
        """The whole blocks after which a resumed run goes on.

        The last block of a run has what ends with the run, too, such as the table of vehicles. A kill may have come
        between this block and the end of the run.
        """
        blocks = self.whole().blocks
        last = blocks[-1].parts if blocks else ()
        has_end = any(part.table == "vehicles" for part in last)
        return Inventory(blocks[:-1] if has_end else blocks)

    def closed(self) -> "Inventory":
        """The whole blocks without what is open: files that stay while the run goes on."""
        return Inventory(tuple(replace(block, open=()) for block in self.whole().blocks))

    def summary(self, tables: Iterable[str]) -> dict[str, Any]:
        """For the manifest: of every table, parts, rows, bytes, steps and a checksum over its parts."""
        tables_ = {}
        for name in tables:
            parts = self.of(name)
            digest = hashlib.sha256("".join(part.sha256 for part in parts).encode()).hexdigest()
            tables_[name] = {
                "parts": len(parts),
                "rows": sum(part.n_rows for part in parts),
                "bytes": sum(part.n_bytes for part in parts),
                "first_step": min((part.first_step for part in parts), default=None),
                "last_step": max((part.last_step for part in parts), default=None),
                "sha256": digest,
            }
        return {"blocks": len(self.blocks), "end_step": self.end_step, "sha256": self.chain, "tables": tables_}


def read(folder: Path) -> Inventory:
    """Read the inventory of a run folder. Raises Damaged if a line was changed after it was written."""
    path = folder / FILE
    try:
        with durable.open_regular(path) as file:
            text = file.read()
    except FileNotFoundError:
        return Inventory()
    except (OSError, ValueError) as error:
        raise Damaged(f"{path} cannot be read ({error}).") from None
    *lines, rest = text.split(b"\n")
    blocks: list[Block] = []
    for number, line in enumerate(lines):
        try:
            block = _block(json.loads(line))
            chained, again = block.line(blocks[-1].chain if blocks else "")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
            chained, again = None, b""
        if chained is None or again != line:
            raise Damaged(f"{path}: line {number + 1} is damaged, or a line before it is missing.")
        begin = blocks[-1].end_step if blocks else 0
        if not begin <= chained.end_step < 2**31:
            raise Damaged(f"{path}: line {number + 1} ends before the line before it.")
        blocks.append(chained)
    del rest  # a line that a crash cut off: never committed
    return Inventory(tuple(blocks))


def _block(line: dict[str, Any]) -> Block:
    parts, open_ = (tuple(map(_part, line[name])) for name in ("parts", "open"))
    files = dict(line["checkpoint"])
    for name, sha256 in files.items():
        if name != f"{CHECKPOINT}/{Path(name).name}" or not isinstance(sha256, str):
            raise ValueError(f"{CHECKPOINT} outside of its folder")
    return Block(
        int(line["number"]),
        int(line["end_step"]),
        bool(line["is_whole"]),
        parts,
        open_,
        files,
        str(line["chain"]),
    )


def _part(content: dict[str, Any]) -> Part:
    part = Part(**content)
    if part.table not in TABLES or Path(part.file).name != part.file:
        raise ValueError(part.name)
    numbers = (part.n_rows, part.n_bytes, part.first_step, part.last_step)
    if not isinstance(part.sha256, str) or set(map(type, numbers)) != {int}:
        raise ValueError(part.name)
    if min(part.n_rows, part.n_bytes) < 0:
        raise ValueError(part.name)
    return part


def rewrite(folder: Path, inventory: Inventory) -> Inventory:
    """Replace the inventory of the folder and return it with its checksums."""
    lines, before, blocks = b"", "", []
    for block in inventory.blocks:
        chained, line = block.line(before)
        lines, before = lines + line + b"\n", chained.chain
        blocks.append(chained)
    durable.write(folder / FILE, lines)
    durable.sync_folder(folder)
    return Inventory(tuple(blocks))


def commit(folder: Path, inventory: Inventory, block: Block) -> Inventory:
    """Add a block whose files are on disk."""
    chained, line = block.line(inventory.chain)
    is_first = not inventory.blocks
    durable.append_line(folder / FILE, line)
    if is_first:
        durable.sync_folder(folder)
    return Inventory((*inventory.blocks, chained))
