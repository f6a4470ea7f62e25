"""What SUMO's process tells about a step, and the words of its answers."""

from typing import NamedTuple

from jaxtyping import Float, Int
from numpy import ndarray

ANSWERED, ENDED, FAILED = "answered", "ended", "failed"
"""The first word of an answer: it holds the result, why the traffic has ended, or SUMO's error."""


class NewActor(NamedTuple):
    """An actor that is on the road for the first time."""

    domain: str
    """`vehicle` or `person`."""
    name: str
    vclass: str
    """SUMO's vehicle class."""
    lwh_m: tuple[float, float, float]
    """Length, width and height [m], as SUMO has them."""


class Snapshot(NamedTuple):
    """What SUMO knows of all actors after a step."""

    new: list[NewActor]
    """They have the next numbers."""
    number: Int[ndarray, "n"]
    """Number of each actor on the road: its place among all `NewActor` of the simulation."""
    front_m: Float[ndarray, "n 3"]
    """Centres of the front bumpers, in the network's coordinates [m]."""
    compass_deg: Float[ndarray, "n"]
    """Headings, clockwise from north."""
    speed_mps: Float[ndarray, "n"]
    n_waiting: int
    """Vehicles that wait to enter."""
    n_teleports: int
    """Teleports since the warm-up."""
    n_collisions: int
    """Pairs of vehicles that have collided since the warm-up. 0 without a driver."""
