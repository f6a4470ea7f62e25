"""Attacks with several identities at once. For whitewashing and newcomers, see the key `renewal` of every section."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Gt, Le
from jaxtyping import Int
from numpy import ndarray

from cosim.addons.attacks.ghosts import CAR_LWH_M, ground_m
from cosim.attacks.attack import AttackContext, EvaluationRows, WithParams, certified, fabricated, placed
from cosim.attacks.ghost_insertion import CAR
from cosim.base.bounds import NotNegative1000, Positive1000
from cosim.messages.content import Detections
from sensors.boxes import Boxes


@dataclass(frozen=True, kw_only=True, slots=True)
class SybilParams:
    """Number and positions of the ghost vehicles."""

    n_ghosts: Annotated[int, Gt(0), Le(20)] = 5
    """Number of ghost vehicles per attacker, each with its own pseudonym and messages. F2MD uses 5, NextGen 4 to 6.
    SCMS issues 20 certificates that are valid at once."""
    spacing_m: Positive1000 = 5.0
    """Distance between two ghosts along the road [m]. The default is F2MD's."""
    aside_m: NotNegative1000 = 2.0
    """Distance of the ghosts to the left and to the right of the attacker, in turn [m]. The default is F2MD's."""
    agree: bool = True
    """Whether ghosts confirm each other, with evaluation 1 and visibility 1. What the attacker detects they evaluate as
    the attacker does."""


class Sybil(WithParams[SybilParams]):
    """Simulates ghost vehicles beside and behind the attacker, each of which reports itself.

    To receivers every ghost is a vehicle. It has its own pseudonym, its own detection message with itself as detection
    0, and its own evaluation message. Ghosts are to the attacker's left and right. The first pair is beside it, and
    each further pair is `spacing_m` behind. They have the attacker's heading and speed.

    Notes
    -----
    Deviations: ghosts report only themselves. Their evaluations are the attacker's, except those of each other. The
    attacker's radio sends all messages, so that they share its reception.
    """

    Params = SybilParams

    def identities(self, context: AttackContext) -> Int[ndarray, "n"]:
        """One identity for each ghost."""
        return np.full(len(context.world), self.params.n_ghosts)

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with the self reports of the ghosts added."""
        p, world = self.params, context.world
        attackers = np.flatnonzero(context.attacker)
        number = np.tile(np.arange(p.n_ghosts), len(attackers))
        row = np.repeat(attackers, p.n_ghosts)
        ahead = -p.spacing_m * (number // 2)
        left = np.where(number % 2 == 0, p.aside_m, -p.aside_m)
        xyz, yaw = placed(world, row, ahead, left, np.zeros(len(row)))
        lwh = np.tile(CAR_LWH_M, (len(row), 1))
        xyz[:, 2] = ground_m(world, row) + lwh[:, 2] / 2
        return fabricated(
            listed,
            row,
            np.full(len(row), CAR),
            Boxes(xyz, lwh, yaw),
            np.ones(len(row)),
            identity=number + 1,
            speed_mps=world.speed_mps[row],
        )

    def evaluations(
        self, rows: EvaluationRows, detections: Detections, context: AttackContext
    ) -> tuple[ndarray, ndarray]:
        """The rows, with the attacker's own ghosts confirmed if they agree."""
        if not self.params.agree:
            return rows.evaluation, rows.visibility
        return certified(rows, detections, context)
