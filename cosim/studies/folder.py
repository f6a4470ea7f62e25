"""A study on disk. Its state is read from its folders, so a killed sweep needs no repair."""

import fcntl
import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from cosim.base import durable
from cosim.config.data import read_toml
from cosim.studies.plan import PlannedRun, as_data
from cosim.studies.points import Point
from cosim.studies.study import Study
from results.study_measuring import SUMS

STATES = ("finished", "failed", "unfinished", "waiting")
"""States of a point: its run is finished; its last attempt failed; its run has begun; nothing was done yet."""
States = dict[str, int]
"""Number of points in each of them."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a run."""

    outcome: str
    """ok, failed, timeout, memory or stopped."""
    wall_s: float
    memory_bytes: int
    """Largest resident memory."""
    error: str = ""
    """Last line of its log if it failed."""
    cpu_s: float = 0.0
    """Processor time."""


@dataclass(frozen=True, slots=True)
class StudyFolder:
    """`study.toml`, `index.parquet`, `runs/<id>/` as `cosim run` writes them, and `jobs/<id>/` with plan, log and
    metrics of each."""

    path: Path

    def run(self, id: str) -> Path:
        return self.path / "runs" / id

    def job(self, id: str) -> Path:
        return self.path / "jobs" / id

    @property
    def stop(self) -> Path:
        """A file that tells workers to stop."""
        return self.path / "stop"

    def prepare(self, study: Study) -> None:
        """Create the folder, or check that it belongs to this study; ValueError if it does not."""
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"--out {self.path} is a file. Give a folder.")
        kept = self.path / "study.toml"
        if kept.is_file():
            name = read_toml(kept, "study file").get("study", {}).get("name")
            if name != study.head.name:
                raise ValueError(
                    f'{self.path} holds the study "{name}", not "{study.head.name}". Nothing was changed. '
                    "Give another --out."
                )
        elif self.path.is_dir() and any(self.path.iterdir()):
            raise ValueError(f"--out {self.path} is not empty and holds no study. Give another folder.")
        self.check()
        (self.path / "runs").mkdir(parents=True, exist_ok=True)
        write_whole(kept, study.to_toml().encode())

    def check(self) -> None:
        """Raise ValueError if something that a sweep reads or writes is a symbolic link, a pipe or a device.

        A link would lead to another place, and a pipe may never end.
        """
        own = ("lock", "stop", "study.toml", "index.parquet", "*.partial")
        for pattern in (*own, "runs", "runs/*", "jobs", "jobs/*", "jobs/*/*", "traffic", "traffic/*"):
            for path in self.path.glob(pattern):
                if path.is_symlink():
                    raise ValueError(f"{path} is a symbolic link: nothing is written through it. Give another --out.")
                if not (path.is_file() or path.is_dir()):
                    raise ValueError(f"{path} is neither a file nor a folder. Remove it, or give another --out.")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder for this process; ValueError if another one sweeps it."""
        with open(durable.open_lock(self.path / "lock"), "w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise ValueError(f"{self.path}: another `cosim sweep` works in this folder. Wait for it.") from None
            yield

    def is_swept(self) -> bool:
        """Whether a process sweeps it now."""
        try:
            with self.locked():
                return False
        except ValueError:
            return True

    def tidy(self) -> None:
        """Remove incomplete files that a killed sweep left."""
        for pattern in ("*.partial", "jobs/*/*.partial", "traffic/*.partial"):
            for path in self.path.glob(pattern):
                path.unlink(missing_ok=True)

    def write_job(self, planned: PlannedRun, more: Mapping[str, Any]) -> None:
        """Write `job.json` for the process that makes the run."""
        self.job(planned.id).mkdir(parents=True, exist_ok=True)
        data = as_data(planned) | dict(more)
        write_whole(self.job(planned.id) / "job.json", json.dumps(data, default=str).encode())

    def is_finished(self, id: str) -> bool:
        """Whether a run is finished and measured."""
        return status_of(self.run(id)) == "finished" and (self.job(id) / "measures.parquet").is_file()

    def forget_measures(self, id: str) -> None:
        """Delete the metrics of a run, so that it is measured again."""
        for name in ("measures.parquet", "curves.parquet", SUMS):
            (self.job(id) / name).unlink(missing_ok=True)

    def answers(self) -> dict[str, tuple[str, str]]:
        """Run and trust variant by point, for all planned points. Finished runs take precedence, then the run that was
        planned last: what a study asks for may have changed since an earlier one."""
        found: dict[str, tuple[str, str]] = {}
        jobs = sorted((self.path / "jobs").glob("*/job.json"))
        jobs.sort(key=lambda path: path.stat().st_mtime_ns, reverse=True)
        for path in sorted(jobs, key=lambda path: not self.is_finished(path.parent.name)):
            for point, variant in _members(path).items():
                found.setdefault(point, (path.parent.name, variant))
        return found

    def state(self, id: str) -> str:
        """State of a run, one of `STATES`."""
        if self.is_finished(id):
            return "finished"
        done = self.attempts(id)
        if done and done[-1].outcome not in ("ok", "stopped"):
            return "failed"
        return "unfinished" if self.run(id).exists() else "waiting"

    def attempts(self, id: str) -> list[Attempt]:
        """Attempts at a run until now."""
        path = self.job(id) / "attempts.json"
        return _attempts(path) if path.is_file() else []

    def add_attempt(self, id: str, attempt: Attempt) -> None:
        rows = [asdict(a) for a in (*self.attempts(id), attempt)]
        write_whole(self.job(id) / "attempts.json", json.dumps(rows).encode())

    def write_index(self, study: Study, points: Sequence[Point]) -> States:
        """Write `index.parquet` with one row per point; return the number of points in each state."""
        content, states = self.index(study, points)
        write_whole(self.path / "index.parquet", content)
        return states

    def index(self, study: Study, points: Sequence[Point]) -> tuple[bytes, States]:
        """The content of `index.parquet`, and the number of points in each state."""
        answers = self.answers()
        rows: list[dict[str, Any]] = []
        of_run: dict[str, dict[str, Any]] = {}
        for point in points:
            id, variant = answers.get(point.id, ("", ""))
            if id not in of_run:
                of_run[id] = self._cost(id)
            named = {"point": point.id, "run": id, "variant": variant, "replicate": point.replicate}
            rows.append(named | of_run[id])
        columns: dict[str, Any] = {}
        for name in rows[0] if rows else ():
            columns[name] = [row[name] for row in rows]
        for key in study.keys:
            columns[key] = _column([point.keys[key] for point in points])
        head = {
            "name": study.head.name,
            "question": study.head.question,
            "keys": list(study.keys),
            "baseline": study.head.baseline,
            "measure": asdict(study.measuring),
        }
        table = pa.table(columns).replace_schema_metadata({"study": json.dumps(head)})
        sink = io.BytesIO()
        pq.write_table(table, sink)
        states = [row["state"] for row in rows]
        return sink.getvalue(), {state: states.count(state) for state in STATES}

    def _cost(self, id: str) -> dict[str, Any]:
        """State of a run, and what it has taken; nothing where `id` is empty because the run has not been planned."""
        done = self.attempts(id) if id else []
        return {
            "state": self.state(id) if id else "waiting",
            "attempts": len(done),
            "wall_s": sum(a.wall_s for a in done),
            "cpu_s": sum(a.cpu_s for a in done),
            "memory_bytes": max((a.memory_bytes for a in done), default=0),
            "disk_bytes": _size(self.run(id)) if id else 0,
        }


def status_of(run: Path) -> str:
    """Status in a run's manifest; empty if there is none."""
    try:
        return str(json.loads(durable.read(run / "manifest.json"))["status"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""


def _members(job: Path) -> dict[str, str]:
    """Trust variant of each point of a job. Damaged, in one line, if the file says no such thing."""
    try:
        members = dict(json.loads(durable.read(job))["members"])
        if not all(isinstance(text, str) for item in members.items() for text in item):
            raise ValueError("members are no names")
        return members
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise _damaged(job, error) from None


def _attempts(path: Path) -> list[Attempt]:
    """Attempts as a file has them. Damaged, in one line, if it has something else."""
    number = (int, float)
    kinds: dict[str, Any] = {"outcome": str, "error": str, "wall_s": number, "cpu_s": number, "memory_bytes": int}
    try:
        found = [Attempt(**row) for row in json.loads(durable.read(path))]
        for attempt in found:
            for name, kind in kinds.items():
                if not isinstance(getattr(attempt, name), kind):
                    raise ValueError(f"{name} is of another kind")
        return found
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> durable.Damaged:
    reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return durable.Damaged(f"{path} is damaged ({reason}). Sweep the study in another --out.")


def write_whole(path: Path, content: bytes) -> None:
    """Write a file through a temporary file, so that it is never incomplete."""
    partial = path.with_name(f"{path.name}.{os.getpid()}{durable.PARTIAL}")
    try:
        with durable.Growing(partial) as file:
            file.write(content)
            file.finish(path)
    finally:
        partial.unlink(missing_ok=True)


def _column(values: Sequence[Any]) -> Sequence[Any]:
    """Values of a key as a column: numbers, texts and booleans unchanged, anything else as text."""
    kinds = {type(v) for v in values}
    if kinds in ({bool}, {str}):
        return values
    if bool not in kinds and all(isinstance(v, int | float) for v in values):
        return [float(v) for v in values]
    return [v if isinstance(v, str) else json.dumps(v) for v in values]


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
