"""Encounters of pairs of actors, tracked step by step."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.codes import EncounterPairs, LookupState, LosBlockers, TrustSource
from results import encounter_counts

Rows = dict[str, ndarray]
"""Columns of the table `encounters`, ready for the recorder."""

Appearance = Literal["ends", "censors"]
"""What an actor's first and last step mean: it enters and leaves the road, or its observation begins and ends."""


@dataclass(frozen=True, kw_only=True, slots=True)
class EncounterParams:
    """What counts as an encounter."""

    radius_m: Annotated[float, Gt(0), Le(100_000)] = 100.0
    """Largest distance that counts as contact [m]."""
    hysteresis_s: Annotated[float, Ge(0), Le(1e7)] = 3.0
    """An interruption of contact that is shorter than this does not end an encounter [s]."""
    pairs: Literal["all", "equipped", "los", "all_los"] = "equipped"
    """Pairs that count. `all`: all pairs. `equipped`: pairs of equipped vehicles. `los`: pairs of equipped vehicles
    with line of sight. `all_los`: all pairs with line of sight."""
    los: Literal["buildings", "buildings_and_vehicles"] = "buildings_and_vehicles"
    """What obstructs the line of sight between two roofs: buildings, or buildings and the bodies of other actors."""
    pedestrians: bool = False
    """Whether pedestrians count, with `pairs = "all"` or `"all_los"`."""

    def __post_init__(self) -> None:
        if self.pedestrians and self.pairs not in ("all", "all_los"):
            raise ValueError(
                f'encounters.pedestrians = true with encounters.pairs = "{self.pairs}": pedestrians are not equipped. '
                'Set encounters.pairs to "all" or "all_los".'
            )


def check_definitions(definitions: Sequence[EncounterParams]) -> None:
    """ValueError where two definitions would have the same rows: tables keep radii and times as 32-bit numbers."""
    first_of: dict[tuple, int] = {}
    for number, of in enumerate(definitions):
        kept = np.array([of.radius_m, of.hysteresis_s], np.float32)
        key = (*kept.tolist(), of.pairs, of.los, of.pedestrians)
        first = first_of.setdefault(key, number)
        if first < number:
            raise ValueError(
                f"encounters.{number} is the same definition as encounters.{first}: radius_m = "
                f"{of.radius_m!r} and {definitions[first].radius_m!r} are one 32-bit number, and "
                "all else is equal. Leave one of them out."
            )


_COUNTERS = tuple(f"n_{what}_{way}" for what in ("messages", "evaluations") for way in ("ab", "ba"))
_LIVE: dict[str, type] = {
    "start": np.int32,  # first step in contact
    "end": np.int32,  # one past the last step in contact
    "n": np.int32,  # steps in contact
    "n_los": np.int32,
    "sum_m": np.float64,
    "min_m": np.float64,
    "previous_end": np.int32,
    "again": np.bool_,  # the two had an encounter before
    "censored_left": np.bool_,
    "entered": np.bool_,
    **dict.fromkeys(_COUNTERS, np.int32),
    **{f"{name}_later": np.int32 for name in _COUNTERS},  # of them since the last step in contact
}
_TRUST_OF_WAY: dict[str, type] = {
    "trusted_{way}": np.bool_,
    "trusted_step_{way}": np.int32,
    "trust_{way}": np.float32,
    "known_{way}": np.bool_,
    "source_{way}": np.int8,
    "state_{way}": np.int8,
    "age_{way}_s": np.float32,
}
_TRUST = {name.format(way=way): dtype for name, dtype in _TRUST_OF_WAY.items() for way in ("ab", "ba")}
"""Columns of which there is one per trust variant."""

AWAY_S = 3600.0
"""An actor that is off the road for longer has no earlier encounters when it comes back [s]."""
_PENDING = 4096
"""Ended encounters gathered before they join the sorted memory of past ones."""


class EncounterTracker:
    """Encounters by one definition, updated at every step; memory grows with the pairs of an hour, not with time.

    It takes plain arrays of actor numbers and can be copied deeply and pickled at any time. Of each actor, one number
    stays.

    Notes
    -----
    Steps are samples: a pair in contact at steps s ... t-1 was so for (t - s) * dt_s, an unbiased estimate of
    the time in continuous contact. A break is the time out of contact between two contacts; if it is
    shorter than `hysteresis_s` the encounter goes on and the break counts in its duration.

    An encounter under way at the first step is censored on the left; one not known to be over at
    `close` is censored on the right (also during a break that may still be bridged), and so lasts at least
    as long as its duration says. An actor that leaves the simulation ends its encounters: that is
    no censoring, because the pair no longer exists; `departed` marks them for another convention.
    The end of a pair's last encounter is remembered until one of the two is away for longer than `AWAY_S`, or for
    good if `appearance` is "censors".

    With `n_variants` trust variants, columns of trust are arrays (encounter, variant): `by_variant` takes them apart.

    If `appearance` is "censors", an actor appears and vanishes because its observation begins and ends, as in a trace
    with gaps: it may have been on the road before, and the pair may go on. Encounters that begin or end with that
    are censored.
    """

    _censors = False

    def __init__(
        self, params: EncounterParams, dt_s: float, n_variants: int = 1, appearance: Appearance = "ends"
    ) -> None:
        self.params = params
        self.dt_s = dt_s
        self.n_variants = n_variants
        self._censors = appearance == "censors"
        # A break of m steps ends the encounter once m * dt_s >= hysteresis_s (but for rounding).
        self._patience = max(1, int(np.ceil(params.hysteresis_s / dt_s - 1e-9)))
        self._step: int | None = None
        self._present = np.zeros(0, np.int64)
        self._last_seen = np.zeros(0, np.int32)  # step, by actor number
        self._longest_away = math.inf if self._censors else AWAY_S / dt_s  # steps
        self._pair = np.zeros(0, np.int64)  # a << 32 | b, sorted
        self._slot = np.zeros(0, np.int64)  # where the columns hold each pair
        self._index: tuple[ndarray, ndarray, ndarray] | None = None  # of these two; None after a change
        self._free = np.zeros(0, np.int64)  # slots that hold none
        self._live: Rows = self._columns(0)
        # Pairs, sorted, and ends of their last encounter.
        self._past = (np.zeros(0, np.int64), np.zeros(0, np.int32))
        self._pending = (np.zeros(0, np.int64), np.zeros(0, np.int32))

    def __len__(self) -> int:
        """Encounters under way."""
        return len(self._pair)

    def update(
        self,
        step: int,
        a: Int[ndarray, "n"],
        b: Int[ndarray, "n"],
        distance_m: Float[ndarray, "n"],
        los: Bool[ndarray, "n"],
        present: Int[ndarray, "m"],
        equipped: Bool[ndarray, "n"] | None = None,
    ) -> tuple[Rows, Int[ndarray, "k"]]:
        """Add one step.

        Parameters
        ----------
        step
            One more than at the last call; after a call without actors, any later one.
        a, b
            Actor numbers, a < b, no pair twice; at least all pairs within the radius.
        los
            Whether the two have line of sight.
        present
            All actors on the road.
        equipped
            Whether both are equipped; left out, all pairs given are.

        Returns
        -------
        Rows of the encounters now over, and indices of the given pairs whose encounter begins.
        """
        self._assert_follows(step)
        first = self._step is None
        contact = distance_m <= self.params.radius_m
        if self.params.pairs in ("equipped", "los") and equipped is not None:
            contact &= equipped
        if self.params.pairs in ("los", "all_los"):
            contact &= los
        given = np.flatnonzero(contact)
        pair = _pair(a[given], b[given])
        assert (a[given] < b[given]).all(), "pairs must be given as a < b"
        if (pair[1:] <= pair[:-1]).any():
            order = np.argsort(pair, kind="stable")
            given, pair = given[order], pair[order]
            assert (pair[1:] > pair[:-1]).all(), "a pair is given twice"
        present = np.sort(np.asarray(present, np.int64))
        came = np.setdiff1d(present, self._present, assume_unique=True)
        left = np.setdiff1d(self._present, present, assume_unique=True)
        self._forget(came, step)
        self._step, self._present = step, present
        self._last_seen[present] = step

        at, under_way = _find(self._pair, pair)
        live, now = self._live, self._slot[at[under_way]]
        metres, visible = distance_m[given], los[given]
        live["end"][now] = step + 1
        live["n"][now] += 1
        live["n_los"][now] += visible[under_way]
        live["sum_m"][now] += metres[under_way]
        live["min_m"][now] = np.minimum(live["min_m"][now], metres[under_way])
        for name in _COUNTERS:  # the break is bridged
            live[name][now] += live[f"{name}_later"][now]
            live[f"{name}_later"][now] = 0

        new = ~under_way
        gone = _involve(self._pair, left)
        end = live["end"][self._slot]
        over = np.flatnonzero(gone | (step + 1 - end >= self._patience))
        departed = gone[over] & (end[over] == step)
        rows = self._rows(over, departed, gone[over] & self._censors)
        self._remember(over)
        keep = np.ones(len(self._pair), bool)
        keep[over] = False
        new_pair = pair[new]
        opened = self._opened(step, new_pair, metres[new], visible[new], came, first)
        self._merge(keep, new_pair, opened)
        return rows, given[new]

    def close(self, step: int) -> Rows:
        """Rows of what is still going on at the end of recording; `step` is one past the last step."""
        self._assert_follows(step)
        none = np.zeros(len(self), bool)
        closed = self._rows(np.arange(len(self)), departed=none, censored_right=~none)
        self._merge(none, self._pair[:0], {})
        return closed

    def count_messages(self, sender: Int[ndarray, "n"], receiver: Int[ndarray, "n"]) -> None:
        """Add received messages. Messages between two actors without an encounter under way are left out.

        Parameters
        ----------
        sender, receiver
            Actor numbers, one row per received message; fast if the rows of a receiver follow each other.
        """
        at = self._slots(receiver, sender)  # messages go by receiver
        self._count("messages", at, sender, receiver, np.zeros(0, np.int64))

    def count_evaluations(
        self,
        evaluator: Int[ndarray, "n"],
        observer: Int[ndarray, "n"],
        n: Int[ndarray, "n"],
    ) -> None:
        """Add evaluations. Those between two actors without an encounter under way are left out.

        Parameters
        ----------
        evaluator, observer
            Actor numbers of who evaluates, and of whose detections are evaluated; fast if the rows of an evaluator
            follow each other.
        n
            Number of evaluations in each row.
        """
        at = self._slots(evaluator, observer)
        self._count("evaluations", at, evaluator, observer, np.asarray(n, np.int64))

    def _count(
        self,
        what: str,
        at: Int[ndarray, "n"],
        one: Int[ndarray, "n"],
        other: Int[ndarray, "n"],
        n: Int[ndarray, "_"],
    ) -> None:
        """Count what one does to the other. What follows the last step in contact counts if contact comes again."""
        assert self._step is not None
        live = self._live
        in_contact = live["end"] == self._step + 1
        one, other = (np.asarray(actors, np.int32) for actors in (one, other))  # the type of the compiled kernel
        names = [f"n_{what}_{way}{when}" for when in ("", "_later") for way in ("ab", "ba")]
        encounter_counts.count(at, one, other, n, in_contact, *(live[name] for name in names))

    def note_trust(
        self,
        holder: Int[ndarray, "n"],
        other: Int[ndarray, "n"],
        looked_up: Bool[ndarray, "n v"],
    ) -> None:
        """Note that trust with evidence is looked up in this step. Only the first time in an encounter counts.

        Two actors without an encounter under way are left out.

        Parameters
        ----------
        holder, other
            Actor numbers of who looks up trust, and of the actor that it is about.
        looked_up
            Whether the value rests on an evaluation; one column per trust variant.
        """
        assert self._step is not None
        live = self._live
        trusted = live["trusted_ab"], live["trusted_ba"]
        since = live["trusted_step_ab"], live["trusted_step_ba"]
        at = self._slots(holder, other)
        encounter_counts.note(at, holder, other, looked_up, self._step, *trusted, *since)

    def first_contact(
        self,
        holder: Int[ndarray, "n"],
        other: Int[ndarray, "n"],
        trust: Float[ndarray, "n v"],
        source: Int[ndarray, "n v"],
        state: Int[ndarray, "n v"],
        age_s: Float[ndarray, "n v"],
    ) -> None:
        """Note the trust that `holder` would look up now, for pairs whose encounter begins in this step.

        Other pairs are left out. Values that rest on an evaluation also count for `note_trust`.

        Parameters
        ----------
        holder, other
            Actor numbers of who would look up trust, and of the actor that it is about.
        trust, source, state, age_s
            Value, code of `TrustSource`, code of `LookupState`, and age, which is ignored for a default value. One
            column per trust variant; with one variant the arrays may be flat.
        """
        shape = len(holder), self.n_variants
        given = trust, source, state, age_s
        trust, source, state, age_s = (np.reshape(values, shape) for values in given)
        at = self._slots(holder, other)
        begins = at >= 0
        live = self._live
        begins[begins] = live["start"][at[begins]] == self._step
        rests_on_evaluation = np.isin(state[begins], (LookupState.EVALUATED, LookupState.STALE))
        self.note_trust(holder[begins], other[begins], rests_on_evaluation)
        age_s = np.where(source == TrustSource.DEFAULT, 0, age_s)
        is_ab = holder < other
        for way, of_way in (("ab", is_ab), ("ba", ~is_ab)):
            rows = begins & of_way
            where = at[rows]
            live[f"known_{way}"][where] = True
            live[f"trust_{way}"][where] = trust[rows]
            live[f"source_{way}"][where] = source[rows]
            live[f"state_{way}"][where] = state[rows]
            live[f"age_{way}_s"][where] = age_s[rows]

    def _assert_follows(self, step: int) -> None:
        if self._step is None:
            return
        is_next = step == self._step + 1
        nobody = step > self._step and not len(self._present)
        assert is_next or nobody, f"step {step} does not follow {self._step}"

    def _slots(self, one: ndarray, other: ndarray) -> Int[ndarray, "n"]:
        """Slot of the encounter of each two, -1 where none is under way."""
        one, other = (np.asarray(actors, np.int32) for actors in (one, other))  # the type of the compiled kernel
        if self._index is None:
            self._index = encounter_counts.index(self._pair, self._slot)
        return encounter_counts.slots(*self._index, one, other)

    def _opened(
        self, step: int, pair: ndarray, metres: ndarray, visible: ndarray, came: ndarray, first: bool
    ) -> dict[str, ndarray]:
        """Live columns of encounters that begin now."""
        opened = self._columns(len(pair))
        for past in (self._past, self._pending):  # the later one holds the later encounter
            at, met = _find(past[0], pair)
            opened["previous_end"][met] = past[1][at[met]]
            opened["again"] |= met
        opened["start"][:] = step
        opened["end"][:] = step + 1
        opened["n"][:] = 1
        opened["n_los"][:] = visible
        opened["sum_m"][:] = metres
        opened["min_m"][:] = metres
        opened["censored_left"][:] = first
        if not first:
            opened["entered"][:] = _involve(pair, came)
            opened["censored_left"][:] = opened["entered"] & self._censors
        return opened

    def _columns(self, n: int) -> Rows:
        """Live columns of `n` encounters, all zero."""
        flat: Rows = {name: np.zeros(n, dtype) for name, dtype in _LIVE.items()}
        shape = (n, self.n_variants)
        return flat | {name: np.zeros(shape, dtype) for name, dtype in _TRUST.items()}

    def _merge(
        self,
        keep: Bool[ndarray, "live"],
        pair: Int[ndarray, "k"],
        opened: dict[str, ndarray],
    ) -> None:
        """Drop encounters that are over, let new ones in, stay sorted."""
        if keep.all() and not len(pair):
            return
        self._free = np.concatenate([self._free, self._slot[~keep]])
        if len(self._free) < len(pair):
            size = len(self._live["n"])
            more = size + len(pair)  # at least twice as many as are held
            self._free = np.concatenate([self._free, np.arange(size, size + more)])
            for name, empty in self._columns(more).items():
                self._live[name] = np.concatenate([self._live[name], empty])
        slots = self._free[: len(pair)]
        self._free = self._free[len(pair) :]
        for name, values in opened.items():
            self._live[name][slots] = values
        held = self._pair[keep]
        at = np.searchsorted(held, pair)
        self._pair = np.insert(held, at, pair)
        self._slot = np.insert(self._slot[keep], at, slots)
        self._index = None

    def _forget(self, came: Int[ndarray, "c"], step: int) -> None:
        """Forget past encounters of actors that come back after a long time; make room for those that are new."""
        known = len(self._last_seen)
        if len(came) and came[-1] >= known:
            more = np.full(came[-1] + 1, step, np.int32)
            self._last_seen = np.concatenate([self._last_seen, more])
        back = came[came < known]
        back = back[step - self._last_seen[back] > self._longest_away]
        if len(back):
            self._past = _without(back, *self._past)
            self._pending = _without(back, *self._pending)

    def _remember(self, over: Int[ndarray, "k"]) -> None:
        end = self._live["end"][self._slot[over]]
        pair, end = _latest(*self._pending, self._pair[over], end)
        if len(pair) > _PENDING:
            pair, end = _latest(*self._past, pair, end)
            assert self._step is not None
            away = self._step - self._last_seen > self._longest_away
            first, second = _actors(pair)
            kept = ~(away[first] | away[second])
            self._past = (pair[kept], end[kept])
            pair, end = pair[:0], end[:0]
        self._pending = (pair, end)

    def _rows(self, at: ndarray, departed: ndarray, censored_right: ndarray) -> Rows:
        """Rows of the table `encounters`."""
        slot = self._slot[at]
        live = {name: values[slot] for name, values in self._live.items()}
        n = len(at)
        a, b = _actors(self._pair[at])
        start = live["start"][:, None]
        end = live["end"][:, None]
        trust: Rows = {}
        for way in ("ab", "ba"):
            known = live[f"known_{way}"]
            since = live[f"trusted_step_{way}"]
            in_time = since < end  # a value first looked up after the last contact came too late for the encounter
            trust |= {
                f"trust_{way}": live[f"trust_{way}"],
                f"trust_{way}__valid": known,
                f"source_{way}": live[f"source_{way}"],
                f"source_{way}__valid": known,
                f"state_{way}": live[f"state_{way}"],
                f"state_{way}__valid": known,
                f"age_{way}_s": live[f"age_{way}_s"],
                f"age_{way}_s__valid": known & (live[f"source_{way}"] != TrustSource.DEFAULT),
                f"trusted_after_{way}_s": (since - start) * self.dt_s,
                f"trusted_after_{way}_s__valid": live[f"trusted_{way}"] & in_time,
            }
        if self.n_variants == 1:
            trust = {name: values[:, 0] for name, values in trust.items()}
        return {
            "a": a.astype(np.int32),
            "b": b.astype(np.int32),
            "start_step": live["start"],
            "radius_m": np.full(n, self.params.radius_m, np.float32),
            "pairs": np.full(n, EncounterPairs[self.params.pairs.upper()], np.int8),
            "hysteresis_s": np.full(n, self.params.hysteresis_s, np.float32),
            "los": np.full(n, LosBlockers[self.params.los.upper()], np.int8),
            "pedestrians": np.full(n, self.params.pedestrians),
            "end_step": live["end"],
            "duration_s": (live["end"] - live["start"]) * self.dt_s,
            "censored_left": live["censored_left"],
            "censored_right": censored_right,
            "entered": live["entered"],
            "departed": departed,
            "gap_s": (live["start"] - live["previous_end"]) * self.dt_s,
            "gap_s__valid": live["again"],
            "min_distance_m": live["min_m"],
            "mean_distance_m": live["sum_m"] / np.maximum(live["n"], 1),
            "los_share": live["n_los"] / np.maximum(live["n"], 1),
            **{name: live[name] for name in _COUNTERS},
            **trust,
        }


ENCOUNTER_KEY = ("a", "b", "start_step", "radius_m", "pairs", "hysteresis_s", "los", "pedestrians")
"""Columns that name an encounter."""


def by_variant(rows: Rows) -> tuple[Rows, Rows]:
    """A tracker's rows as rows of the tables `encounters` (trust of the variant that acts) and `encounter_trust`."""
    of_variants = {name: values for name, values in rows.items() if values.ndim == 2}
    if not of_variants:
        return rows, {}
    n, n_variants = next(iter(of_variants.values())).shape
    variant = np.repeat(np.arange(1, n_variants), n)
    others = {"variant": variant}
    for name in ENCOUNTER_KEY:
        others[name] = np.tile(rows[name], n_variants - 1)
    acting: Rows = {}
    for name, values in of_variants.items():
        acting[name] = values[:, 0]
        others[name] = values[:, 1:].T.ravel()
    return rows | acting, others


def _pair(
    a: Int[ndarray, "n"],
    b: Int[ndarray, "n"],
) -> Int[ndarray, "n"]:
    return (np.asarray(a, np.int64) << 32) | np.asarray(b, np.int64)


def _actors(
    pair: Int[ndarray, "n"],
) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    return pair >> 32, pair & 0xFFFFFFFF


def _involve(
    pair: Int[ndarray, "n"],
    actors: Int[ndarray, "m"],
) -> Bool[ndarray, "n"]:
    """Whether one of these actors is in each pair."""
    if not len(actors):
        return np.zeros(len(pair), bool)
    a, b = _actors(pair)
    return np.isin(a, actors) | np.isin(b, actors)


def _without(actors: ndarray, pair: ndarray, end: ndarray) -> tuple[ndarray, ndarray]:
    """Pairs and their ends, without those of these actors."""
    stays = ~_involve(pair, actors)
    return pair[stays], end[stays]


def _find(
    held: Int[ndarray, "m"],
    wanted: Int[ndarray, "n"],
) -> tuple[ndarray, ndarray]:
    """Positions of `wanted` in sorted `held`, and whether they are there."""
    at = np.searchsorted(held, wanted)
    if not len(held):
        return at, np.zeros(len(wanted), bool)
    return at, held[np.minimum(at, len(held) - 1)] == wanted


def _latest(pair: ndarray, end: ndarray, new_pair: ndarray, new_end: ndarray) -> tuple[ndarray, ndarray]:
    """Both lists in one, sorted; the new one wins."""
    at, known = _find(pair, new_pair)
    end = end.copy()
    end[at[known]] = new_end[known]
    new = ~known
    place = at[new]
    ends = np.insert(end, place, new_end[new])
    return np.insert(pair, place, new_pair[new]), ends
