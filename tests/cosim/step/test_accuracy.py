"""What vehicles state of the accuracy of their detections is true of them."""

import numpy as np
import pytest

from cosim.config.config import load
from cosim.messages.content import SELF, Detections
from cosim.runs.simulation import Simulation
from cosim.step.accuracy import aged
from sensors.boxes import Boxes
from sensors.tracking import TrackingParams

SETTINGS = ("preset=modern", "traffic.duration_s=6", "traffic.warmup_s=200", "trust.matching=gates", "attacks=[]",
            "fleet.penetration_p=1")  # fmt: skip


@pytest.fixture(scope="module")
def errors():
    """Class (-1 for self reports), squared normalised error over 2, and factor 1 for each detection of an actor."""
    label, square = [], []
    with Simulation(load(None, SETTINGS)) as simulation:
        for result in simulation:
            sensed = result.result.sensed
            if sensed is None:
                continue
            objects, truth, world = sensed.listed.objects, sensed.listed.truth, result.world
            who = objects.observer.astype(np.int64) << 32 | truth.actor_row
            _, first, n = np.unique(who, return_index=True, return_counts=True)
            rows = np.intersect1d(first[n == 1], np.flatnonzero(truth.is_real))  # without second boxes of one object
            x, y = (objects.boxes.xyz_m[rows, :2] - world.boxes.xyz_m[truth.actor_row[rows], :2]).T
            xx, xy, yy = objects.variance_m2[rows].T
            square.append((yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy) / 2)
            label.append(np.where(objects.origin[rows] == SELF, -1, objects.label[rows].astype(int)))
    return np.concatenate(label), np.concatenate(square)


@pytest.mark.parametrize("label", [-1, 0, 1], ids=["self", "car", "pedestrian"])
def test_normalised_errors_have_unit_variance(errors, label):
    """The squared error in units of the variance is 2 on average, in two dimensions. The median is that of an
    exponential distribution, 2 ln 2; confused classes are in the tail, so the mean is taken up to the 97th percentile,
    where that of an exponential distribution of mean 1 is 1 - 0.03 x ln(1 / 0.03) / 0.97 = 0.89."""
    square = errors[1][errors[0] == label]
    assert len(square) > 150
    assert 0.8 < np.median(square) / np.log(2) < 1.25
    core = square[square <= np.quantile(square, 0.97)]
    assert 0.8 < core.mean() / 0.89 < 1.25
    for factor in (0.5, 2.0):  # a variance that is twice or half as large is noticed
        assert not 0.8 < np.median(square / factor) / np.log(2) < 1.25


def test_age_adds_the_variance_of_the_motion():
    """A car whose velocity is known to 0.5 m/s, after 0.4 s: 0.25 x 0.16 = 0.04, and 1.5 x 0.064 / 3 = 0.032 by the
    random acceleration of cars (1.5 m2/s3)."""
    boxes = Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1))
    one = Detections(
        observer=np.zeros(1, int), detection_index=np.ones(1, int), label=np.zeros(1, np.uint8), boxes=boxes,
        score=np.ones(1), n_points=np.ones(1, int), origin=np.zeros(1, np.uint8), transmitted=np.ones(1, bool),
        variance_m2=np.array([[0.1, 0.02, 0.2]]), velocity_variance=np.array([0.25]),
    )  # fmt: skip
    found = aged(one, np.array([0.4]), TrackingParams())
    np.testing.assert_allclose(found.variance_m2, [[0.172, 0.02, 0.272]])
