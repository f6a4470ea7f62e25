"""Pseudonyms: the identities in messages, and the policies by which vehicles change them.

Messages, trust and the trust server know only pseudonyms. The table `pseudonyms` contains the vehicle of each
pseudonym, which is ground truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Generic, Literal, Protocol, TypeVar

import numpy as np
from annotated_types import Gt, Le
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base import rng
from cosim.base.bounds import Share
from cosim.base.rows import no_rows
from cosim.world import World

FIRST_STRETCH_M = 800.0
"""Distance driven under a pseudonym before `c2c` may change it [m]."""
FIRST_EXTRA = 1 << 30
"""Without a policy a vehicle's pseudonym is its actor number. Further pseudonyms of attackers begin at this number."""


@dataclass(frozen=True, slots=True)
class PseudonymAges:
    """Age and use of the current pseudonym of each equipped vehicle on the road."""

    n_changes: Int[ndarray, "e"]
    """Number of pseudonym changes in this trip."""
    age_s: Float[ndarray, "e"]
    """Time since the vehicle took the pseudonym [s]."""
    distance_m: Float[ndarray, "e"]
    """Distance driven since then [m]."""
    away_m: Float[ndarray, "e"]
    """Straight-line distance from the position where it took the pseudonym [m]."""
    beyond_s: Float[ndarray, "e"]
    """Time since it had driven 800 m under the pseudonym [s]; 0 before that."""
    n_messages: Int[ndarray, "e"]
    """Number of detection messages sent since it took the pseudonym."""
    trip_draws: Float[ndarray, "e 4"]
    """Uniforms in [0, 1) that stay the same as long as the pseudonym, for random periods and distances."""
    step_draws: Float[ndarray, "e"]
    """A uniform in [0, 1) that is new in every step."""


class PseudonymPolicy(Protocol):
    """Decides when vehicles change their pseudonyms."""

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Whether each vehicle changes its pseudonym before its next message.

        The method is called in every step with messages, and where vehicles enter. Its result is ignored for vehicles
        without a pseudonym.
        """


P = TypeVar("P")


class _WithParams(Generic[P]):
    """Base of policies that have parameters."""

    def __init__(self, params: P) -> None:
        self.params = params


class Never:
    """One pseudonym for the whole trip: the actor number of the vehicle."""

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """No vehicle changes."""
        return np.zeros(len(ages.age_s), bool)


@dataclass(frozen=True, kw_only=True, slots=True)
class PeriodicalParams:
    """Parameters of `periodical`."""

    period_s: Annotated[float, Gt(0), Le(1e8)] = 240.0
    """Time after which a pseudonym changes [s]. The default is F2MD's."""


class Periodical(_WithParams[PeriodicalParams]):
    """A change after a fixed time."""

    Params = PeriodicalParams

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Vehicles whose pseudonym has reached the period."""
        return ages.age_s >= self.params.period_s - 1e-9


@dataclass(frozen=True, kw_only=True, slots=True)
class DisposableParams:
    """Parameters of `disposable`."""

    n_messages: Annotated[int, Gt(0), Le(2**31 - 1)] = 10
    """Number of messages after which a pseudonym changes. The default is F2MD's."""


class Disposable(_WithParams[DisposableParams]):
    """A change after a number of messages."""

    Params = DisposableParams

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Vehicles that have sent this number of messages."""
        return ages.n_messages >= self.params.n_messages


@dataclass(frozen=True, kw_only=True, slots=True)
class DistanceParams:
    """Parameters of `distance`."""

    distance_m: Annotated[float, Gt(0), Le(1e9)] = 80.0
    """Driven distance after which a pseudonym changes [m]. The default is F2MD's."""


class Distance(_WithParams[DistanceParams]):
    """A change after a distance."""

    Params = DistanceParams

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Vehicles that have driven this distance."""
        return ages.distance_m >= self.params.distance_m


@dataclass(frozen=True, kw_only=True, slots=True)
class RandomParams:
    """Parameters of `random`."""

    change_p: Share = 0.1
    """Probability of a change at each sweep, after which a vehicle sends. The default is F2MD's."""


class Random(_WithParams[RandomParams]):
    """A change with a fixed probability at every sweep."""

    Params = RandomParams

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Vehicles that are drawn."""
        return ages.step_draws < self.params.change_p


@dataclass(frozen=True, kw_only=True, slots=True)
class C2cParams:
    """Parameters of `c2c`."""

    reading: Literal["then", "both"] = "then"
    """Condition for all changes but the first. `then`: U(120, 360) s after the first 800 m under the pseudonym. `both`:
    once 800 m have been driven and U(120, 360) s have passed since the last change."""


class C2c(_WithParams[C2cParams]):
    """The policy of the CAR 2 CAR Communication Consortium, as implemented in F2MD and NextGen.

    A vehicle takes a new pseudonym at the start of the trip, and the next one after U(800, 1500) m. All later changes
    follow after at least 800 m and a further U(120, 360) s.

    Notes
    -----
    The source allows two readings of "and a further" (`C2cParams.reading`): the time begins when 800 m have been driven
    (the default), or with the pseudonym.
    Deviations: none known. The source is the published code of F2MD and NextGen, not the original policy.
    """

    Params = C2cParams

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Vehicles that have driven far enough and used the pseudonym long enough."""
        first = ages.distance_m >= FIRST_STRETCH_M + 700.0 * ages.trip_draws[:, 0]
        since_s = ages.beyond_s if self.params.reading == "then" else ages.age_s
        is_time = since_s >= 120.0 + 240.0 * ages.trip_draws[:, 1]
        later = is_time & (ages.distance_m >= FIRST_STRETCH_M)
        return np.where(ages.n_changes == 0, first, later)


class Bsp:
    """The basic policy of ETSI TR 103 415 (secondary source): within a minute of ignition, then every U(10, 30) min."""

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Vehicles whose drawn time has passed."""
        first = ages.age_s >= 60.0 * ages.trip_draws[:, 0]
        later = ages.age_s >= 600.0 + 1200.0 * ages.trip_draws[:, 1]
        return np.where(ages.n_changes == 0, first, later)


@dataclass(frozen=True, kw_only=True, slots=True)
class ScmsParams:
    """Parameters of `scms`."""

    distance: Literal["place", "driven"] = "place"
    """Distance that the rule uses. `place`: the straight line from the position of the last change. `driven`: the
    distance driven since the last change."""


class Scms(_WithParams[ScmsParams]):
    """The rule of SAE J2945/1 (secondary source): a change every 5 min, unless the vehicle is less than 2 km from the
    position of its last change.

    Notes
    -----
    The distance is the straight line to the position of the last change (absolute distance, vCertChangeDistance of the
    standard), so that a vehicle that drives in circles does not change. `distance = "driven"` uses the driven distance.
    Deviations: the standard itself was not available. The limit of SCMS on certificates (20 a week) is not modelled.
    """

    Params = ScmsParams

    def changes(self, ages: PseudonymAges) -> Bool[ndarray, "e"]:
        """Vehicles for which both the time and the distance are reached."""
        far_m = ages.away_m if self.params.distance == "place" else ages.distance_m
        return (ages.age_s >= 300.0 - 1e-9) & (far_m >= 2000.0)


POLICIES: Mapping[str, type] = {
    "none": Never,
    "periodical": Periodical,
    "disposable": Disposable,
    "distance": Distance,
    "random": Random,
    "c2c": C2c,
    "bsp": Bsp,
    "scms": Scms,
}
"""Classes of the included policies, by their name in the config."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PseudonymParams:
    """Changes, linkage and revocation of the identities in messages."""

    policy: str = "none"
    """Policy by which a vehicle changes its pseudonym: `none`, `periodical`, `disposable`, `distance`, `random`, `c2c`,
    `bsp`, `scms`, or a class of your own as path.py:Name."""
    linkage: Literal["none", "server", "on_demand", "own"] = "none"
    """Effect of a pseudonym change on trust. `none`: a new pseudonym is unknown. `server`: trust stays with the vehicle
    and is broadcast under its current pseudonym; all its identities are one evaluator then, of which the server uses
    one evaluation of a detection, so that attacks.n_identities adds none. `on_demand`: once a pseudonym has been
    accused `n_accusations` times, it and all later pseudonyms of the vehicle are linked. `own`: each receiver links
    pseudonyms itself, by position and speed."""
    n_accusations: Annotated[int, Gt(0), Le(2**31 - 1)] = 10
    """With `on_demand`: number of reports against a pseudonym after which the vehicle's later pseudonyms are linked to
    it."""
    own_gap_s: Annotated[float, Gt(0), Le(1e4)] = 1.5
    """With `own`: longest time between the last message of the old pseudonym and the first of the new one [s]."""
    own_gate_m: Annotated[float, Gt(0), Le(10_000)] = 3.0
    """With `own`: largest distance of the new pseudonym from the predicted position of the old one [m]."""
    revocation: Literal["none", "immediate", "list", "not_renewed"] = "none"
    """What happens if the server's trust in a vehicle is below `revoke_below`. Without `linkage` the server knows only
    pseudonyms, and revokes one of them. `none`: nothing. `immediate`: receivers drop its messages at once. `list`:
    receivers drop its messages from the next revocation list on. `not_renewed`: the vehicle gets no new pseudonym after
    its current ones."""
    revoke_below: Share = 0.25
    """A vehicle is revoked if the server's trust in it is below this value."""
    min_evaluations: Annotated[int, Gt(0), Le(2**31 - 1)] = 5
    """Smallest number of evaluations for a revocation."""
    list_every_s: Annotated[float, Gt(0), Le(1e8)] = 60.0
    """With `list`: time between two revocation lists [s]."""


@dataclass(frozen=True, slots=True)
class PseudonymState:
    """Pseudonyms in use, by actor number, and all pseudonyms that were issued."""

    current: Int[ndarray, "capacity"] = no_rows(np.int64)
    """Pseudonym of each vehicle; -1 for none."""
    since_step: Int[ndarray, "capacity"] = no_rows(np.int64)
    seen_step: Int[ndarray, "capacity"] = no_rows(np.int64)
    n_changes: Int[ndarray, "capacity"] = no_rows(np.int64)
    n_messages: Int[ndarray, "capacity"] = no_rows(np.int64)
    distance_m: Float[ndarray, "capacity"] = no_rows()
    xy_m: Float[ndarray, "capacity 2"] = no_rows(np.float64, 2)
    """Last position."""
    from_xy_m: Float[ndarray, "capacity 2"] = no_rows(np.float64, 2)
    """Position where it took its pseudonym."""
    beyond_step: Int[ndarray, "capacity"] = no_rows(np.int64)
    """Step in which it had driven `FIRST_STRETCH_M` under its pseudonym. It has no meaning before that."""
    linked: Int[ndarray, "capacity"] = no_rows(np.int64)
    """Pseudonym of each vehicle to which its later ones are linked on demand; -1 for none."""
    issued: Int[ndarray, "n_issued 3"] = no_rows(np.int64, 3)
    """Vehicle, identity and first step of each pseudonym that is not an actor number, in the order of issue."""
    extra: Int[ndarray, "x 4"] = no_rows(np.int64, 4)
    """Further identities. Columns: `_identity_key` (ascending), pseudonym, first and last step."""
    n_sent: int = 0
    """Number of detection messages that vehicles have made so far."""
    accusations: dict[int, set[int]] = field(default_factory=dict)
    """Accusations of pseudonyms that are not linked yet: evaluator and step in one number."""
    revoked: dict[int, int] = field(default_factory=dict)
    """Subjects that are revoked, and the first step of the revocation."""
    refused: dict[int, int] = field(default_factory=dict)
    """Pseudonyms whose messages were dropped, and the first step in which they were."""

    def of(self, actor: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
        """Current pseudonym of each vehicle; -1 if it has had none yet."""
        found = np.full(len(actor), -1)
        known = actor < len(self.current)
        found[known] = self.current[actor[known]]
        return found

    def further(self, actor: Int[ndarray, "n"]) -> Int[ndarray, "x"]:
        """Pseudonyms of all further identities of these vehicles."""
        vehicle, _ = _of_identity_key(self.extra[:, 0])
        return self.extra[np.isin(vehicle, actor), 1]

    def begun(self, actor: Int[ndarray, "n"], now_step: int) -> Int[ndarray, "n"]:
        """Step in which each vehicle took its current pseudonym; `now_step` if it has none."""
        found = np.full(len(actor), now_step)
        known = np.flatnonzero(actor < len(self.current))
        known = known[self.current[actor[known]] >= 0]
        found[known] = self.since_step[actor[known]]
        return found

    def with_columns(self, actor: Int[ndarray, "n"], columns: Mapping[str, ndarray | int]) -> "PseudonymState":
        """The state, with these values of some vehicles in the named columns."""
        changed: dict[str, Any] = {}
        for name, values in columns.items():
            changed[name] = getattr(self, name).copy()
            changed[name][actor] = values
        return replace(self, **changed)


@dataclass(frozen=True, slots=True)
class PseudonymUse:
    """Pseudonyms that have ended: rows of the table `pseudonyms`."""

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
        """Rows for these pseudonyms."""
        identity = np.zeros(len(pseudonym), np.int64) if identity is None else identity
        refused_step = [state.refused.get(p, -1) for p in pseudonym.tolist()]
        refused = np.array(refused_step, np.int64)
        return PseudonymUse(pseudonym, vehicle, from_step, to_step, identity, refused)


@dataclass(frozen=True, slots=True)
class Pseudonyms:
    """Issues pseudonyms to equipped vehicles by a policy."""

    policy: PseudonymPolicy
    seed: int
    dt_s: float

    @property
    def by_number(self) -> bool:
        """Whether a vehicle's pseudonym is its actor number."""
        return isinstance(self.policy, Never)

    def issue(
        self,
        state: PseudonymState,
        world: World,
        observers: Int[ndarray, "e"],
        wants: Bool[ndarray, "e"] | None = None,
    ) -> tuple[PseudonymState, PseudonymUse]:
        """Give equipped vehicles the pseudonyms of this step.

        Parameters
        ----------
        observers
            Equipped vehicles, rows of the world.
        wants
            Vehicles that change whatever the policy says.

        Returns
        -------
        The new state, and the pseudonyms that ended in this step.
        """
        actor = world.actor[observers]
        xy_m = world.boxes.xyz_m[observers, :2]
        state = _grown(state, int(actor.max(initial=-1)) + 1)
        current = state.current[actor]
        is_new = current < 0
        before_m = state.distance_m[actor]
        moved_m = np.hypot(*(xy_m - state.xy_m[actor]).T)
        distance_m = before_m + np.where(is_new, 0.0, moved_m)
        gets_beyond = (before_m < FIRST_STRETCH_M) & (distance_m >= FIRST_STRETCH_M)
        beyond_step = np.where(gets_beyond, world.step, state.beyond_step[actor])
        ages = self._ages(state, world, observers, distance_m, beyond_step)

        changes = np.asarray(self.policy.changes(ages), bool)
        if wants is not None:
            changes = changes | wants
        changes = changes & ~is_new & ~world.is_roadside[observers]  # certificates of roadside units say who they are
        takes = is_new | changes
        given_up = actor[changes]
        last_step = np.full(len(given_up), world.step - 1)  # in use between its last message and the first of the next
        ended = PseudonymUse.of(state, current[changes], given_up, state.since_step[given_up], last_step)

        is_numbered = takes
        if self.by_number:
            current[is_new] = actor[is_new]
            is_numbered = changes  # only by attackers that change their pseudonyms in addition to the policy
        numbered = actor[is_numbered]
        first_identity = np.zeros_like(numbered)
        state, current[is_numbered] = self._next_numbers(state, numbered, first_identity, world.step)
        columns = {
            "current": current,
            "since_step": np.where(takes, world.step, state.since_step[actor]),
            "seen_step": world.step,
            "n_changes": ages.n_changes + changes,
            "n_messages": np.where(takes, 0, ages.n_messages),
            "distance_m": np.where(takes, 0.0, distance_m),
            "xy_m": xy_m,
            "from_xy_m": np.where(takes[:, None], xy_m, state.from_xy_m[actor]),
            "beyond_step": beyond_step,
        }
        return state.with_columns(actor, columns), ended

    def counted(self, state: PseudonymState, actor: Int[ndarray, "k"]) -> PseudonymState:
        """The state after these vehicles have each made a detection message."""
        counted = state.with_columns(actor, {"n_messages": state.n_messages[actor] + 1})
        return replace(counted, n_sent=state.n_sent + len(actor))

    def _ages(
        self,
        state: PseudonymState,
        world: World,
        observers: Int[ndarray, "e"],
        distance_m: Float[ndarray, "e"],
        beyond_step: Int[ndarray, "e"],
    ) -> PseudonymAges:
        """Age and use of the pseudonyms of these vehicles, given the last two columns of the state as they are now."""
        actor, name = world.actor[observers], world.name_key[observers]
        from_start_m = world.boxes.xyz_m[observers, :2] - state.from_xy_m[actor]
        beyond_s = (world.step - beyond_step) * self.dt_s
        n_changes = state.n_changes[actor]
        trip_key = rng.key(self.seed, rng.Stream.PSEUDONYM)
        step_key = rng.key(self.seed, rng.Stream.PSEUDONYM, world.step + 1)
        return PseudonymAges(
            n_changes=n_changes,
            age_s=(world.step - state.since_step[actor]) * self.dt_s,
            distance_m=distance_m,
            away_m=np.hypot(*from_start_m.T),
            beyond_s=np.where(distance_m >= FIRST_STRETCH_M, beyond_s, 0.0),
            n_messages=state.n_messages[actor],
            trip_draws=rng.uniforms(trip_key, name, n_changes, n=4),
            step_draws=rng.uniforms(step_key, name)[:, 0],
        )

    def issue_extra(
        self, state: PseudonymState, vehicle: Int[ndarray, "x"], identity: Int[ndarray, "x"], step: int
    ) -> tuple[PseudonymState, Int[ndarray, "x"]]:
        """Pseudonyms of further identities of vehicles. An identity keeps its pseudonym.

        Parameters
        ----------
        vehicle
            Actor number.
        identity
            Number of the identity, from 1.

        Returns
        -------
        The new state, and the pseudonyms in the given order.
        """
        key = _identity_key(vehicle, identity)
        new = np.setdiff1d(key, state.extra[:, 0])
        state, numbers = self._next_numbers(state, *_of_identity_key(new), step)
        rows = np.column_stack([new, numbers, np.full((len(new), 2), step)])
        extra = np.concatenate([state.extra, rows])
        extra = extra[np.argsort(extra[:, 0], kind="stable")]
        at = np.searchsorted(extra[:, 0], key)
        extra[at, 3] = step
        return replace(state, extra=extra), extra[at, 1]

    def owners(
        self, state: PseudonymState, pseudonym: Int[ndarray, "n"]
    ) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
        """Actor number of the vehicle behind each pseudonym, and its identity; -1 and -1 if it was never issued."""
        return self._issued(state, pseudonym, 0, pseudonym), self._issued(state, pseudonym, 1, 0)

    def since(self, state: PseudonymState, pseudonym: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
        """First step of each pseudonym; -1 if it is an actor number or was never issued."""
        return self._issued(state, pseudonym, 2, -1)

    def _issued(self, state: PseudonymState, pseudonym: ndarray, column: int, of_number: ndarray | int) -> ndarray:
        """A column of `state.issued` for each pseudonym; -1 if it was never issued.

        `of_number` is the value for a pseudonym that is an actor number.
        """
        at = pseudonym - FIRST_EXTRA if self.by_number else pseudonym
        inside = (at >= 0) & (at < len(state.issued))
        found = np.full(len(pseudonym), -1)
        found[inside] = state.issued[at[inside], column]
        if self.by_number:
            by_number = np.flatnonzero((pseudonym >= 0) & (pseudonym < len(state.current)))
            by_number = by_number[state.current[pseudonym[by_number]] >= 0]
            found[by_number] = np.broadcast_to(of_number, len(pseudonym))[by_number]
        return found

    def _next_numbers(
        self, state: PseudonymState, vehicle: Int[ndarray, "k"], identity: Int[ndarray, "k"], step: int
    ) -> tuple[PseudonymState, Int[ndarray, "k"]]:
        """The state, and new pseudonyms with the next numbers."""
        if not len(vehicle):
            return state, np.zeros(0, np.int64)
        first = len(state.issued) + (FIRST_EXTRA if self.by_number else 0)
        rows = np.column_stack([vehicle, identity, np.full(len(vehicle), step)])
        state = replace(state, issued=np.concatenate([state.issued, rows]))
        return state, first + np.arange(len(vehicle))

    def in_use(self, state: PseudonymState) -> PseudonymUse:
        """Pseudonyms that are still in use when recording ends."""
        vehicle, extra = np.flatnonzero(state.current >= 0), state.extra
        extra_vehicle, extra_identity = _of_identity_key(extra[:, 0])
        return PseudonymUse.of(
            state,
            np.concatenate([state.current[vehicle], extra[:, 1]]),
            np.concatenate([vehicle, extra_vehicle]),
            np.concatenate([state.since_step[vehicle], extra[:, 2]]),
            np.concatenate([state.seen_step[vehicle], extra[:, 3]]),
            np.concatenate([np.zeros_like(vehicle), extra_identity]),
        )


def _identity_key(
    vehicle: Int[ndarray, "n"],
    identity: Int[ndarray, "n"],
) -> Int[ndarray, "n"]:
    """Vehicle and identity as one integer, in the order of both. Identities have 16 bits."""
    return vehicle.astype(np.int64) << 16 | identity


def _of_identity_key(
    key: Int[ndarray, "n"],
) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    """Vehicle and identity of each `_identity_key`."""
    return key >> 16, key & (1 << 16) - 1


_PER_VEHICLE = (
    "current",
    "since_step",
    "seen_step",
    "n_changes",
    "n_messages",
    "distance_m",
    "xy_m",
    "from_xy_m",
    "beyond_step",
    "linked",
)
"""Columns of `PseudonymState` by actor number."""


def _grown(state: PseudonymState, size: int) -> PseudonymState:
    """The state, extended to actor numbers below `size`."""
    old = len(state.current)
    if size <= old:
        return state
    more = max(size, 2 * old, 64) - old

    def longer(name: str) -> ndarray:
        column = getattr(state, name)
        fill = -1 if name in ("current", "linked") else 0
        added = np.full((more, *column.shape[1:]), fill, column.dtype)
        return np.concatenate([column, added])

    columns: dict[str, Any] = {name: longer(name) for name in _PER_VEHICLE}
    return replace(state, **columns)
