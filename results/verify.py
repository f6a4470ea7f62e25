"""Check run folders for missing, changed or unexpected files."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cosim.base import durable
from cosim.base.durable import Damaged
from results import inventory
from results.columns import LEVELS, Level
from results.inventory import CHECKPOINT, Inventory
from results.manifest import problems, read_manifest, status_of
from results.part_checks import content_problem, problems_of
from results.recorder import is_state
from results.run import ENDED
from results.tables import SCHEMA_VERSION, TABLES, kept

_OWN = ("manifest.json", "config.toml", inventory.FILE, "report.html", "run.log")
UNREADABLE = {"status": "damaged", "steps": 0, "tables": 0, "parts": 0, "rows": 0, "bytes": 0}
"""What is said of a folder whose content is not known."""


def verify(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Check a run folder against its inventory.

    Returns
    -------
    Status, steps, tables, parts, rows and bytes; and one line per problem, none if the folder is intact. While a
    process writes the run, only whole blocks are checked.
    """
    is_live = durable.is_locked(folder)
    try:
        manifest = read_manifest(folder)
        is_live = is_live and manifest["status"] != "finished"
        found = inventory.read(folder).closed() if is_live else inventory.read(folder)
    except Damaged as damage:
        return dict(UNREADABLE), [str(damage)]
    wrong = list(_problems(folder, manifest, found, is_live))
    parts = found.parts
    summary = {
        "status": status_of(folder, manifest),
        "steps": found.end_step,
        "tables": len({part.table for part in parts}),
        "parts": len(parts),
        "rows": sum(part.n_rows for part in parts),
        "bytes": sum(part.n_bytes for part in parts),
    }
    return summary, wrong


def links(folder: Path) -> list[str]:
    """Names in a run folder that are symbolic links where files or folders of the run should be."""
    ours = {*TABLES, *_OWN, CHECKPOINT}
    return [name for name in sorted(ours) if (folder / name).is_symlink()]


def _problems(folder: Path, manifest: dict[str, Any], found: Inventory, is_live: bool) -> Iterator[str]:
    if manifest["schema_version"] != SCHEMA_VERSION:
        yield f"schema version {manifest['schema_version']}, this cosim knows {SCHEMA_VERSION}"
        return
    yield from problems(folder, manifest, found)
    record = manifest["config"].get("record")
    said = record.get("level") if isinstance(record, dict) else None
    level: Level = next((one for one in LEVELS if one == said), "full")
    recorded = (manifest.get("inventory") or {}).get("tables") or ()
    for table in TABLES:
        if table in manifest.get("dropped", ()):
            continue
        listed = found.of(table)
        if listed and table not in kept(level):
            yield f"{table} is in the inventory, but record.level = {level} does not keep it"
        if found.blocks and not listed and table in recorded and not (folder / table).is_dir():
            yield f"{table} is missing, the folder of a table without rows"
        wrong = list(problems_of(folder, table, found, manifest["status"] in ENDED, is_live))
        yield from wrong
        for part in listed:
            is_named = any(line.startswith(part.name) for line in wrong)
            problem = "" if is_named else content_problem(folder, part)
            if problem:
                yield problem
    goes_on = found.to_go_on().blocks
    for block in goes_on if manifest["status"] != "finished" and not is_live else ():
        for name, digest in block.checkpoint.items():
            if block is goes_on[-1] or not is_state(name):
                yield from _file(folder, name, digest)
    for name in links(folder):
        yield f"{name} is a symbolic link"


def _file(folder: Path, name: str, digest: str) -> Iterator[str]:
    try:
        if durable.sha256(folder / name) != digest:
            yield f"{name} is not what was written: its checksum differs"
    except (OSError, ValueError) as error:
        yield f"{name} cannot be read ({error})"
