"""A run of which workers compute sweeps and detections: its tables are those of the run of one process."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import closing

import psutil
import pytest

from cosim.config.config import load
from cosim.execution import run as running
from cosim.studies.engine import connected
from cosim.studies.shards import ShardedPerception
from results.manifest import read_manifest
from results.recorder import fingerprint
from tests.cosim.studies.runs import SHORT, environment, loopback, wait_for

CONFIG = (*SHORT, "fleet.penetration_p=0.5", "record.level=full", "record.block_steps=2",
          "gnss.std_m=0.5", "sensing_interval_s=2", "attacks.0.attack=sybil")  # fmt: skip
"""Vehicles err about their own positions, some have further identities, and every other step is between sweeps."""


def words(out, *more):
    sets = [word for override in CONFIG for word in ("--set", override)]
    return [sys.executable, "-m", "cosim", "run", *sets, "--out", str(out), *more]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The run of one process, and the folder that it lies in; beside it the cache."""
    folder = tmp_path_factory.mktemp("plain")
    done = subprocess.run(words(folder / "run", "--json"), env=environment(folder), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Its traffic."""
    config = load(None, CONFIG)
    return running.record_traffic(config, tmp_path_factory.mktemp("recorded") / "traffic", lambda *_: None)


@pytest.mark.parametrize("sweeps_per_shard", [16, pytest.param(300, marks=pytest.mark.verify)])
def test_sharded_is_plain(plain, recorded, tmp_path, sweeps_per_shard):
    """A step is cut into shards of some observers; and shards hold several steps."""
    config = load(None, CONFIG)
    assert len(set(fingerprint(plain / "run"))) > 10
    with connected(None, 2, None, processes=True) as client, closing(running.worlds_of(config, recorded)) as worlds:
        made: list[ShardedPerception] = []

        def perceive(own):
            plain_data = json.dumps(config.to_dict(), default=str)
            made.append(ShardedPerception(own, client, plain_data, 2, worlds, sweeps_per_shard * 2 * 520 * 64))
            return made[-1]

        out = running.run(config, tmp_path / "run", lambda *_: None, recorded, perceive)
    assert len(made) == 1
    assert fingerprint(out) == fingerprint(plain / "run")


def test_a_driver_that_acts_cannot_be_sensed_ahead(tmp_path):
    more = ("--set", "driver.model=cautious", "--set", "traffic.step_s=0.5", "--workers", "2")
    done = subprocess.run(
        words(tmp_path / "run", *more), env=environment(tmp_path), capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "nothing can be sensed ahead" in done.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.verify
def test_no_scheduler_there(tmp_path):
    more = ("--scheduler", "tcp://127.0.0.1:9")
    done = subprocess.run(
        words(tmp_path / "run", *more), env=environment(tmp_path), capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "no scheduler answers there" in done.stderr
    assert not (tmp_path / "run").exists()


def n_blocks(run):
    """Blocks on disk."""
    path = run / "inventory.jsonl"
    return len(path.read_bytes().splitlines()) if path.exists() else 0


def workers_of(process):
    """Processes of the cluster that this process started."""
    started = psutil.Process(process.pid).children()
    return [p for p in started if "spawn_main" in " ".join(p.cmdline())]


@pytest.mark.verify
def test_a_worker_that_is_killed(plain, tmp_path):
    """Each of the two workers in turn, which are started again."""
    process = subprocess.Popen(words(tmp_path / "run", "--workers", "2"), env=environment(plain))
    try:
        for n in (2, 5):
            wait_for(lambda n=n: n_blocks(tmp_path / "run") >= n)
            found = wait_for(lambda: len(found := workers_of(process)) == 2 and found)
            found[n % 2].kill()
        assert process.wait(timeout=300) == 0
    finally:
        process.kill()
    assert fingerprint(tmp_path / "run") == fingerprint(plain / "run")


@pytest.mark.verify
def test_workers_started_by_hand_of_which_one_dies(plain, tmp_path):
    with loopback(plain, 2) as (address, workers):
        time.sleep(5.0)
        process = subprocess.Popen(words(tmp_path / "run", "--scheduler", address), env=environment(plain))
        try:
            wait_for(lambda: n_blocks(tmp_path / "run") >= 2)
            os.killpg(workers[0].pid, signal.SIGKILL)
            assert process.wait(timeout=300) == 0
        finally:
            process.kill()
    assert fingerprint(tmp_path / "run") == fingerprint(plain / "run")


@pytest.mark.verify
def test_a_run_that_is_killed_goes_on_with_workers(plain, tmp_path):
    process = subprocess.Popen(words(tmp_path / "run", "--workers", "1"), env=environment(plain))
    try:
        wait_for(lambda: n_blocks(tmp_path / "run") >= 3)
    finally:
        process.kill()
        process.wait()
    resume = [sys.executable, "-m", "cosim", "resume", str(tmp_path / "run"), "--workers", "2"]
    done = subprocess.run(resume, env=environment(plain), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert read_manifest(tmp_path / "run")["resumed_at"]
    assert fingerprint(tmp_path / "run") == fingerprint(plain / "run")
