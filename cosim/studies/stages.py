"""The cache of recorded traffic: the runs of a study that differ in nothing of the traffic replay it.

An entry is a folder `<cache>/<stage>/<name>/` with a `stage.json` that lists the checksums of its files. An entry is
never incomplete. An entry whose files have changed is made again.
"""

import fcntl
import json
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import time

from cosim.base.durable import PARTIAL
from cosim.config.config import Config
from cosim.runs import run as running
from cosim.runs.drive import Advance
from cosim.runs.manifest import sha256
from cosim.studies.folder import write_whole

LIMIT_GB = 10.0
"""Size above which the least recently used entries are deleted, unless COSIM_CACHE_GB sets another size."""

_log = logging.getLogger(__name__)


def default_folder() -> Path:
    """Folder of the cache: COSIM_CACHE, or a folder in the user's cache folder."""
    if named := os.environ.get("COSIM_CACHE"):
        return Path(named)
    of_user = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(of_user) / "cosim" / "stages"


def limit_gb() -> float:
    """Size of the cache [GB]: COSIM_CACHE_GB, or LIMIT_GB."""
    said = os.environ.get("COSIM_CACHE_GB", str(LIMIT_GB))
    with suppress(ValueError):
        if (limit := float(said)) >= 0:
            return limit
    raise ValueError(f"COSIM_CACHE_GB = {said}: gigabytes, 0 or more, are wanted.")


@dataclass(frozen=True, slots=True)
class Entry:
    """One result of a stage."""

    stage: str
    """What the entry holds; today `traffic` is the only stage."""
    name: str
    bytes: int
    used_s: float
    """Time of its last use [s since 1970]."""
    seconds: float
    """Time that it took to make [s]."""


@dataclass(frozen=True, slots=True)
class Cache:
    """Results of stages in a folder."""

    path: Path

    def find(self, stage: str, name: str) -> Path | None:
        """The folder of an unchanged entry; None if there is none. A changed entry is deleted."""
        entry = self.path / stage / name
        try:
            files = json.loads((entry / "stage.json").read_text())["files"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            files = None
        if files is None or _files(entry) != files:
            _log.warning("%s was changed after it was written: it is not used, and made anew.", entry)
            shutil.rmtree(entry, ignore_errors=True)
            return None
        os.utime(entry / "stage.json")
        return entry

    def names(self, stage: str) -> set[str]:
        """Names of the entries of a stage, unchecked."""
        return {path.parent.name for path in (self.path / stage).glob("*/stage.json")}

    def make_traffic(self, name: str, config: Config, advance: Advance) -> None:
        """Record the traffic of a config, unless the cache holds it."""
        entry = self.path / "traffic" / name
        partial = entry.with_name(f"{name}{PARTIAL}")
        entry.parent.mkdir(parents=True, exist_ok=True)
        with entry.with_name(f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            shutil.rmtree(partial, ignore_errors=True)  # left by a process that was killed
            if self.find("traffic", name) is not None:
                return
            partial.mkdir()
            begun_s = time()
            running.record_traffic(config, partial, advance)
            for folder in [path for path in partial.iterdir() if path.is_dir()]:
                if not any(folder.iterdir()):
                    folder.rmdir()
            content = {"files": _files(partial), "seconds": round(time() - begun_s, 2)}
            write_whole(partial / "stage.json", json.dumps(content, indent=1).encode())
            partial.replace(entry)
            self.shrink(limit_gb(), {name})

    def entries(self) -> list[Entry]:
        """All entries, the most recently used first."""
        return sorted(self._entries(), key=lambda entry: -entry.used_s)

    def _entries(self) -> Iterator[Entry]:
        for path in self.path.glob("*/*/stage.json"):
            if path.parent.name.endswith(PARTIAL):  # another process is about to rename it
                continue
            try:
                used_s = path.stat().st_mtime
                size = sum(f.stat().st_size for f in path.parent.rglob("*") if f.is_file())
            except FileNotFoundError:  # another process has removed it meanwhile
                continue
            try:
                seconds = float(json.loads(path.read_text()).get("seconds", 0))
            except (OSError, ValueError, AttributeError, TypeError, RecursionError):  # `find` will not take it either
                seconds = 0.0
            yield Entry(path.parent.parent.name, path.parent.name, size, used_s, seconds)

    def shrink(self, limit_gb: float, spared: set[str]) -> list[Entry]:
        """Delete the least recently used entries until the rest fits; return the deleted ones."""
        total, gone = 0, []
        for entry in self.entries():
            total += entry.bytes
            if total > limit_gb * 1e9 and entry.name not in spared:
                shutil.rmtree(self.path / entry.stage / entry.name, ignore_errors=True)
                gone.append(entry)
                total -= entry.bytes
        return gone


def _files(entry: Path) -> dict[str, str]:
    """Checksums of an entry's files."""
    checksums = {}
    for path in sorted(entry.rglob("*")):
        if path.is_file() and path.name != "stage.json":
            checksums[path.relative_to(entry).as_posix()] = sha256(path)
    return checksums
