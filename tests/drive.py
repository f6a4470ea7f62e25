"""Runs for tests: each in a process of its own, because libsumo holds one simulation per process."""

import subprocess
import sys
from pathlib import Path

SHORT = ("traffic.duration_s=20", "adversary.start_s=5", "fleet.malicious_p=0.2", "fleet.unreliable_p=0.2")
"""Twenty seconds of the shipped city, in which everybody comes to what they are."""


def cosim(*words: str, cwd: Path | None = None) -> subprocess.CompletedProcess:
    """`cosim` with these words on its command line."""
    return subprocess.run([sys.executable, "-m", "cosim", *words], capture_output=True, text=True, cwd=cwd, timeout=600)


def drive(folder: Path, *overrides: str, before: str = "") -> Path:
    """A short run of the shipped city into `folder`; `before` is Python that is executed first."""
    code = f"""
from pathlib import Path
from cosim import cycle, run
from cosim.config import load
{before}
run.run(load(None, {[*SHORT, *overrides]!r}), Path({str(folder)!r}), lambda *_: None)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return folder
