"""The manifest of a run folder: read, written with a checksum of itself, and what it says of the run."""

import json
import math
import shutil
import tomllib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeGuard

from cosim.base import durable
from cosim.base.codes import BASE_VARIANT, Role, labels
from cosim.base.durable import Damaged
from results import inventory
from results.inventory import Inventory
from results.tables import SCHEMA_VERSION, TABLES

MANIFEST = "manifest.json"
CONFIG = "config.toml"
STATUSES = ("running", "finished", "interrupted", "failed")

_SECTIONS = ("config", "net", "versions", "source", "choices", "timings_s", "summary", "inventory")
_LISTS = ("variants", "roles", "dropped")


def read_manifest(path: str | Path) -> dict[str, Any]:
    """Read the manifest of a run folder. Raises Damaged if it was changed after it was written."""
    path = Path(path)
    if not path.is_dir():
        raise ValueError(f"{path} is not a folder. Give the folder that `cosim run` wrote.")
    if not (path / MANIFEST).is_file() and (path / "index.parquet").is_file():
        raise ValueError(f"{path} is a study, not a run. In Python, `results.study.open_study` opens it, and its runs.")
    if not (path / MANIFEST).is_file():
        raise ValueError(f"{path} is not a run: it holds no manifest.json. Give the folder that `cosim run` wrote.")
    try:
        with durable.open_regular(path / MANIFEST) as file:
            manifest = json.loads(file.read())
        if not isinstance(manifest["schema_version"], int):
            raise ValueError("schema_version")
        if manifest["schema_version"] == SCHEMA_VERSION and not durable.is_sealed(manifest):
            raise ValueError("its checksum differs")
        if manifest["schema_version"] == SCHEMA_VERSION:
            _check_kinds(manifest)
        manifest["dt_s"], manifest["steps"], manifest["config"], manifest["status"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise Damaged(f"{path}/{MANIFEST} is damaged ({reason}). Run again.") from None
    return manifest


def check_schema(path: Path, manifest: Mapping[str, Any]) -> None:
    """Raise ValueError, with a one-line message, if the tables of a run have another schema than this cosim's."""
    version = manifest["schema_version"]
    if version == SCHEMA_VERSION:
        return
    source = manifest.get("source")
    said = source if isinstance(source, Mapping) else {}
    named = {"cosim": said.get("version"), "commit": said.get("commit")}
    known = [f"{what} {name}" for what, name in named.items() if _is_name(name)]
    reader = ", ".join(known) or "the cosim that wrote it"
    raise ValueError(
        f"{path} was written with schema version {version} of the tables, and this cosim reads {SCHEMA_VERSION}. "
        f"Read it with {reader}, or run again."
    )


def _is_name(value: Any) -> bool:
    """Whether a value of a manifest can be shown as part of a line."""
    return isinstance(value, str) and value.isprintable() and 0 < len(value) <= _LONGEST_NAME


_LONGEST_NAME = 60


def _is_positive(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and 0 < value < math.inf


def _check_kinds(manifest: Mapping[str, Any]) -> None:
    """ValueError where an entry is no such thing as is written there: a checksum can be made anew by anybody."""
    if not (isinstance(manifest["status"], str) and manifest["status"] in STATUSES):
        raise ValueError(f"status {json.dumps(manifest['status'])} is none of {', '.join(STATUSES)}")
    if not _is_positive(manifest["dt_s"]):
        raise ValueError("dt_s is no length of a step")
    if type(manifest["steps"]) is not int or not 0 <= manifest["steps"] < 2**31:
        raise ValueError("steps is no number of steps")
    for name in (*_SECTIONS, *_LISTS):
        kind: type = dict if name in _SECTIONS else list
        if name in manifest and not isinstance(manifest[name], kind):
            raise ValueError(f"{name} is no {'section' if kind is dict else 'list'}")
    names = [name for key in _LISTS for name in manifest.get(key, ())]
    if not all(isinstance(name, str) for name in names):
        raise ValueError(f"one of {', '.join(_LISTS)} holds something else than names")
    if not isinstance(manifest.get("inventory", {}).get("tables", {}), dict):
        raise ValueError("inventory.tables is no section")
    text = json.dumps(manifest, ensure_ascii=False)
    for spent_s in manifest.get("timings_s", {}).values():
        if not isinstance(spent_s, int | float):
            raise ValueError("timings_s holds something else than seconds")
    if any(sign in text for sign in _CONTROL):
        raise ValueError("control characters, which a terminal would obey")


_CONTROL = ("\\u001b", "\\u007f", *(chr(code) for code in range(0x7F, 0xA0)))
"""Escape, delete and the second set of control characters, as `json.dumps` writes them."""


def problems(folder: Path, manifest: Mapping[str, Any], found: Inventory) -> Iterator[str]:
    """Contradictions in a manifest, or between it and the inventory or the config file.

    Checksums reveal accidental changes, and changes after which the checksum was not computed again. Values that the
    manifest contains twice are compared too.
    """
    if manifest["status"] == "finished":
        said = manifest.get("inventory") or {}
        if found.summary(said.get("tables") or ()) != said:
            yield f"{inventory.FILE} is not the one that {MANIFEST} was written with"
        if manifest["steps"] != found.end_step:
            yield f"{MANIFEST} says {manifest['steps']} steps, the inventory {found.end_step}"
        asked, summary = steps_asked_for(manifest["config"]), manifest.get("summary", {})
        if "vehicles_on_road_mean" in summary and "ended_early" not in summary and asked not in (None, found.end_step):
            yield f"{MANIFEST} says finished after {found.end_step} steps, but its config asks for {asked}"
    for part in found.parts:
        end = found.end_step - (TABLES[part.table].key[0] == "step")
        if part.first_step < 0 or part.last_step > end:
            yield f"{part.name} has steps {part.first_step} to {part.last_step}, outside of 0 to {found.end_step}"
    if problem := config_problem(folder, manifest, is_only_begun=not found.blocks):
        yield problem
    for key, value in _repeated(manifest["config"]):
        if key in manifest and manifest[key] != value:
            said = json.dumps(manifest[key])
            yield f"{MANIFEST}: {key} = {said}, but its config says {json.dumps(value)}"


def config_problem(folder: Path, manifest: Mapping[str, Any], is_only_begun: bool) -> str:
    """Problem with the config file of a run folder; empty if there is none, or if the run never had a config file.

    A run that has only begun may have been killed before the file was written.
    """
    path = folder / CONFIG
    if "config_sha256" not in manifest:
        return ""
    if not (path.exists() or path.is_symlink()):
        return "" if manifest["status"] == "running" and is_only_begun else f"{CONFIG} is missing"
    try:
        if durable.sha256(path) != manifest["config_sha256"]:
            return f"{CONFIG} was changed since it was written: its checksum differs"
        with durable.open_regular(path) as file:
            stated = tomllib.load(file)
    except (OSError, ValueError, RecursionError) as error:
        return f"{CONFIG} cannot be read ({error})"
    return "" if _stated(manifest["config"]) == stated else f"{CONFIG} says something else than {MANIFEST}"


def _stated(data: Any) -> Any:
    """Plain data as a TOML file states them: without what is not set."""
    if isinstance(data, dict):
        return {key: _stated(value) for key, value in data.items() if value is not None}
    return [_stated(value) for value in data] if isinstance(data, list) else data


def steps_asked_for(config: Mapping[str, Any]) -> int | None:
    """Number of steps that a config asks for; None if it does not say."""
    traffic = config.get("traffic")
    if not isinstance(traffic, dict):
        return None
    duration_s, step_s = traffic.get("duration_s"), traffic.get("step_s")
    if not _is_positive(duration_s) or not _is_positive(step_s) or duration_s >= 1e12:
        return None
    return max(1, math.floor(duration_s / step_s + 1e-9))


def _repeated(config: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Entries of the manifest that follow from its config."""
    traffic, interval_s = config.get("traffic"), config.get("sensing_interval_s")
    traffic = traffic if isinstance(traffic, dict) else {}
    step_s = traffic.get("step_s")
    if _is_positive(step_s):
        yield "dt_s", step_s
        yield "traffic_seed", traffic.get("seed")
        yield "roles", list(labels(Role))
        if _is_positive(interval_s):
            yield "sense_every_steps", round(interval_s / step_s)
    if "seed" in config:
        yield "seed", config["seed"]
    variants = config.get("trust_variant")
    if isinstance(variants, list) and all(isinstance(v, dict) for v in variants):
        yield "variants", [BASE_VARIANT, *(v.get("name") for v in variants)]


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
    """Delete tables of a finished run that shall not be kept, and name them in its manifest."""
    manifest = read_manifest(folder)
    gone = {*manifest.get("dropped", ()), *names} & TABLES.keys()
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
