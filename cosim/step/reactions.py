"""The reasons of drivers' commands, with ground truth about the objects. The simulation never reads it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.messages.content import FABRICATED
from cosim.step.exchange import Exchange
from cosim.step.listing import Listed
from cosim.traffic.driver import SpeedCommands
from cosim.world import World


@dataclass(frozen=True, slots=True)
class Reactions:
    """C commands of one step, sorted by vehicle."""

    commands: SpeedCommands
    deceleration_mps2: Float[ndarray, "c"]
    """Deceleration from the present speed to the commanded one within a step."""
    fabricated: Bool[ndarray, "c"]
    """Whether an attack fabricated the object."""
    truth_actor: Int[ndarray, "c"]
    is_real: Bool[ndarray, "c"]
    """Whether the actor exists."""


@dataclass(frozen=True, slots=True)
class DetectionTruth:
    """Ground truth of the D detections of one step, sorted by key."""

    step: int
    key: Int[ndarray, "d"]
    """Pseudonym of the observer and index of the detection in one number."""
    fabricated: Bool[ndarray, "d"]
    is_real: Bool[ndarray, "d"]
    actor: Int[ndarray, "d"]
    """Actor number; meaningful only if it is real."""


@dataclass(frozen=True, slots=True)
class ReactionTruth:
    """Ground truth of the detections to which drivers may still react."""

    steps: tuple[DetectionTruth, ...] = ()

    def next(self, exchange: Exchange, listed: Listed, kept_s: float, dt_s: float) -> "ReactionTruth":
        """Add the detections of one step and drop those that are older than `kept_s`."""
        world, truth = exchange.world, listed.truth
        key = _key(exchange.senders.pseudonym[listed.detections.message], listed.objects.detection_index)
        order = np.argsort(key)
        now = DetectionTruth(
            step=world.step,
            key=key[order],
            fabricated=(listed.objects.origin == FABRICATED)[order],
            is_real=truth.is_real[order],
            actor=world.actor[truth.actor_row][order].astype(np.int64),
        )
        oldest = world.step - kept_s / dt_s - 1e-9
        kept = [one for one in self.steps if one.step >= oldest]
        return ReactionTruth((*kept, now))

    def of(self, commands: SpeedCommands, world: World, dt_s: float) -> Reactions | None:
        """The commands with ground truth about the objects; None if the driver gives no reasons."""
        why, n = commands.reasons, len(commands)
        if why is None:
            return None
        fabricated = np.zeros(n, bool)
        is_real = np.zeros(n, bool)
        truth_actor = np.zeros(n, np.int64)
        wanted = _key(why.source, why.source_index)
        for then in self.steps:
            rows = np.flatnonzero(why.source_step == then.step)
            at = np.searchsorted(then.key, wanted[rows])
            at = np.minimum(at, len(then.key) - 1)
            found = then.key[at] == wanted[rows]
            rows, at = rows[found], at[found]
            fabricated[rows] = then.fabricated[at]
            is_real[rows] = then.is_real[at]
            truth_actor[rows] = then.actor[at]
        speed = world.speed_mps[np.searchsorted(world.actor, commands.actor)]
        return Reactions(
            commands=commands,
            deceleration_mps2=(speed - commands.speed_mps) / dt_s,
            fabricated=fabricated,
            truth_actor=truth_actor,
            is_real=is_real,
        )


def _key(
    pseudonym: Int[ndarray, "n"],
    index: Int[ndarray, "n"],
) -> Int[ndarray, "n"]:
    return pseudonym.astype(np.int64) << 20 | index.astype(np.int64)
