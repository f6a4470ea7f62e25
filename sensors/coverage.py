"""What a detector should find from another vehicle's place, as far as an evaluator knows the scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.codes import ObjectClass
from cosim.base.ragged import owner_of_rows
from sensors.boxes import Boxes
from sensors.expected_returns import expected_returns
from sensors.lidar import Beams, LidarParams, beams, mount
from sensors.line_of_sight import WallIndex
from sensors.neighbours import Neighbours
from sensors.scene import Shape, prisms

SAME_M = 4.0
"""A detection at most this far from an object, horizontally, is one of that object [m]: as by the rules of inclusion of
ETSI TS 103 324. Of an object longer than twice this, half its length counts."""

_SHAPE = np.zeros(len(ObjectClass), np.uint8)
_SHAPE[ObjectClass.CAR] = Shape.CAR
_SHAPE[ObjectClass.PEDESTRIAN] = Shape.PEDESTRIAN
_SHAPE[ObjectClass.CYCLIST] = Shape.BICYCLE
_SHAPE[ObjectClass.TRUCK] = Shape.TRUCK


@dataclass(frozen=True, slots=True)
class Coverage:
    """The sensor and the detector that all vehicles have, and the buildings of the map."""

    lidar: LidarParams
    beams: Beams
    walls: WallIndex
    recall: Callable[[ndarray, ndarray, ndarray], ndarray]
    """As `sensors.detector.KnowsRecall`."""

    @staticmethod
    def of(lidar: LidarParams, walls: WallIndex, recall: Callable[[ndarray, ndarray, ndarray], ndarray]) -> Coverage:
        """The coverage of a LiDAR with these parameters."""
        return Coverage(lidar, beams(lidar), walls, recall)

    def expected_recall(
        self, carrier: Int[ndarray, "p"], bodies: Neighbours, boxes: Boxes, label: UInt8[ndarray, "n"]
    ) -> Float[ndarray, "k"]:
        """Recall of the detector of each carrier for the bodies around it.

        Parameters
        ----------
        carrier
            Row of the box that carries the sensor. One row per question; two evaluators ask about one carrier twice.
        bodies
            For each question, the bodies that its evaluator knows, without the carrier.
        boxes, label
            Box and `ObjectClass` of all bodies, as messages state them; world frame.

        Returns
        -------
        Probability in [0, 1] that one sweep yields a report of the body, one per row of `bodies`.

        Notes
        -----
        The recall is that of the whole number of expected returns behind the other bodies and the buildings
        (`expected_returns`). Bodies that the evaluator does not know hide nothing; behind them, the recall is too high.
        """
        poses = mount(boxes, carrier, self.lidar)
        solid = prisms(_SHAPE[label], boxes)
        range_m = self.lidar.max_range_m
        found = expected_returns(poses, carrier, self.beams, bodies, boxes, solid, self.walls, range_m)
        n_returns = np.floor(found.n).astype(np.int64)
        question = owner_of_rows(np.diff(bodies.ptr))
        apart_m = boxes.xyz_m[bodies.row] - poses.origin_m[question]
        return self.recall(n_returns, label[bodies.row], np.linalg.norm(apart_m, axis=1))


def at_place(found_m: Float[ndarray, "n 3"], place: Boxes) -> Bool[ndarray, "n"]:
    """Whether each detection is one of the object in the same row, by their horizontal distance (`SAME_M`)."""
    away_m = np.hypot(*(found_m - place.xyz_m)[:, :2].T)
    return away_m <= np.maximum(SAME_M, 0.5 * place.lwh_m[:, 0])
