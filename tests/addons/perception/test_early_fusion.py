"""Early fusion without partners against the detections that the run recorded."""

import numpy as np
import pandas as pd
import pyarrow.compute as pc
import pytest

from cosim.addons.perception.kitti_frames import BOX, at_steps, observed_by_vehicle, posed
from cosim.addons.perception.measures.early_fusion import Disturbance, cloud_bytes, early_boxes
from results.archive import open_run
from tests.drive import drive

ALONE = pd.DataFrame({"frame": np.zeros(0, int), "observer": np.zeros(0, int)})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    sets = ("traffic.duration_s=3", "attacks=[]", "radio.model=unit_disk", "detector.model=pointpillars")
    return open_run(drive(tmp_path_factory.mktemp("early") / "run", *sets, "fleet.penetration_p=0.2"))


def early(run, beside, delay_steps=0, east_m=0.0):
    poses, actors = posed(run, np.array([2]))
    error = np.tile([east_m, 0.0, 0.0], (len(beside), 1))
    return poses, actors, early_boxes(run, poses, actors, beside, Disturbance(delay_steps=delay_steps, error=error))


@pytest.mark.verify
def test_without_partners_it_is_what_the_run_recorded(run):
    """The same returns and the same draws: every detection of an object, to the resolution of the tables."""
    poses, _, found = early(run, ALONE)
    where = at_steps(np.array([2])) & (pc.field("origin") == "sensed")
    own = observed_by_vehicle(run, "local", ["step", "observer", "class", *BOX, "score", "truth_actor"], where)
    own = own[own.truth_actor.notna()].merge(poses[["frame", "step", "observer"]], on=["step", "observer"])
    key = ["frame", "truth_actor", "score"]
    found, own = found.sort_values(key), own.sort_values(key)
    assert len(found) == len(own) > 5
    assert found["class"].astype(str).tolist() == own["class"].astype(str).tolist()
    np.testing.assert_allclose(found[[*BOX]].to_numpy(float), own[[*BOX]].to_numpy(float), atol=0.005)


@pytest.mark.verify
def test_partners_add_objects_and_their_errors_move_boxes(run):
    poses, _ = posed(run, np.array([2]))
    pairs = poses.merge(poses[["observer"]].rename(columns={"observer": "other"}), how="cross")
    pairs = pairs[pairs.observer != pairs.other]
    beside = pd.DataFrame({"frame": pairs.frame.to_numpy(), "observer": pairs.other.to_numpy()})
    _, _, alone = early(run, ALONE)
    _, _, exact = early(run, beside)
    _, _, off = early(run, beside, east_m=0.5)
    assert len(exact) > 1.5 * len(alone)
    both = exact.merge(off, on=["frame", "truth_actor", "score"], suffixes=("", "_off"))
    moved = both.x_m_off - both.x_m
    assert len(both) > 100 and moved.between(-1e-9, 0.5 + 1e-9).all() and moved.max() == pytest.approx(0.5)
    np.testing.assert_allclose(both.y_m_off, both.y_m, atol=1e-9)


@pytest.mark.verify
def test_bytes_by_hand(run):
    """At most 64 x 520 points of 16 bytes in a sweep."""
    (size,) = cloud_bytes(run)
    assert 0.1 < size < 64 * 520 * 16 / 1e6
