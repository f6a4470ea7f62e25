"""Opening a run: its tables, and the metrics read off them."""

import json
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

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
    if not path.is_dir():
        raise ValueError(f"{path} is not a folder. Give the folder that `cosim run` wrote.")
    if not (path / "manifest.json").is_file():
        raise ValueError(f"{path} is not a run: it holds no manifest.json. Give the folder that `cosim run` wrote.")
    try:
        manifest = json.loads((path / "manifest.json").read_text())
        version, status = manifest["schema_version"], manifest["status"]
        manifest["dt_s"], manifest["steps"], manifest["config"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}/manifest.json is damaged ({error}). Run again.") from error
    if version != SCHEMA_VERSION:
        raise ValueError(
            f"{path} was written with schema version {version} (other names of tables and columns); this cosim reads "
            f"version {SCHEMA_VERSION}. Run again with this cosim, or read it with the one in its manifest.json."
        )
    if status != "finished" and not unfinished:
        raise ValueError(f'{path} is unfinished (status "{status}"). Run it again: `cosim run {path}/config.toml`.')
    return OpenRun(path, manifest)
