"""The world of one step: every actor on the road, as arrays."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.base.codes import ObjectClass, labels
from sensors.boxes import Boxes
from sensors.scene import LABEL_OF_SHAPE, Shape

LABELS = labels(ObjectClass)
"""Object classes that a detector distinguishes, by code."""


@dataclass(frozen=True, slots=True)
class LanePaths:
    """Centre lines of the lanes that P vehicles have ahead of them on their routes; world frame, seen from above.

    Vehicles on one lane with the same way ahead share a line, which begins where their present lane begins.
    """

    row: Int[ndarray, "p"]
    """Row of the world, ascending."""
    line: Int[ndarray, "p"]
    front_m: Float[ndarray, "p"]
    """Where on the line its front bumper is, from the line's begin."""
    ptr: Int[ndarray, "l+1"]
    """Vertices of line i are ptr[i]:ptr[i + 1]; there are two or more."""
    xy_m: Float[ndarray, "v 2"]
    along_m: Float[ndarray, "v"]
    """Distance of each vertex from its line's begin."""


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
    paths: LanePaths | None = None  # of the equipped vehicles; None where no driver asks for them

    def __len__(self) -> int:
        return len(self.actor)

    @property
    def label(self) -> UInt8[ndarray, "n"]:
        """Object class code of each actor."""
        return LABEL_OF_SHAPE[self.shape]

    @property
    def is_roadside(self) -> Bool[ndarray, "n"]:
        """Whether each actor is a roadside unit, which senses, sends and evaluates but is no traffic."""
        return self.shape == Shape.ROADSIDE_UNIT

    def take(self, rows: Int[ndarray, "k"]) -> "World":
        """The actors in these rows, ascending, without the lanes ahead of them."""
        return World(
            step=self.step,
            actor=self.actor[rows],
            name_key=self.name_key[rows],
            shape=self.shape[rows],
            boxes=self.boxes.take(rows),
            speed_mps=self.speed_mps[rows],
            equipped=self.equipped[rows],
            attack=self.attack[rows],
        )
