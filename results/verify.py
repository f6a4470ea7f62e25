"""Holding a run folder against its inventory: nothing missing, nothing changed, nothing foreign."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from results import durable, inventory
from results.durable import Damaged
from results.inventory import Inventory, Part
from results.manifest import read_manifest, status_of
from results.recorder import CHECKPOINT, is_state
from results.run import OVER, content_problem, problems_of
from results.tables import SCHEMA_VERSION, TABLES, kept, schema

STATUSES = ("running", "finished", "interrupted", "failed")
_OWN = ("manifest.json", "config.toml", inventory.FILE, "report.html", "run.log")


def verify(folder: str | Path) -> tuple[dict[str, Any], list[str]]:
    """What a run folder is, and all that is wrong with it.

    Returns
    -------
    status, steps, tables, parts, rows and bytes; and a line per problem, none for a whole folder.
    """
    folder = Path(folder)
    try:
        manifest = read_manifest(folder)
        found = inventory.read(folder)
    except Damaged as damage:
        return {"status": "damaged", "steps": 0, "tables": 0, "parts": 0, "rows": 0, "bytes": 0}, [str(damage)]
    problems = list(_problems(folder, manifest, found))
    parts = found.parts
    return {
        "status": status_of(folder, manifest), "steps": found.end_step, "tables": len({part.table for part in parts}),
        "parts": len(parts), "rows": sum(part.n_rows for part in parts), "bytes": sum(part.n_bytes for part in parts),
    }, problems  # fmt: skip


def _problems(folder: Path, manifest: dict[str, Any], found: Inventory) -> Iterator[str]:
    is_finished = manifest["status"] == "finished"
    if manifest["schema_version"] != SCHEMA_VERSION:
        yield f"schema version {manifest['schema_version']}, this cosim knows {SCHEMA_VERSION}"
        return
    if manifest["status"] not in STATUSES:
        yield f"manifest.json: status {json.dumps(manifest['status'])} is none of {', '.join(STATUSES)}"
    if is_finished:
        said = manifest.get("inventory") or {}
        if found.summary(said.get("tables") or ()) != said:
            yield f"{inventory.FILE} is not the one that manifest.json was written with"
        if manifest["steps"] != found.end_step:
            yield f"manifest.json says {manifest['steps']} steps, the inventory {found.end_step}"
    config = folder / "config.toml"
    is_only_begun = manifest["status"] == "running" and not found.blocks
    try:
        if is_only_begun and not (config.exists() or config.is_symlink()):
            pass  # killed before it was written: a resumed run writes it
        elif durable.sha256(config) != manifest.get("config_sha256"):
            yield "config.toml is not what was written: its checksum differs"
    except (OSError, ValueError) as error:
        yield f"config.toml cannot be read ({error})"
    level = (manifest["config"].get("record") or {}).get("level", "full")
    for table in TABLES:
        if table in manifest.get("dropped", ()):
            continue
        listed = found.of(table)
        if listed and table not in kept(level):
            yield f"{table} is in the inventory, but record.level = {level} does not keep it"
        wrong = list(problems_of(folder, table, found, manifest["status"] in OVER))
        yield from wrong
        for part in listed:
            if not any(problem.startswith(part.name) for problem in wrong):
                yield from _content(folder, part, found.end_step)
    whole = found.whole().blocks
    for block in whole if not is_finished else ():
        for name, digest in block.checkpoint.items():
            if block is whole[-1] or not is_state(name):
                yield from _file(folder, name, digest)
    for path in sorted(folder.iterdir()):
        if path.is_symlink() and (path.name in TABLES or path.name in _OWN or path.name == CHECKPOINT):
            yield f"{path.name} is a symbolic link"


def _file(folder: Path, name: str, digest: str) -> Iterator[str]:
    try:
        if durable.sha256(folder / name) != digest:
            yield f"{name} is not what was written: its checksum differs"
    except (OSError, ValueError) as error:
        yield f"{name} cannot be read ({error})"


def _content(folder: Path, part: Part, end_step: int) -> Iterator[str]:
    if problem := content_problem(folder, part):
        yield problem
        return
    try:
        about = pq.ParquetFile(folder / part.name)
        n_rows, its_schema = about.metadata.num_rows, about.schema_arrow
    except (pa.ArrowException, OSError) as error:
        yield f"{part.name} cannot be read ({str(error).splitlines()[0]})"
        return
    if n_rows != part.n_rows:
        yield f"{part.name} has {n_rows} rows and should have {part.n_rows}"
    if not its_schema.equals(schema(part.table)):
        yield f"{part.name} has other columns than this cosim writes"
    if part.first_step < 0 or part.last_step > end_step:
        yield f"{part.name} has steps {part.first_step} to {part.last_step}, outside of 0 to {end_step}"
