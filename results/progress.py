"""How far a run is: what of it is on disk, and what to do next."""

import shlex
from pathlib import Path
from typing import Any

from cosim.base import durable
from results import inventory
from results.manifest import problems, read_manifest, status_of, steps_asked_for

_NEXT = {
    "finished": "cosim report {folder}",
    "running": "wait for its end; cosim measure {folder} shows what is on disk",
    "killed": "cosim resume {folder}",
    "interrupted": "cosim resume {folder}",
    "failed": "cosim resume {folder}",
}
"""What a user does with a run of this status."""


def progress(folder: Path) -> dict[str, Any]:
    """State of a run.

    Returns
    -------
    status; steps on disk; steps_asked, None if the run does not say; blocks; bytes of its tables; error, why the run
    failed (empty if it did not); next, what to do with the run.

    Raises
    ------
    Damaged
        If the manifest or the inventory is not what was written.
    """
    is_live, manifest = durable.is_locked(folder), read_manifest(folder)
    found = inventory.read(folder)
    status = "running" if is_live and manifest["status"] != "finished" else status_of(folder, manifest)
    wrong = "" if is_live else next(problems(folder, manifest, found), "")
    following = "cosim verify {folder}" if wrong else _NEXT[status]
    return {
        "status": status,
        "steps": found.end_step,
        "steps_asked": steps_asked_for(manifest["config"]),
        "blocks": len(found.blocks),
        "bytes": sum(part.n_bytes for part in found.parts),
        "error": wrong or str(manifest.get("error", "")),
        "next": following.format(folder=shlex.quote(str(folder))),
    }
