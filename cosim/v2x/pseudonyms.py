"""Pseudonyms: the identities that messages carry, and when a vehicle changes its own.

Messages, trust and the trust server know pseudonyms and nothing else. Which vehicle a pseudonym belonged to, and when,
stands in the table `pseudonyms`, which is ground truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, Protocol

import numpy as np
from annotated_types import Gt, Interval, Le
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim import rng
from cosim.world import World

FIRST_STRETCH_M = 800.0
"""Way driven under a pseudonym before `c2c` may change it [m]."""
FIRST_EXTRA = 1 << 30
"""Without a policy a vehicle's pseudonym is its number; pseudonyms that attackers make up begin here."""


@dataclass(frozen=True, slots=True)
class PseudonymAges:
    """What each equipped vehicle on the road has done under its present pseudonym."""

    n_changes: Int[ndarray, "e"]
    """Pseudonyms that it has given up in this trip."""
    age_s: Float[ndarray, "e"]
    """Since it took the pseudonym [s]."""
    distance_m: Float[ndarray, "e"]
    """Driven since [m]."""
    away_m: Float[ndarray, "e"]
    """Straight line from the place where it took the pseudonym [m]."""
    beyond_s: Float[ndarray, "e"]
    """Since it had driven 800 m under the pseudonym [s]; 0 before."""
    n_messages: Int[ndarray, "e"]
    """Detection messages sent since."""
    trip_draws: Float[ndarray, "e 4"]
    """Uniforms in [0, 1) that last as long as the pseudonym: for drawn periods and distances."""
    step_draws: Float[ndarray, "e"]
    """A uniform in [0, 1), new in every step."""


class PseudonymPolicy(Protocol):
    """When vehicles change their pseudonyms."""

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Which of them change before their next message."""


class Never:
    """One pseudonym for the whole trip: the number of the vehicle."""

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """None."""
        return np.zeros(len(ages.age_s), bool)


@dataclass(frozen=True, kw_only=True, slots=True)
class PeriodicalParams:
    """Parameters of `periodical`."""

    period_s: Annotated[float, Gt(0), Le(1e8)] = 240.0
    """Life of a pseudonym [s]; default as in F2MD."""


class Periodical:
    """A change after a fixed time."""

    Params = PeriodicalParams

    def __init__(self, params: PeriodicalParams) -> None:
        self.params = params

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Those whose pseudonym is as old as the period."""
        return ages.age_s >= self.params.period_s - 1e-9


@dataclass(frozen=True, kw_only=True, slots=True)
class DisposableParams:
    """Parameters of `disposable`."""

    n_messages: Annotated[int, Gt(0), Le(2**31 - 1)] = 10
    """Messages sent under one pseudonym; default as in F2MD."""


class Disposable:
    """A change after a number of messages."""

    Params = DisposableParams

    def __init__(self, params: DisposableParams) -> None:
        self.params = params

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Those that have used their pseudonym up."""
        return ages.n_messages >= self.params.n_messages


@dataclass(frozen=True, kw_only=True, slots=True)
class DistanceParams:
    """Parameters of `distance`."""

    distance_m: Annotated[float, Gt(0), Le(1e9)] = 80.0
    """Way driven under one pseudonym [m]; default as in F2MD."""


class Distance:
    """A change after a distance."""

    Params = DistanceParams

    def __init__(self, params: DistanceParams) -> None:
        self.params = params

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Those that have driven far enough."""
        return ages.distance_m >= self.params.distance_m


@dataclass(frozen=True, kw_only=True, slots=True)
class RandomParams:
    """Parameters of `random`."""

    change_p: Annotated[float, Interval(ge=0, le=1)] = 0.1
    """Chance of a change before each message; default as in F2MD."""


class Random:
    """A change by chance, before every message."""

    Params = RandomParams

    def __init__(self, params: RandomParams) -> None:
        self.params = params

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Those whom chance picks."""
        return ages.step_draws < self.params.change_p


@dataclass(frozen=True, kw_only=True, slots=True)
class C2cParams:
    """Parameters of `c2c`."""

    reading: Literal["then", "both"] = "then"
    """How the later changes are read: then: after 800 m, and U(120, 360) s after these; both: once 800 m have been
    driven and U(120, 360) s have passed since the last change, whichever is later."""


class C2c:
    """The policy of the CAR 2 CAR Communication Consortium, as F2MD and NextGen have it.

    A new pseudonym at the start of the trip; the next after U(800, 1500) m; from then on after at least 800 m and a
    further U(120, 360) s.

    Notes
    -----
    "And a further" has two readings (`C2cParams.reading`): the time begins at the 800th metre, which is the default, or
    with the pseudonym.   Deviations: none known; the source is the published code of F2MD and NextGen, at second hand.
    """

    Params = C2cParams

    def __init__(self, params: C2cParams) -> None:
        self.params = params

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Those that have driven and waited long enough."""
        far = ages.distance_m >= FIRST_STRETCH_M + 700.0 * ages.trip_draws[:, 0]
        since_s = ages.beyond_s if self.params.reading == "then" else ages.age_s
        later = (ages.distance_m >= FIRST_STRETCH_M) & (since_s >= 120.0 + 240.0 * ages.trip_draws[:, 1])
        return np.where(ages.n_changes == 0, far, later)


class Bsp:
    """The basic policy of ETSI TR 103 415 (second hand): within a minute of ignition, then every U(10, 30) min."""

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Those whose time has come."""
        first = ages.age_s >= 60.0 * ages.trip_draws[:, 0]
        later = ages.age_s >= 600.0 + 1200.0 * ages.trip_draws[:, 1]
        return np.where(ages.n_changes == 0, first, later)


@dataclass(frozen=True, kw_only=True, slots=True)
class ScmsParams:
    """Parameters of `scms`."""

    distance: Literal["place", "driven"] = "place"
    """place: straight line from where the vehicle last changed; driven: way driven since."""


class Scms:
    """The rule of SAE J2945/1 at second hand: a change every 5 min, unless the vehicle is less than 2 km from where it
    last changed.

    Notes
    -----
    The distance is the straight line to the place of the last change (absolute distance, vCertChangeDistance of the
    standard, from memory): a vehicle that drives in circles does not change. `distance = "driven"` counts the way.
    Deviations: the standard itself could not be read; SCMS limits certificates (20 a week), which is not modelled.
    """

    Params = ScmsParams

    def __init__(self, params: ScmsParams) -> None:
        self.params = params

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Those whose time has come, and that are far enough."""
        far_m = ages.away_m if self.params.distance == "place" else ages.distance_m
        return (ages.age_s >= 300.0 - 1e-9) & (far_m >= 2000.0)


POLICIES: Mapping[str, type] = {
    "none": Never, "periodical": Periodical, "disposable": Disposable, "distance": Distance, "random": Random,
    "c2c": C2c, "bsp": Bsp, "scms": Scms,
}  # fmt: skip
"""Policies at hand, by the config's name."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PseudonymParams:
    """Which identities messages carry."""

    policy: str = "none"
    """When a vehicle changes its pseudonym: none, periodical, disposable, distance, random, c2c, bsp, scms, or your
    own."""
    linkage: Literal["none", "server", "on_demand", "own"] = "none"
    """How trust copes with a change: none: a new pseudonym is a newcomer; server: reputation stays with the vehicle, is
    broadcast under its present pseudonym; on_demand: pseudonyms are linked from the one on that has been accused
    n_accusations times; own: each receiver links them itself, by place and speed."""
    n_accusations: Annotated[int, Gt(0), Le(2**31 - 1)] = 10
    """on_demand: reports against one pseudonym after which the vehicle's later ones are linked to it."""
    own_gap_s: Annotated[float, Gt(0), Le(1e4)] = 1.5
    """own: longest time between the last message of the old pseudonym and the first of the new one [s]."""
    own_gate_m: Annotated[float, Gt(0), Le(10_000)] = 3.0
    """own: farthest that the new pseudonym may stand from where the old one is expected [m]."""
    revocation: Literal["none", "immediate", "list", "not_renewed"] = "none"
    """What happens to a subject that the acting server trusts less than revoke_below: nothing; receivers drop its
    messages at once; from the next revocation list on; or it gets no new pseudonym after its present one."""
    revoke_below: Annotated[float, Interval(ge=0, le=1)] = 0.25
    """Trust at the acting server below which a subject is revoked."""
    min_evaluations: Annotated[int, Gt(0), Le(2**31 - 1)] = 5
    """Evaluations that a revocation takes at least."""
    list_every_s: Annotated[float, Gt(0), Le(1e8)] = 60.0
    """list: time between two revocation lists [s]."""


@dataclass(frozen=True, slots=True)
class PseudonymState:
    """Pseudonyms in use, by actor number, and all that were ever issued."""

    current: Int[ndarray, "capacity"] = field(default_factory=lambda: np.full(0, -1, np.int64))
    since_step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))
    seen_step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))
    n_changes: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))
    n_messages: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))
    distance_m: Float[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0))
    xy_m: Float[ndarray, "capacity 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """Last place."""
    from_xy_m: Float[ndarray, "capacity 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """Place where it took its pseudonym."""
    beyond_step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Step in which it had driven `FIRST_STRETCH_M` under its pseudonym; read only where it has."""
    linked: Int[ndarray, "capacity"] = field(default_factory=lambda: np.full(0, -1, np.int64))
    """Pseudonym of each vehicle to which its later ones are linked on demand; -1 for none."""
    issued: Int[ndarray, "n_issued 3"] = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    """Vehicle, identity and first step of each pseudonym that is no vehicle's number, in the order of issue."""
    extra: Int[ndarray, "x 4"] = field(default_factory=lambda: np.zeros((0, 4), np.int64))
    """Further identities: vehicle and identity in one number, ascending; pseudonym, first and last step in use."""
    accusations: dict[int, int] = field(default_factory=dict)
    """Of pseudonyms that are not linked yet."""
    revoked: dict[int, int] = field(default_factory=dict)
    """Subjects that lose their certificates, and from which step on."""
    refused: dict[int, int] = field(default_factory=dict)
    """Pseudonyms whose messages were dropped, and since which step."""

    def of(self, actor: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
        """Present pseudonym of each vehicle; -1 where it has had none yet."""
        found = np.full(len(actor), -1)
        known = actor < len(self.current)
        found[known] = self.current[actor[known]]
        return found

    def begun(self, actor: Int[ndarray, "n"], now_step: int) -> Int[ndarray, "n"]:
        """Step in which each vehicle took its present pseudonym; now for those without any."""
        found = np.full(len(actor), now_step)
        known = np.flatnonzero(actor < len(self.current))
        known = known[self.current[actor[known]] >= 0]
        found[known] = self.since_step[actor[known]]
        return found


@dataclass(frozen=True, slots=True)
class PseudonymUse:
    """Pseudonyms that came to an end: rows of the table `pseudonyms`."""

    pseudonym: Int[ndarray, "p"]
    vehicle: Int[ndarray, "p"]
    from_step: Int[ndarray, "p"]
    to_step: Int[ndarray, "p"]
    identity: Int[ndarray, "p"]
    """0 for the vehicle's own."""
    refused_step: Int[ndarray, "p"]
    """First step in which receivers dropped its messages; -1 for none."""

    @staticmethod
    def none() -> "PseudonymUse":
        nothing = np.zeros(0, np.int64)
        return PseudonymUse(nothing, nothing, nothing, nothing, nothing, nothing)

    @staticmethod
    def of(state: PseudonymState, pseudonym, vehicle, from_step, to_step, identity=None) -> "PseudonymUse":
        """Rows of these pseudonyms."""
        identity = np.zeros(len(pseudonym), np.int64) if identity is None else identity
        refused = np.array([state.refused.get(p, -1) for p in pseudonym.tolist()], np.int64)
        return PseudonymUse(pseudonym, vehicle, from_step, to_step, identity, refused)


@dataclass(frozen=True, slots=True)
class Pseudonyms:
    """Issues pseudonyms to equipped vehicles by a policy."""

    policy: PseudonymPolicy
    seed: int
    dt_s: float

    @property
    def by_number(self) -> bool:
        """Whether a vehicle's pseudonym is its number."""
        return isinstance(self.policy, Never)

    def issue(
        self, state: PseudonymState, world: World, observers: Int[ndarray, "e"],
        wants: Bool[ndarray, "e"] | None = None,
    ) -> tuple[PseudonymState, Int[ndarray, "e"], PseudonymUse]:  # fmt: skip
        """The pseudonym of each equipped vehicle in this step.

        Parameters
        ----------
        observers
            Equipped vehicles, rows of the world.
        wants
            Those that change of their own accord, whatever the policy says.

        Returns
        -------
        The state; the pseudonyms, in the order of `observers`; and those that were given up in this step.
        """
        actor, xy = world.actor[observers], world.boxes.xyz_m[observers, :2]
        state = _grown(state, int(actor.max(initial=-1)) + 1)
        new = state.current[actor] < 0
        distance_m = state.distance_m.copy()
        distance_m[actor] += np.where(new, 0.0, np.hypot(*(xy - state.xy_m[actor]).T))
        names = world.name_key[observers]
        n_changes = state.n_changes[actor]
        beyond_step = state.beyond_step.copy()
        arrives = actor[(distance_m[actor] >= FIRST_STRETCH_M) & ~(state.distance_m[actor] >= FIRST_STRETCH_M)]
        beyond_step[arrives] = world.step
        beyond_s = (world.step - beyond_step[actor]) * self.dt_s
        ages = PseudonymAges(
            n_changes=n_changes,
            age_s=(world.step - state.since_step[actor]) * self.dt_s,
            distance_m=distance_m[actor],
            away_m=np.hypot(*(xy - state.from_xy_m[actor]).T),
            beyond_s=np.where(distance_m[actor] >= FIRST_STRETCH_M, beyond_s, 0.0),
            n_messages=state.n_messages[actor],
            trip_draws=rng.uniforms(rng.key(self.seed, rng.Stream.PSEUDONYM), names, n_changes, n=4),
            step_draws=rng.uniforms(rng.key(self.seed, rng.Stream.PSEUDONYM, world.step + 1), names)[:, 0],
        )
        changes = np.asarray(self.policy.changes(ages), bool)
        changes = ~new & (changes if wants is None else changes | wants)
        given_up = actor[changes]
        ended = PseudonymUse.of(
            state, state.current[given_up], given_up, state.since_step[given_up], state.seen_step[given_up]
        )
        fresh = np.flatnonzero(new | changes)
        taking = actor[fresh]
        current, since, seen = state.current.copy(), state.since_step.copy(), state.seen_step.copy()
        n_changes_all, n_messages, place = state.n_changes.copy(), state.n_messages.copy(), state.xy_m.copy()
        from_xy_m = state.from_xy_m.copy()
        from_xy_m[taking] = xy[fresh]
        numbered = taking[changes[fresh]] if self.by_number else taking
        if self.by_number:
            current[taking] = taking
        current[numbered], state = self._numbers(state, numbered, np.zeros(len(numbered), np.int64), world.step)
        since[taking], n_messages[taking], distance_m[taking] = world.step, 0, 0.0
        n_changes_all[given_up] += 1
        n_messages[actor] += 1
        seen[actor], place[actor] = world.step, xy
        state = replace(
            state, current=current, since_step=since, seen_step=seen, n_changes=n_changes_all, n_messages=n_messages,
            distance_m=distance_m, xy_m=place, from_xy_m=from_xy_m, beyond_step=beyond_step,
        )  # fmt: skip
        return state, current[actor], ended

    def issue_extra(
        self, state: PseudonymState, vehicle: Int[ndarray, "x"], identity: Int[ndarray, "x"], step: int
    ) -> tuple[PseudonymState, Int[ndarray, "x"]]:
        """Pseudonyms of further identities of vehicles, given by actor number; each keeps its own for good."""
        key = vehicle.astype(np.int64) << 16 | identity
        new = np.setdiff1d(key, state.extra[:, 0])
        numbers, state = self._numbers(state, new >> 16, new & (1 << 16) - 1, step)
        rows = np.column_stack([new, numbers, np.full((len(new), 2), step)])
        extra = np.concatenate([state.extra, rows])
        extra = extra[np.argsort(extra[:, 0], kind="stable")]
        at = np.searchsorted(extra[:, 0], key)
        extra[at, 3] = step
        return replace(state, extra=extra), extra[at, 1]

    def owners(
        self, state: PseudonymState, pseudonym: Int[ndarray, "n"]
    ) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
        """Vehicle and identity behind each pseudonym; -1 for those that were never issued."""
        return self._issued(state, pseudonym, 0, pseudonym), self._issued(state, pseudonym, 1, 0)

    def since(self, state: PseudonymState, pseudonym: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
        """First step of each pseudonym; -1 for those that are a vehicle's number."""
        return self._issued(state, pseudonym, 2, -1)

    def _issued(self, state: PseudonymState, pseudonym: ndarray, column: int, of_number: ndarray | int) -> ndarray:
        at = pseudonym - FIRST_EXTRA if self.by_number else pseudonym
        inside = (at >= 0) & (at < len(state.issued))
        found = np.full(len(pseudonym), -1)
        found[inside] = state.issued[at[inside], column]
        if self.by_number:
            number = (pseudonym >= 0) & (pseudonym < len(state.current))
            number[number] = state.current[pseudonym[number]] >= 0
            found[number] = np.broadcast_to(of_number, len(pseudonym))[number]
        return found

    def _numbers(
        self, state: PseudonymState, vehicle: Int[ndarray, "k"], identity: Int[ndarray, "k"], step: int
    ) -> tuple[Int[ndarray, "k"], PseudonymState]:
        """New pseudonyms, numbered on."""
        if not len(vehicle):
            return np.zeros(0, np.int64), state
        numbers = len(state.issued) + np.arange(len(vehicle)) + (FIRST_EXTRA if self.by_number else 0)
        rows = np.column_stack([vehicle, identity, np.full(len(vehicle), step)])
        return numbers, replace(state, issued=np.concatenate([state.issued, rows]))

    def in_use(self, state: PseudonymState) -> PseudonymUse:
        """Pseudonyms that were never given up, when recording ends."""
        vehicle, extra = np.flatnonzero(state.current >= 0), state.extra
        return PseudonymUse.of(
            state,
            np.concatenate([state.current[vehicle], extra[:, 1]]),
            np.concatenate([vehicle, extra[:, 0] >> 16]),
            np.concatenate([state.since_step[vehicle], extra[:, 2]]),
            np.concatenate([state.seen_step[vehicle], extra[:, 3]]),
            np.concatenate([np.zeros(len(vehicle), np.int64), extra[:, 0] & (1 << 16) - 1]),
        )


def _grown(state: PseudonymState, size: int) -> PseudonymState:
    """The same with room for actor numbers below `size`."""
    old = len(state.current)
    if size <= old:
        return state
    more = max(size, 2 * old, 64) - old

    def longer(a: ndarray, fill: int = 0) -> ndarray:
        return np.concatenate([a, np.full((more, *a.shape[1:]), fill, a.dtype)])

    return replace(
        state, current=longer(state.current, -1), since_step=longer(state.since_step),
        seen_step=longer(state.seen_step),
        n_changes=longer(state.n_changes), n_messages=longer(state.n_messages), distance_m=longer(state.distance_m),
        xy_m=longer(state.xy_m), from_xy_m=longer(state.from_xy_m), beyond_step=longer(state.beyond_step),
        linked=longer(state.linked, -1),
    )  # fmt: skip
