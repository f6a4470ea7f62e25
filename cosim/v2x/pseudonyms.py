"""Pseudonyms: the identities that messages carry, and when a vehicle changes its own.

Messages, trust and the trust server know pseudonyms and nothing else. Which vehicle a pseudonym belonged to, and when,
stands in the table `pseudonyms`, which is ground truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Protocol

import numpy as np
from annotated_types import Gt, Interval, Le
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim import rng
from cosim.world import World

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


class C2c:
    """The policy of the CAR 2 CAR Communication Consortium, as F2MD and NextGen have it.

    A new pseudonym at the start of the trip; the next after U(800, 1500) m; from then on after at least 800 m and a
    further U(120, 360) s.

    Notes
    -----
    Deviations: the further time is counted from the pseudonym's start, not from the 800th metre.
    """

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Those that have driven and waited long enough."""
        far = ages.distance_m >= 800.0 + 700.0 * ages.trip_draws[:, 0]
        later = (ages.distance_m >= 800.0) & (ages.age_s >= 120.0 + 240.0 * ages.trip_draws[:, 1])
        return np.where(ages.n_changes == 0, far, later)


class Bsp:
    """The basic policy of ETSI TR 103 415 (second hand): within a minute of ignition, then every U(10, 30) min."""

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Those whose time has come."""
        first = ages.age_s >= 60.0 * ages.trip_draws[:, 0]
        later = ages.age_s >= 600.0 + 1200.0 * ages.trip_draws[:, 1]
        return np.where(ages.n_changes == 0, first, later)


POLICIES: Mapping[str, type] = {
    "none": Never, "periodical": Periodical, "disposable": Disposable, "distance": Distance, "random": Random,
    "c2c": C2c, "bsp": Bsp,
}  # fmt: skip
"""Policies at hand, by the config's name."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PseudonymParams:
    """Which identities messages carry."""

    policy: str = "none"
    """When a vehicle changes its pseudonym: none, periodical, disposable, distance, random, c2c, bsp, or your own."""


@dataclass(frozen=True, slots=True)
class PseudonymState:
    """Pseudonyms in use, by actor number; rows of `log` are all that ever were."""

    n_issued: int = 0
    current: Int[ndarray, "capacity"] = field(default_factory=lambda: np.full(0, -1, np.int64))
    since_step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))
    seen_step: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))
    n_changes: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))
    n_messages: Int[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0, np.int64))
    distance_m: Float[ndarray, "capacity"] = field(default_factory=lambda: np.zeros(0))
    xy_m: Float[ndarray, "capacity 2"] = field(default_factory=lambda: np.zeros((0, 2)))

    def of(self, actor: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
        """Present pseudonym of each vehicle; -1 where it has had none yet."""
        found = np.full(len(actor), -1)
        known = actor < len(self.current)
        found[known] = self.current[actor[known]]
        return found


@dataclass(frozen=True, slots=True)
class PseudonymUse:
    """Pseudonyms that came to an end: rows of the table `pseudonyms`."""

    pseudonym: Int[ndarray, "p"]
    vehicle: Int[ndarray, "p"]
    from_step: Int[ndarray, "p"]
    to_step: Int[ndarray, "p"]

    @staticmethod
    def none() -> "PseudonymUse":
        nothing = np.zeros(0, np.int64)
        return PseudonymUse(nothing, nothing, nothing, nothing)


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
        self, state: PseudonymState, world: World, observers: Int[ndarray, "e"]
    ) -> tuple[PseudonymState, Int[ndarray, "e"], PseudonymUse]:
        """The pseudonym of each equipped vehicle in this step.

        Parameters
        ----------
        observers
            Equipped vehicles, rows of the world.

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
        ages = PseudonymAges(
            n_changes, (world.step - state.since_step[actor]) * self.dt_s, distance_m[actor], state.n_messages[actor],
            rng.uniforms(rng.key(self.seed, rng.Stream.PSEUDONYM), names, n_changes, n=4),
            rng.uniforms(rng.key(self.seed, rng.Stream.PSEUDONYM, world.step + 1), names)[:, 0],
        )  # fmt: skip
        changes = ~new & np.asarray(self.policy.changes(ages), bool)
        given_up = actor[changes]
        ended = PseudonymUse(state.current[given_up], given_up, state.since_step[given_up], state.seen_step[given_up])
        fresh = np.flatnonzero(new | changes)
        taking = actor[fresh]
        current, since, seen = state.current.copy(), state.since_step.copy(), state.seen_step.copy()
        n_changes_all, n_messages, place = state.n_changes.copy(), state.n_messages.copy(), state.xy_m.copy()
        n_issued = state.n_issued
        if self.by_number:
            current[taking] = taking
        else:
            current[taking] = n_issued + np.arange(len(taking))
            n_issued += len(taking)
        since[taking], n_messages[taking], distance_m[taking] = world.step, 0, 0.0
        n_changes_all[given_up] += 1
        n_messages[actor] += 1
        seen[actor], place[actor] = world.step, xy
        state = PseudonymState(n_issued, current, since, seen, n_changes_all, n_messages, distance_m, place)
        return state, current[actor], ended

    def in_use(self, state: PseudonymState) -> PseudonymUse:
        """Pseudonyms that were never given up, when recording ends."""
        vehicle = np.flatnonzero(state.current >= 0)
        return PseudonymUse(state.current[vehicle], vehicle, state.since_step[vehicle], state.seen_step[vehicle])


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
        xy_m=longer(state.xy_m),
    )  # fmt: skip
