"""Tracking in a step and in a run: what it adds, and that it adds nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from cosim.messages.content import SELF, SENSED, Detections
from cosim.step.ground_truth import lies_in_detections
from results.archive import open_run
from tests.drive import assert_refused, cosim, drive
from tests.fingerprint import fingerprint
from tests.processes import set_words
from tests.scene import assert_same, play
from tests.sensors.town import boxes_at

ON = "tracking.model=constant_velocity"


def test_in_the_cycle_only_velocities_are_added():
    with_tracks, without = play(6, ON)[0], play(6)[0]
    assert all(s.positioned.objects is None for s in without)
    for a, b in zip(with_tracks, without, strict=True):
        objects = replace(a.listed.objects, velocity_mps=b.listed.objects.velocity_mps)
        assert_same(replace(a.listed, objects=objects, tracks=None), b.listed)
        for name in ("rounds", "evaluated", "fused", "published"):
            assert_same(getattr(a, name), getattr(b, name), name)
    last = with_tracks[-1]
    sensed = last.listed.objects.origin == SENSED
    assert sensed.sum() == len(last.positioned.objects.object_id) > 0
    known = ~np.isnan(last.listed.objects.velocity_mps).any(axis=1)
    assert known.any() and not known[last.listed.objects.origin == SELF].any()


def test_a_falsified_velocity_is_a_lie():
    # by hand: 0.3 and 0.4 m/s off is 0.5, which is noise; 0.6 off is not; made up where none was is; left out is not
    n = 5
    boxes = boxes_at(np.zeros((n, 3)))
    perceived = replace(
        Detections.perceived(
            np.zeros(n, int), np.arange(n), np.zeros(n, np.uint8), boxes, np.ones(n), np.zeros(n, int),
            np.full(n, SENSED, np.uint8),
        ),
        velocity_mps=np.array([[5.0, 1.0], [5.0, 1.0], [np.nan, np.nan], [5.0, 1.0], [np.nan, np.nan]]),
    )  # fmt: skip
    sent = replace(
        perceived, velocity_mps=np.array([[5.3, 1.4], [5.6, 1.0], [5.0, 1.0], [np.nan, np.nan], [np.nan, np.nan]])
    )
    assert lies_in_detections(perceived, sent, np.zeros(1, bool)).tolist() == [False, True, True, False, False]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder, common = tmp_path_factory.mktemp("runs"), ("traffic.duration_s=10", "traffic.warmup_s=120")
    return [drive(folder / "off", *common), drive(folder / "on", *common, ON, "record.block_steps=3")]


def test_tables_of_a_run(runs):
    off, on = map(open_run, runs)
    assert not len(off.tracks)
    was, now = map(fingerprint, runs)
    assert {name for name in was if was[name] != now[name]} == {"tracks"}
    found = on.detections[on.detections.origin == "sensed"].merge(
        on.tracks, on=["step", "observer", "detection_index"], validate="one_to_one"
    )
    assert len(found) == on.tracks.object_id.notna().sum() > 500
    rest = on.tracks[on.tracks.object_id.isna()]  # fabricated objects claim a velocity and have no track
    assert len(rest) == len(on.tracks) - len(found) and rest.velocity_x_mps.notna().all()
    new = found.sort_values("step", kind="stable").drop_duplicates(["observer", "object_id"])
    assert (new.age_s == 0).all() and new.velocity_x_mps.isna().all(), "a new object has no velocity"
    assert not found.duplicated(["step", "observer", "object_id"]).any()
    moving = found[found.velocity_x_mps.notna()].merge(
        on.actors[["step", "actor", "speed_mps"]], left_on=["step", "truth_actor"], right_on=["step", "actor"],
        suffixes=("_own", ""),
    )  # fmt: skip
    error = (np.hypot(moving.velocity_x_mps, moving.velocity_y_mps) - moving.speed_mps).abs()
    assert len(moving) > 100 and error.median() < 0.4 and (moving.age_s >= 2).all()
    certain = found[found.existence_p > 0.95]
    assert certain.truth_actor.notna().mean() > 0.95 > found.truth_actor.notna().mean()


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        (("tracking.model=kalman",), "'none' or 'constant_velocity'"),
        ((ON, "sensing_interval_s=5"), "tracking.keep_s = 2.5 s is shorter than the longest sensing interval, 5 s"),
        (("tracking.gate_p=1",), "tracking.gate_p"),
        (("tracking.position_sigma_m=[1, 1]",), "tracking.position_sigma_m"),
    ],
)
def test_mistakes_are_one_line(keys, told):
    done = cosim("check", *set_words(keys))
    assert_refused(done, told)
