"""Whatever goes wrong in a sweep, the same command goes on, with the tables of one that nothing happened to."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import psutil
import pytest

from cosim.studies.stages import Cache
from results.manifest import read_manifest
from results.study import open_study
from tests.cosim.studies.runs import ROOT, assert_same, environment, loopback, wait_for

pytestmark = pytest.mark.verify

STUDY = """
[study]
name = "small"
replicates = 1
[base]
preset = "v0.2"
traffic.duration_s = 40
traffic.warmup_s = 60
compute.threads = 1
record.block_steps = 4
attacks = [{ attack = "ghost_insertion", start_s = 5, share_p = 0.3 }]
[grid]
trust.freshness_s = [6, 20]
fleet.penetration_p = [0.3, 0.4]
[limits]
retries = 2
"""
"""Two runs of two points each, on one recorded traffic."""


def words(out, *more):
    return [sys.executable, "-m", "cosim", "sweep", "study.toml", "--out", str(out), "--workers", "1", *more]


def sweep(folder, out="out", *more):
    return subprocess.run(
        words(out, *more), cwd=folder, env=environment(folder), capture_output=True, text=True, timeout=900
    )


@contextmanager
def under_way(folder, out="out", *more):
    """A sweep that runs; it is killed at the end if it still does."""
    process = subprocess.Popen(
        words(out, *more), cwd=folder, env=environment(folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def n_blocks(study):
    """Blocks of all runs that are on disk."""
    return sum(len(path.read_bytes().splitlines()) for path in study.glob("runs/*/inventory.jsonl"))


def assert_same_study(one, other):
    one, other = open_study(one), open_study(other)
    assert list(one.points.point) == list(other.points.point)
    assert set(one.points.state) == set(other.points.state) == {"finished"}
    for point in one.points.point:
        assert_same(one.run(point), other.run(point))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The study, swept without any trouble."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "study.toml").write_text(STUDY)
    done = sweep(folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def folder(whole, tmp_path):
    """A folder of its own, with the study file and the recorded traffic."""
    shutil.copy(whole / "study.toml", tmp_path)
    shutil.copytree(whole / "cache", tmp_path / "cache")
    return tmp_path


def test_a_sweep_killed_at_random_moments(whole, tmp_path):
    shutil.copy(whole / "study.toml", tmp_path)
    for kill in sorted(random.Random(7).sample(range(20), 5)):  # blocks on disk, of ten of each run
        with under_way(tmp_path) as process:
            wait_for(lambda n=kill: n_blocks(tmp_path / "out") >= n)
            process.send_signal(signal.SIGKILL)
    done = sweep(tmp_path)
    assert done.returncode == 0, done.stderr
    assert_same_study(whole / "out", tmp_path / "out")
    assert not list(tmp_path.rglob("*.partial"))


def test_a_run_that_is_killed_goes_on_from_its_last_block(whole, folder):
    with under_way(folder) as process:
        run = wait_for(lambda: next(folder.glob("out/runs/*/inventory.jsonl"), None)).parent
        workers = [p for p in psutil.Process(process.pid).children(True) if "cosim.studies.worker" in p.cmdline()]
        assert len(workers) == 1
        workers[0].kill()
        assert process.wait(timeout=300) == 0
    assert read_manifest(run)["resumed_at"] and len(open_study(folder / "out").points) == 4
    assert_same_study(whole / "out", folder / "out")


def test_a_full_disk(whole, folder):
    small = folder / "small"
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(small)], capture_output=True).returncode:
        pytest.skip("a small disk needs the right to mount")
    try:
        full = sweep(folder, small / "out")
        assert full.returncode == 1 and "Traceback" not in full.stderr
        assert "No space left on device" in full.stdout + full.stderr
        subprocess.run(["mount", "-o", "remount,size=200m", str(small)], check=True)
        done = sweep(folder, small / "out")
        assert done.returncode == 0, done.stderr
        assert_same_study(whole / "out", small / "out")
    finally:
        subprocess.run(["umount", str(small)], check=True)


def test_traffic_that_was_tampered_with_is_driven_again(whole, folder):
    entry = next((folder / "cache" / "traffic").glob("*/stage.json")).parent
    part = next((entry / "actors").glob("*.parquet"))
    part.write_bytes(part.read_bytes()[:-8] + b"tampered")
    done = sweep(folder)
    assert done.returncode == 0 and "was changed after it was written" in done.stderr
    assert_same_study(whole / "out", folder / "out")
    assert Cache(folder / "cache").find("traffic", entry.name)


def test_a_folder_of_another_study(whole, folder):
    (folder / "study.toml").write_text(STUDY.replace('"small"', '"other"'))
    before = (whole / "out" / "index.parquet").read_bytes()
    done = sweep(folder, whole / "out")
    note, error = done.stderr.splitlines()
    assert done.returncode == 2 and note.startswith("note: study.replicates") and 'holds the study "small"' in error
    assert (whole / "out" / "index.parquet").read_bytes() == before


def test_a_scheduler_and_two_workers_of_which_one_dies(whole, folder):
    with loopback(folder, 2) as (address, workers):
        time.sleep(5.0)
        with under_way(folder, "out", "--scheduler", address) as process:
            wait_for(lambda: next(folder.glob("out/runs/*/inventory.jsonl"), None))
            os.killpg(workers[0].pid, signal.SIGKILL)
            assert process.wait(timeout=300) == 0
    assert_same_study(whole / "out", folder / "out")


def test_workers_of_another_version(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    for room in ("cosim", "sensors", "trust", "results", "sumo_nets"):
        shutil.copytree(ROOT / room, other / room, ignore=shutil.ignore_patterns("__pycache__", "data"))
    with (other / "trust" / "fusion.py").open("a") as file:
        file.write("# changed\n")
    with loopback(folder, 1, other) as (address, _):
        time.sleep(5.0)
        done = sweep(folder, "out", "--scheduler", address)
    note, expected, error = done.stderr.splitlines()
    assert note.startswith("note: study.replicates") and expected.startswith("about ")
    assert done.returncode == 2 and "another version of cosim" in error
    assert not list(folder.glob("out/runs/*"))
