"""Runs of a study on Dask distributed.

Every run is a subprocess of a worker, so a crash is a failed run and not a lost worker. Results stay on disk. Only
paths are sent between processes.
"""

import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil
from distributed import Client, Future, as_completed

from cosim.runs import process
from cosim.studies.folder import Attempt, StudyFolder
from cosim.studies.study import Limits

_POLL_S = 0.2
_ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True, slots=True)
class Work:
    """Jobs of a study: folders with a `job.json`, and the traffic that each waits for."""

    runs: Mapping[str, str]
    """Name of the recorded traffic by run; empty if the run simulates its own."""
    traffic: Mapping[str, Path]
    """By name, a file with a config whose traffic is simulated first."""
    cache: Path


def execute(client: Client, study: StudyFolder, work: Work, limits: Limits) -> Iterator[tuple[str, Attempt]]:
    """Make all runs. Yields the name and the last attempt of each run and each traffic when it ends."""
    first: dict[str, Future] = {}
    asked: tuple[Any, ...]
    for name, path in work.traffic.items():
        asked = (str(work.cache), name, str(path), str(study.path), limits.timeout_s)
        first[name] = client.submit(drive_traffic, *asked, key=f"traffic-{name}", pure=False)
    runs: dict[Future, str] = {}
    for id, traffic in work.runs.items():
        allowed = limits.retries, limits.timeout_s, limits.memory_gb
        asked = (str(study.path), id, *allowed, first.get(traffic))
        key = f"run-{study.path.name}-{id}-{time.time_ns()}"
        runs[client.submit(make_run, *asked, key=key, pure=False)] = id
    runs |= {future: name for name, future in first.items()}
    for future in as_completed(list(runs)):
        id = runs[future]
        try:
            yield id, Attempt(**future.result())
        except Exception as error:  # the workers died more often than the scheduler allows
            lost = Attempt("failed", 0.0, 0, f"worker lost: {type(error).__name__}")
            if id in work.runs:
                study.add_attempt(id, lost)
            yield id, lost


def make_run(
    study: str, id: str, retries: int, timeout_s: float, memory_gb: float, after: Any = None
) -> dict[str, Any]:
    """Make a run and its metrics in a subprocess of a worker; repeat it up to `retries` times if it fails."""
    folder = StudyFolder(Path(study))
    job = folder.job(id)
    attempt = Attempt("stopped", 0.0, 0)
    for _ in range(retries + 1):
        if folder.stop.exists():
            break
        attempt = _attempt(["run", str(job)], job / "log.txt", folder.stop, timeout_s, memory_gb)
        folder.add_attempt(id, attempt)
        if attempt.outcome in ("ok", "stopped"):
            break
    return asdict(attempt)


def drive_traffic(cache: str, name: str, config: str, study: str, timeout_s: float) -> dict[str, Any]:
    """Record traffic for several runs in a subprocess of a worker. If this fails, each run simulates its own."""
    words = ["traffic", cache, name, config]
    log = Path(config).with_suffix(".log")
    return asdict(_attempt(words, log, StudyFolder(Path(study)).stop, timeout_s, 1e3))


def _attempt(words: Sequence[str], log: Path, stop: Path, timeout_s: float, memory_gb: float) -> Attempt:
    """Run `cosim.studies.worker` once, within limits."""
    begun, outcome, peak, cpu_s = time.monotonic(), "", 0, 0.0
    with log.open("ab") as out:
        worker = subprocess.Popen(
            process.command("cosim.studies.worker", *words),
            stdin=subprocess.PIPE,
            stdout=out,
            stderr=out,
            env=process.environment(**_ONE_THREAD),
            start_new_session=True,
        )
        try:
            while worker.poll() is None:
                time.sleep(_POLL_S)
                resident, cpu_s = _used(worker.pid, cpu_s)
                peak = max(peak, resident)
                if stop.exists():
                    outcome = "stopped"
                elif time.monotonic() - begun > timeout_s:
                    outcome = "timeout"
                elif peak > memory_gb * 1e9:
                    outcome = "memory"
                if outcome:
                    worker.kill()
                    worker.wait()
        finally:
            worker.kill()
            worker.wait()
    wall_s = round(time.monotonic() - begun, 2)
    said = ""
    if outcome == "timeout":
        said = f"longer than limits.timeout_s = {timeout_s:g} s"
    elif outcome == "memory":
        said = f"more than limits.memory_gb = {memory_gb:g} GB"
    elif not outcome and worker.returncode:
        said = _last_line(log) or f"ended with status {worker.returncode}"
    if not outcome:
        outcome = "failed" if worker.returncode else "ok"
    return Attempt(outcome, wall_s, peak, said, round(cpu_s, 2))


def _used(pid: int, before_s: float) -> tuple[int, float]:
    """Present resident memory and processor time so far; 0 and `before_s` if the process has ended."""
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            spent = process.cpu_times()
            return int(process.memory_info().rss), max(before_s, spent.user + spent.system)
    except psutil.Error:
        return 0, before_s


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1][:300] if lines else ""
