"""Evaluations that holders have received of the recent steps: one log for all models that read it."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from numpy import ndarray

from trust.open_steps import LARGE, OpenSteps
from trust.pair_index import PairIndex, find, with_rows
from trust.tables import DetectionRows, ObserverRows, ReceivedEvaluations, float64, int64

_QUANTUM = float(1 << 32)


def exact(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Round values so that their sums do not depend on the order of summation.

    Returns
    -------
    The values as multiples of 2^-32. Sums of them are exact as long as they do not exceed 2^20 in size.
    """
    return np.rint(values * _QUANTUM) / _QUANTUM


@njit(cache=True, nogil=True, inline="always")
def rounded(value):
    """One value as `exact` rounds it, for kernels."""
    return np.rint(value * _QUANTUM) / _QUANTUM


@njit(cache=True, nogil=True)
def _sums(group, values, n_groups):
    sums = np.zeros(n_groups)
    for i in range(group.size):
        sums[group[i]] += rounded(values[i])
    return sums


def exact_sums(group: Int[ndarray, "n"], values: Float[ndarray, "n"], n_groups: int) -> Float[ndarray, "n_groups"]:
    """Sums by group that do not depend on the order of the rows.

    Parameters
    ----------
    group
        Group of each value, from 0 to `n_groups` - 1.
    values
        Rounded by `exact` before they are added.

    Returns
    -------
    Sum of each group; 0 for a group without values.
    """
    return _sums(int64(group), float64(values), n_groups)


@dataclass(slots=True)
class StepRows:
    """Accepted evaluations of one step, in any order, by others than the subject who could see the detection.

    Rows of (holder, subject) are those of `EvaluationLog.pairs`; rows of (evaluator, observer) are those of
    `EvaluationLog.edges`.
    """

    evaluator: Int[ndarray, "n"]  # row of (holder, evaluator); one table row per holder, evaluator and observer
    observer: Int[ndarray, "n"]  # row of (holder, observer)
    edge: Int[ndarray, "n"]  # row of (evaluator, observer)
    pos: Float[ndarray, "n"]  # sum of the positive evidence
    neg: Float[ndarray, "n"]  # sum of the negative evidence
    n: Int[ndarray, "n"]  # evaluations
    row: Int[ndarray, "k"]  # of every single evaluation: its row above
    by: Int[ndarray, "k"]  # of every single evaluation: row of (holder, evaluator)
    about: Int[ndarray, "k"]  # of every single evaluation: row of (holder, observer)
    object: Int[ndarray, "k"]  # of every single evaluation: the detection, numbered by holder, observer and index
    object_pos: Float[ndarray, "k"]
    object_neg: Float[ndarray, "k"]
    index: Int[ndarray, "k"]  # of every single evaluation: detection_index, the number of its detection or claim
    sender: Int[ndarray, "o"]  # of each detection: row of (holder, observer)
    is_self: Bool[ndarray, "k"]  # of every single evaluation: whether it is of the observer's report of itself
    n_sent: Int[ndarray, "n"]  # detections in the evaluator's newest message then, its self report included
    is_own: Bool[ndarray, "n"]  # whether the holder itself is the evaluator

    def per_observer(self, values: Float[ndarray, "n"], n_pairs: int) -> Float[ndarray, "n_pairs"]:
        """Sums over the rows of each (holder, observer), rounded as in `exact_sums`.

        Parameters
        ----------
        values
            One value per row of this table.
        n_pairs
            Number of sums: at least the number of rows of `EvaluationLog.pairs`.

        Returns
        -------
        Sum for each row of `EvaluationLog.pairs`; 0 for a pair without evaluations in this step.
        """
        return exact_sums(self.observer, values, n_pairs)

    def per_object(self, values: Float[ndarray, "k"]) -> Float[ndarray, "o"]:
        """Sums over the evaluations of each detection, rounded as in `exact_sums`.

        Parameters
        ----------
        values
            One value per single evaluation, in the order of `row` and `object`.

        Returns
        -------
        Sum for each detection, numbered as in `object`.
        """
        return exact_sums(self.object, values, self.sender.size)


@dataclass(slots=True)
class _Step:
    """What has been transmitted and received of one step so far."""

    pseudonyms: Int[ndarray, "n"]  # present in the step, ascending
    n_sent: Int[ndarray, "n"]  # detections in the newest message of each
    waiting: list[ReceivedEvaluations] = field(default_factory=list)  # not yet checked
    parts: list[tuple[ObserverRows, DetectionRows]] = field(default_factory=list)
    own: list[bool] = field(default_factory=list)  # of each part: whether its holders made it
    rows: StepRows | None = None  # of all parts
    n_counted: int = 0  # rows that are in `EvaluationLog.counted`


class EvaluationLog:
    """Accepted evaluations by step, and a row for each (holder, pseudonym) that any of them names.

    Several models may share one log. Each model passes every call that it gets on to the log, and the log acts on the
    first of these equal calls. All models must therefore have got a call before any of them is asked for scores.

    Evaluations wait until somebody reads the log or their step closes. Many small batches of one step are then checked
    and added as one.
    """

    def __init__(self, n_steps: int) -> None:
        self.steps = OpenSteps(n_steps)
        self.pairs = PairIndex()
        self.edges = PairIndex()
        self.closed: list[int] = []
        """Steps for which nothing is accepted any more, and whose rows can still be read, ascending."""
        self.counted = np.zeros((0, 3), np.int64)
        """Of each row of `pairs`, over the steps whose rows have been read: evaluations, newest and oldest step."""
        self._open: dict[int, _Step] = {}  # ascending
        self._sent = np.zeros((0, 3), np.int64)  # newest messages: pseudonym, ascending, step and number of detections
        self._n_added = 0

    def open(self, step: int, pseudonyms, observer_row, detection_index, score) -> None:
        """Begin a step, once; the arguments are those of `TrustModel.open_step`."""
        if step in self._open:
            return
        self.advance(step)
        self.steps.open(step, pseudonyms, observer_row, detection_index, score)
        pseudonyms = int64(pseudonyms)
        self._note_sent(step, pseudonyms, np.bincount(observer_row, minlength=len(pseudonyms)))
        at, has_sent = find(pseudonyms, self._sent[:, 0])
        n_sent = np.zeros(len(pseudonyms), np.int64)
        n_sent[has_sent] = self._sent[at[has_sent], 2]
        self._open[step] = _Step(pseudonyms, n_sent)

    def _note_sent(self, step: int, pseudonyms: Int[ndarray, "n"], n_sent: Int[ndarray, "n"]) -> None:
        """Keep the newest message of each pseudonym, as long as its step is open.

        Vehicles may sense and send in turns, so that an evaluator need not send in the step that it evaluates.
        """
        sends = n_sent > 0
        kept = self._sent[
            (self._sent[:, 1] > step - self.steps.n_steps) & ~np.isin(self._sent[:, 0], pseudonyms[sends])
        ]
        new = np.column_stack([pseudonyms[sends], np.full(sends.sum(), step), n_sent[sends]])
        sent = np.concatenate([kept, new])
        self._sent = sent[np.argsort(sent[:, 0], kind="stable")]

    def advance(self, now_step: int) -> None:
        """Close the steps that are too old.

        The rows of a step that closes now are kept until the log advances again, so that all models can still read
        them.
        """
        if now_step <= self.steps.now:
            return
        for step in self.closed:
            del self._open[step]
        self.closed = [step for step in self._open if step <= now_step - self.steps.n_steps]
        for step in self.closed:
            self._settle(step)
        self.steps.advance(now_step)

    def add(self, number: int, received: ReceivedEvaluations) -> None:
        """Add received evaluations, unless another model has added them already.

        Parameters
        ----------
        number
            How many additions this model has made before.
        received
            Evaluations of one step.
        """
        if number < self._n_added:
            return
        self._n_added += 1
        step = received.messages.step
        if step not in self.steps:
            self.steps.accepted(received)  # counts them as late, or of the future
            return
        self._open[step].waiting.append(received)
        if received.messages.observer.size >= LARGE:
            self._settle(step)

    def rejected(self) -> Int[ndarray, "reasons"]:
        """Evaluations rejected so far, by `RejectReason`."""
        for step in self._open:
            self._settle(step)
        return self.steps.rejected

    def versions(self, until: float = np.inf) -> Iterator[tuple[int, int]]:
        """Steps up to `until` whose rows can be read, ascending, with a number that grows with each addition."""
        for step, of_step in self._open.items():
            if step > until:
                return
            self._settle(step)
            yield step, len(of_step.parts)

    def rows(self, step: int) -> StepRows:
        """Evaluations of a step that have been accepted so far."""
        of_step = self._open[step]
        self._settle(step)
        if of_step.rows is None:
            rows = of_step.rows = self._merged(of_step)
            self._count(step, rows.observer[of_step.n_counted :], rows.n[of_step.n_counted :])
            of_step.n_counted = rows.n.size
        return of_step.rows

    def _settle(self, step: int) -> None:
        """Check and add the evaluations of a step that wait."""
        of_step = self._open[step]
        if not of_step.waiting:
            return
        waiting, of_step.waiting = of_step.waiting, []
        for received in ReceivedEvaluations.joined(waiting):
            accepted = self.steps.accepted(received)
            if accepted is not None and len(accepted):
                of_step.parts.append(accepted.both())
                of_step.own.append(received.is_own)
                of_step.rows = None

    def _count(self, step: int, pair: Int[ndarray, "n"], n: Int[ndarray, "n"]) -> None:
        """Add evaluations of a step about each pair to `counted`."""
        self.counted = with_rows(self.counted, len(self.pairs))
        before, newest, oldest = self.counted[pair].T
        self.counted[pair, 1] = np.maximum(newest, step)
        self.counted[pair, 2] = np.where(before > 0, np.minimum(oldest, step), step)
        np.add.at(self.counted[:, 0], pair, n)

    def _merged(self, step: _Step) -> StepRows:
        parts, own = step.parts, step.own
        if not parts:
            row, real = np.zeros(0, np.int64), np.zeros(0)
            parts, own = [(ObserverRows(row, row, row, real, real, row), DetectionRows(row, row, real, real))], [False]
        first = np.cumsum([0, *(len(observers.n) for observers, _ in parts)])
        holder, evaluator, observer, pos, neg, n = (np.concatenate(c) for c in zip(*(o for o, _ in parts), strict=True))
        row = np.concatenate([d.row + begin for (_, d), begin in zip(parts, first, strict=False)])
        index, object_pos, object_neg = (
            np.concatenate([d[column] for _, d in parts]) for column in range(1, 4)
        )  # fmt: skip
        n_sent = step.n_sent[find(evaluator, step.pseudonyms)[0]]
        evaluator, observer = self.pairs.rows(holder, evaluator), self.pairs.rows(holder, observer)
        used = np.zeros(len(self.pairs), np.int64)
        used[observer] = 1
        width = int(index.max(initial=0)) + 1
        about = observer[row]
        number = (np.cumsum(used) - used)[about] * width + index
        taken = np.zeros(int(used.sum()) * width, np.int64)
        taken[number] = 1
        one = (np.cumsum(taken) - taken)[number]
        sender = np.zeros(int(taken.sum()), np.int64)
        sender[one] = about
        return StepRows(
            evaluator, observer, self.edges.rows(evaluator, observer), pos, neg, n, row, evaluator[row], about, one,
            object_pos, object_neg, index, sender, index == 0, n_sent, np.repeat(own, np.diff(first)),
        )  # fmt: skip
