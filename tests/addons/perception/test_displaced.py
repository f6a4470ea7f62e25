"""Displaced boxes and objects against homogeneous matrices, as OpenCOOD multiplies them."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from cosim.addons.perception.kitti_frames import BOX
from cosim.addons.perception.measures.displaced import (
    ERROR,
    displaced,
    seen_by_senders,
    with_errors,
    with_larger_errors,
)

VAN = [5.0, 2.0, 2.0]


@dataclass
class Recorded:
    """Two tables, whatever rows are asked for."""

    actors: pd.DataFrame
    vehicles: pd.DataFrame

    def table(self, name, columns, where=None):
        return getattr(self, name)[columns]


def recorded(rng: np.random.Generator) -> Recorded:
    """Actors 0 to 3 in steps 0 and 1, anywhere."""
    actors = pd.DataFrame({"step": np.repeat([0, 1], 4), "actor": np.tile(np.arange(4), 2), "z_m": 0.0})
    actors = actors.assign(
        x_m=rng.uniform(-50, 50, 8), y_m=rng.uniform(-50, 50, 8), yaw_rad=rng.uniform(-np.pi, np.pi, 8)
    )
    sizes = dict(zip(("length_m", "width_m", "height_m"), VAN, strict=True))
    return Recorded(actors, pd.DataFrame({"vehicle": np.arange(4), **sizes}))


def matrix(x: float, y: float, yaw: float) -> np.ndarray:
    return np.array([[np.cos(yaw), -np.sin(yaw), x], [np.sin(yaw), np.cos(yaw), y], [0.0, 0.0, 1.0]])


def pose(run: Recorded, step: int, actor: int) -> np.ndarray:
    row = run.actors.set_index(["step", "actor"]).loc[(step, actor)]
    return row[["x_m", "y_m", "yaw_rad"]].to_numpy(np.float64)


def test_an_object_of_partners_moves_with_the_first_of_them_and_its_error():
    """Actor 0 is the ego, 1 and 2 are partners that both see 3. The ego sees actor 2 itself."""
    run = recorded(np.random.default_rng(5))
    beside = with_errors(pd.DataFrame({"frame": [0, 0], "observer": [2, 1]}), (0.2, 0.2), None).assign(step=1)
    theirs = beside.merge(pd.DataFrame({"frame": [0, 0], "actor": [2, 3]}), on="frame")
    own = pd.DataFrame({"frame": [0], "actor": [2]})
    world = np.array([[*pose(run, 1, k)[:2], 0.0, *VAN, pose(run, 1, k)[2]] for k in (2, 3)])
    placed = seen_by_senders(run, world, (np.array([0, 0]), np.array([2, 3])), own, theirs, 1)
    np.testing.assert_array_equal(placed[0], world[0])
    first = beside[beside.observer == 1].iloc[0]
    noisy = pose(run, 1, 1) + first[[*ERROR]].to_numpy(np.float64)
    want = matrix(*noisy) @ np.linalg.inv(matrix(*pose(run, 0, 1))) @ matrix(*pose(run, 1, 3))
    np.testing.assert_allclose(matrix(*placed[1, [0, 1, 6]]), want, atol=1e-12)
    np.testing.assert_array_equal(placed[1, 2:6], world[1, 2:6])
    still = seen_by_senders(
        run, world, (np.array([0, 0]), np.array([2, 3])), own, theirs.assign(**dict.fromkeys(ERROR, 0.0)), 0
    )
    np.testing.assert_allclose(matrix(*still[1, [0, 1, 6]]), matrix(*world[1, [0, 1, 6]]), atol=1e-12)


def test_boxes_turn_about_their_sender():
    run = recorded(np.random.default_rng(6))
    boxes = pd.DataFrame({"step": [1], "observer": [1], "x_m": 3.0, "y_m": 4.0, "z_m": 0.5, "yaw_rad": 0.3})
    boxes = boxes.assign(length_m=4.0, width_m=1.8, height_m=1.5)
    boxes = with_errors(boxes, (0.0, 0.0), (0.05, 0.21, -0.19))
    (moved,) = displaced(boxes, run)[[*BOX]].to_numpy(np.float64)
    noisy = pose(run, 1, 1) + [0.05, 0.21, np.radians(-0.19)]
    want = matrix(*noisy) @ np.linalg.inv(matrix(*pose(run, 1, 1))) @ matrix(3.0, 4.0, 0.3)
    np.testing.assert_allclose(matrix(*moved[[0, 1, 6]]), want, atol=1e-12)


def test_errors_of_boxes_are_multiplied_and_false_positives_stay():
    run = recorded(np.random.default_rng(7))
    true = np.array([*pose(run, 0, 3)[:2], 0.0, *VAN, pose(run, 0, 3)[2]])
    box = true + [0.1, -0.2, 0.0, 0.3, 0.0, 0.0, 2 * np.pi + 0.02]
    boxes = pd.DataFrame([box, box], columns=[*BOX]).assign(step=0, truth_actor=pd.array([3, None], dtype="Int64"))
    larger = with_larger_errors(boxes, run, 2.0)[[*BOX]].to_numpy(np.float64)
    np.testing.assert_allclose(larger[0] - true, [0.2, -0.4, 0.0, 0.6, 0.0, 0.0, 0.04], atol=1e-12)
    np.testing.assert_array_equal(larger[1], box)
