"""The same experiment gives the same tables, whoever computes it and whatever else is switched on."""

import pandas as pd
import pytest

from results.archive import open_run
from results.recorder import fingerprint
from results.tables import TABLES
from tests.drive import drive

FULL = "record.level=full"


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("run") / "base", FULL, "compute.threads=1")


@pytest.mark.parametrize(
    "other", [("compute.threads=2",), ("record.block_steps=7",), ("lidar.engine=columnar", "compute.threads=2")]
)
def test_threads_and_blocks_change_nothing(base, tmp_path, other):
    again = drive(tmp_path / "again", FULL, *other)
    assert fingerprint(again) == fingerprint(base)
    assert set(fingerprint(base)) == set(TABLES)


def test_seed_changes_what_is_seen_but_not_the_traffic(base, tmp_path):
    other = fingerprint(drive(tmp_path / "seed", FULL, "seed=2"))
    same = {name for name, value in fingerprint(base).items() if other[name] == value}
    assert same == {"actors"}


def test_without_liars_every_honest_detection_is_bit_identical(base, tmp_path):
    quiet = drive(tmp_path / "quiet", FULL, "fleet.malicious_p=0", "fleet.unreliable_p=0")
    with_liars, without = open_run(base), open_run(quiet)
    sensed = with_liars.detections[with_liars.detections.origin != "fabricated"].drop(columns="transmitted")
    assert len(sensed) > 1000 and (with_liars.detections.origin == "fabricated").sum() > 50
    pd.testing.assert_frame_equal(sensed.reset_index(drop=True), without.detections.drop(columns="transmitted"))
    pd.testing.assert_frame_equal(with_liars.observability, without.observability)


def test_raising_penetration_keeps_everybody_who_was_equipped(base, tmp_path):
    more = open_run(drive(tmp_path / "more", "fleet.penetration_p=0.6")).vehicles.set_index("sumo_id")
    fewer = open_run(base).vehicles.set_index("sumo_id")
    assert more.equipped[fewer.index[fewer.equipped]].all()
    assert more.equipped.sum() > 1.4 * fewer.equipped.sum()
    both = fewer.index[fewer.equipped]
    assert (more.role[both] == fewer.role[both]).all()


def test_no_truth_leaks(base, tmp_path):
    """With the names of all that is seen mixed up, only truth columns change."""
    mixed = drive(
        tmp_path / "mixed",
        FULL,
        before="""
import dataclasses
import numpy as np
honest = cycle.detector.detect
def mixed(*args):
    found = honest(*args)
    real = np.flatnonzero(~found.is_false_positive)
    actor = found.actor.copy()
    actor[real] = actor[real[np.lexsort((-real, found.observer[real]))]]  # each observer's list, back to front
    return dataclasses.replace(found, actor=actor)
cycle.detector.detect = mixed
""",
    )
    one, other = open_run(base), open_run(mixed)
    changed = False
    for name, table in TABLES.items():
        shown = [column for column, about in table.columns.items() if not about.truth]
        pd.testing.assert_frame_equal(one.table(name, shown), other.table(name, shown))
        truths = [column for column, about in table.columns.items() if about.truth]
        changed |= bool(truths) and not one.table(name, truths).equals(other.table(name, truths))
    assert changed
