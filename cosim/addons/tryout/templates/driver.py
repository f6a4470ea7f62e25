"""A driver: it slows down if others report an object close ahead that its own detector does not report."""

from dataclasses import dataclass

import numpy as np

from cosim.extend import SpeedCommands


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [driver] that belong to this driver."""

    ahead_m: float = 20.0  # distance that it looks ahead [m]
    min_score: float = 0.5  # smallest score of an object that it reacts to


class MyDriver:
    Params = Params

    def __init__(self, params):
        self.params = params

    def commands(self, state, world, beliefs, dt_s):  # state: the one returned in the previous step, None at first
        if beliefs is None:  # between two sweeps
            return state, SpeedCommands.none()
        ego, yaw_rad = beliefs.ego, world.boxes.yaw_rad[beliefs.ego]  # one row for each belief; ego: row of the world
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        way_m = beliefs.boxes.xyz_m - world.boxes.xyz_m[ego]
        east_m, north_m, _ = way_m.T
        ahead_m = east_m * cos + north_m * sin
        left_m = north_m * cos - east_m * sin
        in_way = (ahead_m > 0) & (np.abs(left_m) < 1.5)
        close = in_way & (ahead_m < self.params.ahead_m)
        chosen = close & ~beliefs.ego_detected & (beliefs.score >= self.params.min_score)
        rows = np.unique(ego[chosen])  # each vehicle once
        return state, SpeedCommands(world.actor[rows], world.speed_mps[rows] / 2)
