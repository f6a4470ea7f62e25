"""Seven extensions, each one file plus config, run end to end without touching a source file."""

from pathlib import Path

import numpy as np
import pytest

from cosim.runs.run import pseudonym_remarks
from results.archive import open_run
from tests.drive import cosim, simulate
from tests.processes import manifest_of, set_words

HERE = Path(__file__).parent
BASE = """
[traffic]
duration_s = 14
warmup_s = 200
[record]
level = "full"
"""


def drive(folder, config):
    """A run of a config file in a folder of its own; the extension lies beside it."""
    (folder / "mine.toml").write_text(config)
    run = open_run(simulate(folder / "run", config=folder / "mine.toml"))
    return run, manifest_of(folder / "run")["choices"]


@pytest.fixture
def beside(tmp_path):
    """Copies an extension beside the config, as a user would have it."""

    def put(name):
        (tmp_path / name).write_text((HERE / name).read_text())
        return tmp_path

    return put


def test_trust_model(beside):
    folder = beside("own_trust.py")
    run, choices = drive(folder, BASE + '[trust]\nmodel = "own_trust.py:Beta"\nprior = 2.0\n')
    trust = run.trust
    assert len(trust) > 50
    # A holder of n positive and no negative evidence is trusted with (n + 2) / (n + 4) under a prior of 2.
    assert ((trust.trust > 0) & (trust.trust < 1)).all()
    np.testing.assert_allclose(trust.uncertainty, 4 / (trust.weight + 4), rtol=1e-5)
    # It keeps the newest step of its evidence alone, so how old the oldest is is not known, here or in any mean.
    assert trust.newest_evaluation_age_s.notna().any() and trust.oldest_evaluation_age_s.isna().all()
    assert {"newest evaluation"} == set(run.measure.freshness.ages().what) - {"value"}
    assert choices["trust.model"]["file"] == str(folder / "own_trust.py")
    assert len(choices["trust.model"]["sha256"]) == 64


def test_a_class_that_fails_in_a_run(tmp_path):
    """One line, exit status 1, although the class would end the program with 0; what was written can be resumed."""
    (tmp_path / "bad.py").write_text(
        "import sys\nclass Bad:\n    def changes(self, ages):\n        if (ages.n_messages >= 3).any():\n"
        "            sys.exit(0)\n        return ages.age_s < 0\n"
    )
    sets = ("pseudonyms.policy=bad.py:Bad", "traffic.duration_s=6", "traffic.warmup_s=120", "record.block_steps=2")
    words = set_words(sets)
    done = cosim("run", *words, "--out", "run", cwd=tmp_path)
    told = f"error: {tmp_path}/bad.py:5: pseudonym policy Bad: changes() raised SystemExit: 0, which ends the program."
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and done.stderr.startswith(told)
    assert done.stderr.endswith("run again: no run goes on with changed code.\n")
    manifest = manifest_of(tmp_path / "run")
    assert manifest["status"] == "failed" and manifest["steps"] == 2


def test_attack_on_detections(beside):
    folder = beside("own_attack.py")
    run, _ = drive(folder, BASE + """
[[attacks]]
attack = "own_attack.py:Shift"
share_p = 0.5
start_s = 5
east_m = 30
""")  # fmt: skip
    found = run.detections[run.detections.origin == "sensed"].dropna(subset="truth_actor")
    roles = run.vehicles.set_index("vehicle").role
    shifted = found[(found.observer.map(roles) == "malicious") & (found.step >= 5)]
    honest = found[found.observer.map(roles) == "honest"]
    assert len(shifted) > 100 and shifted.truth_iou.max() < 0.5 < honest.truth_iou.mean()


@pytest.mark.verify
def test_attack_on_evaluations(beside):
    folder = beside("own_bad_mouthing.py")
    run, _ = drive(folder, BASE + """
[[attacks]]
attack = "own_bad_mouthing.py:BadMouthing"
share_p = 0.5
start_s = 5
""")  # fmt: skip
    roles = run.vehicles.set_index("vehicle").role
    evaluated = run.evaluations[run.evaluations.evaluator != run.evaluations.observer]
    lies = evaluated[(evaluated.evaluator.map(roles) == "malicious") & (evaluated.step >= 5)]
    assert len(lies) > 500 and (lies.evaluation == -1).all() and (lies.visibility == 1).all()
    assert (evaluated[evaluated.evaluator.map(roles) == "honest"].evaluation > 0).any()


@pytest.mark.verify
def test_detector(beside):
    folder = beside("own_detector.py")
    run, _ = drive(folder, BASE + '[detector]\nmodel = "own_detector.py:Threshold"\nenough_returns = 30\n')
    sensed = run.detections[run.detections.origin == "sensed"]
    assert len(sensed) > 1000 and sensed.truth_actor.notna().all() and (sensed.truth_iou > 0.9).all()
    seen = run.observability
    assert len(sensed) == (seen.n_points >= 30).sum()


@pytest.mark.verify
def test_medium(beside):
    folder = beside("own_medium.py")
    run, _ = drive(folder, BASE + '[radio]\nmodel = "own_medium.py:Ideal"\nideal_range_m = 150\n')
    assert run.receptions.distance_m.max() <= 150 and len(run.receptions) > 1000
    assert (run.radio.n_delivered == run.radio.n_in_range).all()


@pytest.mark.verify
def test_pseudonym_policy(beside):
    folder = beside("own_pseudonyms.py")
    run, _ = drive(folder, BASE + '[pseudonyms]\npolicy = "own_pseudonyms.py:Every"\nevery_messages = 6\n')
    names = run.pseudonyms
    assert names.groupby("vehicle").size().max() == 3  # 14 messages: 6, 6, 2
    assert (names.to_step - names.from_step < 6).all()
    mean = manifest_of(run.path)["summary"]["messages_per_pseudonym"]
    assert 3 < mean < 6 and not pseudonym_remarks({"messages_per_pseudonym": mean})
    used = run.receptions.merge(names, left_on="sender", right_on="pseudonym")
    assert len(used) == len(run.receptions) and used.step.between(used.from_step, used.to_step).all()


def test_driver(beside):
    folder = beside("own_driver.py")
    drive(folder, BASE + f'[driver]\nmodel = "own_driver.py:Logger"\nlog = "{folder}/seen.txt"\n')
    lines = (folder / "seen.txt").read_text().split("\n")[:-1]
    assert [int(line.split()[0]) for line in lines] == list(range(14))
