"""The world of one step: every actor on the road, as arrays."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from sensors.boxes import Boxes
from sensors.scene import LABEL_OF_SHAPE, ObjectClass

LABELS = tuple(label.name.lower() for label in ObjectClass)
"""Object classes that a detector tells apart, by code."""

BEHAVIOURS = ("honest", "unreliable", "malicious")
"""How an equipped vehicle reports, by code."""

HONEST, UNRELIABLE, MALICIOUS = range(3)


@dataclass(frozen=True, slots=True)
class World:
    """N actors of one step, sorted by `actor`; world frame (x east, y north, z up; SUMO's net origin).

    An actor's number is given at its first appearance and never re-used; `name_key` is the hash of its
    name by which chance knows it.
    """

    step: int
    actor: Int[ndarray, "n"]
    name_key: UInt64[ndarray, "n"]
    shape: UInt8[ndarray, "n"]
    boxes: Boxes
    speed_mps: Float[ndarray, "n"]
    equipped: Bool[ndarray, "n"]
    behaviour: UInt8[ndarray, "n"]

    def __len__(self) -> int:
        return len(self.actor)

    @property
    def label(self) -> UInt8[ndarray, "n"]:
        """Object class code of each actor."""
        return LABEL_OF_SHAPE[self.shape]
