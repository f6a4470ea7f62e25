"""Interface of attacks: methods that change what attackers send, and the information that they get.

An attack is a class with one or more of the methods of `Attack`. Its own parameters are a frozen dataclass `Params`,
which is read from its `[[attacks]]` section and given to the constructor. An attack does not know which detections are
true. It knows what its vehicles perceive and receive, and the poses of actors, as radio messages would tell them.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim.attacks import victims
from cosim.attacks.params import AttackParams
from cosim.base import rng
from cosim.base.plane import turned_by, wrapped
from cosim.base.ragged import place_in_group
from cosim.base.rng import Stream
from cosim.base.rows import Rows, no_rows
from cosim.messages.content import FABRICATED, Detections
from cosim.world import World
from sensors.boxes import Boxes
from sensors.line_of_sight import WallIndex

P = TypeVar("P")


@dataclass(frozen=True, slots=True)
class AttackContext:
    """What an attack knows in one step. N is the number of actors in the world."""

    world: World
    """Poses of all actors. `Detections.observer` is a row of it."""
    attacker: Bool[ndarray, "n"]
    """Actors that carry out this attack in this step, by row of the world."""
    time_s: float
    """Time since recording began [s]."""
    seed: int
    number: int
    """Position of the attack in the config."""
    params: AttackParams = field(default_factory=AttackParams)
    """The keys that every `[[attacks]]` section has."""
    member: Bool[ndarray, "n"] = no_rows(bool)
    """All actors of this attack, including those that are honest in this step."""
    ring: Int[ndarray, "n"] = no_rows(np.int64)
    """Ring of colluders of each member. Values of other actors have no meaning."""
    n_active: Int[ndarray, "n"] = no_rows(np.int64)
    """Number of messages that each attacker has sent since it last began, without this one."""
    memory: dict[str, Any] = field(default_factory=dict)
    """What the attack stores between steps, under names of its choice."""
    walls: WallIndex | None = None
    """Walls of the buildings. None if there are none."""
    n_identities: Int[ndarray, "n"] = no_rows(np.int64)
    """Number of identities under which each actor sends in this step, in addition to its own. Given to `detections`
    only."""

    seen: Detections | None = None
    """What the detectors of all vehicles found in this step, before any attack: how real detections look. Given to
    `phantoms` and `detections` only."""

    def uniforms(self, *names: ndarray, n: int = 1) -> Float[ndarray, "rows n"]:
        """Draw `n` uniforms in [0, 1) of this step for each row of names (`world.name_key`, detection indices, ...).

        They depend on the names, the step and the seed only, so that switching off an attack changes no other draw.
        """
        key = rng.key(self.seed, Stream.ATTACK, self.world.step)
        return rng.uniforms(key, np.uint64(self.number), *names, n=n)

    def lasting(self, *names: ndarray, n: int = 1) -> Float[ndarray, "rows n"]:
        """Draw `n` uniforms in [0, 1) for each row of names, the same in every step."""
        key = rng.key(self.seed, Stream.ATTACK_LASTING)
        return rng.uniforms(key, np.uint64(self.number), *names, n=n)

    def draw(self, stream: Stream, *names: ndarray, n: int = 1) -> Float[ndarray, "rows n"]:
        """Draw uniforms like `uniforms`, from another stream of random numbers."""
        return rng.uniforms(rng.key(self.seed, stream, self.world.step), *names, n=n)

    def name_key(self, rows: Int[ndarray, "r"]) -> UInt64[ndarray, "r"]:
        """Keys of the names of actors, by row of the world, for draws."""
        return self.world.name_key[rows]

    def own_rows(self, listed: Detections) -> Int[ndarray, "r"]:
        """Rows of `listed` that are detections of attackers, self reports included; ascending."""
        return np.flatnonzero(self.attacker[listed.observer])

    def victims(self) -> tuple[Int[ndarray, "b"], Int[ndarray, "b"]]:
        """Attackers that have a victim within range, ascending, and the victim of each; both as rows of the world."""
        rows = np.flatnonzero(self.attacker)
        draw = np.zeros(len(rows))
        if self.params.victim == "random":
            draw = self.uniforms(self.name_key(rows))[:, 0]
        return victims.victims(self.world, rows, self.params, draw, self.seed)

    def victim_of(self) -> Int[ndarray, "n"]:
        """Victim of each actor as a row of the world; -1 if it has none."""
        attacker, victim = self.victims()
        found = np.full(len(self.world), -1)
        found[attacker] = victim
        return found


@dataclass(frozen=True, slots=True)
class EvaluationRows:
    """M evaluations of one step before they are sent, sorted by evaluator, then detection."""

    evaluator: Int[ndarray, "m"]
    """Row of the world."""
    detection: Int[ndarray, "m"]
    """Row of the step's detections."""
    evaluation: Float[ndarray, "m"]
    """In [-1, 1]."""
    visibility: Float[ndarray, "m"]
    """In [0, 1]."""
    number: Int[ndarray, "m"] | None = None
    """Number of what the evaluation is about (`trust.claims.claim_number`); None if all are about detections."""

    @property
    def about(self) -> Int[ndarray, "m"]:
        """Rows about the same have the same number, from 0; the row of the detection if all are about detections."""
        if self.number is None:
            return self.detection
        key = self.detection.astype(np.int64) << 32 | self.number
        return np.unique(key, return_inverse=True)[1].reshape(-1)


LOUDEST_DBM = 33.0
"""Largest power that ITS-G5 allows [dBm]."""


@dataclass(frozen=True, slots=True)
class Sending(Rows):
    """How each actor sends its messages in a step, by row of the world."""

    delay_s: Float[ndarray, "n"]
    """Delay that is added before its detection message is generated [s]."""
    n_copies: Int[ndarray, "n"]
    """Number of copies of its detection message that it sends in addition to the first."""
    n_reports: Int[ndarray, "n"]
    """Number of copies of its report to the trust server in addition to the first."""
    jam_dbm: Float[ndarray, "n"]
    """Power of noise that it transmits all the time [dBm]; -inf for none."""
    react_dbm: Float[ndarray, "n"]
    """Power of noise that it transmits while it detects a frame [dBm]; -inf for none."""
    ignores_dcc: Bool[ndarray, "n"]
    """Whether it sends without congestion control."""

    @staticmethod
    def plain(n: int) -> "Sending":
        """Honest sending: without delay, without copies, and by the rules of the channel."""
        return Sending(
            delay_s=np.zeros(n),
            n_copies=np.zeros(n, np.int64),
            n_reports=np.zeros(n, np.int64),
            jam_dbm=np.full(n, -np.inf),
            react_dbm=np.full(n, -np.inf),
            ignores_dcc=np.zeros(n, bool),
        )

    def and_also(self, other: "Sending") -> "Sending":
        """Both attacks at the same time. Delays and copies add up; of two jamming powers the larger is used."""
        return Sending(
            delay_s=self.delay_s + other.delay_s,
            n_copies=self.n_copies + other.n_copies,
            n_reports=self.n_reports + other.n_reports,
            jam_dbm=np.maximum(self.jam_dbm, other.jam_dbm),
            react_dbm=np.maximum(self.react_dbm, other.react_dbm),
            ignores_dcc=self.ignores_dcc | other.ignores_dcc,
        )

    def abuses_channel(self) -> Bool[ndarray, "n"]:
        """Actors that jam, or send without congestion control."""
        jams_dbm = np.maximum(self.jam_dbm, self.react_dbm)
        return self.ignores_dcc | (jams_dbm > -np.inf)

    def attacks(self) -> Bool[ndarray, "n"]:
        """Actors that do not send honestly."""
        repeats = (self.n_copies > 0) | (self.n_reports > 0)
        return (self.delay_s > 0) | repeats | self.abuses_channel()


class Attack(Protocol):
    """The five methods of an attack. A class has one or more of them."""

    def phantoms(self, seen: Detections, context: AttackContext) -> Detections:
        """What detectors find, with the phantoms that real objects of the attackers make them report.

        The vehicles that report phantoms need not attack. To them, phantoms are detections like all others: they track
        them, send them and confirm them. Sweeps of vehicles have no returns of the objects.

        Parameters
        ----------
        seen
            What the detectors of all vehicles that sense in this step found, and their self reports, at true positions.

        Returns
        -------
        All rows of `seen` unchanged, and phantoms that `fabricated` added for observers in `seen`. The `target` of a
        phantom is the attacker whose object causes it.
        """

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The detection lists as they will be sent.

        Rows can be hidden (`transmitted` false), changed, or added with `fabricated`. Only detections of
        `context.attacker` may differ, and no row may be removed.
        """

    def evaluations(
        self, rows: EvaluationRows, detections: Detections, context: AttackContext
    ) -> tuple[Float[ndarray, "m"], Float[ndarray, "m"]]:
        """Evaluation in [-1, 1] and visibility in [0, 1] of each row, as they will be sent.

        Parameters
        ----------
        rows
            Evaluations of all vehicles. Only those of `context.attacker` may be changed.
        detections
            The step's detections, to which `rows.detection` refers.
        """

    def identities(self, context: AttackContext) -> Int[ndarray, "n"]:
        """Number of identities under which each actor sends in this step, in addition to its own.

        `Detections.identity` is the number of the identity that sends a detection, from 1. The actor's evaluations are
        sent under all its identities.

        Returns
        -------
        By row of the world. The numbers of actors that do not attack in this step are ignored.
        """

    def sending(self, context: AttackContext) -> Sending:
        """How each actor sends its messages, by row of the world.

        Actors that are not `context.attacker` send as in `Sending.plain`.
        """


class WithParams(Generic[P]):
    """Base of attacks that have parameters of their own."""

    def __init__(self, params: P) -> None:
        self.params = params


class Vouched(WithParams[P]):
    """Base of attacks whose vehicles confirm what they fabricate: evaluation 1 and visibility 1."""

    def evaluations(
        self, rows: EvaluationRows, detections: Detections, context: AttackContext
    ) -> tuple[ndarray, ndarray]:
        """The rows, with the attacker's own fabricated detections confirmed."""
        return certified(rows, detections, context)


def fabricated(
    listed: Detections,
    observer: Int[ndarray, "c"],
    label: ndarray,
    boxes: Boxes,
    score: Float[ndarray, "c"],
    target: Int[ndarray, "c"] | None = None,
    identity: Int[ndarray, "c"] | None = None,
    speed_mps: Float[ndarray, "c"] | None = None,
    n_points: Int[ndarray, "c"] | None = None,
    velocity_mps: Float[ndarray, "c 2"] | None = None,
) -> Detections:
    """Add fabricated detections to the lists. Their indices continue those of each observer and identity.

    Parameters
    ----------
    observer
        Row of the world of the vehicle that adds each detection, in any order.
    label
        Class of each detection.
    boxes
        Boxes in the world frame.
    score
        Scores in [0, 1].
    target
        Row of the world of the vehicle that each detection aims at. If it is left out, there is no victim.
    identity
        Identity under which each detection is sent. The default 0 is the vehicle's own. The first detection under
        another identity has index 0 and is the self report of that identity.
    speed_mps
        Speed that such a self report claims. If it is left out, there is none.
    n_points, velocity_mps
        Returns inside the box, and velocity east and north of the object, as the detector and the tracking report them
        of real objects. If they are left out, there are none.
    """
    n = len(observer)
    identity = np.zeros(n, np.int64) if identity is None else identity
    absent = np.full(n, np.nan)
    n_points = np.zeros(n, np.int32) if n_points is None else n_points.astype(np.int32)
    added = Detections(
        observer=observer,
        detection_index=np.arange(n),
        label=label.astype(np.uint8),
        boxes=boxes,
        score=score,
        n_points=n_points,
        origin=np.full(n, FABRICATED, np.uint8),
        transmitted=np.ones(n, bool),
        target=observer if target is None else target,
        identity=identity,
        speed_mps=absent if speed_mps is None else speed_mps,
        acceleration_mps2=absent,
        velocity_mps=np.full((n, 2), np.nan) if velocity_mps is None else velocity_mps,
    )
    added = added.take(np.lexsort((identity, observer)))
    # The index of a detection continues those of its sender, which is an identity of a vehicle.
    n_identities = 1 + int(max(listed.identity.max(initial=0), identity.max(initial=0)))
    sender = added.observer * n_identities + added.identity
    own = listed.observer * n_identities + listed.identity
    n_senders = 1 + int(max(own.max(initial=-1), sender.max(initial=-1)))
    last = np.full(n_senders, -1)
    np.maximum.at(last, own, listed.detection_index)
    added = replace(added, detection_index=last[sender] + 1 + place_in_group(sender))
    return Detections.by_key([listed, added])


def placed(
    world: World, row: Int[ndarray, "c"], ahead_m: ndarray, left_m: ndarray, turned_rad: ndarray
) -> tuple[Float[ndarray, "c 3"], Float[ndarray, "c"]]:
    """Positions and headings relative to actors, in the world frame.

    Parameters
    ----------
    row
        Actor, as a row of the world.
    ahead_m, left_m
        Distances ahead of and to the left of the actor's centre.
    turned_rad
        Angle from the actor's heading, counter-clockwise.

    Returns
    -------
    Positions at the height of the actor's centre, and headings in (-pi, pi].
    """
    yaw = world.boxes.yaw_rad[row]
    xyz = world.boxes.xyz_m[row].copy()
    xyz[:, :2] += turned_by(yaw, np.column_stack([ahead_m, left_m]))
    return xyz, wrapped(yaw + turned_rad)


def per_actor(
    context: AttackContext, name: str, rows: Bool[ndarray, "n"], values: Float[ndarray, "..."] | float
) -> Float[ndarray, "n ..."]:
    """Store one number or several for some actors, and return the stored numbers of all actors.

    Parameters
    ----------
    name
        Name under which the numbers are stored in `context.memory`.
    rows
        Actors of the world for which `values` are stored in this step.
    values
        One value for all, or one per actor of the world.

    Returns
    -------
    The stored numbers of each actor of the world; 0 if nothing is stored.
    """
    actor, shape = context.world.actor, np.shape(values)[1:]
    kept = context.memory.get(name, np.zeros((0, *shape)))
    if (more := int(actor.max(initial=-1)) + 1 - len(kept)) > 0:
        kept = np.concatenate([kept, np.zeros((max(more, 256), *shape))])
    of_all = np.broadcast_to(values, (len(actor), *shape))
    kept[actor[rows]] = of_all[rows]
    context.memory[name] = kept
    return kept[actor]


def certified(
    rows: EvaluationRows, detections: Detections, context: AttackContext
) -> tuple[Float[ndarray, "m"], Float[ndarray, "m"]]:
    """Evaluations in which attackers confirm what they fabricated themselves: evaluation and visibility 1 [1]_.

    Returns
    -------
    Evaluation and visibility of each row. All other evaluations are unchanged.

    References
    ----------
    .. [1] Hurl, Cohen, Czarnecki, Waslander, "TruPercept", 2020: the published code's malicious vehicles.
    """
    own = rows.evaluator == detections.observer[rows.detection]
    is_fabricated = detections.origin[rows.detection] == FABRICATED
    vouched = own & context.attacker[rows.evaluator] & is_fabricated
    return np.where(vouched, 1.0, rows.evaluation), np.where(vouched, 1.0, rows.visibility)
