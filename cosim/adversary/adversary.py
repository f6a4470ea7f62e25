"""All attacks of a run: who carries out which, from when on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Float, UInt8
from numpy import ndarray

from cosim.adversary.attack import Attack, AttackContext, EvaluationRows
from cosim.adversary.ghost_insertion import GhostInsertion
from cosim.adversary.unreliable import Unreliable
from cosim.v2x.messages import Detections
from cosim.world import World
from results.codes import Role

ATTACKS: Mapping[str, type] = {"ghost_insertion": GhostInsertion, "unreliable": Unreliable}
"""Attacks at hand, by the config's name."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AttackParams:
    """One attack: what, by whom, from when on. Its own parameters stand in the same section."""

    attack: str = "ghost_insertion"
    """Name of the attack, or one of your own: path.py:Name."""
    role: Literal["malicious", "unreliable"] = "malicious"
    """What its vehicles are called in tables and figures."""
    share_p: Annotated[float, Ge(0), Le(1)] = 0.1
    """Share of the equipped vehicles that carry it out, decided vehicle by vehicle from its name."""
    start_s: Annotated[float, Ge(0), Le(1e8)] = 60.0
    """Recorded time from which it is carried out [s]; until then its vehicles are honest and build up trust."""


PAPER: tuple[dict[str, Any], ...] = (
    {"attack": "ghost_insertion", "role": "malicious"},
    {"attack": "unreliable", "role": "unreliable"},
)
"""The two behaviours of TruPercept's experiments: the default."""


@dataclass(frozen=True, slots=True)
class Adversary:
    """The attacks of a run, in the order of the config; `world.attack` numbers them from 1."""

    attacks: tuple[Attack, ...]
    start_s: tuple[float, ...]
    seed: int

    @staticmethod
    def of(params: Sequence[AttackParams], attacks: Sequence[Attack], seed: int) -> "Adversary":
        return Adversary(tuple(attacks), tuple(p.start_s for p in params), seed)

    def detections(self, listed: Detections, world: World, time_s: float) -> Detections:
        """What each vehicle will send of its list."""
        for attack, context in self._active(world, time_s):
            if hasattr(attack, "detections"):
                listed = attack.detections(listed, context)
        return listed

    def evaluations(
        self, rows: EvaluationRows, detections: Detections, world: World, time_s: float
    ) -> tuple[Float[ndarray, "m"], Float[ndarray, "m"]]:
        """Evaluation and visibility as each vehicle will send them."""
        evaluation, visibility = rows.evaluation, rows.visibility
        for attack, context in self._active(world, time_s):
            if hasattr(attack, "evaluations"):
                now = EvaluationRows(rows.evaluator, rows.detection, evaluation, visibility)
                evaluation, visibility = attack.evaluations(now, detections, context)
        return evaluation, visibility

    def _active(self, world: World, time_s: float) -> list[tuple[Attack, AttackContext]]:
        """Attacks that have begun and have somebody to carry them out."""
        active = []
        for number, (attack, start_s) in enumerate(zip(self.attacks, self.start_s, strict=True)):
            attacker = world.equipped & (world.attack == number + 1)
            if time_s >= start_s and attacker.any():
                active.append((attack, AttackContext(world, attacker, time_s, self.seed, number)))
        return active


def check_shares(params: Sequence[AttackParams]) -> None:
    """ValueError where more vehicles would attack than there are."""
    total = sum(p.share_p for p in params)
    if total > 1 + 1e-9:
        raise ValueError(
            f"attacks: the shares share_p sum to {total:g}, more than all equipped vehicles. "
            "Lower one of them so that they sum to at most 1."
        )


def roles_of(params: Sequence[AttackParams]) -> UInt8[ndarray, "a"]:
    """Code of the role (`results.codes.Role`) that goes with each number of `world.attack`; 0 is honest."""
    return np.array([Role.HONEST, *(Role[p.role.upper()] for p in params)], np.uint8)
