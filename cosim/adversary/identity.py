"""Attacks with several identities at once. Whitewashing and newcomers: the key `renewal` of every section."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Int
from numpy import ndarray

from cosim.adversary.attack import AttackContext, EvaluationRows, fabricated, placed
from cosim.adversary.ghost_insertion import CAR
from cosim.adversary.ghosts import CAR_LWH_M
from cosim.v2x.messages import FABRICATED, Detections
from sensors.boxes import Boxes


@dataclass(frozen=True, kw_only=True, slots=True)
class SybilParams:
    """How many ghosts, and where."""

    n_ghosts: Annotated[int, Gt(0), Le(20)] = 5
    """Ghost vehicles per attacker, each with a pseudonym and messages of its own; F2MD has 5, NextGen 4 to 6. SCMS
    issues 20 certificates that are valid at once."""
    spacing_m: Annotated[float, Gt(0), Le(1000)] = 5.0
    """Between two ghosts along the road [m]; default as in F2MD."""
    aside_m: Annotated[float, Ge(0), Le(1000)] = 2.0
    """Ghosts stand to the left of the attacker and to its right, in turn [m]; default as in F2MD."""
    agree: bool = True
    """Ghosts confirm each other and the attacker: evaluation and visibility 1."""


class Sybil:
    """Traffic that is not there: ghosts beside and behind the attacker, each of which reports itself.

    Every ghost is a vehicle to all receivers: its own pseudonym, its own detection message with itself as detection 0,
    its own evaluation message. They stand to the attacker's left and right, the first pair abreast of it, each further
    pair `spacing_m` behind, with its heading and its speed.

    Notes
    -----
    Deviations: ghosts report nothing but themselves; their evaluations are the attacker's own, but for what the ghosts
    say of each other. All are sent by the attacker's one radio, so that they share its reception.
    """

    Params = SybilParams

    def __init__(self, params: SybilParams) -> None:
        self.params = params

    def identities(self, context: AttackContext) -> Int[ndarray, "n"]:
        """One for each ghost."""
        return np.full(len(context.world), self.params.n_ghosts)

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The ghosts' reports of themselves."""
        p, world = self.params, context.world
        attackers = np.flatnonzero(context.attacker)
        number = np.tile(np.arange(p.n_ghosts), len(attackers))
        row = np.repeat(attackers, p.n_ghosts)
        left = np.where(number % 2 == 0, p.aside_m, -p.aside_m)
        xyz, yaw = placed(world, row, -p.spacing_m * (number // 2), left, np.zeros(len(row)))
        lwh = np.tile(CAR_LWH_M, (len(row), 1))
        xyz[:, 2] = world.boxes.xyz_m[row, 2] - world.boxes.lwh_m[row, 2] / 2 + lwh[:, 2] / 2
        return fabricated(
            listed, row, np.full(len(row), CAR), Boxes(xyz, lwh, yaw), np.ones(len(row)),
            identity=number + 1, speed_mps=world.speed_mps[row],
        )  # fmt: skip

    def evaluations(
        self, rows: EvaluationRows, detections: Detections, context: AttackContext
    ) -> tuple[ndarray, ndarray]:
        """What belongs to the attacker, confirmed."""
        own = context.attacker[rows.evaluator] & (detections.observer[rows.detection] == rows.evaluator)
        own &= self.params.agree & (detections.origin[rows.detection] == FABRICATED)
        return np.where(own, 1.0, rows.evaluation), np.where(own, 1.0, rows.visibility)
