"""What an attack is: two hooks on what its vehicles send, and what it may know.

An attack is a class with a frozen dataclass `Params` (its own parameters, read from its `[[attacks]]` section), a
constructor that takes one, and one or both of the hooks of `Attack`. It never sees what detections really are: only
what its vehicles perceive, receive and know of the world's poses, as radio messages would tell them.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.rng import Stream
from cosim.v2x.messages import FABRICATED, Detections
from cosim.world import World
from sensors.boxes import Boxes


@dataclass(frozen=True, slots=True)
class AttackContext:
    """What an attack knows in one step."""

    world: World
    """Poses of all actors; rows are what detections call observer."""
    attacker: Bool[ndarray, "n"]
    """Actors that carry out this attack now, by row of the world."""
    time_s: float
    """Since recording began [s]."""
    seed: int
    number: int
    """Position of the attack in the config."""

    def uniforms(self, *names: ndarray, n: int = 1) -> Float[ndarray, "rows n"]:
        """`n` uniforms in [0, 1) of this step for each row of names (`world.name_key`, detection indices, ...).

        The same whatever else happens, so that switching an attack off changes no other draw.
        """
        number = np.asarray(self.number, np.uint64)
        return rng.uniforms(rng.key(self.seed, Stream.ATTACK, self.world.step), number, *names, n=n)

    def draw(self, stream: Stream, *names: ndarray, n: int = 1) -> Float[ndarray, "rows n"]:
        """The same from a stream of the attack's own."""
        return rng.uniforms(rng.key(self.seed, stream, self.world.step), *names, n=n)

    def name_key(self, rows: Int[ndarray, "r"]) -> UInt64[ndarray, "r"]:
        """Names of actors by row, for draws."""
        return self.world.name_key[rows]


@dataclass(frozen=True, slots=True)
class EvaluationRows:
    """M evaluations of one step before they are sent, by evaluator, then detection."""

    evaluator: Int[ndarray, "m"]
    """Row of the world."""
    detection: Int[ndarray, "m"]
    """Row of the step's detections."""
    evaluation: Float[ndarray, "m"]
    """In [-1, 1]."""
    visibility: Float[ndarray, "m"]
    """In [0, 1]."""


class Attack(Protocol):
    """The two hooks; a class may leave either out."""

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists as they will be sent: rows hidden (`transmitted` false), changed, or added by `fabricated`.

        Only rows of `context.attacker` may differ.
        """

    def evaluations(
        self, rows: EvaluationRows, detections: Detections, context: AttackContext
    ) -> tuple[Float[ndarray, "m"], Float[ndarray, "m"]]:
        """Evaluation and visibility as they will be sent."""


def fabricated(
    listed: Detections, observer: Int[ndarray, "c"], label: ndarray, boxes: Boxes, score: Float[ndarray, "c"],
    target: Int[ndarray, "c"] | None = None,
) -> Detections:  # fmt: skip
    """The lists with fabricated detections added, numbered on from each observer's last.

    Parameters
    ----------
    observer
        Row of the world of the vehicle that adds each, in any order.
    target
        Row of the world of the vehicle that each is meant for; left out, none in particular.
    """
    n = len(observer)
    added = Detections(
        observer=observer, detection_index=np.arange(n), label=label.astype(np.uint8), boxes=boxes, score=score,
        n_points=np.zeros(n, np.int32), origin=np.full(n, FABRICATED, np.uint8), transmitted=np.ones(n, bool),
        target=observer if target is None else target,
    )  # fmt: skip
    added = added.take(np.argsort(observer, kind="stable"))
    last = np.full(max(int(listed.observer.max(initial=-1)), int(observer.max(initial=-1))) + 1, -1)
    np.maximum.at(last, listed.observer, listed.detection_index)
    first = np.searchsorted(added.observer, added.observer)
    added = replace(added, detection_index=last[added.observer] + 1 + np.arange(n) - first)
    return Detections.concat([listed, added])


def placed(
    world: World, row: Int[ndarray, "c"], ahead_m: ndarray, left_m: ndarray, turned_rad: ndarray
) -> tuple[Float[ndarray, "c 3"], Float[ndarray, "c"]]:
    """Places and headings relative to actors: metres ahead of and left of the centre, radians from its heading."""
    yaw = world.boxes.yaw_rad[row]
    c, s = np.cos(yaw), np.sin(yaw)
    xyz = world.boxes.xyz_m[row].copy()
    xyz[:, 0] += c * ahead_m - s * left_m
    xyz[:, 1] += s * ahead_m + c * left_m
    turned = yaw + turned_rad
    return xyz, np.pi - np.mod(np.pi - turned, 2 * np.pi)


def certified(
    rows: EvaluationRows, detections: Detections, context: AttackContext
) -> tuple[Float[ndarray, "m"], Float[ndarray, "m"]]:
    """Evaluations in which attackers vouch for what they fabricated themselves: evaluation and visibility 1 [1]_.

    References
    ----------
    .. [1] Hurl, Cohen, Czarnecki, Waslander, "TruPercept", 2020: the published code's malicious vehicles.
    """
    own = rows.evaluator == detections.observer[rows.detection]
    vouched = own & context.attacker[rows.evaluator] & (detections.origin[rows.detection] == FABRICATED)
    return np.where(vouched, 1.0, rows.evaluation), np.where(vouched, 1.0, rows.visibility)
