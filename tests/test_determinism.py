"""The same experiment gives the same tables, whatever the threads and whatever else is switched on."""

import pandas as pd
import pytest

from results.archive import open_run
from results.tables import TABLES
from tests.drive import drive
from tests.fingerprint import fingerprint

FULL, SHORT = "record.level=full", "traffic.duration_s=12"

PSEUDONYMS = {
    name: [column for column, about in table.columns.items() if about.meaning.startswith("Pseudonym")]
    for name, table in TABLES.items()
}
"""Columns that hold pseudonyms."""


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("run") / "base", FULL, SHORT, "compute.threads=1")


def test_threads_and_blocks_change_nothing(base, tmp_path):
    again = drive(tmp_path / "again", FULL, SHORT, "compute.threads=2", "record.block_steps=7")
    assert fingerprint(again) == fingerprint(base)
    assert set(fingerprint(base)) == set(TABLES)


@pytest.mark.verify
@pytest.mark.parametrize("medium", ["nr_mode2", "lte_mode4"])
def test_threads_and_blocks_change_nothing_over_the_sidelink(medium, tmp_path):
    sidelink = (FULL, f"radio.model={medium}", "traffic.duration_s=10", "traffic.warmup_s=60")
    one = drive(tmp_path / "one", *sidelink, "compute.threads=1")
    other = drive(tmp_path / "other", *sidelink, "compute.threads=2", "record.block_steps=3")
    assert fingerprint(one) == fingerprint(other)


def test_seed_changes_what_is_seen_but_not_the_traffic(base, tmp_path):
    other = drive(tmp_path / "seed", FULL, SHORT, "seed=2")
    was, now = fingerprint(base), fingerprint(other)
    same = {name for name in TABLES if was[name] == now[name] and len(open_run(base).table(name))}
    assert same == {"actors"}


def test_without_attackers_every_honest_detection_is_bit_identical(base, tmp_path):
    quiet = drive(tmp_path / "quiet", FULL, SHORT, "attacks.0.share_p=0", "attacks.1.share_p=0")
    attacked, honest = open_run(base), open_run(quiet)
    found = attacked.detections
    of_attack = ["transmitted", "withheld", "target", "lied"]
    is_lie = found.origin == "fabricated"
    lists = found.set_index(["step", "observer"]).index
    shuffled = lists.isin(lists[is_lie])  # whoever fabricates numbers its detections anew
    kept = honest.detections.set_index(["step", "observer"]).index.isin(lists[is_lie])
    assert (~is_lie).sum() > 1000 and is_lie.sum() > 50 and 0 < kept.sum() < 0.5 * len(kept)
    plain, before = found[~shuffled].drop(columns=of_attack), honest.detections[~kept].drop(columns=of_attack)
    pd.testing.assert_frame_equal(plain.reset_index(drop=True), before.reset_index(drop=True))
    of_attack.append("detection_index")
    order = ["step", "observer", "origin", "x_m", "y_m", "score"]
    own, before = (
        rows.drop(columns=of_attack).sort_values(order, ignore_index=True)
        for rows in (found[shuffled & ~is_lie], honest.detections[kept])
    )
    pd.testing.assert_frame_equal(own, before)
    pd.testing.assert_frame_equal(attacked.observability, honest.observability)


def test_raising_penetration_keeps_all_that_were_equipped(base, tmp_path):
    more = open_run(drive(tmp_path / "more", SHORT, "fleet.penetration_p=0.6")).vehicles.set_index("sumo_id")
    fewer = open_run(base).vehicles.set_index("sumo_id")
    assert more.equipped[fewer.index[fewer.equipped]].all()
    assert more.equipped.sum() > 1.4 * fewer.equipped.sum()
    both = fewer.index[fewer.equipped]
    assert (more.role[both] == fewer.role[both]).all()


def assert_only_truth_differs(one, other):
    """Every column but those of truth is the same, and some column of truth is not.

    What an attack withholds or achieves is ground truth, whole tables of it included.
    """
    changed = False
    for name, table in TABLES.items():
        if any(about.key and about.truth for about in table.columns.values()):
            continue  # its rows are chosen by truth
        known = [column for column, about in table.columns.items() if not about.truth]
        truths = [column for column, about in table.columns.items() if about.truth]
        pd.testing.assert_frame_equal(one.table(name, known), other.table(name, known))
        changed |= bool(truths) and not one.table(name, truths).equals(other.table(name, truths))
    assert changed


def test_no_truth_leaks(base, tmp_path):
    """With the true actors of all detections mixed up, only truth columns change."""
    mixed = drive(tmp_path / "mixed", FULL, SHORT, "detector.model=tests.parts:MixedActors")
    assert_only_truth_differs(open_run(base), open_run(mixed))


@pytest.mark.verify
def test_origins_that_an_attack_mixes_up_are_put_right(tmp_path):
    """What a vehicle has sensed is known, so nothing changes."""
    ghosts = (FULL, "attacks.0.attack=tests.parts:Ghosts", "attacks.0.ghosts=car_and_pedestrian")
    one = drive(tmp_path / "one", *ghosts)
    other = drive(tmp_path / "other", *ghosts, "attacks.0.mixed=true")
    for name in TABLES:
        pd.testing.assert_frame_equal(open_run(one).table(name), open_run(other).table(name))


def test_pseudonyms_are_names(base, tmp_path):
    """Numbered otherwise, they change nothing but themselves."""
    one = open_run(base)
    other = open_run(drive(tmp_path / "other", FULL, SHORT, "pseudonyms.policy=tests.parts:Renumbered"))
    names = other.pseudonyms.set_index("pseudonym").vehicle
    assert names.is_unique and (names.index != names).any()
    for name, _table in TABLES.items():
        a, b = one.table(name), other.table(name)
        for column in PSEUDONYMS[name] + ["pseudonym"] * (name == "pseudonyms"):
            b[column] = b[column].map(names).astype(a[column].dtype)
        pd.testing.assert_frame_equal(a, b)
