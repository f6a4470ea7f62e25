"""What a driver is, and the one that never reacts."""

from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.world import World
from sensors.boxes import Boxes


@dataclass(frozen=True, slots=True)
class Beliefs:
    """Fused objects of all equipped vehicles in one step, by vehicle; world frame."""

    known_s: float
    """Time at which the vehicles have fused them [s]; the boxes are those of the step's sweeps."""
    ego: Int[ndarray, "f"]
    """Row of the world of the vehicle that believes."""
    label: UInt8[ndarray, "f"]
    """Class of the object."""
    boxes: Boxes
    score: Float[ndarray, "f"]
    """In [0, 1]."""
    ego_detected: Bool[ndarray, "f"]
    """Whether the vehicle's own detector reports it."""
    source: Int[ndarray, "f"]
    """Pseudonym of the vehicle whose detection of this step gave the box."""
    source_index: Int[ndarray, "f"]
    """Number of that detection in its list."""


@dataclass(frozen=True, slots=True)
class Reasons:
    """What each command answers to: one object per command."""

    source_step: Int[ndarray, "c"]
    """Step of the detection of the object."""
    source: Int[ndarray, "c"]
    """Pseudonym of the vehicle that made it."""
    source_index: Int[ndarray, "c"]
    gap_m: Float[ndarray, "c"]
    """From the front bumper to the object along the lane path."""

    def take(self, rows: ndarray) -> "Reasons":
        """These rows, in this order."""
        return Reasons(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True, slots=True)
class SpeedCommands:
    """Speeds that vehicles shall drive in the next step; those not named drive by the traffic model."""

    actor: Int[ndarray, "c"]
    """Ascending, each once."""
    speed_mps: Float[ndarray, "c"]
    reasons: Reasons | None = None
    """None where the driver gives none: nothing is written to the table `reactions` then."""

    def __len__(self) -> int:
        return len(self.actor)

    @staticmethod
    def none() -> "SpeedCommands":
        """No vehicle is commanded."""
        return SpeedCommands(np.zeros(0, np.int64), np.zeros(0))


class Driver(Protocol):
    """From beliefs to commands; `state` is whatever the driver keeps from step to step, None at first.

    A class attribute `LARGEST_STEP_S` says the longest step of traffic that it can command [s]; with one, longer steps
    and replayed traffic are refused before the run begins.
    """

    def commands(
        self, state: object, world: World, beliefs: Beliefs | None, dt_s: float
    ) -> tuple[object, SpeedCommands]:
        """The new state, and the commands that mobility carries out in the next step.

        Called in every step; `beliefs` is None between two sweeps. `world.paths` are the lane paths ahead.
        """


class Unaffected:
    """A driver that sees with its own eyes only: no commands."""

    def commands(
        self, state: object, world: World, beliefs: Beliefs | None, dt_s: float
    ) -> tuple[object, SpeedCommands]:
        """None."""
        return None, SpeedCommands.none()


@dataclass(frozen=True, kw_only=True, slots=True)
class DriverParams:
    """What belief does to traffic."""

    model: str = "none"
    """How drivers react to what their vehicles believe: none, cautious, or your own as path.py:Name."""


def largest_step_s(driver: type) -> float | None:
    """Longest step of traffic that a class of drivers can command [s]; None where it does not say."""
    return getattr(driver, "LARGEST_STEP_S", None)
