"""Runs in cells whose processes are killed at random times, and what is left when the run itself ends."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

import pytest

from results.archive import read_manifest
from results.recorder import fingerprint
from tests.drive import simulate

pytestmark = [pytest.mark.verify, pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")]

N_CELLS, N_KILLS = 3, 20
SHORT = ("preset=v0.2", "traffic.duration_s=480", "traffic.warmup_s=60", "record.block_steps=10", "seed=37")
SHARED = Path("/dev/shm")


def shared_now() -> set[Path]:
    """Files in shared memory, without the semaphores of other programs' Python processes."""
    return {path for path in SHARED.iterdir() if not path.name.startswith("sem.mp-")}


class Run:
    """`cosim run` in cells; its processes carry a mark in their environment, by which they are found."""

    def __init__(self, out: Path, *settings: str) -> None:
        self.mark = f"COSIM_TEST_RUN={uuid4().hex}"
        words = [word for key in settings for word in ("--set", key)]
        name, _, value = self.mark.partition("=")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "cosim", "run", *words, "--cells", str(N_CELLS), "--out", str(out)],
            env=os.environ | {name: value}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )  # fmt: skip

    def of_cells(self) -> list[int]:
        """The workers and the process that forks them, without those that have ended."""
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                marked = self.mark.encode() in (process / "environ").read_bytes().split(b"\0")
                if marked and b"cosim.addons.cells" in (process / "cmdline").read_bytes():
                    found.append(int(process.name))
        return sorted(found)

    def begun(self) -> list[int]:
        """The processes of the cells, when all are there."""
        while len(found := self.of_cells()) < N_CELLS + 1 and self.process.poll() is None:
            time.sleep(0.05)
        return found

    def forks(self, pid: int) -> bool:
        """Whether this is the process that forks workers."""
        with suppress(OSError):
            return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1] == str(self.process.pid)
        return False

    def left(self) -> list[int]:
        """The processes of the cells that outlive the run by more than they need to notice its end."""
        end = time.monotonic() + 20
        while (found := self.of_cells()) and time.monotonic() < end:
            time.sleep(0.1)
        return found


def test_twenty_kills_at_random_times_change_no_table(tmp_path):
    """One dies some time after the last was replaced. Every fifth time, the process that forks workers dies too."""
    rng, shared = random.Random(37), shared_now()
    run, n_kills = Run(tmp_path / "cells", *SHORT), 0
    there = run.begun()
    while n_kills < N_KILLS and run.process.poll() is None:
        with suppress(ProcessLookupError, IndexError):
            if n_kills % 5 == 4:
                os.kill(next(filter(run.forks, there)), signal.SIGKILL)
            os.kill(rng.choice([pid for pid in there if not run.forks(pid)]), signal.SIGKILL)
            n_kills += 1
        there = run.begun()
        time.sleep(rng.uniform(0, 0.5))
    _, said = run.process.communicate()
    assert run.process.returncode == 0, said
    assert n_kills == N_KILLS, "the run ended before all kills"
    assert fingerprint(tmp_path / "cells") == fingerprint(simulate(tmp_path / "one", *SHORT))
    assert read_manifest(tmp_path / "cells")["cells"]["replaced"] >= N_KILLS / 2
    assert not run.left() and shared_now() <= shared


@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("after_s", [0.0, 3.0], ids=["at the start", "in a step"])
def test_nothing_is_left_of_a_run_that_ends(signum, after_s, tmp_path):
    shared = shared_now()
    run = Run(tmp_path / "run", *SHORT, "traffic.duration_s=600")
    run.begun()
    time.sleep(after_s)
    run.process.send_signal(signum)
    _, said = run.process.communicate()
    assert run.process.returncode == (-9 if signum == signal.SIGKILL else 128 + signum), said
    assert signum == signal.SIGKILL or said.count("\n") == 1
    assert not run.left() and shared_now() <= shared


RAISES = """
from cosim.extend import Reports


class Mine:
    def detect(self, sweeps, seen, boxes, label, draws):
        if draws.time_s > 25:
            raise RuntimeError("no light")
        found = (seen.n_returns >= 20).nonzero()[0]
        actor = seen.actor[found]
        return Reports.of_actors(seen, found, label[actor], boxes.take(actor), 0.5 + 0.0 * actor)
"""


def test_an_error_in_a_worker_ends_the_run_in_one_line_and_keeps_what_is_complete(tmp_path):
    (tmp_path / "mine.py").write_text(RAISES)
    run = Run(tmp_path / "run", *SHORT, f"detector.model={tmp_path / 'mine.py'}:Mine")
    _, said = run.process.communicate()
    assert run.process.returncode == 1 and said.count("\n") == 1, said
    assert "no light" in said and "cosim resume" in said
    assert read_manifest(tmp_path / "run")["steps"] == 20
    assert not run.left()
