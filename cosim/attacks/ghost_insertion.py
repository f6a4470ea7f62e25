"""Ghost insertion: reported objects in front of a victim that do not exist."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from cosim.attacks.attack import AttackContext, Vouched, placed
from cosim.attacks.disguise import ghosts
from cosim.base.bounds import Positive1000
from cosim.messages.content import Detections
from cosim.world import LABELS
from sensors.boxes import Boxes

CAR, PEDESTRIAN = LABELS.index("car"), LABELS.index("pedestrian")
PEDESTRIAN_LWH_M = (0.8, 0.6, 1.75)

GHOSTS = {
    "car": ((CAR, 0.0, 0.0),),
    "car_and_pedestrian": ((CAR, 0.0, 0.0), (PEDESTRIAN, 0.0, -2.0)),
    "three_cars": ((CAR, 0.0, 0.0), (CAR, 0.0, 4.0), (CAR, 7.0, 2.0)),
}
"""For each value of `ghosts`, its objects: class, metres beyond `ahead_m`, metres to the victim's left."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GhostInsertionParams:
    """The inserted objects and their distance. The keys that begin with `victim` choose the victim."""

    ghosts: Literal["car_and_pedestrian", "car", "three_cars"] = "car_and_pedestrian"
    """Oncoming objects that are inserted in front of the victim."""
    ahead_m: Positive1000 = 8.0
    """Distance from the victim's centre to the first inserted object, straight ahead [m]."""


class GhostInsertion(Vouched[GhostInsertionParams]):
    """Inserts a car (and a pedestrian, or two more cars) in front of a victim in every message [1]_.

    A ghost car is oncoming. The attacker confirms its ghosts with evaluation 1 and visibility 1.

    Notes
    -----
    Deviations: ghosts have scores, sizes and speeds like those of real detections (`disguise.ghosts`), while in the
    paper their score is 1, which marks them. They have detection indices of their own, while the published code re-used
    those of real detections.
    In the paper all attackers aim at one ego vehicle. In a city each aims at its nearest neighbour by default.

    References
    ----------
    .. [1] Hurl, Cohen, Czarnecki, Waslander, "TruPercept", 2020, section "Trust Levels".
    """

    Params = GhostInsertionParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with the ghosts added."""
        p, world = self.params, context.world
        attacker, victim = context.victims()
        classes, beyond_m, to_left_m = zip(*GHOSTS[p.ghosts], strict=True)
        label = np.tile(classes, len(attacker)).astype(np.uint8)
        ahead_m = p.ahead_m + np.tile(beyond_m, len(attacker))
        left_m = np.tile(to_left_m, len(attacker))
        attacker = np.repeat(attacker, len(classes))
        victim = np.repeat(victim, len(classes))
        opposite_rad = np.full(len(victim), np.pi)
        xyz, yaw = placed(world, victim, ahead_m, left_m, opposite_rad)
        is_car = label == CAR
        lwh = np.where(is_car[:, None], world.boxes.lwh_m[attacker], PEDESTRIAN_LWH_M)
        height = world.boxes.lwh_m[victim, 2]
        ground = world.boxes.xyz_m[victim, 2] - height / 2
        xyz[:, 2] = ground + lwh[:, 2] / 2
        return ghosts(listed, attacker, label, Boxes(xyz, lwh, yaw), context, victim)
