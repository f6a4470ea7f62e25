"""Opening a run: its tables, and the metrics read off them."""

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from results import inventory
from results.durable import Damaged
from results.manifest import read_manifest, status_of
from results.run import Run
from results.tables import SCHEMA_VERSION

if TYPE_CHECKING:
    from results.measure import Measures


class OpenRun(Run):
    """A run with its metrics at hand."""

    @cached_property
    def measure(self) -> "Measures":
        """Figures of merit: `run.measure()`, `run.measure.trust.over_time()`, `run.measure.trust.plot()`."""
        from results.measure import Measures  # here, because SciPy and NetworkX take their time

        return Measures(self)


def open_run(path: str | Path, unfinished: bool = False) -> OpenRun:
    """Open a run folder.

    Parameters
    ----------
    path
        Folder that `cosim run` wrote.
    unfinished
        Accept a run that crashed or still runs, as far as its blocks are on disk.
    """
    path = Path(path)
    manifest = read_manifest(path)
    version, status = manifest["schema_version"], manifest["status"]
    if version != SCHEMA_VERSION:
        raise ValueError(
            f"{path} was written with schema version {version} (other names of tables and columns); this cosim reads "
            f"version {SCHEMA_VERSION}. Run again with this cosim, or read it with the one in its manifest.json."
        )
    run = OpenRun(path, manifest)
    if status == "finished":
        summary = run.inventory.summary(run.manifest["inventory"]["tables"])
        if summary != manifest["inventory"]:
            raise Damaged(f"{path} is damaged: {inventory.FILE} is not the one that manifest.json was written with.")
    elif not unfinished:
        raise ValueError(
            f'{path} is unfinished (status "{status_of(path, manifest)}", {run.inventory.end_step} steps on disk). '
            f"Continue it: `cosim resume {path}`."
        )
    else:
        manifest["steps"] = run.inventory.end_step
    return run
