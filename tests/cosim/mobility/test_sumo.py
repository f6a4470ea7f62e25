"""From SUMO's pose to ours."""

import numpy as np
import pytest

from cosim.mobility.source import world_from_bumpers
from cosim.roster import FleetParams, Roster
from sensors.scene import Shape


def pose(x, y, z, compass_deg, lwh):
    roster = Roster(FleetParams(), seed=1)
    number = roster.enrol(["a"], np.array([Shape.TRUCK], np.uint8), np.array([lwh], float), 0)
    front_m, angle = np.array([[x, y, z]], float), np.array([compass_deg], float)
    boxes = world_from_bumpers(0, number, front_m, angle, np.zeros(1), roster).boxes
    return boxes.xyz_m[0], boxes.lwh_m[0], boxes.yaw_rad[0]


def test_turning_truck_by_hand():
    """A 10 m truck, 3 m high, front bumper at (100, 50, 2), in a left turn, heading 300 degrees by compass.

    300 degrees clockwise from north is 60 degrees west of north: direction (-sin 60, cos 60) = (-0.8660, 0.5);
    counter-clockwise from east that is 150 degrees. The centre lies 5 m behind the bumper:
    (100 + 4.3301, 50 - 2.5) = (104.3301, 47.5), and half the height, 1.5 m, above the road.
    """
    centre, lwh, yaw = pose(100, 50, 2, 300, (10.0, 2.5, 3.0))
    np.testing.assert_allclose(centre, [104.33012701892, 47.5, 3.5], atol=2**-9)  # to 1/256 m
    np.testing.assert_allclose(yaw, np.deg2rad(150), atol=2**-10)  # to 1/512 rad
    assert lwh.tolist() == [10.0, 2.5, 3.0]


@pytest.mark.parametrize(
    ("compass_deg", "yaw_deg"),
    [(0, 90), (90, 0), (180, -90), (270, 180), (360, 90), (269.999, -179.999), (45, 45), (225, -135)],
)
def test_compass(compass_deg, yaw_deg):
    """North is +90 degrees, east 0, south -90, and west exactly +180: yaw lies in (-pi, pi]."""
    yaw = pose(0, 0, 0, compass_deg, (4.0, 2.0, 1.5))[2]
    # 269.999 by compass is a hair south of west: 180.001 = -179.999 degrees.
    np.testing.assert_allclose(yaw, np.deg2rad(yaw_deg), atol=2**-10)
    assert -np.pi < yaw <= np.pi
