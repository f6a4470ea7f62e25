"""From SUMO's pose to ours."""

import numpy as np
import pytest

from cosim.mobility.source import centre_from_bumper


def pose(x, y, z, compass_deg, lwh):
    boxes = centre_from_bumper(np.array([[x, y, z]], float), np.array([compass_deg], float), np.array([lwh], float))
    return boxes.xyz_m[0], boxes.lwh_m[0], boxes.yaw_rad[0]


def test_turning_truck_by_hand():
    """A 10 m truck, 3 m high, front bumper at (100, 50, 2), in a left turn, heading 300 degrees by compass.

    300 degrees clockwise from north is 60 degrees west of north: direction (-sin 60, cos 60) = (-0.8660, 0.5);
    counter-clockwise from east that is 150 degrees. The centre lies 5 m behind the bumper:
    (100 + 4.3301, 50 - 2.5) = (104.3301, 47.5), and half the height, 1.5 m, above the road.
    """
    centre, lwh, yaw = pose(100, 50, 2, 300, (10.0, 2.5, 3.0))
    np.testing.assert_allclose(centre, [104.33012701892, 47.5, 3.5])
    np.testing.assert_allclose(yaw, np.deg2rad(150))
    assert lwh.tolist() == [10.0, 2.5, 3.0]


@pytest.mark.parametrize(
    ("compass_deg", "yaw_deg"),
    [(0, 90), (90, 0), (180, -90), (270, 180), (360, 90), (269.999, -179.999), (45, 45), (225, -135)],
)
def test_compass(compass_deg, yaw_deg):
    """North is +90 degrees, east 0, south -90, and west exactly +180: yaw lies in (-pi, pi]."""
    yaw = pose(0, 0, 0, compass_deg, (4.0, 2.0, 1.5))[2]
    expected = yaw_deg if yaw_deg != -179.999 else -179.999
    # 269.999 by compass is a hair south of west: 180.001 = -179.999 degrees.
    np.testing.assert_allclose(np.rad2deg(yaw), expected, atol=1e-9)
    assert -np.pi < yaw <= np.pi
