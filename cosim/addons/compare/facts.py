"""Facts: published or measured values with their sources, and what cosim computes beside them."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import stats

from results.metrics.intervals import LEVEL

Compare = Literal["within", "at_least", "at_most"]
Stated = Literal["agrees", "differs", "undecided", "cannot be set"]
Verdict = Literal["agrees", "differs", "undecided", "cannot be set", "not computed"]
FILE = Path(__file__).with_name("facts.toml")


@dataclass(frozen=True, kw_only=True, slots=True)
class Fact:
    """One published or measured quantity, with one or more values."""

    id: str
    group: str
    """Page on which it stands."""
    quantity: str
    unit: str = ""
    at: tuple[str, ...] = ("",)
    """What each value is of: a distance, a class, an overlap."""
    value: tuple[float, ...]
    uncertainty: tuple[float, ...] = (0.0,)
    """Half width of the band around each value, or one for all; not used by `at_least` and `at_most`."""
    uncertainty_why: str = ""
    compare: Compare = "within"
    """`within`: ours lies in the band. `at_least`, `at_most`: ours is not below, or not above, the value."""
    source: str
    conditions: str
    """Under which the value was measured."""
    how: str
    """How ours is computed, and what differs in its conditions."""
    measure: str = ""
    """Name of the way of measuring, in `measures.MEASURES`; none if the conditions of the value cannot be set."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the measure."""
    runs: tuple[str, ...] = ()
    """Names of the plans of the runs in which it is measured; of several, the measure takes one run of each."""
    judges: Literal["yes", "fitted"] = "yes"
    """`fitted`: a model was fitted to these very values, so agreement says only that the fit is good."""
    verdict: Stated
    """What the state of the code is said to be. `cannot be set`: our runs cannot have the conditions of the value."""
    reason: str = ""
    """Why it differs, or which condition cannot be set."""

    def __post_init__(self) -> None:
        n = len(self.value)
        if len(self.at) != n or len(self.uncertainty) not in (1, n):
            raise ValueError(
                f"fact {self.id}: {len(self.at)} places, {n} values and "
                f"{len(self.uncertainty)} uncertainties do not belong together."
            )
        if self.compare not in get_args(Compare) or self.verdict not in get_args(Stated):
            raise ValueError(f"fact {self.id}: compare = {self.compare!r} or verdict = {self.verdict!r} is unknown.")
        if self.verdict in ("differs", "cannot be set") and not self.reason:
            raise ValueError(f"fact {self.id}: verdict = {self.verdict!r} and there is no reason.")
        if not self.measure and self.verdict != "cannot be set":
            raise ValueError(f"fact {self.id} has no measure.")
        if self.compare == "within" and not self.uncertainty_why:
            raise ValueError(f"fact {self.id} does not say where its uncertainty comes from.")

    @property
    def low(self) -> Float[ndarray, "k"]:
        """Lower edge of the band around each value."""
        if self.compare == "at_most":
            return np.full(len(self.value), -np.inf)
        return np.array(self.value) - self._half

    @property
    def high(self) -> Float[ndarray, "k"]:
        """Upper edge of the band around each value."""
        if self.compare == "at_least":
            return np.full(len(self.value), np.inf)
        return np.array(self.value) + self._half

    @property
    def _half(self) -> Float[ndarray, "k"]:
        half = np.broadcast_to(np.array(self.uncertainty), len(self.value))
        return half if self.compare == "within" else np.zeros(len(self.value))


@dataclass(frozen=True, slots=True)
class RunPlan:
    """Runs that some facts need: overrides of the default config, and how many of what length."""

    name: str
    what: str
    sets: tuple[str, ...]
    quick: tuple[int, float]
    """Number of replicates, and duration of each [s]."""
    full: tuple[int, float]
    scene: str = ""
    """File in the folder `scenes` that is changed instead of the default config."""

    def length(self, is_full: bool) -> tuple[int, float]:
        """Number of replicates, and duration of each [s]."""
        return self.full if is_full else self.quick


@dataclass(frozen=True, slots=True)
class Measured:
    """What cosim computes for the values of a fact, with an interval of 95 %."""

    value: Float[ndarray, "k"]
    low: Float[ndarray, "k"]
    high: Float[ndarray, "k"]
    n: int
    """Replicates; 1 where nothing is random."""

    @staticmethod
    def of(values: Sequence[float] | Sequence[Sequence[float]] | ndarray) -> "Measured":
        """Values without chance, or the mean of independent replicates with the interval of Student's t.

        Parameters
        ----------
        values
            Values of the fact; or one row of them per replicate.
        """
        rows = np.asarray(values, float)
        if rows.ndim == 1:
            return Measured(rows, rows, rows, 1)
        n, mean = len(rows), rows.mean(axis=0)
        if n < 2:
            unbounded = np.full(mean.shape, np.inf)
            return Measured(mean, -unbounded, unbounded, n)
        quantile = stats.t.ppf(0.5 + LEVEL / 2, n - 1)
        half = quantile * rows.std(axis=0, ddof=1) / np.sqrt(n)
        return Measured(mean, mean - half, mean + half, n)


@dataclass(frozen=True, slots=True)
class ComparedFact:
    """A fact beside what cosim computes."""

    fact: Fact
    ours: Measured | None
    problem: str = ""
    """Why nothing was computed."""
    unlike: tuple[str, ...] = ()
    """What the runs that the user gave set otherwise than the fact's own runs."""

    @property
    def inside(self) -> Bool[ndarray, "k"]:
        """Whether each of our values lies in the band of the fact."""
        assert self.ours is not None
        value = self.ours.value
        return (value >= self.fact.low) & (value <= self.fact.high)

    @property
    def verdict(self) -> Verdict:
        """`agrees` if all values lie in their bands, `differs` if the interval of one misses its band."""
        if self.ours is None and not self.problem:
            return "cannot be set"
        if self.ours is None or not np.isfinite(self.ours.value).all():
            return "not computed"
        if self.inside.all():
            return "agrees"
        is_below = self.ours.high < self.fact.low
        apart = is_below | (self.ours.low > self.fact.high)
        return "differs" if apart.any() else "undecided"

    @property
    def is_lost(self) -> bool:
        """Whether an agreement that the fact states is no longer there, or could not be looked for."""
        return self.fact.verdict == "agrees" and self.verdict in ("differs", "not computed")


def load(
    path: Path = FILE,
) -> tuple[dict[str, Fact], dict[str, RunPlan]]:
    """The facts and the runs behind them, by name.

    Raises
    ------
    ValueError
        If the file has a mistake: a key that does not exist or is missing, a name that occurs twice, runs that are not
        there.
    """
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    known = {f.name for f in fields(Fact)}
    plans = {}
    for name, plan in data.get("runs", {}).items():
        plans[name] = RunPlan(
            name,
            plan["what"],
            tuple(plan["set"]),
            tuple(plan["quick"]),
            tuple(plan["full"]),
            plan.get("scene", ""),
        )
    facts: dict[str, Fact] = {}
    for row in data["fact"]:
        if unknown := set(row) - known:
            raise ValueError(f"fact {row.get('id')}: unknown keys {sorted(unknown)}.")
        values: dict[str, Any] = {
            key: _listed(value) if key in ("value", "uncertainty", "at", "runs") else value
            for key, value in row.items()
        }
        fact = Fact(**values)
        if fact.id in facts:
            raise ValueError(f"fact {fact.id} is there twice.")
        if absent := [name for name in fact.runs if name not in plans]:
            raise ValueError(f"fact {fact.id}: there are no runs called {absent[0]}.")
        facts[fact.id] = fact
    return facts, plans


def chosen(facts: Mapping[str, Fact], asked: Sequence[str]) -> list[Fact]:
    """The facts of these names or groups; all without any.

    Raises
    ------
    ValueError
        In one line, if a name is neither a fact nor a group.
    """
    groups = {fact.group for fact in facts.values()}
    for name in asked:
        if name not in facts and name not in groups:
            raise ValueError(
                f"{name} is neither a fact nor a group of facts. Groups: {', '.join(sorted(groups))}. "
                "`cosim compare --list` lists the facts."
            )
    if not asked:
        return list(facts.values())
    return [fact for fact in facts.values() if fact.id in asked or fact.group in asked]


def _listed(value: Any) -> tuple[Any, ...]:
    return tuple(value) if isinstance(value, list) else (value,)
