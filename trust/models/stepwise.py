"""Models with a state that each step's evidence updates. Late evidence counts in its own step."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
from annotated_types import Interval
from jaxtyping import Float, Int
from numpy import ndarray

from trust.evaluation_log import EvaluationLog, StepRows
from trust.pair_index import with_rows
from trust.params import grace_steps
from trust.tables import ReceivedEvaluations, TrustScores

S = TypeVar("S")
Advance = Callable[[S, int, int, StepRows, int], S]
"""Arguments: state before the step, steps since then, the step, its rows, number of pairs. Result: state after it."""


class StateReplay(Generic[S]):
    """The state after each step that is still kept. After late evidence, states are computed again from its step on."""

    def __init__(self, start: S) -> None:
        self._before, self._before_step = start, -1
        self._after: dict[int, tuple[int, S]] = {}  # by step: number of additions that it rests on, state

    def state(self, log: EvaluationLog, advance: Advance, until: float = np.inf) -> tuple[int, S]:
        """Newest step, at most `until`, and the state after it."""
        step, state = self._before_step, self._before
        changed = False
        for g, n_additions in log.versions(until):
            if g <= self._before_step:
                continue
            known = self._after.get(g)
            if changed or known is None or known[0] != n_additions:
                rows = log.rows(g)
                n_steps = g - step if step >= 0 else 0
                after = advance(state, n_steps, g, rows, len(log.pairs))
                self._after[g] = n_additions, after
                changed = True
            step, state = g, self._after[g][1]
        if changed:  # later states rest on others
            self._after = {g: known for g, known in self._after.items() if g <= step}
        return step, state

    def fold(self, log: EvaluationLog, advance: Advance) -> None:
        """Keep only one state of the steps that are closed. Later states are computed once they are asked for."""
        if log.closed and log.closed[-1] > self._before_step:
            self._before_step, self._before = self.state(log, advance, log.closed[-1])
            for g in log.closed:
                self._after.pop(g, None)


@dataclass(frozen=True, slots=True)
class Reading:
    """A model's trust in each (holder, subject); rows as in `EvaluationLog.pairs`."""

    trust: Float[ndarray, "p"]
    weight: Float[ndarray, "p"]
    uncertainty: Float[ndarray, "p"] | None = None
    horizon_s: float = np.inf
    """Age from which evaluations do not count any more. A pair without a newer evaluation has no row."""
    counted: Int[ndarray, "p 3"] | None = None
    """Evaluations that count, newest and oldest step of them; None if all in the log do."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StepwiseParams:
    """What all models of this kind have in common."""

    grace_s: Annotated[float, Interval(ge=0.001, le=1e8)] = 10.0
    """Age at which evidence is final [s]: evaluations that arrive later have no effect."""


class Stepwise:
    """A trust model made of a state, a function that advances it by a step, and a function that reads trust from it.

    A subclass defines `Params`, a kind of `StepwiseParams`, and the methods `start`, `advance` and `read`. `advance`
    returns a new state and does not change the given one. Sums over rows use `exact`, so that the order of arrival does
    not matter.
    """

    def __init__(self, params: Any, dt_s: float) -> None:
        self.params, self.dt_s = params, dt_s
        self.log = EvaluationLog(grace_steps(params.grace_s, dt_s))
        """The log of evaluations; `share_logs` gives several models the same one."""
        self._n_added = 0
        self._replay: StateReplay[Any] = StateReplay(self.start())

    def start(self) -> Any:
        """State before any evidence."""
        raise NotImplementedError

    def advance(self, state: Any, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> Any:
        """State after a step. The given state must not be changed.

        Parameters
        ----------
        state
            State before the step.
        n_steps
            Steps since the step of `state`; 0 if there was none.
        step
            The step whose evidence is added.
        rows
            Evidence of the step.
        n_pairs
            Number of rows of `EvaluationLog.pairs`.
        """
        raise NotImplementedError

    def read(self, state: Any, n_steps: int, now: int) -> Reading:
        """Trust in each pair.

        Parameters
        ----------
        state
            State after its last step; it must not be changed.
        n_steps
            Steps from then until `now`.
        now
            Step for which trust is asked.
        """
        raise NotImplementedError

    def open_step(
        self,
        step: int,
        pseudonyms: Int[ndarray, "n"],
        observer_row: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"],
        score: Float[ndarray, "d"],
    ) -> None:
        """Begin a step; see `TrustModel.open_step`."""
        self.log.open(step, pseudonyms, observer_row, detection_index, score)
        self._replay.fold(self.log, self.advance)

    def add_evaluations(self, received: ReceivedEvaluations) -> None:
        """Add received evaluations; see `TrustModel.add_evaluations`."""
        self.log.add(self._n_added, received)
        self._n_added += 1

    def scores(self, now_step: int | None = None) -> TrustScores:
        """Trust of every subject with evidence; see `TrustModel.scores`."""
        now = self.log.steps.now if now_step is None else now_step
        self.log.advance(now)
        self._replay.fold(self.log, self.advance)
        step, state = self._replay.state(self.log, self.advance)
        reading = self.read(state, now - step if step >= 0 else 0, now)
        holder, subject, row = self.log.pairs.sorted()
        counted = reading.counted
        if counted is None:
            counted = with_rows(self.log.counted, len(self.log.pairs))
        n, newest, oldest = counted[row].T
        known = (n > 0) & self.is_younger(now - newest, reading.horizon_s)
        holder, subject, row = (column[known] for column in (holder, subject, row))
        n, newest, oldest = (column[known] for column in (n, newest, oldest))
        uncertainty = np.full(row.size, np.nan)
        if reading.uncertainty is not None:
            uncertainty = reading.uncertainty[row]
        return TrustScores(
            step=now,
            holder=holder,
            subject=subject,
            trust=reading.trust[row],
            uncertainty=uncertainty,
            weight=reading.weight[row],
            n_evaluations=n,
            newest_step=newest,
            oldest_step=oldest,
            newest_evaluation_step=newest.copy(),
            oldest_evaluation_step=oldest.copy(),
            is_evaluated=n > 0,
        )

    @property
    def rejected(self) -> Int[ndarray, "reasons"]:
        """Evaluations rejected so far, by `RejectReason`."""
        return self.log.rejected()

    def decay(self, per_s: float, n_steps: int) -> float:
        """Share that is left after `n_steps` of decay; `per_s` is the share left after one second."""
        return per_s ** (n_steps * self.dt_s)

    def is_younger(self, n_steps: Any, age_s: float) -> Any:
        """Whether what is so many steps old is younger than an age.

        90 steps of 0.7 s are not younger than 63 s, although their product is 62.99... s.
        """
        return n_steps * self.dt_s < age_s * (1 - 1e-9)

    def horizon_s(self, per_s: float) -> float:
        """Age at which decay leaves less than 2^-40; `per_s` is the share left after one second."""
        return np.inf if per_s == 1 else 40 / -np.log2(per_s)


def share_logs(models: Sequence[object]) -> None:
    """Let models share one log if they accept evaluations for the same time.

    All of them must get the same evaluations. Models of other kinds keep what they have.
    """
    logs: dict[int, EvaluationLog] = {}
    for model in models:
        if isinstance(model, Stepwise):
            model.log = logs.setdefault(model.log.steps.n_steps, model.log)
