"""What vehicles look up of trust: the largest table of a run, read once for many metrics and for all trust variants."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from results.codes import LookupState
from results.metrics.trust import watched
from results.run import Run

AGES: Mapping[str, str] = {
    "value": "age_s",
    "newest evaluation": "newest_evaluation_age_s",
    "oldest evaluation": "oldest_evaluation_age_s",
}
"""What ages, and the column of `trust_lookups` that says how old it is."""
RENEWED = ("value", "newest evaluation")
"""Of these, what has a peak age."""
BEHIND = ("n_evaluations", "n_evaluators")
"""Columns of what stands behind values."""
FRESH_S = 10.0
EDGES_S = np.concatenate([[0.0, 1e-6], np.geomspace(0.05, 1e5, 600)])
"""Bins of age for quantiles of tables larger than memory: 2.4 % wide."""

_DTYPES = {
    "variant": np.int16, "step": np.int32, "receiver": np.int32, "subject": np.int32, "state": np.int16,
    "trust": np.float32, "age_s": np.float32, "newest_evaluation_age_s": np.float32,
    "oldest_evaluation_age_s": np.float32, "n_evaluations": np.int32, "n_evaluators": np.float32,
}  # fmt: skip
"""Of the columns that are added up, whatever a block holds, so that kernels are compiled once."""
_PEAK_BLOCKS = 20
_BINS_PER_S, _BINNED_S = 1024, 128
"""Ages are stored in multiples of this part of a second; the bins of those below are looked up."""

NO_LOOKUPS = (
    "holds no trust lookups: no message was received. Raise radio.range_m or fleet.penetration_p, and run again."
)


class Sums(NamedTuple):
    """Lookups of a trust variant added up by vehicle that looks up (r, by number) and role of the subject."""

    states: Int[ndarray, "r role state"]
    """Lookups by what stands behind the value."""
    fresh: Int[ndarray, "r role"]
    """Those whose value rests on an evaluation at most `fresh_s` old."""
    aged: Int[ndarray, "r role age"]
    """Those with each age of `AGES`, and the sum of these."""
    age_sum_s: Float[ndarray, "r role age"]
    histogram: Int[ndarray, "role age bin"]
    """Ages by bin of `EDGES_S`, those beyond its ends in the outermost ones."""
    behind: Int[ndarray, "r 2"]
    """Those with evaluations behind the value, with each of `BEHIND`, and the sum of these."""
    behind_sum: Float[ndarray, "r 2"]
    renewed: Int[ndarray, "r 2"]
    """Lookups before which the value, or the newest evaluation, had been renewed, and the sum of the ages until then;
    of 20 blocks spread over the run at most."""
    peak_sum_s: Float[ndarray, "r 2"]


class Lows(NamedTuple):
    """Lookups of a trust variant, resting on an evaluation, that are lower than any before of that subject since it is
    watched (`trust.watched`)."""

    step: Int[ndarray, "n"]
    subject: Int[ndarray, "n"]
    trust: Float[ndarray, "n"]


class _All(NamedTuple):
    """The same of all trust variants: a first axis, and a column, more."""

    fresh_s: float
    sums: Sums
    variant: Int[ndarray, "n"]
    lows: Lows


def sums(run: Run, fresh_s: float | None = None) -> Sums:
    """Lookups of the run's variant added up; ValueError where there are none. `fresh_s` concerns `fresh` alone."""
    found = _all(run)
    if fresh_s is not None and fresh_s != found.fresh_s:
        found = run.once_for_all(f"lookups, fresh to {fresh_s} s", lambda: _added(run, fresh_s))
    mine = Sums(*(table[run.variants.index(run.variant)] for table in found.sums))
    if not mine.states.any():
        raise ValueError(f"{run.path} {NO_LOOKUPS}")
    return mine


def lows(run: Run) -> Lows:
    """Trust below any threshold is first looked up at one of these."""
    found = _all(run)
    mine = found.variant == run.variants.index(run.variant)
    return Lows(*(column[mine] for column in found.lows))


def blocks(run: Run, columns: Sequence[str]) -> Iterator[Mapping[str, ndarray]]:
    """Lookups of the run's variant, block of steps by block, as of `Run.variant_arrays`; ValueError where there are
    none."""
    n_rows = 0
    for block in run.variant_arrays("trust_lookups", columns):
        n_rows += len(block[columns[0]])
        yield block
    if not n_rows:
        raise ValueError(f"{run.path} {NO_LOOKUPS}")


def role_codes(run: Run, pseudonym: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Code of the role of the vehicle behind each pseudonym, in the order of `Run.role_labels`."""
    known, code = run.once_for_all("roles by pseudonym", lambda: _roles(run))
    return code[np.searchsorted(known, pseudonym)]


def _roles(run: Run) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"]]:
    role = run.subjects.role.sort_index()
    return role.index.to_numpy(np.int64), role.cat.codes.to_numpy(np.int64)


def _all(run: Run) -> _All:
    return run.once_for_all("lookups", lambda: _added(run, FRESH_S))


def _added(run: Run, fresh_s: float) -> _All:
    """One pass over the rows of all variants."""
    known, role_of = run.once_for_all("roles by pseudonym", lambda: _roles(run))
    stride = -(-run.n_blocks("trust_lookups") // _PEAK_BLOCKS)
    return _add_up(
        run.pieces("trust_lookups", list(_DTYPES)), known, role_of, _watched_since(run, known), len(run.variants),
        len(run.role_labels), stride, fresh_s,
    )  # fmt: skip


def compile_kernels() -> None:
    """Compile what adds up the lookups of a run, of any run."""
    one, row = np.zeros(1, np.int64), {name: np.zeros(1, dtype) for name, dtype in _DTYPES.items()}
    _add_up([(0, row)], one, one, one, 1, 1, 1, FRESH_S)


def _add_up(
    pieces: Iterable[tuple[int, Mapping[str, ndarray]]], known: Int[ndarray, "p"], role_of: Int[ndarray, "p"],
    since: Int[ndarray, "p"], n_variants: int, n_roles: int, stride: int, fresh_s: float,
) -> _All:  # fmt: skip
    """Lookups of these pseudonyms, piece by piece with the number of its block; of each pseudonym the role, and the
    step since which it is watched. Peak ages are those of every `stride`-th block."""
    from results.metrics import lookup_sums  # here, because little else in measuring needs Numba

    lowest = np.full((n_variants, len(known)), np.inf, np.float32)
    shapes = {
        "states": (n_roles, len(LookupState)), "fresh": (n_roles,), "aged": (n_roles, len(AGES)),
        "age_sum_s": (n_roles, len(AGES)), "behind": (2,), "behind_sum": (2,), "renewed": (2,), "peak_sum_s": (2,),
    }  # fmt: skip
    tables: dict[str, ndarray] = {
        name: np.zeros((n_variants, 0, *shape), _dtype(name)) for name, shape in shapes.items()
    }
    histogram = np.zeros((n_variants, n_roles, len(AGES), len(EDGES_S) - 1), np.int64)
    lower = [(np.zeros(0, np.int16), Lows(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0, np.float32)))]
    before, block = lookup_sums.none_before(n_variants), -1
    for number, piece in pieces:
        if number != block:
            before, block = lookup_sums.none_before(n_variants), number
        rows = {name: _read_only(piece[name], dtype) for name, dtype in _DTYPES.items()}
        variant, receiver, who = rows["variant"], rows["receiver"], np.searchsorted(known, rows["subject"])
        more = int(receiver.max(initial=-1)) + 1 - tables["states"].shape[1]
        if more > 0:
            tables = {
                name: np.concatenate([t, np.zeros((n_variants, more, *shapes[name]), t.dtype)], axis=1)
                for name, t in tables.items()
            }
        ages_s = tuple(rows[column] for column in AGES.values())
        lookup_sums.add(
            variant, receiver, who, rows["state"], ages_s, rows["n_evaluations"], rows["n_evaluators"], role_of,
            np.float32(fresh_s), EDGES_S, _bins(), _BINS_PER_S, tables["states"], tables["fresh"], tables["aged"],
            tables["age_sum_s"], histogram, tables["behind"], tables["behind_sum"],
        )  # fmt: skip
        if number % stride == 0:
            before = lookup_sums.add_peaks(
                variant, receiver, who, ages_s[: len(RENEWED)], n_variants, before, tables["renewed"],
                tables["peak_sum_s"],
            )  # fmt: skip
        at = np.flatnonzero(lookup_sums.new_lows(
            variant, who, rows["step"], rows["trust"], rows["n_evaluations"], since, lowest
        ))  # fmt: skip
        lower.append((variant[at], Lows(*(rows[name][at] for name in Lows._fields))))
    return _All(
        fresh_s, Sums(**tables, histogram=histogram), np.concatenate([variant for variant, _ in lower]),
        Lows(*(np.concatenate(columns) for columns in zip(*(found for _, found in lower), strict=True))),
    )  # fmt: skip


def _read_only(values: ndarray, dtype: type) -> ndarray:
    """The same values; arrays that come out of Arrow without a copy are read-only, and kernels tell that apart."""
    values = np.asarray(values, dtype).view()
    values.flags.writeable = False
    return values


def _dtype(table: str) -> type:
    return np.float64 if "sum" in table else np.int64


@cache
def _bins() -> Int[ndarray, "n"]:
    """Bin of `EDGES_S` of every multiple of the part of a second in which ages are stored."""
    ages_s = np.arange(_BINNED_S * _BINS_PER_S) / _BINS_PER_S
    return np.clip(np.searchsorted(EDGES_S, ages_s, side="right") - 1, 0, len(EDGES_S) - 2)


def _watched_since(run: Run, known: Int[ndarray, "p"]) -> Int[ndarray, "p"]:
    """First step in which each pseudonym is watched; later than any step for those that are not watched."""
    since = np.full(len(known), np.iinfo(np.int64).max)
    if run.subjects.attack_start_step.notna().any():
        who = watched(run)
        since[np.searchsorted(known, who.index)] = who.since
    return since
