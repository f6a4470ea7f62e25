"""What an attack is: hooks on what its vehicles send, and what it may know.

An attack is a class with a frozen dataclass `Params` (its own parameters, read from its `[[attacks]]` section), a
constructor that takes one, and one or more of the hooks of `Attack`. It never sees what detections really are: only
what its vehicles perceive, receive and know of the world's poses, as radio messages would tell them.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.adversary import victims
from cosim.adversary.params import AttackParams
from cosim.rng import Stream
from cosim.v2x.messages import FABRICATED, Detections
from cosim.world import World
from sensors.boxes import Boxes
from sensors.line_of_sight import WallIndex


@dataclass(frozen=True, slots=True)
class AttackContext:
    """What an attack knows in one step; N actors of the world."""

    world: World
    """Poses of all actors; rows are what detections call observer."""
    attacker: Bool[ndarray, "n"]
    """Actors that carry out this attack now, by row of the world."""
    time_s: float
    """Since recording began [s]."""
    seed: int
    number: int
    """Position of the attack in the config."""
    params: AttackParams = field(default_factory=AttackParams)
    """Who, when, whom."""
    member: Bool[ndarray, "n"] = field(default_factory=lambda: np.zeros(0, bool))
    """Actors of this attack, those included that are honest at the moment."""
    ring: Int[ndarray, "n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Ring of colluders of each member; read only there."""
    n_active: Int[ndarray, "n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Messages that each attacker has sent since it began, or began again, this one not included."""
    memory: dict[str, Any] = field(default_factory=dict)
    """What the attack keeps from step to step, by names of its own."""
    walls: WallIndex | None = None
    """Buildings, as every map shows them; None without any."""
    n_identities: Int[ndarray, "n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Identities beside its own under which each actor sends in this step; told to `detections` alone."""

    def uniforms(self, *names: ndarray, n: int = 1) -> Float[ndarray, "rows n"]:
        """`n` uniforms in [0, 1) of this step for each row of names (`world.name_key`, detection indices, ...).

        The same whatever else happens, so that switching an attack off changes no other draw.
        """
        return rng.uniforms(rng.key(self.seed, Stream.ATTACK, self.world.step), np.uint64(self.number), *names, n=n)

    def lasting(self, *names: ndarray, n: int = 1) -> Float[ndarray, "rows n"]:
        """`n` uniforms in [0, 1) for each row of names, the same in every step."""
        return rng.uniforms(rng.key(self.seed, Stream.ATTACK_LASTING), np.uint64(self.number), *names, n=n)

    def draw(self, stream: Stream, *names: ndarray, n: int = 1) -> Float[ndarray, "rows n"]:
        """The same as `uniforms` from a stream of the attack's own."""
        return rng.uniforms(rng.key(self.seed, stream, self.world.step), *names, n=n)

    def name_key(self, rows: Int[ndarray, "r"]) -> UInt64[ndarray, "r"]:
        """Names of actors by row, for draws."""
        return self.world.name_key[rows]

    def own_rows(self, listed: Detections) -> Int[ndarray, "r"]:
        """Detections of attackers, self reports included."""
        return np.flatnonzero(self.attacker[listed.observer])

    def victims(self) -> tuple[Int[ndarray, "b"], Int[ndarray, "b"]]:
        """Attackers that have a victim within range, and their victims; rows of the world."""
        rows = np.flatnonzero(self.attacker)
        draw = self.uniforms(self.name_key(rows))[:, 0] if self.params.victim == "random" else np.zeros(len(rows))
        return victims.victims(self.world, rows, self.params, draw, self.seed)

    def victim_of(self) -> Int[ndarray, "n"]:
        """Victim of each actor, a row of the world; -1 for those without."""
        attacker, victim = self.victims()
        found = np.full(len(self.world), -1)
        found[attacker] = victim
        return found


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


LOUDEST_DBM = 33.0
"""Largest power that ITS-G5 allows [dBm]."""


@dataclass(frozen=True, slots=True)
class Sending:
    """How each actor sends its messages in a step; rows of the world."""

    delay_s: Float[ndarray, "n"]
    """Added before its detection message is generated [s]."""
    n_copies: Int[ndarray, "n"]
    """Further copies of its detection message, on the air beside the first."""
    n_reports: Int[ndarray, "n"]
    """Further copies of its report to the trust server."""
    jam_dbm: Float[ndarray, "n"]
    """Power of noise that it transmits all the time; -inf for none [dBm]."""
    react_dbm: Float[ndarray, "n"]
    """Power of noise that it transmits while it detects a frame; -inf for none [dBm]."""
    ignores_dcc: Bool[ndarray, "n"]
    """Whether it sends without congestion control."""

    @staticmethod
    def plain(n: int) -> "Sending":
        """At once, once, and by the rules of the channel."""
        return Sending(
            delay_s=np.zeros(n), n_copies=np.zeros(n, np.int64), n_reports=np.zeros(n, np.int64),
            jam_dbm=np.full(n, -np.inf), react_dbm=np.full(n, -np.inf), ignores_dcc=np.zeros(n, bool),
        )  # fmt: skip

    def and_also(self, other: "Sending") -> "Sending":
        """Both at a time; of two jammers the stronger."""
        return Sending(
            delay_s=self.delay_s + other.delay_s,
            n_copies=self.n_copies + other.n_copies,
            n_reports=self.n_reports + other.n_reports,
            jam_dbm=np.maximum(self.jam_dbm, other.jam_dbm),
            react_dbm=np.maximum(self.react_dbm, other.react_dbm),
            ignores_dcc=self.ignores_dcc | other.ignores_dcc,
        )

    def take(self, rows: Int[ndarray, "k"]) -> "Sending":
        """These rows."""
        return Sending(**{f.name: getattr(self, f.name)[rows] for f in fields(Sending)})

    def abuses_channel(self) -> Bool[ndarray, "n"]:
        """Who jams, or sends without congestion control."""
        return self.ignores_dcc | (self.jam_dbm > -np.inf) | (self.react_dbm > -np.inf)

    def attacks(self) -> Bool[ndarray, "n"]:
        """Who does anything of it."""
        return (self.delay_s > 0) | (self.n_copies > 0) | (self.n_reports > 0) | self.abuses_channel()


class Attack(Protocol):
    """The four hooks; a class may leave any of them out."""

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists as they will be sent: rows hidden (`transmitted` false), changed, or added by `fabricated`.

        Only rows of `context.attacker` may differ, and no row may go.
        """

    def evaluations(
        self, rows: EvaluationRows, detections: Detections, context: AttackContext
    ) -> tuple[Float[ndarray, "m"], Float[ndarray, "m"]]:
        """Evaluation and visibility as they will be sent."""

    def identities(self, context: AttackContext) -> Int[ndarray, "n"]:
        """Identities beside its own under which each actor sends in this step; rows of the world.

        What it sends under them stands in `Detections.identity`, from 1; its evaluations go out under all of them.
        """

    def sending(self, context: AttackContext) -> Sending:
        """How messages are sent."""


def fabricated(
    listed: Detections, observer: Int[ndarray, "c"], label: ndarray, boxes: Boxes, score: Float[ndarray, "c"],
    target: Int[ndarray, "c"] | None = None, identity: Int[ndarray, "c"] | None = None,
    speed_mps: Float[ndarray, "c"] | None = None,
) -> Detections:  # fmt: skip
    """The lists with fabricated detections added, numbered on from the last of each observer and identity.

    Parameters
    ----------
    observer
        Row of the world of the vehicle that adds each, in any order.
    target
        Row of the world of the vehicle that each is meant for; left out, none in particular.
    identity
        Under which it is sent, 0 (the vehicle's own) for all if not given. The first under another identity has
        index 0: it is that identity's report of itself.
    speed_mps
        As claimed in such a report; not given otherwise.
    """
    n = len(observer)
    identity = np.zeros(n, np.int64) if identity is None else identity
    absent = np.full(n, np.nan)
    added = Detections(
        observer=observer, detection_index=np.arange(n), label=label.astype(np.uint8), boxes=boxes, score=score,
        n_points=np.zeros(n, np.int32), origin=np.full(n, FABRICATED, np.uint8), transmitted=np.ones(n, bool),
        target=observer if target is None else target,
        identity=identity, speed_mps=absent if speed_mps is None else speed_mps, acceleration_mps2=absent,
    )  # fmt: skip
    added = added.take(np.lexsort((identity, observer)))
    most = 1 + max(int(listed.identity.max(initial=0)), int(identity.max(initial=0)))
    sender, own = added.observer * most + added.identity, listed.observer * most + listed.identity
    last = np.full(max(int(own.max(initial=-1)), int(sender.max(initial=-1))) + 1, -1)
    np.maximum.at(last, own, listed.detection_index)
    first = np.searchsorted(sender, sender)
    added = replace(added, detection_index=last[sender] + 1 + np.arange(n) - first)
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
    return xyz, wrapped(yaw + turned_rad)


def per_actor(
    context: AttackContext, name: str, rows: Bool[ndarray, "n"], values: Float[ndarray, "..."] | float
) -> Float[ndarray, "n ..."]:
    """A number (or several) that an attack keeps for each actor: `values` are kept now for the actors of `rows`.

    Parameters
    ----------
    values
        One for all, or one per actor of the world.

    Returns
    -------
    What is kept for each actor of the world; 0 where nothing is.
    """
    actor, shape = context.world.actor, np.shape(values)[1:]
    kept = context.memory.get(name, np.zeros((0, *shape)))
    if (more := int(actor.max(initial=-1)) + 1 - len(kept)) > 0:
        kept = np.concatenate([kept, np.zeros((max(more, 256), *shape))])
    kept[actor[rows]] = np.broadcast_to(values, (len(actor), *shape))[rows]
    context.memory[name] = kept
    return kept[actor]


def wrapped(angle_rad: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """The same angles in (-pi, pi]."""
    return np.pi - np.mod(np.pi - angle_rad, 2 * np.pi)


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
