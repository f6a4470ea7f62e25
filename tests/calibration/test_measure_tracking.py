"""Tracks of the detections of a real run: Stone Soup's, and the truth."""

import numpy as np
import pytest

from results.archive import open_run
from tests.calibration.measure_tracking import (
    ONE_MOTION,
    by_library,
    recorded,
    reliability,
    rms,
    summary,
    switches,
    tracked,
)
from tests.drive import drive

LENGTH_S = 12


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Twelve seconds of Helsinki, sensed every 0.1 s."""
    return recorded(drive(
        tmp_path_factory.mktemp("run") / "run", "traffic.step_s=0.1", "sensing_interval_s=0.1",
        f"traffic.duration_s={LENGTH_S}", "traffic.warmup_s=200", "fleet.penetration_p=0.15", "trust.host=none",
        "radio.model=unit_disk", "attacks.0.share_p=0", "attacks.1.share_p=0", "seed=21", "traffic.seed=21",
    ))  # fmt: skip


@pytest.mark.verify
@pytest.mark.parametrize("every", [1, 5, 10])
def test_like_stone_soup_and_near_the_truth(data, every):
    ours, theirs = tracked(data, every, ONE_MOTION), by_library(data, every, LENGTH_S)
    assert (ours.object_id == theirs.object_id).mean() > 0.999
    assert switches(ours, 25)[0] == pytest.approx(switches(theirs, 25)[0], abs=2)
    for name in ("velocity_error", "position_error"):
        real = ours.is_real & ours.velocity_error.notna()
        assert rms(ours[name][real]) == pytest.approx(rms(theirs[name][theirs.velocity_error.notna() & real]), rel=0.1)
    said = summary(tracked(data, every), 25)
    assert said["speed, median"] < 0.3 and said["velocity, RMS"] < 2.0
    assert said["position, RMS"] < 1.05 * said["detection, RMS"]


@pytest.mark.verify
def test_the_probability_of_existence_is_calibrated(data):
    """The expected calibration error: said minus true share, in the mean over detections."""
    bins = reliability(tracked(data, 1))
    assert (np.abs(bins.said - bins.real) * bins.detections).sum() < 0.05 * bins.detections.sum()
    assert bins.real.iloc[0] < 0.2 and bins.real.iloc[-1] > 0.98


@pytest.mark.verify
def test_the_probability_of_existence_is_calibrated_by_default(tmp_path):
    """In one of the three cities to which it is fitted. With the values of `avod`, the error is 0.056 here."""
    run = open_run(drive(
        tmp_path / "run", "preset=modern", "traffic.scenario=koenigs-wusterhausen", "traffic.duration_s=15",
        "trust.host=none", "trust_variant=[]", "radio.model=unit_disk", "attacks=[]", "seed=21", "traffic.seed=21",
    ))  # fmt: skip
    key = ["step", "observer", "detection_index"]
    found = run.tracks.merge(run.detections[run.detections.origin == "sensed"], on=key)
    bins = reliability(found.assign(is_real=found.truth_actor.notna()))
    assert (np.abs(bins.said - bins.real) * bins.detections).sum() < 0.02 * bins.detections.sum()
