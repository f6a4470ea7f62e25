"""Folders of runs: one run each, however many begin together; a killed run continues to the same tables."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from cosim.config.config import load
from cosim.door.blame import ExtensionError
from cosim.runs.check import check
from cosim.runs.inputs import provenance
from cosim.runs.manifest import Manifest
from cosim.runs.run import resume, run
from cosim.step.parts import sources
from cosim.traffic.frame import TrafficError
from results.archive import open_run
from results.manifest import read_manifest
from results.verify import verify
from tests.cosim.traffic import mixed_scenario
from tests.drive import cosim, python
from tests.fingerprint import fingerprint
from tests.hostile.scenes import street_sets
from tests.processes import set_words
from tests.refusals import refused_in_one_line

CLAIM = """
import json, os, sys, time
from pathlib import Path
from cosim.runs import folder as run_folder

def claim(out):
    try:
        folder = run_folder.create(out, "town")
    except ValueError as error:
        return f"refused: {error}"
    (folder.path / "manifest.json").write_text("{}")
    time.sleep(1)
    folder.release()
    return str(folder.path)

begin_s, ends = time.time() + 0.3, []
for _ in range(12):
    end, other = os.pipe()
    ends.append(end)
    if not os.fork():
        time.sleep(max(0.0, begin_s - time.time()))
        os.write(other, claim(Path(sys.argv[1]) if len(sys.argv) > 1 else None).encode())
        os._exit(0)
    os.close(other)
print(json.dumps([os.read(end, 10_000).decode() for end in ends]))
"""
"""What each of twelve processes says that claim a folder at once."""


def test_twelve_at_once_get_twelve_folders(tmp_path):
    said = json.loads(python(CLAIM, cwd=tmp_path))
    assert len(set(said)) == 12 and all((tmp_path / path).is_dir() for path in said), said


def test_twelve_into_one_folder_are_one_run_and_refusals(tmp_path):
    said = json.loads(python(CLAIM, "mine", cwd=tmp_path))
    refused = [one for one in said if one.startswith("refused: ")]
    assert len(refused) == 11 and "mine" in said and not any("\n" in one for one in refused), said


SHORT = set_words(("preset=v0.2", "traffic.duration_s=12", "traffic.warmup_s=60", "record.block_steps=4",
                     "tracking.model=constant_velocity"))  # fmt: skip


@pytest.mark.verify
@pytest.mark.parametrize(
    ("signum", "medium"),
    [(signal.SIGKILL, "csma"), (signal.SIGTERM, "csma"), (signal.SIGINT, "csma"), (signal.SIGKILL, "nr_mode2"),
     (signal.SIGKILL, "lte_mode4")],
)  # fmt: skip
def test_a_resumed_run_has_the_tables_of_one_never_interrupted(tmp_path, signum, medium):
    words = [*SHORT, "--set", f"radio.model={medium}"]
    assert cosim("run", *words, "--out", "whole", cwd=tmp_path).returncode == 0
    out = tmp_path / "broken"
    run = subprocess.Popen(
        [sys.executable, "-m", "cosim", "run", *words, "--out", str(out)], stderr=subprocess.PIPE, text=True
    )
    while run.poll() is None and not (out / "inventory.jsonl").exists():
        time.sleep(0.02)
    run.send_signal(signum)
    _, said = run.communicate()
    assert run.returncode == (-9 if signum == signal.SIGKILL else 128 + signum)
    lines = [line for line in said.splitlines() if not line.startswith("note: ")]
    assert signum == signal.SIGKILL or (len(lines) == 1 and "cosim resume" in lines[0])
    assert verify(out)[1] == []
    done = cosim("resume", str(out))
    assert done.returncode == 0, done.stderr
    at = open_run(out).manifest["resumed_at"][-1]
    assert f"s of computing since step {at}, where it was resumed, " in done.stdout
    assert fingerprint(out) == fingerprint(tmp_path / "whole")
    assert verify(out)[0]["status"] == "finished" and verify(out)[1] == []


def begun(folder, sets):
    """A folder in which a run has begun, and was killed before its config was on disk."""
    folder.mkdir()
    config = load(None, sets)
    Manifest(folder, config, provenance(config, check(config)), sources(config)).begin()
    (folder / "config.toml").unlink()
    (folder / ".lock").touch()


def test_a_run_killed_before_its_first_step_goes_on(tmp_path):
    """Whatever is on disk by then: nothing, a part of the manifest, or the manifest alone."""
    sets = street_sets(tmp_path)
    whole, early, later = (tmp_path / name for name in ("whole", "early", "later"))
    run(load(None, sets), whole, lambda *_: None)
    early.mkdir()
    for name in (".lock", "manifest.json.partial"):
        (early / name).touch()
    begun(later, sets)
    about, problems = verify(later)
    assert (about["status"], about["steps"], problems) == ("killed", 0, [])
    with pytest.raises(ValueError, match=r"already holds a run.*cosim resume"):
        run(load(None, sets), later, lambda *_: None)
    run(load(None, sets), early, lambda *_: None)
    resume(later, lambda *_: None)
    for folder in (early, later):
        assert fingerprint(folder) == fingerprint(whole) and verify(folder)[1] == []
        assert sorted(path.name for path in folder.iterdir()) == sorted(path.name for path in whole.iterdir())


def test_a_run_killed_between_its_last_block_and_its_end_goes_on(tmp_path, monkeypatch):
    """The last block holds what ends with the run, such as the table of vehicles, and must not be added to."""
    sets = [*street_sets(tmp_path), "traffic.duration_s=6", "record.block_steps=3"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run(load(None, sets), whole, lambda *_: None)
    write = Manifest.write

    def killed_at_the_end(self, status, *inventory):
        if status == "finished":
            raise SystemExit
        write(self, status, *inventory)

    monkeypatch.setattr(Manifest, "write", killed_at_the_end)
    with pytest.raises(SystemExit):
        run(load(None, sets), killed, lambda *_: None)
    monkeypatch.undo()
    (killed / ".lock").unlink()  # as if the process were gone
    assert open_run(killed, unfinished=True).status == "killed" and verify(killed)[1] == []
    (state,) = killed.glob("checkpoint/state-*")
    kept = state.read_bytes()
    state.write_bytes(kept[:-1])
    assert len(verify(killed)[1]) == 1  # it goes on from this
    state.write_bytes(kept)
    resume(killed, lambda *_: None)
    assert fingerprint(killed) == fingerprint(whole) and verify(killed)[1] == []


def test_a_config_that_is_another_by_now_is_not_gone_on_with(tmp_path):
    begun(tmp_path / "run", street_sets(tmp_path))
    (tmp_path / "run" / "config.toml").write_text("seed = 4")
    with pytest.raises(ValueError, match="was changed since"):
        resume(tmp_path / "run", lambda *_: None)


@pytest.mark.parametrize("section", [["trust.model=self_first"], ["trust_variant=[{name='own', model='self_first'}]"]])
def test_a_model_that_needs_an_own_sweep_is_not_run_on_a_server(section):
    with refused_in_one_line(r'"self_first" .* host = "central" .* which has none'):
        check(load(None, section))
    check(load(None, [*section, "trust.host=local"]))


def test_steps_before_a_sumo_that_breaks_down_are_kept(tmp_path):
    """SUMO is killed in the middle of a block, and again while the traffic of the recorded steps is repeated. The
    resumed run has the tables of one that was not disturbed."""
    scenario = mixed_scenario.write(tmp_path / "net")
    keys = [f"traffic.scenario={scenario}", "traffic.warmup_s=0", "traffic.duration_s=16", "fleet.penetration_p=1"]
    config, out = load(None, [*keys, "record.block_steps=6"]), tmp_path / "killed"

    def killed_at(when, step):
        def advance(phase, done, total, note):
            if (phase, done) == (when, step):
                me = str(os.getpid())
                pids = subprocess.check_output(["pgrep", "-P", me, "-f", "sumo_process"], text=True).split()
                os.kill(int(pids[-1]), signal.SIGKILL)

        return advance

    kept = pytest.raises(TrafficError, match=r"broke down \(signal 9\)\. The steps before it are kept: cosim resume ")
    with kept:
        run(config, out, killed_at("run", 8))
    steps = read_manifest(out)["steps"]
    assert 8 <= steps <= 11 and read_manifest(out)["status"] == "failed"
    with kept:
        resume(out, killed_at("repeat traffic", 1))
    assert read_manifest(out)["status"] == "failed" and verify(out)[1] == []
    whole = run(config, tmp_path / "whole", lambda *_: None)
    assert fingerprint(resume(out, lambda *_: None)) == fingerprint(whole)


FAILS = """
from cosim.extend import TrustScores
import numpy as np

class Fails:
    def open_step(self, step, pseudonyms, observer_row, detection_index, score):
        if step >= 10:
            raise ValueError("ten")
    def add_evaluations(self, received):
        pass
    def scores(self, now_step=None):
        none = np.zeros(0, int)
        return TrustScores.of(now_step, none, none, np.zeros(0), newest_step=none)
"""


def test_a_class_that_fails_is_to_be_corrected(tmp_path):
    """`cosim resume` was named, which fails again, or refuses the corrected class."""
    (tmp_path / "mine.py").write_text(FAILS)
    scenario = mixed_scenario.write(tmp_path / "net")
    keys = [f"traffic.scenario={scenario}", "traffic.warmup_s=0", "traffic.duration_s=16", "fleet.penetration_p=1"]
    config = load(None, [*keys, "record.block_steps=6", f"trust.model={tmp_path / 'mine.py'}:Fails"])
    with pytest.raises(ExtensionError, match=r"ValueError: ten\. .* are kept\. Correct the class, and run again: "):
        run(config, tmp_path / "run", lambda *_: None)
    assert read_manifest(tmp_path / "run")["status"] == "failed"
