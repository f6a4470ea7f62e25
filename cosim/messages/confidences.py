"""What a message can say of accuracy: the confidence values of the common data dictionary (TS 102 894-2 v2.1.1)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.messages.etsi import up

_HALF_WIDTH = 1.96
"""Half the width of the interval that holds 95 % of a normal distribution, in standard deviations."""
_ANGLE_BEYOND, _SPEED_BEYOND = 126, 126
"""The values of AngleConfidence and SpeedConfidence for more than 12.5 degrees and 1.25 m/s."""


class Confidences(NamedTuple):
    """Confidence values of objects: half the width of the interval that holds the truth in 95 % of the cases.

    They are in the units of their data elements. A value above the range becomes "out of range", NaN "unavailable".
    """

    x: Int[ndarray, "n"]
    y: Int[ndarray, "n"]
    angle: Int[ndarray, "n"]
    length: Int[ndarray, "n"]
    width: Int[ndarray, "n"]
    height: Int[ndarray, "n"]
    velocity_x: Int[ndarray, "n"]
    velocity_y: Int[ndarray, "n"]

    @staticmethod
    def of(
        position_std_m: Float[ndarray, "n 2"],
        angle_std_rad: Float[ndarray, "n"],
        lwh_std_m: Float[ndarray, "n 3"],
        velocity_std_mps: Float[ndarray, "n 2"],
    ) -> "Confidences":
        """The confidence values of normal errors with these standard deviations; place and velocity have two each."""
        position = up(_HALF_WIDTH * position_std_m.ravel(), 0.01, 1, 4095, 4096)
        x, y = position.reshape(-1, 2).T
        size = up(_HALF_WIDTH * lwh_std_m.ravel(), 0.1, 1, 31, 32)
        length, width, height = size.reshape(-1, 3).T
        angle = up(_HALF_WIDTH * np.degrees(angle_std_rad), 0.1, 1, _ANGLE_BEYOND, 127)
        velocity = up(_HALF_WIDTH * velocity_std_mps.ravel(), 0.01, 1, _SPEED_BEYOND, 127).reshape(-1, 2)
        return Confidences(x, y, angle, length, width, height, *velocity.T)

    def standard_deviations(self) -> "StatedDeviations":
        """What a receiver reads from confidence values that are available."""
        place = np.column_stack([self.x, self.y])
        angle_deg = np.where(self.angle == _ANGLE_BEYOND, np.nan, 0.1 * self.angle)
        size = np.column_stack([self.length, self.width, self.height])
        velocity = np.column_stack([self.velocity_x, self.velocity_y])
        velocity_mps = np.where(velocity == _SPEED_BEYOND, np.nan, 0.01 * velocity)
        return StatedDeviations(
            position_m=0.01 * place / _HALF_WIDTH,
            angle_rad=np.radians(angle_deg / _HALF_WIDTH),
            lwh_m=0.1 * size / _HALF_WIDTH,
            velocity_mps=velocity_mps / _HALF_WIDTH,
        )

    @staticmethod
    def unavailable(n: int) -> "Confidences":
        """Those of objects whose accuracy is not known."""
        one, two, three = (np.full((n, columns), np.nan) for columns in (1, 2, 3))
        return Confidences.of(two, one.ravel(), three, two)


class StatedDeviations(NamedTuple):
    """Standard deviations of normal errors with given confidence values; NaN where a value is "out of range".

    Positions and sizes that are out of range have the next value, 40.95 and 3.1 m.
    """

    position_m: Float[ndarray, "n 2"]
    angle_rad: Float[ndarray, "n"]
    lwh_m: Float[ndarray, "n 3"]
    velocity_mps: Float[ndarray, "n 2"]
