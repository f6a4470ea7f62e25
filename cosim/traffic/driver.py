"""Interface of drivers, and the driver `none`, which never reacts."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.addons import Choices
from cosim.base.rows import Rows
from cosim.world import World
from sensors.boxes import Boxes


@dataclass(frozen=True, slots=True)
class Beliefs:
    """Fused objects of all equipped vehicles in one step, sorted by vehicle; world frame."""

    known_s: float
    """Time at which the vehicles finished the fusion [s]. The boxes are of the time of the step's sweeps."""
    ego: Int[ndarray, "f"]
    """Vehicle that fused the object, as a row of the world."""
    label: UInt8[ndarray, "f"]
    """Class of the object."""
    boxes: Boxes
    score: Float[ndarray, "f"]
    """In [0, 1]."""
    ego_detected: Bool[ndarray, "f"]
    """Whether the vehicle's own detector reports the object."""
    source: Int[ndarray, "f"]
    """Pseudonym of the vehicle whose detection gave the box."""
    source_index: Int[ndarray, "f"]
    """Index of that detection in the vehicle's list."""
    source_step: Int[ndarray, "f"]
    """Step of that detection."""


@dataclass(frozen=True, slots=True)
class Reasons(Rows):
    """The object that is the reason of each command."""

    source_step: Int[ndarray, "c"]
    """Step in which the object was detected."""
    source: Int[ndarray, "c"]
    """Pseudonym of the vehicle that detected it."""
    source_index: Int[ndarray, "c"]
    gap_m: Float[ndarray, "c"]
    """Distance from the front bumper to the object along the lane path."""


@dataclass(frozen=True, slots=True)
class SpeedCommands:
    """Commanded speeds of vehicles in the next step. All other vehicles drive as the traffic model says."""

    actor: Int[ndarray, "c"]
    """Actor numbers, ascending, each once."""
    speed_mps: Float[ndarray, "c"]
    reasons: Reasons | None = None
    """Reasons of the commands. If it is None, nothing is written to the table `reactions`."""

    def __len__(self) -> int:
        return len(self.actor)

    @staticmethod
    def none() -> "SpeedCommands":
        """Commands for no vehicle."""
        return SpeedCommands(np.zeros(0, np.int64), np.zeros(0))


class Driver(Protocol):
    """Turns fused objects into speed commands. `state` is what the driver stores between steps, None at first.

    The class attribute `LARGEST_STEP_S` is the longest traffic step that the driver can command [s]. If a class has it,
    longer steps and replayed traffic are refused before the run begins. The attribute `memory_s` says how long after it
    was last known an object may be the reason of a command [s]; without it, 10 s.
    """

    def commands(
        self, state: object, world: World, beliefs: Beliefs | None, dt_s: float
    ) -> tuple[object, SpeedCommands]:
        """Decide the commands of one step. The method is called in every step.

        Parameters
        ----------
        state
            The state that the method returned in the previous step; None at first.
        world
            Actors of this step. `world.paths` are the lane paths of equipped vehicles.
        beliefs
            Fused objects of this step's sweeps. None between two sweeps.
        dt_s
            Length of one traffic step.

        Returns
        -------
        The new state, and the commands for the next step.
        """


class Unaffected:
    """A driver that never reacts to fused objects."""

    def commands(
        self, state: object, world: World, beliefs: Beliefs | None, dt_s: float
    ) -> tuple[object, SpeedCommands]:
        """No commands."""
        return None, SpeedCommands.none()


@dataclass(frozen=True, kw_only=True, slots=True)
class DriverParams:
    """How drivers react to the objects that their vehicles fuse."""

    model: str = "none"
    """Model of the drivers: `none`, `cautious`, or a class of your own as path.py:Name."""


def largest_step_s(driver: type) -> float | None:
    """Longest traffic step that a class of drivers can command [s]. None if the class does not define it."""
    return getattr(driver, "LARGEST_STEP_S", None)


def memory_s(driver: object) -> float:
    """How long after it was last known an object may be the reason of a driver's command [s]."""
    return getattr(driver, "memory_s", 10.0)


DRIVERS: Mapping[str, type] = Choices("driver", {"none": Unaffected})
"""Classes of the included drivers, by their name in the config."""
