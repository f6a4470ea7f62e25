"""What a receiver reads of accuracies from the confidence values of a message (`cpm.accuracy = "etsi"`), by hand."""

import numpy as np
import pytest

from cosim.config.config import resolve_data
from cosim.messages.content import SELF, SENSED, Detections
from cosim.messages.etsi import Confidences
from cosim.step.accuracy import DetectorAccuracy, Reporters, as_encoded, pose_variance, stated
from tests.sensors.town import boxes_at


def test_standard_deviations_of_confidence_values():
    """0.2 m: 0.392 m at 95 %, sent as 40 cm. 0.1 rad: 11.23 degrees, 11.3. 0.1 m: 0.196 m, 0.2. 0.64 m/s: 1.2544 m/s,
    above the largest value of 1.25; so are 12.6 degrees, 3.92 m (sent as 31, 3.1 m) and 98 m (4095, 40.95 m)."""
    values = Confidences.of(
        np.array([[0.2, 50.0]]), np.array([0.1]), np.array([[0.1, 0.0, 2.0]]), np.array([[0.5, 0.64]])
    )
    read = values.standard_deviations()
    np.testing.assert_allclose(read.position_m * 1.96, [[0.40, 40.95]])
    np.testing.assert_allclose(np.degrees(read.angle_rad) * 1.96, [11.3])
    np.testing.assert_allclose(read.lwh_m * 1.96, [[0.2, 0.1, 3.1]])
    np.testing.assert_allclose(read.velocity_mps * 1.96, [[0.98, np.nan]])
    wide = Confidences.of(np.zeros((1, 2)), np.radians([12.6 / 1.96]), np.zeros((1, 3)), np.zeros((1, 2)))
    assert np.isnan(wide.standard_deviations().angle_rad).all()


def four() -> Detections:
    """Cars of 4 x 2 x 1.5 m: a self report, one with a track that is well known, one with a fast one, one without."""
    listed = Detections(
        observer=np.zeros(4, int), detection_index=np.arange(4), label=np.zeros(4, np.uint8),
        boxes=boxes_at(np.zeros((4, 3)), (4.0, 2.0, 1.5)), score=np.ones(4),
        n_points=np.ones(4, int), origin=np.array([SELF, SENSED, SENSED, SENSED], np.uint8),
        transmitted=np.ones(4, bool), velocity_mps=np.array([[5.0, 0], [5, 0], [5, 0], [np.nan, np.nan]]),
    )  # fmt: skip
    listed.variance_m2[:] = [[0.0, 0, 0], [0.04, 0.01, 0.09], [0.04, 0, 0.04], [0.04, 0, 0.04]]
    listed.relative_m2[:] = 0.25 * listed.variance_m2
    listed.velocity_variance[:] = [[0.01, 0, 0.01], [0.25, 0, 0.25], [1.0, 0, 1.0], [30.0, 2.0, 1.0]]
    listed.heading_variance[:] = [0.0, 0.01, 0.04, 0.04]
    listed.size_variance[:] = [0.0, 0.0025, 0.0025, 0.0025]
    return listed


def test_what_a_receiver_reads():
    """By car: sqrt(0.04) = 0.2 m is sent as 40 cm and 0.3 m as 59 cm; the correlation is not sent. Half of that
    relative to the vehicle at this score. 0.5 m/s are 98 cm/s, 1 m/s is out of range and counts as a car without a
    track. 0.1 rad are 11.3 degrees; 0.2 rad are out of range, so that the heading may be any of 180 degrees.
    Sizes: 5 % of 4, 2 and 1.5 m are 0.392, 0.196 and 0.147 m at 95 %, sent as 0.4, 0.2 and 0.2 m."""
    of_class = np.tile([40.0, 3.0, 2.0], (4, 1))
    said, read = four(), as_encoded(four(), of_class)
    for name in ("variance_m2", "relative_m2", "velocity_variance", "heading_variance", "size_variance"):
        assert (getattr(read, name)[0] == getattr(said, name)[0]).all(), name  # the self report
    first, second = (0.40 / 1.96) ** 2, (0.59 / 1.96) ** 2
    np.testing.assert_allclose(read.variance_m2[1:], [[first, 0, second], [first, 0, first], [first, 0, first]])
    np.testing.assert_allclose(read.relative_m2, 0.25 * read.variance_m2)
    np.testing.assert_allclose(read.velocity_variance[1:], [[0.25, 0, 0.25], [40.0, 3.0, 2.0], [30.0, 2.0, 1.0]])
    np.testing.assert_allclose(np.sqrt(read.heading_variance[1]), np.radians(11.3) / 1.96)
    np.testing.assert_allclose(read.heading_variance[2:], np.pi**2 / 12)
    relative = np.array([0.4 / 4, 0.2 / 2, 0.2 / 1.5]) / 1.96
    np.testing.assert_allclose(read.size_variance[1:], np.mean(relative**2))


@pytest.mark.parametrize(("accuracy", "variance_m2"), [("exact", 0.09 + 0.04), ("etsi", (0.59 / 1.96) ** 2 + 0.04)])
def test_the_vehicles_own_error_is_added(accuracy, variance_m2):
    """A detector's error of 0.3 m, the default, and a position error of 0.2 m."""
    config = resolve_data(
        {"gnss": {"std_m": 0.2, "heading_std_deg": 0.0}, "cpm": {"accuracy": accuracy}}, "a test", None
    )
    listed = four().take(np.array([3]))
    reporters = Reporters(np.zeros((1, 3)), np.zeros(1), pose_variance(np.zeros(1, bool), config), np.zeros(1))
    found = stated(listed, None, reporters, np.full(1, np.nan), DetectorAccuracy(), config)
    np.testing.assert_allclose(found.variance_m2, [[variance_m2, 0, variance_m2]])
