"""All attacks of a run: which vehicles carry them out in a step, and how they change what is sent."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.attacks.attack import Attack, AttackContext, EvaluationRows, Sending
from cosim.attacks.params import AttackParams, owners
from cosim.base import rng
from cosim.base.codes import DetectionFault, Role
from cosim.messages.content import FABRICATED, Detections, faults
from cosim.world import World
from sensors.line_of_sight import WallIndex

_CELL_M = 200.0
"""Attackers that appear in the same step are numbered by cells of this size, so that the members of a ring are close
to each other."""


@dataclass(slots=True)
class AttackState:
    """State of the attacks between steps: one row per section of the config, one column per actor number."""

    rank: Int[ndarray, "a capacity"]
    """Number of each attacker within its section, in the order of appearance; -1 for others."""
    awake: Bool[ndarray, "a capacity"]
    """Whether an attacker with `when = "sleeper"` has begun."""
    n_active: Int[ndarray, "a capacity"]
    """Number of steps with messages since each attacker last began."""
    memory: list[dict[str, Any]] = field(default_factory=list)
    """What the attack of each section stores."""

    def make_room(self, capacity: int) -> None:
        """Add columns, so that there is one for every actor number below `capacity`."""
        more = capacity - self.rank.shape[1]
        if more > 0:
            more = max(more, 256)
            self.rank = np.pad(self.rank, ((0, 0), (0, more)), constant_values=-1)
            self.awake = np.pad(self.awake, ((0, 0), (0, more)))
            self.n_active = np.pad(self.n_active, ((0, 0), (0, more)))


@dataclass(frozen=True, slots=True)
class ActiveAttacks:
    """The attacks that are active in one step, in the order of the config."""

    attacks: tuple[tuple[Attack, AttackContext], ...]
    xyz_m: Float[ndarray, "n 3"]
    """Positions of all actors, world frame."""
    sends: Bool[ndarray, "n"] | None = None
    """Actors that send messages in this step, by row of the world; None if all equipped vehicles do."""

    def _on_messages(self, method: str) -> list[tuple[Any, AttackContext]]:
        """Attacks that have this method, which changes messages; their attackers are only those that send now.

        An attack whose class says `remembers` is asked where none does, too: it notes what others send.
        """
        found = []
        for attack, context in self.attacks:
            if not hasattr(attack, method):
                continue
            if self.sends is not None:
                context = replace(context, attacker=context.attacker & self.sends)
                if not context.attacker.any() and not getattr(attack, "remembers", False):
                    continue
            found.append((attack, context))
        return found

    def phantoms(self, seen: Detections) -> Detections:
        """What detectors find, with phantoms as `Attack.phantoms` adds them; `seen` itself if there are none."""
        for attack, context in self.attacks:  # an object misleads detectors whether its attacker sends or not
            if hasattr(attack, "phantoms"):
                seen = attack.phantoms(seen, replace(context, seen=seen))
        return seen

    def detections(self, listed: Detections) -> tuple[Detections, Int[ndarray, "f"]]:
        """Apply the attacks to the detection lists of all vehicles.

        Returns
        -------
        The lists as they will be sent, and the numbers of detections that cannot be sent, by `DetectionFault`.
        """
        perceived = listed
        listed, n_dropped = without_faults(listed, self.xyz_m)
        seen = listed  # what attacks learn of real detections, whatever the attacks before them did
        n_identities = self.identities()
        for attack, context in self._on_messages("detections"):
            listed = attack.detections(listed, replace(context, n_identities=n_identities, seen=seen))
            listed, n_dropped_here = without_faults(listed, self.xyz_m)
            n_dropped += n_dropped_here
        return with_perceived(listed, perceived), n_dropped

    def evaluations(
        self, rows: EvaluationRows, detections: Detections
    ) -> tuple[Float[ndarray, "m"], Float[ndarray, "m"]]:
        """Evaluation and visibility as each vehicle will send them.

        Returns
        -------
        Aligned with `rows`. If no active attack has the method `evaluations`, they are the arrays of `rows` themselves.
        """
        evaluation, visibility = rows.evaluation, rows.visibility
        for attack, context in self._on_messages("evaluations"):
            now = replace(rows, evaluation=evaluation, visibility=visibility)
            evaluation, visibility = attack.evaluations(now, detections, context)
        return evaluation, visibility

    def identities(self) -> Int[ndarray, "n"]:
        """Number of identities under which each actor sends in addition to its own, by row of the world.

        If several attacks give an actor identities, the largest number is used.
        """
        found = np.zeros(len(self.xyz_m), np.int64)
        for attack, context in self._on_messages("identities"):
            found = np.maximum(found, np.where(context.attacker, attack.identities(context), 0))
        return found

    def sending(self) -> Sending:
        """How each actor sends its messages, by row of the world."""
        found = Sending.plain(len(self.xyz_m))
        for attack, context in self.attacks:  # a jammer jams whether it sends or not
            if hasattr(attack, "sending"):
                found = found.and_also(attack.sending(context))
        return found

    def malicious(self) -> Bool[ndarray, "n"]:
        """Which actors attack in this step and have the role malicious, by row of the world."""
        found = np.zeros(len(self.xyz_m), bool)
        for _, context in self.attacks:
            if context.params.role == Role.MALICIOUS.name.lower():
                found |= context.attacker
        return found


@dataclass(frozen=True, slots=True)
class Adversary:
    """The attacks of a run, in the order of the config; `world.attack` numbers them from 1."""

    params: tuple[AttackParams, ...]
    attacks: tuple[Attack, ...]
    owner: tuple[int, ...]
    """For each section, the number of the section that defines its vehicles."""
    period_steps: tuple[float, ...]
    """For each section, the length of a period of `on_off` in steps."""
    seed: int
    dt_s: float
    walls: WallIndex | None = None
    """Walls of the city's buildings, which attackers know."""

    @staticmethod
    def of(
        params: Sequence[AttackParams],
        attacks: Sequence[Attack],
        seed: int,
        dt_s: float = 1.0,
        freshness_s: float | str = "off",
        walls: WallIndex | None = None,
    ) -> "Adversary":
        """Attacks with their parameters. `freshness_s` is the window of evidence, a unit for periods."""
        period_s = [p.period_s if p.when != "on_off" else p.period_of(freshness_s) for p in params]
        period_steps = tuple(s / dt_s for s in period_s)
        return Adversary(tuple(params), tuple(attacks), owners(params), period_steps, seed, dt_s, walls)

    def start(self) -> AttackState:
        """The state before the first step."""
        n = len(self.params)
        nothing = np.zeros((n, 0), np.int64)
        return AttackState(nothing, nothing.astype(bool), nothing, [{} for _ in range(n)])

    @property
    def reads_trust(self) -> bool:
        """Whether any attacker depends on the trust that is broadcast about it."""
        return any(p.reads_trust for p in self.params)

    @property
    def renews(self) -> bool:
        """Whether any attacker changes its pseudonym in addition to the pseudonym policy."""
        return any(p.renewal != "by_policy" for p in self.params)

    def renewals(
        self, world: World, time_s: float, trust: Float[ndarray, "n"] | None, age_s: Float[ndarray, "n"]
    ) -> Bool[ndarray, "n"]:
        """Actors that change their pseudonyms in addition to the pseudonym policy.

        Parameters
        ----------
        trust
            Trust in each actor, as the actor last received it; NaN where it received none. None if no attack reads it.
        age_s
            Age of each actor's current pseudonym.

        Returns
        -------
        By row of the world.
        """
        found = np.zeros(len(world), bool)
        for number, p in enumerate(self.params):
            if p.renewal == "by_policy" or not _has_begun(p, time_s):
                continue
            if p.renewal == "whitewashing":
                assert trust is not None, "given where an attack reads it"
                wants = trust < p.renew_below
            else:
                wants = age_s >= p.renew_s - 1e-9
            found |= wants & self._members(world, number)
        return found

    def active(
        self,
        state: AttackState,
        world: World,
        time_s: float,
        trust: Float[ndarray, "n"] | None = None,
        sends: Bool[ndarray, "n"] | None = None,
    ) -> ActiveAttacks:
        """The attacks that at least one vehicle carries out in this step. The function updates `state`.

        Parameters
        ----------
        time_s
            Time since recording began.
        trust
            Trust in each actor, as the actor last received it; NaN where it received none. None if no attack reads it.
        sends
            Actors that send messages in this step, by row of the world. None if all equipped vehicles do.
        """
        found = []
        state.make_room(int(world.actor.max(initial=-1)) + 1)
        for number, (p, attack) in enumerate(zip(self.params, self.attacks, strict=True)):
            member = self._members(world, number)
            if not member.any():
                continue
            ring = self._rings(state, world, number, member)
            attacker = member & _has_begun(p, time_s)
            if attacker.any() and p.when != "persistent":
                attacker &= self._active_by_when(state, world, number, trust)
            n_active = state.n_active[number, world.actor]
            n_sent = 1 if sends is None else sends
            state.n_active[number, world.actor] = np.where(attacker, n_active + n_sent, 0)
            if not attacker.any() and not (getattr(attack, "remembers", False) and _has_begun(p, time_s)):
                continue
            context = AttackContext(
                world=world,
                attacker=attacker,
                time_s=time_s,
                seed=self.seed,
                number=number,
                params=p,
                member=member,
                ring=ring,
                n_active=n_active,
                memory=state.memory[number],
                walls=self.walls,
            )
            found.append((attack, context))
        return ActiveAttacks(tuple(found), world.boxes.xyz_m, sends)

    def _members(self, world: World, number: int) -> Bool[ndarray, "n"]:
        return world.equipped & (world.attack == self.owner[number] + 1)

    def _rings(
        self,
        state: AttackState,
        world: World,
        number: int,
        member: Bool[ndarray, "n"],
    ) -> Int[ndarray, "n"]:
        """Ring of each member. Members that are new get the next ranks: `ring_size` successive ranks are a ring."""
        size = self.params[number].ring_size
        if not size:
            return np.zeros(len(world), np.int64)
        rank = state.rank[number]
        new = np.flatnonzero(member & (rank[world.actor] < 0))
        xy_m = world.boxes.xyz_m[new, :2]
        east, north = np.floor(xy_m / _CELL_M).T  # cell of each
        order = np.lexsort((world.actor[new], north, east))
        new = new[order]
        next_rank = rank.max(initial=-1) + 1
        rank[world.actor[new]] = next_rank + np.arange(len(new))
        return rank[world.actor] // size

    def _active_by_when(
        self, state: AttackState, world: World, number: int, trust: Float[ndarray, "n"] | None
    ) -> Bool[ndarray, "n"]:
        """Actors that attack in this step according to the key `when`."""
        p = self.params[number]
        if p.when == "sporadic":
            key = rng.key(self.seed, rng.Stream.ATTACK_TIME, world.step)
            draws = rng.uniforms(key, np.uint64(number), world.name_key)[:, 0]
            return draws < p.active_p
        if p.when == "on_off":
            period = self.period_steps[number]
            since_start = world.step - np.ceil(p.start_s / self.dt_s - 1e-9)
            is_on = np.mod(since_start + 1e-9, period) < p.duty_p * period
            return np.full(len(world), is_on)
        assert trust is not None, "given where an attack reads it"
        if p.when == "camouflage":
            return trust > p.keep_above
        state.awake[number, world.actor] |= trust >= p.wake_trust
        return state.awake[number, world.actor]


def _has_begun(params: AttackParams, time_s: float) -> bool:
    """Whether an attack has begun: a step's time, a product, may be rounded to a little less than `start_s`."""
    return time_s >= params.start_s - 1e-9


def with_perceived(listed: Detections, perceived: Detections) -> Detections:
    """The lists, with every detection that a vehicle has really made, once.

    What an attack made impossible to send, or gave another number, its vehicle has still perceived: it is in the list
    and not transmitted. A detection under a number that the vehicle has not perceived is fabricated.
    """
    key = listed.numbers()
    perceived_key = perceived.numbers()
    is_real = listed.origin != FABRICATED
    has_all = np.array_equal(key[is_real], perceived_key)
    if has_all and np.array_equal(listed.origin[is_real], perceived.origin):
        return listed
    at = np.searchsorted(perceived_key, key)
    is_perceived = (listed.identity == 0) & (np.append(perceived_key, -1)[at] == key)
    at = at[is_perceived]
    origin = np.full(len(listed), FABRICATED, np.uint8)
    origin[is_perceived] = perceived.origin[at]
    is_left_out = np.ones(len(perceived), bool)
    is_left_out[at] = False
    left_out = perceived.take(np.flatnonzero(is_left_out))
    left_out = replace(left_out, transmitted=np.zeros(len(left_out), bool))
    return Detections.by_key([replace(listed, origin=origin), left_out])


def without_faults(
    listed: Detections,
    xyz_m: Float[ndarray, "w 3"],
) -> tuple[Detections, Int[ndarray, "f"]]:
    """Drop the detections that cannot be sent.

    Parameters
    ----------
    listed
        Detections of all vehicles, in any order.
    xyz_m
        Positions of all actors by row of the world.

    Returns
    -------
    The remaining detections, sorted by key, and the numbers of dropped ones, by `DetectionFault`.
    """
    fault = faults(listed, xyz_m)
    n_dropped = np.bincount(fault[fault >= 0], minlength=len(DetectionFault))
    if n_dropped.any():
        listed = listed.take(np.flatnonzero(fault < 0))
    # One integer in the order of the key: numbers and identities have 16 bits at most. No key is there twice.
    message = listed.observer.astype(np.int64) << 16 | listed.identity
    key = message << 16 | listed.detection_index
    if (key[1:] < key[:-1]).any():
        listed = listed.take(np.argsort(key))
    return listed, n_dropped
