"""Short runs for the tests of studies, their tables side by side, and workers started by hand."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pandas as pd

from cosim.base.codes import BASE_VARIANT
from results.archive import open_run
from results.run import Run
from results.tables import TABLES
from tests.drive import simulate

ROOT = Path(__file__).parents[3]

SHORT = ("traffic.duration_s=14", "traffic.warmup_s=60", "attacks.0.start_s=5", "attacks.1.start_s=5",
         "attacks.0.share_p=0.3", "compute.threads=1")  # fmt: skip
"""Fourteen seconds of the shipped city, with attacks."""


def drive(folder: Path, *overrides: str) -> Run:
    """A run of the shipped city, in a process of its own."""
    return open_run(simulate(folder, *SHORT, *overrides))


def of_variant(run: Run, table: str) -> pd.DataFrame:
    """A table as a run of this variant alone would hold it."""
    frame = run.variant_table(table).reset_index(drop=True)
    if "variant" in frame:
        assert set(frame.variant) <= {run.variant}
        frame = frame.assign(variant=BASE_VARIANT)
    return frame


def assert_same(one: Run, other: Run, but: tuple[str, ...] = ()) -> None:
    """All tables have the same rows, value for value, each run seen as its variant."""
    assert set(one.tables) ^ set(other.tables) <= {*but, "encounter_trust"}
    for name in TABLES:
        if name in one.tables and name not in (*but, "encounter_trust"):
            pd.testing.assert_frame_equal(
                of_variant(one, name), of_variant(other, name), check_exact=True, obj=name, check_categorical=False
            )


def environment(folder, source=ROOT):
    """Variables of a process whose source lies there, and whose cache is in the folder."""
    return os.environ | {"COSIM_CACHE": str(folder / "cache"), "PYTHONPATH": str(source)}


def wait_for(what, timeout_s=300.0):
    end = time.monotonic() + timeout_s
    while not (found := what()):
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.05)
    return found


@contextmanager
def loopback(folder, n_workers, source=ROOT):
    """A Dask scheduler and workers started by hand; its address, and the workers."""
    address, started = folder / "address.json", []

    def start(kind, *more):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *more]
        process = subprocess.Popen(
            command, cwd=folder, env=environment(folder, source), start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        started.append(process)
        return process

    try:
        start("scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(address))
        wait_for(address.is_file)
        options = ("--nthreads", "1", "--no-dashboard", "--scheduler-file", str(address))
        workers = [start("worker", *options, "--name", str(number)) for number in range(n_workers)]

        yield json.loads(address.read_text())["address"], workers
    finally:
        for process in started:
            with suppress(ProcessLookupError):  # a test has killed it
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
