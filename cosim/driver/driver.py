"""What a driver is, and the one that never reacts."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.world import World
from sensors.boxes import Boxes


@dataclass(frozen=True, slots=True)
class Beliefs:
    """Fused objects of all equipped vehicles in one step, by vehicle; world frame."""

    ego: Int[ndarray, "f"]
    """Row of the world of the vehicle that believes."""
    label: UInt8[ndarray, "f"]
    """Class of the object."""
    boxes: Boxes
    score: Float[ndarray, "f"]
    """In [0, 1]."""
    ego_detected: Bool[ndarray, "f"]
    """Whether the vehicle's own detector reports it."""


@dataclass(frozen=True, slots=True)
class SpeedCommands:
    """Speeds that vehicles shall drive in the next step; NaN gives the speed back to the traffic model."""

    actor: Int[ndarray, "c"]
    speed_mps: Float[ndarray, "c"]

    def __len__(self) -> int:
        return len(self.actor)

    @staticmethod
    def none() -> "SpeedCommands":
        return SpeedCommands(np.zeros(0, np.int64), np.zeros(0))


class Driver(Protocol):
    """From beliefs to commands; `state` is whatever the driver keeps from step to step, None at first."""

    def commands(self, state: object, world: World, beliefs: Beliefs, dt_s: float) -> tuple[object, SpeedCommands]:
        """The new state, and the commands that mobility carries out in the next step."""


class Unaffected:
    """A driver that sees with its own eyes only: no commands."""

    def commands(self, state: object, world: World, beliefs: Beliefs, dt_s: float) -> tuple[object, SpeedCommands]:
        """None."""
        return None, SpeedCommands.none()


DRIVERS: Mapping[str, type] = {"none": Unaffected}
"""Drivers at hand, by the config's name."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DriverParams:
    """What belief does to traffic."""

    model: str = "none"
    """How drivers react to what their vehicles believe: none, or your own as path.py:Name."""
