"""Runs of the shipped city for tests of what reads runs: each is simulated once per process and then copied."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

from tests.drive import drive


def write(folder, *changes, steps=10, level="full"):
    """Copy a run of so many seconds into a new folder; changes are keys of its config."""
    return Path(shutil.copytree(_driven(steps, level, changes), folder))


@cache
def _driven(steps, level, changes):
    folder = tempfile.TemporaryDirectory(prefix="cosim-recorded-")
    atexit.register(folder.cleanup)
    keys = (f"traffic.duration_s={steps}", f"record.level={level}", "record.block_steps=5")
    return drive(Path(folder.name) / "run", *keys, *changes)
