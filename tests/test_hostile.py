"""What a hostile sender may send: it is counted and dropped; it changes no trust and ends no run."""

import pytest

from cosim.runs.run import remarks
from results.archive import open_run
from tests.drive import drive
from tests.fingerprint import fingerprint
from tests.processes import manifest_of

DISK = ("traffic.duration_s=12", "radio.model=unit_disk", "radio.unit_disk.loss_p=0", "record.level=full")


def third_attack(name):
    return (f"attacks.2.attack=tests.parts:{name}", "attacks.2.share_p=0.3", "attacks.2.start_s=0")


def summary(folder):
    return manifest_of(folder)["summary"]


def test_nonsense_in_detections_changes_nothing(tmp_path):
    base = drive(tmp_path / "base", *DISK, *third_attack("Compliant"))
    hostile = drive(tmp_path / "hostile", *DISK, *third_attack("Nonsense"))
    marks = fingerprint(hostile) | {"dropped_detections": fingerprint(base)["dropped_detections"]}
    assert marks == fingerprint(base)
    sent = open_run(base).detections
    # Numbers of attacks follow the attacks before: 0.2 and 0.2 of the vehicles have others, 0.3 have this one.
    n_messages = (sent.detection_index == 0).sum()
    n_dropped = sum(summary(hostile)["detections_dropped"].values())
    assert open_run(hostile).dropped_detections.n.sum() == n_dropped
    assert summary(base)["detections_dropped"] == {} and remarks(base) == []
    assert f"{n_dropped:,} detections that attacks changed or added were not sent" in remarks(hostile)[0]
    assert n_dropped % 6 == 0 and 0.15 * n_messages < n_dropped / 6 < 0.45 * n_messages


@pytest.mark.verify
def test_nonsense_in_evaluations_changes_no_trust(tmp_path):
    base = drive(tmp_path / "base", *DISK)
    hostile = drive(tmp_path / "hostile", *DISK, "trust.model=tests.parts:HostileMessages")
    assert open_run(hostile).trust.equals(open_run(base).trust)
    assert len(open_run(base).trust) > 100
    assert summary(base)["evaluations_rejected"] == {}
    rejected = summary(hostile)["evaluations_rejected"]
    assert set(rejected) == {"bad_value", "unknown_observer", "unknown_detection", "duplicate"}
