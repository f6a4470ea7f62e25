"""What vehicles look up of trust: the largest table of a run, read once for many metrics and for all trust variants."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.codes import LookupState, TrustSource
from cosim.base.durable import Damaged
from results.metrics.radio import why_none_received
from results.metrics.trust import HONEST, suspect_below, suspect_from, watched
from results.run import Run
from results.sensing import interval_steps

AGES: Mapping[str, str] = {
    "value": "age_s",
    "newest evaluation": "newest_evaluation_age_s",
    "oldest evaluation": "oldest_evaluation_age_s",
}
"""What ages, and the column of `trust_lookups` that says how old it is."""
RENEWED = ("value", "newest evaluation")
"""Of these, what has a peak age and an age over time."""
BEHIND = ("n_evaluations", "n_evaluators")
"""Columns of what stands behind values."""
FRESH_S = 10.0
REACH_S = 3.0
"""Two successive lookups of a subject are one stay within reach if they lie at most this far apart, or at most two
sensing intervals of the receiver where these are longer."""

_DTYPES = {
    "variant": np.int16,
    "step": np.int32,
    "receiver": np.int32,
    "subject": np.int32,
    "state": np.int16,
    "source": np.int16,
    "trust": np.float32,
    "age_s": np.float32,
    "newest_evaluation_age_s": np.float32,
    "oldest_evaluation_age_s": np.float32,
    "n_evaluations": np.int32,
    "n_evaluators": np.float32,
}
"""Of the columns that are added up, whatever a block holds, so that kernels are compiled once."""
_AGES_PER_S = 1024
"""Ages are stored in multiples of this part of a second."""
_PIECE_ROWS = 1_000_000
"""Rows that are read at once, about."""
_MOST_SCORES = 1 << 21
"""Different pairs of subject and value that are kept apart; where there are more, values are rounded."""
_SCORES = 4096
"""Values are then multiples of this part of 1."""


def no_lookups(run: Run) -> ValueError:
    """The error that no vehicle has looked up trust, and why."""
    return run.lacks("trust lookups", why_none_received(run))


class Sums(NamedTuple):
    """Lookups of a trust variant added up by vehicle that looks up (r, by number) and role of the subject."""

    states: Int[ndarray, "r role state"]
    """Lookups by what stands behind the value."""
    fresh: Int[ndarray, "r role"]
    """Those whose value rests on an evaluation at most `fresh_s` old."""
    aged: Int[ndarray, "r role age"]
    """Those with each age of `AGES`, and the sum of these."""
    age_sum_s: Float[ndarray, "r role age"]
    age_counts: Int[ndarray, "role age k"]
    """How often each of the ages in `ages_s` occurs."""
    behind: Int[ndarray, "r 2"]
    """Those with evaluations behind the value, with each of `BEHIND`, and the sum of these."""
    behind_sum: Float[ndarray, "r 2"]
    renewed: Int[ndarray, "r 2"]
    """Lookups at which each of `RENEWED` is newer than at the lookup before of the same subject, and the sum of the
    ages at the lookups before."""
    peak_sum_s: Float[ndarray, "r 2"]
    observed_s: Float[ndarray, "r 2"]
    """Time between successive lookups within reach, and the integral of the age over it: it grows until a lookup finds
    something newer."""
    area_s2: Float[ndarray, "r 2"]
    sawtooth_peaks: Int[ndarray, "r 2"]
    """Renewals within reach, and the sum of the ages just before."""
    sawtooth_peak_sum_s: Float[ndarray, "r 2"]
    n_watched: Int[ndarray, "p"]
    """Lookups of each pseudonym, in the order of `subjects`, while it is watched (`trust.watched`); those with an
    evaluated value; and those below the threshold that rest on enough evaluations (`trust.suspect_from`)."""
    n_evaluated: Int[ndarray, "p"]
    n_low: Int[ndarray, "p"]
    pairs: Int[ndarray, "p"]
    """Vehicles that looked it up meanwhile, and those that found it below the threshold."""
    pairs_found: Int[ndarray, "p"]
    waited: Int[ndarray, "role 2 step"]
    """These pairs by role, by whether they found it so, and by the steps from the first lookup until they did, or until
    the last one."""


class Scores(NamedTuple):
    """Values of watched subjects, resting on an evaluation, that were looked up."""

    who: Int[ndarray, "n"]
    """Place of the subject among `subjects`."""
    trust: Float[ndarray, "n"]
    n: Int[ndarray, "n"]
    """How often."""
    is_rounded: bool
    """Whether values were rounded because there were too many different ones."""


@dataclass(frozen=True, slots=True)
class _Asked:
    """What the sums depend on."""

    fresh_s: float
    threshold: float
    least: int
    """Evaluations behind a low value, at least."""


@dataclass(frozen=True, slots=True)
class _All:
    """Sums of all trust variants, whose tables have a first axis more, for the variant, and all ages."""

    asked: _Asked
    sums: Sums
    ages_s: Float[ndarray, "k"]


_Rows = Mapping[str, ndarray]


class _Numbers:
    """Numbers of keys, from 0 on in the order in which they were first asked for."""

    def __init__(self) -> None:
        self.keys: Int[ndarray, "n"] = np.zeros(0, np.int64)

    def of(self, wanted: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
        """Number of each wanted key, -1 for keys below 0; new keys get the next numbers."""
        number = pd.Index(self.keys).get_indexer(pd.Index(wanted))
        new = np.flatnonzero((number < 0) & (wanted >= 0))
        code, more = pd.factorize(wanted[new])
        number[new] = len(self.keys) + code
        self.keys = np.append(self.keys, more)
        return number


def sums(run: Run, fresh_s: float = FRESH_S, threshold: float | None = None) -> Sums:
    """Lookups of the run's variant, added up.

    Parameters
    ----------
    fresh_s
        Largest age of an evaluation that counts in `Sums.fresh`.
    threshold
        Trust below which a value counts as low; by default that of the run's config.

    Raises
    ------
    ValueError
        If there are no lookups.
    """
    number = run.variants.index(run.variant)
    mine = Sums(*(table[number] for table in _all(run, fresh_s, threshold).sums))
    if not mine.states.any():
        raise no_lookups(run)
    return mine


def ages_s(run: Run) -> Float[ndarray, "k"]:
    """Different ages, ascending [s]: the last axis of `Sums.age_counts`."""
    return _all(run).ages_s


_EVALUATED = f"""
WITH watched AS (
    SELECT pseudonym, to_step, greatest(from_step, if(role = '{HONEST}', first_step, attack_start_step)) AS since
    FROM subjects, (SELECT min(attack_start_step) AS first_step FROM subjects) WHERE first_step IS NOT NULL
        AND (role = '{HONEST}' OR attack_start_step IS NOT NULL)
), evaluated AS (
    SELECT variant, subject, step, trust, n_evaluations FROM trust_lookups JOIN watched ON pseudonym = subject
    WHERE n_evaluations > 0 AND step BETWEEN since AND to_step
)
"""
"""Lookups of subjects while they are watched (`trust.watched`) whose value rests on an evaluation."""


def first_lows(
    run: Run,
    threshold: float,
) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    """Step and subject of the first value by which each watched subject is suspected, of those that are looked up."""
    found = run.sql(
        f"""
        {_EVALUATED} SELECT min(step) AS step, subject FROM evaluated
        WHERE variant = $variant AND trust::DOUBLE < $threshold AND n_evaluations >= $least
        GROUP BY subject ORDER BY subject
    """,
        threshold=threshold,
        least=suspect_from(run),
    )
    return found.step.to_numpy(), found.subject.to_numpy()


def scores(run: Run) -> Scores:
    """Values of watched subjects that were looked up in the run's variant."""
    found, is_rounded = run.once_for_all("lookups.scores", lambda: _scores(run))
    mine = found[found.number == run.variants.index(run.variant)]
    who = np.searchsorted(subjects(run)[0], mine.subject.to_numpy())
    return Scores(who, mine.trust.to_numpy(np.float64), mine.n.to_numpy(), is_rounded)


def _scores(run: Run) -> tuple[pd.DataFrame, bool]:
    """number of the variant, subject, trust, n; and whether values are rounded."""
    value, is_rounded = "trust", False
    if run.n_rows("trust_lookups") > _MOST_SCORES:
        several = f"(SELECT DISTINCT variant, subject, trust FROM evaluated LIMIT {_MOST_SCORES + 1})"
        is_rounded = run.sql(f"{_EVALUATED} SELECT count(*) AS n FROM {several}").n[0] > _MOST_SCORES
    if is_rounded:
        value = f"(round_even(trust * {_SCORES}, 0) / {_SCORES})::FLOAT"
    found = run.sql(
        f"""
        {_EVALUATED} SELECT list_position($variants, variant)::SMALLINT - 1 AS number, subject, {value} AS trust,
            count(*)::INT AS n
        FROM evaluated GROUP BY ALL
    """,
        variants=list(run.variants),
    )
    return found, is_rounded


Numbers = Int[ndarray, "p"]
"""A number of each pseudonym."""


def subjects(run: Run) -> tuple[Numbers, Numbers, Numbers]:
    """All pseudonyms of the run.

    Returns
    -------
    Pseudonyms, ascending, the code of the role of each, in the order of `Run.role_labels`, and its vehicle.
    """
    return run.once_for_all("roles by pseudonym", lambda: _roles(run))


def _places(
    known: Int[ndarray, "p"],
    pseudonym: Int[ndarray, "n"],
    path: Path,
) -> Int[ndarray, "n"]:
    """Place of each pseudonym among the known ones, which are ascending; Damaged if one is not among them."""
    place = np.searchsorted(known, pseudonym)
    there = np.append(known, -1)[place] == pseudonym
    if not there.all():
        name = pseudonym[~there][0]
        raise Damaged(f"{path} is damaged: it has values for the pseudonym {name}, which no vehicle with a role used.")
    return place


def _roles(run: Run) -> tuple[Numbers, Numbers, Numbers]:
    who = run.subjects.sort_index()
    role = who.role.cat.codes.to_numpy(np.int64)
    return who.index.to_numpy(np.int64), role, who.vehicle.to_numpy(np.int64)


def _all(run: Run, fresh_s: float = FRESH_S, threshold: float | None = None) -> _All:
    """One pass over the rows of all variants, made once for every question."""
    asked = _Asked(fresh_s, suspect_below(run, threshold), suspect_from(run))
    return run.once_for_all(f"lookups, {asked}", lambda: _added(run, asked))


def _added(run: Run, asked: _Asked) -> _All:
    known, role_of, _ = subjects(run)
    vehicles = run.table("vehicles", ["vehicle", "last_step"])
    last = int(vehicles.vehicle.to_numpy().max(initial=-1))
    left = np.zeros(last + 1, np.int64)
    left[vehicles.vehicle] = vehicles.last_step
    intervals_s = interval_steps(run, np.arange(len(left))) * run.dt_s
    adding = _Adding(
        known=known,
        role_of=role_of,
        since=_watched_since(run, known),
        until=run.subjects.to_step.reindex(known).to_numpy(np.int64),  # last step in which each is in use
        left=left,
        n_variants=len(run.variants),
        n_roles=len(run.role_labels),
        n_steps=int(run.manifest["steps"]),
        dt_s=run.dt_s,
        reach_s=np.maximum(REACH_S, 2 * intervals_s),
        asked=asked,
        path=run.path,
    )
    return adding.result(run.pieces("trust_lookups", list(_DTYPES), _PIECE_ROWS))


@dataclass(eq=False)
class _Adding:
    """Lookups of some pseudonyms, added up piece by piece.

    Memory grows with vehicles, pseudonyms and different ages, and with what the vehicles now on the road have met; not
    with the number of lookups.
    """

    known: Int[ndarray, "p"]
    role_of: Int[ndarray, "p"]
    """Role of each pseudonym."""
    since: Int[ndarray, "p"]
    """First step in which it is watched."""
    until: Int[ndarray, "p"]
    """Last step in which it is in use."""
    left: Int[ndarray, "r"]
    """Last step of each vehicle."""
    n_variants: int
    n_roles: int
    n_steps: int
    dt_s: float
    reach_s: Float[ndarray, "r"]
    """How far apart two lookups of one vehicle may lie."""
    asked: _Asked
    path: Path

    def __post_init__(self) -> None:
        of_two = (
            "behind",
            "behind_sum",
            "renewed",
            "peak_sum_s",
            "observed_s",
            "area_s2",
            "sawtooth_peaks",
            "sawtooth_peak_sum_s",
        )
        by_receiver: dict[str, tuple[int, ...]] = {
            "states": (self.n_roles, len(LookupState)),
            "fresh": (self.n_roles,),
            "aged": (self.n_roles, len(AGES)),
            "age_sum_s": (self.n_roles, len(AGES)),
            **dict.fromkeys(of_two, (2,)),
        }
        self.of_receivers: dict[str, ndarray] = {}
        for name, shape in by_receiver.items():
            dtype = np.float64 if name.endswith(("_s", "_s2", "_sum")) else int
            self.of_receivers[name] = np.zeros((self.n_variants, 0, *shape), dtype)
        self.of_subjects = {
            name: np.zeros((self.n_variants, len(self.known)), np.int64)
            for name in ("n_watched", "n_evaluated", "n_low", "pairs", "pairs_found")
        }
        groups = self.n_variants, self.n_roles
        self.waited = np.zeros((*groups, 2, self.n_steps + 1), np.int64)
        self.ages = _Numbers()
        self.age_counts = np.zeros((*groups, len(AGES), 0), np.int64)
        self.pairs = _Numbers()
        self.of_pairs = self._no_pairs()

    def _no_pairs(self) -> dict[str, ndarray]:
        n = self.n_variants
        steps = {f"{name}_step": np.zeros((n, 0), np.int32) for name in ("last", "first", "low", "seen")}
        return steps | {"last_s": np.zeros((n, 0, 2), np.float32)}

    def result(self, pieces: Iterable[tuple[int, _Rows]]) -> _All:
        """The sums of pieces, each with the number of its block."""
        block, last_step = -1, -1
        for number, piece in pieces:
            if number != block:
                self._forget(last_step)
                block = number
            rows = {name: _read_only(piece[name], dtype) for name, dtype in _DTYPES.items()}
            steps = np.append(np.int32(last_step), rows["step"])
            if (np.diff(steps) < 0).any():
                raise Damaged(f"{self.path} is damaged: the steps of its trust_lookups are not ascending.")
            self._add(rows)
            last_step = int(steps[-1])
        self._settle(np.ones(len(self.pairs.keys), bool))
        order = np.argsort(self.ages.keys)
        age_counts = self.age_counts[..., order]
        sums = Sums(**self.of_receivers, **self.of_subjects, waited=self.waited, age_counts=age_counts)
        return _All(self.asked, sums, self.ages.keys[order] / _AGES_PER_S)

    def _add(self, rows: _Rows) -> None:
        who = _places(self.known, rows["subject"], self.path)
        ages_s = np.stack([rows[column] for column in AGES.values()])
        self._count(rows, who, ages_s)
        pair = self.pairs.of((rows["receiver"].astype(np.int64) << 32) | who)
        self.of_pairs = {
            name: _widened(table, 1, len(self.pairs.keys), np.nan if name == "last_s" else -1)
            for name, table in self.of_pairs.items()
        }
        self._compare_successive(rows, pair, ages_s)
        self._count_watched(rows, who, pair)

    def _count(self, rows: _Rows, who: ndarray, ages_s: ndarray) -> None:
        """Count lookups by receiver and role, with their ages."""
        from results.metrics import lookup_sums

        receiver = rows["receiver"]
        parts = np.rint(np.maximum(np.nan_to_num(ages_s), 0) * _AGES_PER_S)
        keys = np.where(np.isnan(ages_s), -1, parts)
        age_number = self.ages.of(keys.astype(np.int64).ravel()).reshape(keys.shape)
        self.age_counts = _widened(self.age_counts, 3, len(self.ages.keys))
        n_receivers = int(receiver.max(initial=-1)) + 1
        if n_receivers > len(self.left):
            raise Damaged(f"{self.path} is damaged: vehicle {n_receivers - 1} looks up trust, and there is none.")
        self.of_receivers = {name: _widened(table, 1, n_receivers) for name, table in self.of_receivers.items()}
        of = self.of_receivers
        fresh_s = np.float32(self.asked.fresh_s)
        lookup_sums.add(
            rows["variant"],
            receiver,
            who,
            rows["state"],
            ages_s,
            age_number,
            rows["n_evaluations"],
            rows["n_evaluators"],
            self.role_of,
            fresh_s,
            of["states"],
            of["fresh"],
            of["aged"],
            of["age_sum_s"],
            self.age_counts,
            of["behind"],
            of["behind_sum"],
        )

    def _compare_successive(self, rows: _Rows, pair: ndarray, ages_s: ndarray) -> None:
        """Add up what is renewed from one lookup of a pair to the next."""
        from results.metrics import lookup_sums

        of, pairs = self.of_receivers, self.of_pairs
        from_server = ages_s[: len(RENEWED)].copy()
        from_server[0, rows["source"] != TrustSource.SERVER] = np.nan
        lookup_sums.add_successive(
            rows["variant"],
            rows["receiver"],
            rows["step"],
            pair,
            from_server,
            self.dt_s,
            self.reach_s,
            pairs["last_step"],
            pairs["last_s"],
            of["renewed"],
            of["peak_sum_s"],
            of["observed_s"],
            of["area_s2"],
            of["sawtooth_peaks"],
            of["sawtooth_peak_sum_s"],
        )

    def _count_watched(self, rows: _Rows, who: ndarray, pair: ndarray) -> None:
        """Count lookups of subjects while they are watched."""
        from results.metrics import lookup_sums

        in_use = rows["step"] <= self.until[who]  # a message can still be used after its pseudonym has ended
        if not in_use.all():
            kept = {name: column[in_use] for name, column in rows.items()}
            rows = {name: _read_only(column, _DTYPES[name]) for name, column in kept.items()}
            who, pair = who[in_use], pair[in_use]
        mine, pairs, asked = self.of_subjects, self.of_pairs, self.asked
        lookup_sums.add_watched(
            rows["variant"],
            rows["step"],
            who,
            pair,
            rows["trust"],
            rows["n_evaluations"],
            self.since,
            asked.threshold,
            asked.least,
            mine["n_watched"],
            mine["n_evaluated"],
            mine["n_low"],
            pairs["first_step"],
            pairs["low_step"],
            pairs["seen_step"],
        )

    def _forget(self, step: int) -> None:
        """Forget the pairs of receivers that have left: they look nothing up any more."""
        over = self.left[self.pairs.keys >> 32] <= step
        self._settle(over)
        kept = self.pairs.keys[~over].copy()
        self.pairs = _Numbers()
        self.pairs.of(kept)
        for name, table in self.of_pairs.items():
            self.of_pairs[name] = table[:, ~over]

    def _settle(self, over: ndarray) -> None:
        """Add the pairs that are over: by role, found or not, how many steps they waited; and pairs by subject."""
        variant, pair = np.nonzero(over & (self.of_pairs["first_step"] >= 0))
        who = (self.pairs.keys & 0xFFFFFFFF)[pair]
        names = ("first_step", "low_step", "seen_step")
        first, low, seen = (self.of_pairs[name][variant, pair] for name in names)
        found = low >= 0
        waited = np.where(found, low, seen) - first
        role = self.role_of[who]
        np.add.at(self.waited, (variant, role, found.astype(int), waited), 1)
        np.add.at(self.of_subjects["pairs"], (variant, who), 1)
        np.add.at(self.of_subjects["pairs_found"], (variant[found], who[found]), 1)


def _widened(table: ndarray, axis: int, n: int, fill: float = 0) -> ndarray:
    """A table whose axis has at least `n` places."""
    more = n - table.shape[axis]
    if more <= 0:
        return table
    shape = [more if k == axis else size for k, size in enumerate(table.shape)]
    return np.concatenate([table, np.full(shape, fill, table.dtype)], axis=axis)


def _read_only(values: ndarray, dtype: type) -> ndarray:
    """Values, not to be written: arrays from Arrow without a copy are read-only, and kernels tell that apart."""
    values = np.asarray(values, dtype).view()
    values.flags.writeable = False
    return values


def _watched_since(run: Run, known: Int[ndarray, "p"]) -> Int[ndarray, "p"]:
    """First step in which each pseudonym is watched; later than any step for those that are not watched."""
    since = np.full(len(known), np.iinfo(np.int64).max)
    if run.subjects.attack_start_step.notna().any():
        who = watched(run)
        since[np.searchsorted(known, who.index)] = who.since
    return since
