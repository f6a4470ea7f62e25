"""Detections in a sensor's frame are where the sensor measured them, whatever the vehicle takes its own pose to be."""

from types import SimpleNamespace

import numpy as np

from cosim.addons.export.frames import in_sensor
from cosim.step.positioning import as_estimated
from results.moments import Selection
from sensors.boxes import Boxes


def test_the_error_of_the_own_pose_cancels():
    """Boxes are displaced by the step's own code, and come back by the pose that the vehicle believes."""
    rng = np.random.default_rng(5)
    boxes = Boxes(rng.normal(0, 30, (9, 3)), rng.uniform(1, 5, (9, 3)), rng.uniform(-3, 3, 9))
    pose, error = np.array([12.0, -7.0, 1.9, 0.4]), np.array([0.3, -0.2, 0.02])
    sent = as_estimated(boxes, np.zeros(9, int), pose[None, :3], error[None])
    moment = SimpleNamespace(pose_error={4: error})
    believed = Selection.believed_pose(SimpleNamespace(pose=lambda moment, vehicle: pose.copy()), moment, 4)
    seen, measured = (
        in_sensor(np.column_stack([of.xyz_m, of.lwh_m, of.yaw_rad]), by) for of, by in ((sent, believed), (boxes, pose))
    )
    turns = (seen[:, 6] - measured[:, 6]) / (2 * np.pi)
    assert np.abs(seen[:, :6] - measured[:, :6]).max() < 1e-9 and np.abs(turns - np.round(turns)).max() < 1e-9
