"""A closed loop killed in its middle goes on: commands of before the kill belong to the traffic that is repeated."""

import signal
import subprocess
import sys
import time

import pytest

from results.archive import open_run
from results.verify import verify
from tests.drive import cosim
from tests.fingerprint import fingerprint
from tests.processes import set_words

KEYS = (
    "preset=v0.2", "traffic.step_s=0.5", "sensing_interval_s=0.5", "traffic.duration_s=20", "traffic.warmup_s=100",
    "attacks.0.start_s=1", "attacks.0.share_p=0.3", "fleet.penetration_p=0.5", "record.block_steps=5",
    "driver.model=cautious", "trust.method=any",
)  # fmt: skip
N_BLOCKS = 3
"""Blocks of five steps that are on disk when the run is killed; the run has eight."""


@pytest.mark.verify
def test_a_closed_loop_killed_in_the_middle_has_the_tables_of_one_never_interrupted(tmp_path):
    sets = set_words(KEYS)
    assert cosim("run", *sets, "--out", "whole", cwd=tmp_path).returncode == 0
    out = tmp_path / "broken"
    run = subprocess.Popen(
        [sys.executable, "-m", "cosim", "run", *sets, "--out", str(out)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    inventory = out / "inventory.jsonl"
    while run.poll() is None and not (
        inventory.exists() and inventory.read_text().count('"table":"reactions"') >= N_BLOCKS
    ):
        time.sleep(0.02)
    run.send_signal(signal.SIGKILL)
    assert run.wait() == -signal.SIGKILL
    before = open_run(out, unfinished=True).reactions
    assert cosim("resume", str(out)).returncode == 0
    assert fingerprint(out) == fingerprint(tmp_path / "whole")
    assert verify(out)[0]["status"] == "finished" and verify(out)[1] == []
    after = open_run(out).reactions
    braked = after[after.deceleration_mps2 > 1]
    assert len(before) and before.step.max() < 35
    assert (braked.step <= before.step.max()).any() and (braked.step > before.step.max()).any()
    print(f"\nkilled with {len(before)} of {len(after)} reactions on disk; the tables are those of the whole run")
