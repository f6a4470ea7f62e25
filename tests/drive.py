"""Runs for tests: each in a process of its own, because libsumo holds one simulation per process."""

import subprocess
import sys
from pathlib import Path

SHORT = (
    "traffic.duration_s=20",
    "attacks.0.start_s=5",
    "attacks.0.share_p=0.2",
    "attacks.1.start_s=5",
    "attacks.1.share_p=0.2",
)
"""Twenty seconds of the shipped city, long enough for every attack to begin."""


def cosim(*words: str, cwd: Path | None = None) -> subprocess.CompletedProcess:
    """`cosim` with these words on its command line."""
    return subprocess.run([sys.executable, "-m", "cosim", *words], capture_output=True, text=True, cwd=cwd, timeout=600)


def drive(folder: Path, *overrides: str, config: Path | None = None) -> Path:
    """A short run of the shipped city, or one of a config, into `folder`; overrides may name parts of `tests.parts`."""
    sets = [word for override in (*(() if config else SHORT), *overrides) for word in ("--set", override)]
    done = cosim("run", *([str(config)] if config else []), *sets, "--out", str(folder), "--json")
    assert done.returncode == 0, done.stderr
    return folder
