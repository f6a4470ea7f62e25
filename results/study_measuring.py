"""How the points of a study were measured, as `jobs/<id>/job.json` says, and whether the metrics are still those."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.base import durable

OWN_CODE = "the code of measure.own"
SUMS = "measured.json"
"""Checksums of the tables of metrics of a job, by name. Jobs of earlier versions have none."""


def write_measured(job: Path, tables: Mapping[str, pd.DataFrame]) -> None:
    """Write the tables of metrics of a run, after their checksums. With the last table the run counts as measured."""
    contents = {name: table.to_parquet(index=False) for name, table in tables.items()}
    sums = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    durable.write(job / SUMS, json.dumps(sums).encode())
    for name, content in contents.items():
        durable.write(job / name, content)


def changed_in(job: Path) -> list[str]:
    """Tables of metrics that are missing, or not what was written; none if the job has no checksums."""
    if not (job / SUMS).is_file():
        return []
    try:
        sums = dict(json.loads(durable.read(job / SUMS)))
        return [name for name in sums if _digest(job / name) != sums[name]]
    except (OSError, ValueError, TypeError, RecursionError):
        return [SUMS]


def _digest(path: Path) -> str:
    """SHA-256 of a file; empty if there is none."""
    return durable.sha256(path) if path.is_file() else ""


def measuring_of(asked: Mapping[str, Any]) -> dict[str, Any]:
    """What decides the metrics of a job, by key of the study file.

    A file of own metrics counts by its name and its content, not by its folder.
    """
    found = {f"measure.{name}": value for name, value in asked.get("measure", {}).items()}
    found["measure.own"] = str(found.get("measure.own", "")).rpartition("/")[2]
    found["keep.topics"] = sorted(asked.get("topics", ()))
    found[OWN_CODE] = asked.get("own_sha256", "")
    return found


def measuring_in(job: Path) -> dict[str, Any]:
    """`measuring_of` a folder with a `job.json`. Damaged, in one line, if the file says no such thing."""
    path = job / "job.json"
    try:
        return measuring_of(json.loads(durable.read(path)))
    except (OSError, ValueError, AttributeError, TypeError, RecursionError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise durable.Damaged(f"{path} is damaged ({reason}). Sweep the study in another --out.") from None


def changes(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Keys of the study that differ. A key that one of them lacks is of another version, and makes no difference."""
    return [key for key, value in one.items() if other.get(key, value) != value]
