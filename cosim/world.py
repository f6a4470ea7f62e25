"""The world of one step: every actor on the road, as arrays."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from results.codes import labels
from sensors.boxes import Boxes
from sensors.scene import LABEL_OF_SHAPE, ObjectClass

LABELS = labels(ObjectClass)
"""Object classes that a detector distinguishes, by code."""


@dataclass(frozen=True, slots=True)
class World:
    """N actors of one step, sorted by `actor`; world frame (x east, y north, z up; SUMO's net origin).

    An actor's number is given at its first appearance and never reused. `name_key` is the hash of its name; random
    draws are keyed by it, so that they do not depend on the numbering.
    """

    step: int
    actor: Int[ndarray, "n"]
    name_key: UInt64[ndarray, "n"]
    shape: UInt8[ndarray, "n"]
    boxes: Boxes
    speed_mps: Float[ndarray, "n"]
    equipped: Bool[ndarray, "n"]
    attack: UInt8[ndarray, "n"]  # number of the attack that it carries out, from 1 in the config's order; 0 for none

    def __len__(self) -> int:
        return len(self.actor)

    @property
    def label(self) -> UInt8[ndarray, "n"]:
        """Object class code of each actor."""
        return LABEL_OF_SHAPE[self.shape]
