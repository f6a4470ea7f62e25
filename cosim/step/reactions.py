"""Why vehicles are commanded, with the truth about what they react to. The simulation never reads it."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.driver.driver import SpeedCommands
from cosim.step.ground_truth import GroundTruth
from cosim.v2x.messages import FABRICATED, Detections
from cosim.world import World

_KEPT_S = 10.0
"""How long the truth about detections is kept for reactions to them."""


@dataclass(frozen=True, slots=True)
class Reactions:
    """C commands of one step, by vehicle."""

    commands: SpeedCommands
    deceleration_mps2: Float[ndarray, "c"]
    """From the present speed to the commanded one within a step."""
    fabricated: Bool[ndarray, "c"]
    """The object was fabricated by an attack."""
    truth_actor: Int[ndarray, "c"]
    is_real: Bool[ndarray, "c"]
    """There is such an actor."""


@dataclass(slots=True)
class ReactionTruth:
    """The truth about the detections of the last seconds, by their names."""

    kept: list[tuple[int, Int[ndarray, "d"], Bool[ndarray, "d"], Bool[ndarray, "d"], Int[ndarray, "d"]]] = field(
        default_factory=list
    )
    """Per step: key, fabricated, real, actor; sorted by key."""

    def add(
        self, world: World, listed: Detections, truth: GroundTruth, pseudonym: Int[ndarray, "d"], dt_s: float
    ) -> None:
        """The detections of a step; `pseudonym` is that of each one's observer."""
        key = _key(pseudonym, listed.detection_index)
        order = np.argsort(key)
        actor = world.actor[truth.actor_row][order].astype(np.int64)
        self.kept = [k for k in self.kept if (world.step - k[0]) * dt_s <= _KEPT_S]
        self.kept.append((world.step, key[order], (listed.origin == FABRICATED)[order], truth.is_real[order], actor))

    def of(self, commands: SpeedCommands, world: World, dt_s: float) -> Reactions | None:
        """The commands with what they really answer to; None where the driver gives no reasons."""
        why, n = commands.reasons, len(commands)
        if why is None:
            return None
        fabricated, is_real, truth_actor = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, np.int64)
        wanted = _key(why.source, why.source_index)
        for step, key, fabricated_then, real_then, actor_then in self.kept:
            rows = np.flatnonzero(why.source_step == step)
            at = np.minimum(np.searchsorted(key, wanted[rows]), len(key) - 1)
            found = key[at] == wanted[rows]
            rows, at = rows[found], at[found]
            fabricated[rows], is_real[rows], truth_actor[rows] = fabricated_then[at], real_then[at], actor_then[at]
        speed = world.speed_mps[np.searchsorted(world.actor, commands.actor)]
        return Reactions(commands, (speed - commands.speed_mps) / dt_s, fabricated, truth_actor, is_real)


def _key(pseudonym: Int[ndarray, "n"], index: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    return pseudonym.astype(np.int64) << 20 | index.astype(np.int64)
