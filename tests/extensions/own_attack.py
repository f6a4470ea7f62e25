"""An attack on detections of one's own: every detection is sent a few metres to the side."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of its [[attacks]] section."""

    east_m: float = 3.0
    """Shift of every own detection [m]."""


class Shift:
    """A constant position offset."""

    Params = Params

    def __init__(self, params):
        self.params = params

    def detections(self, listed, context):
        xyz_m = listed.boxes.xyz_m.copy()
        rows = np.flatnonzero(context.attacker[listed.observer] & (listed.detection_index > 0))
        xyz_m[rows, 0] += self.params.east_m
        return replace(listed, boxes=replace(listed.boxes, xyz_m=xyz_m))
