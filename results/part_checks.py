"""Whether the part files of a run are those that its inventory lists."""

from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq

from cosim.base import durable
from results.inventory import Inventory, Part
from results.tables import TABLES, schema


def problems_of(folder: Path, table: str, found: Inventory, has_ended: bool, is_live: bool) -> Iterator[str]:
    """Parts of a table that are missing, of another size, or not in the inventory.

    Before the run has ended, there may be parts of the block that is being written; they are not read. While a process
    writes the run (`is_live`), there may be parts of further blocks.
    """
    known = {part.file: part for part in found.of(table)}
    try:
        on_disk = {path.name: path for path in (folder / table).iterdir()}
    except (FileNotFoundError, NotADirectoryError):
        on_disk = {}
    for file, part in known.items():
        if file not in on_disk:
            yield f"{part.name} is missing"
        elif on_disk[file].is_symlink() or not on_disk[file].is_file():
            yield f"{part.name} is no regular file"
        elif (size := on_disk[file].stat().st_size) != part.n_bytes:
            yield f"{part.name} has {size} bytes and should have {part.n_bytes}"
    if is_live:
        return
    last = found.blocks[-1].number if found.blocks else -1
    opened = {f"open-{n:05d}.parquet" for n in (last - 1, last + 1)}
    under_way = set() if has_ended else {"part-next", "open-next", f"part-{last + 1:05d}.parquet"} | opened
    for file in sorted(on_disk.keys() - known.keys()):
        if file.removesuffix(durable.PARTIAL) not in under_way:
            yield f"{table}/{file} is not in the inventory"


def content_problem(folder: Path, part: Part) -> str:
    """Problem with the content of a part: its bytes, rows, columns or steps. Empty if there is none."""
    try:
        if durable.sha256(folder / part.name) != part.sha256:
            return f"{part.name} is not what was written: its checksum differs"
        about = pq.ParquetFile(folder / part.name)
    except (OSError, ValueError) as error:  # among them those of Arrow
        return f"{part.name} cannot be read ({str(error).splitlines()[0]})"
    with about:
        if (n := about.metadata.num_rows) != part.n_rows:
            return f"{part.name} has {n} rows and should have {part.n_rows}"
        if not about.schema_arrow.equals(schema(part.table)):
            return f"{part.name} has other columns than this cosim writes"
        found = _steps_of(about.metadata) if TABLES[part.table].key[0] == "step" else None
        if found not in (None, (part.first_step, part.last_step)):
            return f"{part.name} has other steps than {part.first_step} to {part.last_step}"
    return ""


def _steps_of(about: pq.FileMetaData) -> tuple[int, int] | None:
    """The first and the last step of a part, by the statistics of its first column."""
    of_groups = (about.row_group(i).column(0).statistics for i in range(about.num_row_groups))
    stated = [group for group in of_groups if group is not None and group.has_min_max]
    ends = [int(end) for group in stated for end in (group.min, group.max)]
    return (min(ends), max(ends)) if ends else None
