"""An attack without false messages: real objects mislead the detector of an honest victim, which loses trust."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from scipy.spatial import cKDTree

from cosim.addons.attacks.ghosts import CAR_LWH_M
from cosim.attacks.attack import AttackContext, WithParams, placed
from cosim.attacks.disguise import ghosts
from cosim.attacks.ghost_insertion import CAR
from cosim.base.bounds import NotNegative100, Positive100, Share
from cosim.messages.content import Detections
from sensors.boxes import Boxes

STEP_M = 2.0
"""Distance between two places that the attacker tries."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrustFlipParams:
    """Where the phantom appears, and how reliably."""

    ahead_m: Positive100 = 8.0
    """Smallest distance from the victim's centre to the phantom, straight ahead [m]."""
    farthest_m: Positive100 = 40.0
    """Largest distance [m]. The nearest free place is taken. If there is none, the victim reports no phantom."""
    clear_m: NotNegative100 = 6.0
    """Smallest distance of the phantom from the centres of real actors [m]. Where one stands, others confirm it."""
    left_m: Annotated[float, Ge(-50), Le(50)] = 0.0
    """Distance of the phantom to the left of this line [m]; below 0 to the right."""
    misled_p: Share = 1.0
    """Probability that the victim's detector reports the phantom in a sweep. The default has no source."""

    def __post_init__(self) -> None:
        if self.farthest_m < self.ahead_m:
            raise ValueError(
                f"attacks.farthest_m = {self.farthest_m:g} m is below attacks.ahead_m = {self.ahead_m:g} m. Swap them."
            )


class TrustFlip(WithParams[TrustFlipParams]):
    """Makes an honest victim detect a car that no other vehicle detects, so that the victim loses trust (TrustFlip).

    The attacker has put an object before the victim that only the victim's detector takes for a car, where no other
    actor is [1]_. The victim tracks this phantom, sends it and confirms it, because it believes in it, and others deny
    it. No message is false, neither of the victim nor of the attacker. In the table `detections` the phantom is a false
    positive of the victim, with the victim as its `target`, and it is no lie.

    Notes
    -----
    A victim has one phantom in a sweep, whatever the number of its attackers. It has score, size and number of returns
    of a real detection (`disguise.ghosts`).

    Deviations: [1]_ computes shapes that published detectors mistake from the victim's viewpoint, and measures how
    often a defence then excludes the victim. Here the effect on the detector is given. The object moves with the
    victim. It returns no rays and hides nothing, so that all others see free space. The opposite effect, a victim that
    misses a real object, is left out. From the abstract and quotations, not from the full paper.

    References
    ----------
    .. [1] Liu, Wang, Li, Zhang, "Adversarial Trust Poisoning in Vehicular Collaborative Perception", arXiv:2605.22122,
       2026.
    """

    Params = TrustFlipParams

    def phantoms(self, seen: Detections, context: AttackContext) -> Detections:
        """The detections, with a phantom for each victim that senses."""
        p, world = self.params, context.world
        attacker, victim = context.victims()
        chance = context.uniforms(context.name_key(attacker), context.name_key(victim))[:, 0]
        rows = np.flatnonzero((chance < p.misled_p) & np.isin(victim, seen.observer))
        rows = rows[np.argsort(context.name_key(attacker[rows]))]  # so that nothing depends on actor numbers
        victim, first = np.unique(victim[rows], return_index=True)
        attacker = attacker[rows[first]]
        ahead_m = np.arange(p.ahead_m, p.farthest_m + 1e-9, STEP_M)
        row = np.repeat(victim, len(ahead_m))
        ahead_m = np.tile(ahead_m, len(victim))
        left_m = np.full(len(row), p.left_m)
        oncoming_rad = np.full(len(row), np.pi)
        xyz, yaw = placed(world, row, ahead_m, left_m, oncoming_rad)
        height_m = world.boxes.lwh_m[row, 2]
        xyz[:, 2] += (CAR_LWH_M[2] - height_m) / 2
        actors = cKDTree(world.boxes.xyz_m[:, :2])
        away_m, _ = actors.query(xyz[:, :2])
        free = np.flatnonzero(away_m >= p.clear_m)
        finds, nearest = np.unique(row[free], return_index=True)
        at, attacker = free[nearest], attacker[np.isin(victim, finds)]
        lwh = np.tile(CAR_LWH_M, (len(at), 1))
        boxes = Boxes(xyz[at], lwh, yaw[at])
        label = np.full(len(at), CAR, np.uint8)
        return ghosts(seen, finds, label, boxes, context, attacker)
