"""Evaluations that holders have received of the recent steps: one log for all models that read it.

Trust models that are written in NumPy (`trust.models.stepwise`) read one step of it at a time, as `StepRows`. The model
TruPercept has a store of its own, `trust.evidence_store`, which keeps sums instead of rows.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled, inlined
from cosim.base.ragged import rows_of
from trust.open_steps import LARGE, OpenSteps
from trust.pair_index import PairIndex, with_rows
from trust.tables import QUANTUM, DetectionRows, ObserverRows, ReceivedEvaluations, float64, int64


def exact(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Round values so that their sums do not depend on the order of summation.

    Returns
    -------
    The values as multiples of 2^-32. Sums of them are exact as long as they do not exceed 2^20 in size.
    """
    return np.rint(values * QUANTUM) / QUANTUM


@inlined
def rounded(value):
    """One value as `exact` rounds it, for kernels."""
    return np.rint(value * QUANTUM) / QUANTUM


@compiled
def _sums(group, values, n_groups):
    """`exact_sums`, compiled."""
    sums = np.zeros(n_groups)
    for i in range(group.size):
        sums[group[i]] += rounded(values[i])
    return sums


def exact_sums(
    group: Int[ndarray, "n"],
    values: Float[ndarray, "n"],
    n_groups: int,
) -> Float[ndarray, "n_groups"]:
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

    There are three tables. The first has a row for every holder, evaluator and observer, with sums (n rows). The second
    has a row for every single evaluation (k rows). The third has a row for every detection of which a holder has
    evaluations (o rows).

    Rows of (holder, evaluator) and (holder, observer) are those of `EvaluationLog.pairs`. Rows of (evaluator, observer)
    are those of `EvaluationLog.edges`.
    """

    evaluator: Int[ndarray, "n"]  # row of (holder, evaluator)
    observer: Int[ndarray, "n"]  # row of (holder, observer)
    edge: Int[ndarray, "n"]  # row of (evaluator, observer)
    pos: Float[ndarray, "n"]  # sum of the positive evidence
    neg: Float[ndarray, "n"]  # sum of the negative evidence
    n: Int[ndarray, "n"]  # evaluations
    n_sent: Int[ndarray, "n"]  # detections in the evaluator's newest message then, its self report included
    is_own: Bool[ndarray, "n"]  # whether the holder itself is the evaluator
    row: Int[ndarray, "k"]  # row of the first table to which the evaluation belongs
    by: Int[ndarray, "k"]  # row of (holder, evaluator)
    about: Int[ndarray, "k"]  # row of (holder, observer)
    object: Int[ndarray, "k"]  # row of the third table: the detection, numbered by holder, observer and index
    object_pos: Float[ndarray, "k"]  # positive evidence
    object_neg: Float[ndarray, "k"]  # negative evidence
    index: Int[ndarray, "k"]  # detection_index, the number of its detection or claim
    is_self: Bool[ndarray, "k"]  # whether it is of the observer's report of itself
    sender: Int[ndarray, "o"]  # row of (holder, observer)

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
        at, has_sent = rows_of(pseudonyms, self._sent[:, 0])
        n_sent = np.zeros(len(pseudonyms), np.int64)
        n_sent[has_sent] = self._sent[at[has_sent], 2]
        self._open[step] = _Step(pseudonyms, n_sent)

    def _note_sent(self, step: int, pseudonyms: Int[ndarray, "n"], n_sent: Int[ndarray, "n"]) -> None:
        """Keep the newest message of each pseudonym, as long as its step is open.

        Vehicles may sense and send in turns, so that an evaluator need not send in the step that it evaluates.
        """
        rows = np.flatnonzero(n_sent > 0)
        senders = pseudonyms[rows]
        is_open = self._sent[:, 1] > step - self.steps.n_steps
        is_latest = ~np.isin(self._sent[:, 0], senders)
        new = np.column_stack([senders, np.full(len(rows), step), n_sent[rows]])
        sent = np.concatenate([self._sent[is_open & is_latest], new])
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
                of_step.parts.append(accepted.by_observer_and_detection())
                of_step.own.append(received.is_own)
                of_step.rows = None

    def _count(self, step: int, pair: Int[ndarray, "n"], n: Int[ndarray, "n"]) -> None:
        """Add evaluations of a step about each pair to `counted`."""
        self.counted = with_rows(self.counted, len(self.pairs))
        before, newest, oldest = self.counted[pair].T
        self.counted[pair, 1] = np.maximum(newest, step)
        older = np.minimum(oldest, step)
        self.counted[pair, 2] = np.where(before > 0, older, step)
        np.add.at(self.counted[:, 0], pair, n)

    def _merged(self, step: _Step) -> StepRows:
        """All parts of a step as one."""
        observers, singles = _concatenated(step.parts)
        evaluator = self.pairs.rows(observers.holder, observers.evaluator)
        observer = self.pairs.rows(observers.holder, observers.observer)
        about, index = observer[singles.row], singles.detection_index
        pair, n_pairs = _ranks(about, len(self.pairs))
        width = int(index.max(initial=0)) + 1
        detection, n_detections = _ranks(pair * width + index, n_pairs * width)
        sender = np.zeros(n_detections, np.int64)
        sender[detection] = about
        n_rows = [len(of_observers.n) for of_observers, _ in step.parts]
        return StepRows(
            evaluator=evaluator,
            observer=observer,
            edge=self.edges.rows(evaluator, observer),
            pos=observers.pos,
            neg=observers.neg,
            n=observers.n,
            n_sent=step.n_sent[rows_of(observers.evaluator, step.pseudonyms)[0]],
            is_own=np.repeat(np.array(step.own, bool), np.array(n_rows, int)),
            row=singles.row,
            by=evaluator[singles.row],
            about=about,
            object=detection,
            object_pos=singles.pos,
            object_neg=singles.neg,
            index=index,
            is_self=index == 0,
            sender=sender,
        )


def _concatenated(parts: list[tuple[ObserverRows, DetectionRows]]) -> tuple[ObserverRows, DetectionRows]:
    """The rows of all parts, one part after another."""
    whole, real = np.zeros(0, np.int64), np.zeros(0)
    if not parts:
        return ObserverRows(whole, whole, whole, real, real, whole), DetectionRows(whole, whole, real, real)
    by_observer, by_detection = [], []
    n_rows = 0
    for observers, detections in parts:
        by_observer.append(observers)
        by_detection.append(detections._replace(row=detections.row + n_rows))
        n_rows += observers.n.size
    return (
        ObserverRows(*map(np.concatenate, zip(*by_observer, strict=True))),
        DetectionRows(*map(np.concatenate, zip(*by_detection, strict=True))),
    )


def _ranks(
    values: Int[ndarray, "k"],
    limit: int,
) -> tuple[Int[ndarray, "k"], int]:
    """Rank of each value among the different values, and how many of these there are; values are below `limit`."""
    occurs = np.zeros(limit, np.int64)
    occurs[values] = 1
    return (np.cumsum(occurs) - occurs)[values], int(occurs.sum())
