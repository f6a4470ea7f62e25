"""Open a run folder: its tables (`results.run`) and the metrics computed from them (`results.measure`)."""

import shlex
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.base import durable
from cosim.base.durable import Damaged
from results.manifest import check_schema, problems, read_manifest
from results.run import Run

if TYPE_CHECKING:
    from results.measure import Measures


class OpenRun(Run):
    """A run together with its metrics."""

    @cached_property
    def measure(self) -> "Measures":
        """All metrics: `run.measure()`, `run.measure.trust.over_time()`, `run.measure.trust.plot()`."""
        from results.measure import Measures  # here, because SciPy takes its time

        return Measures(self)


def open_run(path: str | Path, unfinished: bool = False) -> OpenRun:
    """Open a run folder.

    Parameters
    ----------
    path
        Folder that `cosim run` wrote.
    unfinished
        Also open a run that crashed or is still running, up to its last block on disk.

    Raises
    ------
    ValueError
        If the run is unfinished and `unfinished` is false, or if its schema version is another one.
    Damaged
        If the run folder is damaged.
    """
    path = Path(path)
    is_live, manifest = durable.is_locked(path), read_manifest(path)
    if manifest["status"] == "running" and not is_live:
        manifest = read_manifest(path)  # it may have ended meanwhile
    check_schema(path, manifest)
    status = manifest["status"]
    run = OpenRun(path, manifest)
    is_live = is_live and status != "finished"  # a finished run may still be locked for a moment
    if is_live and unfinished:
        run.hold_open_parts()
    if problem := next(problems(path, manifest, run.inventory), ""):
        raise Damaged(f"{path} is damaged: {problem}.")
    if status != "finished" and not unfinished:
        how = "Wait for its end." if is_live else f"Continue it: `cosim resume {shlex.quote(str(path))}`."
        raise ValueError(f'{path} is unfinished (status "{run.status}", {run.inventory.end_step} steps on disk). {how}')
    if status != "finished":
        manifest["steps"] = run.inventory.end_step
    return run
