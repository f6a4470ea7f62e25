"""A faulty vehicle that loses own detections and adds copies at wrong places."""

from dataclasses import dataclass, replace

import numpy as np

from cosim.attacks.attack import AttackContext, Vouched, fabricated, placed
from cosim.base.bounds import Positive1000, Share
from cosim.base.rng import Stream
from cosim.messages.content import FABRICATED, SENSED, Detections
from sensors.boxes import Boxes


@dataclass(frozen=True, kw_only=True, slots=True)
class UnreliableParams:
    """Probabilities of losses and of copies."""

    add_p: Share = 0.1
    """Probability that a copy of an own detection is added somewhere in the forward view."""
    remove_p: Share = 0.1
    """Probability that an own detection is not transmitted."""
    add_range_m: Positive1000 = 70.0
    """Largest distance of a copy [m]."""


class Unreliable(Vouched[UnreliableParams]):
    """TruPercept's unreliable vehicle [1]_.

    Notes
    -----
    Deviations: the published code's unreliable behaviour had no effect. Here it works as in the paper. Copies have
    detection indices of their own.

    References
    ----------
    .. [1] Hurl, Cohen, Czarnecki, Waslander, "TruPercept", 2020, section "Trust Levels".
    """

    Params = UnreliableParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with some own detections not transmitted and some copied."""
        p, world = self.params, context.world
        faulty = np.flatnonzero(context.attacker[listed.observer])
        own = listed.take(faulty)
        named = world.name_key[own.observer], own.detection_index
        omission = context.draw(Stream.OMISSION, *named)[:, 0]
        omitted = (own.origin == SENSED) & (omission < p.remove_p)
        draws = context.draw(Stream.FABRICATION, *named, n=4)
        is_copied = (own.origin != FABRICATED) & (draws[:, 0] < p.add_p)
        copied = np.flatnonzero(is_copied)
        source, u = own.take(copied), draws[copied, 1:]
        ahead_m = p.add_range_m * u[:, 0]
        left_m = ahead_m * (u[:, 1] - 0.5)
        turned_rad = np.pi * (u[:, 2] - 0.5)
        xyz, yaw = placed(world, source.observer, ahead_m, left_m, turned_rad)
        xyz[:, 2] = source.boxes.xyz_m[:, 2]
        transmitted = listed.transmitted.copy()
        transmitted[faulty[omitted]] = False
        kept = replace(listed, transmitted=transmitted)
        return fabricated(
            kept,
            source.observer,
            source.label,
            Boxes(xyz, source.boxes.lwh_m, yaw),
            source.score,
            n_points=source.n_points,
            velocity_mps=source.velocity_mps,
        )
