"""What a detector should find from another's place: by hand."""

import numpy as np
import pytest
import shapely

from sensors.boxes import Boxes
from sensors.coverage import Coverage, at_place
from sensors.detector import IdealDetector, StatisticalDetector
from sensors.lidar import LidarParams
from sensors.line_of_sight import WallIndex
from sensors.neighbours import Neighbours
from sensors.scene import Scene
from sensors.statistical_detector import DetectorParams
from tests.sensors.town import to_scene

CAR, TRUCK = 0, 3
SIZES = {CAR: (4.4, 1.8, 1.5), TRUCK: (9.0, 2.5, 3.5)}


def boxes(*bodies):
    """Boxes of bodies (class, x, y) that stand on the ground and head east."""
    lwh = np.array([SIZES[label] for label, *_ in bodies])
    xyz = np.column_stack([[x for _, x, _ in bodies], [y for *_, y in bodies], lwh[:, 2] / 2])
    return Boxes(xyz, lwh, np.zeros(len(bodies))), np.array([label for label, *_ in bodies], np.uint8)


def recall(*bodies, detector=None, walls=None, **lidar):
    """Expected recall of all bodies but the first, which carries the sensor at (0, 0)."""
    params = LidarParams(**lidar)
    detector = StatisticalDetector(DetectorParams()) if detector is None else detector
    index = WallIndex.of((Scene.empty() if walls is None else walls).buildings)
    where, label = boxes((CAR, 0, 0), *bodies)
    near = Neighbours(np.array([0, len(bodies)]), np.arange(1, len(bodies) + 1))
    return Coverage.of(params, index, detector.recall).expected_recall(np.array([0]), near, where, label)


def test_a_car_in_the_open_is_expected_and_one_far_away_is_not():
    near, far, beyond = (recall((CAR, x, 5))[0] for x in (15, 60, 500))
    assert 0.5 < near < 1 and 0 < far < near and beyond == 0


def test_a_truck_in_between_excuses_the_sender():
    assert recall((CAR, 30, 0))[0] > 0.3
    assert recall((CAR, 30, 0), (TRUCK, 12, 0))[0] == 0
    assert recall((CAR, 30, 0), (TRUCK, 12, 8))[0] == recall((CAR, 30, 0))[0], "one beside the line hides nothing"
    assert recall((CAR, 30, 0), (TRUCK, 60, 0))[0] == recall((CAR, 30, 0))[0], "nor does one behind"


def test_a_building_in_between_excuses_the_sender():
    house = to_scene([shapely.box(10, -6, 14, 6)], np.zeros(1), np.full(1, 10.0))
    ahead, behind = (recall((CAR, x, 0), walls=house, fov_deg=360.0, n_azimuths=2048)[0] for x in (30, -30))
    assert ahead == 0 and behind > 0.1


def test_what_is_outside_the_field_of_view_is_not_expected():
    assert recall((CAR, -20, 0), fov_deg=90.0)[0] == 0 and recall((CAR, 20, 0), fov_deg=90.0)[0] > 0.3


def test_less_than_one_return_is_none():
    assert recall((CAR, 20, 0), detector=IdealDetector(DetectorParams()))[0] == 1
    assert recall((CAR, 400, 0), detector=IdealDetector(DetectorParams()))[0] == 0


@pytest.mark.parametrize(("away_m", "expected"), [(3.9, True), (4.1, False)])
def test_the_place_of_an_object(away_m, expected):
    where, _ = boxes((CAR, 0, 0))
    assert at_place(np.array([[away_m, 0.0, 50.0]]), where).tolist() == [expected], "height does not matter"


def test_the_place_of_a_long_object_is_longer():
    where, _ = boxes((TRUCK, 0, 0))  # half of 9 m
    assert at_place(np.array([[4.4, 0.0, 1.0], [4.6, 0.0, 1.0]]), where.take(np.zeros(2, int))).tolist() == [
        True,
        False,
    ]
