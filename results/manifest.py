"""The manifest of a run folder: read, written with a checksum of itself, and what it says of the run."""

import json
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from results import durable, inventory
from results.durable import Damaged
from results.tables import SCHEMA_VERSION, TABLES

MANIFEST = "manifest.json"


def read_manifest(path: str | Path) -> dict[str, Any]:
    """The manifest of a run folder; Damaged where it is not what was written."""
    path = Path(path)
    if not path.is_dir():
        raise ValueError(f"{path} is not a folder. Give the folder that `cosim run` wrote.")
    if not (path / MANIFEST).is_file():
        raise ValueError(f"{path} is not a run: it holds no manifest.json. Give the folder that `cosim run` wrote.")
    try:
        with durable.open_regular(path / MANIFEST) as file:
            manifest = json.loads(file.read())
        if not isinstance(manifest["schema_version"], int):
            raise ValueError("schema_version")
        if manifest["schema_version"] == SCHEMA_VERSION and not durable.is_sealed(manifest):
            raise ValueError("its checksum differs")
        manifest["dt_s"], manifest["steps"], manifest["config"], manifest["status"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise Damaged(f"{path}/{MANIFEST} is damaged ({reason}). Run again.") from None
    return manifest


def write_manifest(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the manifest of a run folder, with a checksum of itself."""
    text = json.dumps(durable.seal(dict(content)), indent=1, ensure_ascii=False)
    durable.write(folder / MANIFEST, text.encode())
    durable.sync_folder(folder)


def finish(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the manifest of a finished run, with the inventory of what its recorder wrote."""
    tables = [name for name in TABLES if (folder / name).is_dir()]
    summary = inventory.read(folder).summary(tables)
    about = {"schema_version": SCHEMA_VERSION, "status": "finished", "steps": summary["end_step"]}
    write_manifest(folder, about | dict(content) | {"inventory": summary})


def drop_tables(folder: Path, names: Collection[str]) -> None:
    """Delete tables of a finished run that are not to be kept; its manifest says which."""
    manifest = read_manifest(folder)
    gone = {*manifest.get("dropped", ()), *names}
    if manifest["status"] != "finished":
        raise ValueError(f"{folder} is not finished: tables are dropped from finished runs only.")
    write_manifest(folder, manifest | {"dropped": [name for name in TABLES if name in gone]})
    for name in gone:
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)


def status_of(path: Path, manifest: Mapping[str, Any]) -> str:
    """running, finished, interrupted, failed, or killed: running by its manifest, but no process writes it."""
    status = str(manifest["status"])
    return "killed" if status == "running" and not durable.is_locked(path) else status
