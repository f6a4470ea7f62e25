"""The law of freshness: from chances of evaluation to the ages and states that lookups find.

The derivation, with numbered equations and assumptions, is the page `models/freshness-law`. Time is counted in
steps of length D, those in which any vehicle may sense. A step has two rounds of messages of length r. Vehicles that
sense at random phases do so in every n-th step; evidence has the step of the detections that were evaluated.
"""

from bisect import bisect_right
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled

_REST = 1e-3
"""Broadcasts before the newest are followed until the chance that all were lost is below this."""
_MOST_BROADCASTS = 10


def period_steps(period_s: float, interval_s: float) -> int:
    """Number of sensing steps between two publications: the first that is a server period or more after the last."""
    return max(1, int(np.ceil(period_s / interval_s - 1e-9)))


@dataclass(slots=True)
class PublishingSteps:
    """The steps in which a server publishes: the first one, and each that is a period or more after the last.

    A step without equipped vehicles is none: the server then publishes in the next one.
    """

    period_steps: int
    published: list[int] = field(default_factory=list)

    def open(self, step: int) -> None:
        """A step with equipped vehicles begins."""
        if not self.published or step - self.published[-1] >= self.period_steps:
            self.published.append(step)

    @property
    def steps(self) -> Int[ndarray, "b"]:
        """Steps of the publications so far."""
        return np.array(self.published, np.int64)

    def before(self, step: int, n: int) -> Int[ndarray, "n"]:
        """The `n` newest publications at a step, newest first; -1 where there are fewer."""
        last = bisect_right(self.published, step)
        newest = self.published[max(0, last - n) : last][::-1]
        return np.array(newest + [-1] * (n - len(newest)), np.int64)


def n_followed(loss_p: float) -> int:
    """Number of publications that are followed for each lookup, if each is lost with this probability."""
    if loss_p <= 0 or loss_p >= 1:
        return 1
    n_lost = int(np.ceil(np.log(_REST) / np.log(loss_p)))
    return min(_MOST_BROADCASTS, 1 + n_lost)


class ExpectedLookups(NamedTuple):
    """Expected lookups by subject and step, and the publication whose value they find."""

    subject: Int[ndarray, "r"]
    """Row of the histories."""
    step: Int[ndarray, "r"]
    publication: Int[ndarray, "r i"]
    """Steps of the newest publications, newest first; -1: none."""
    n: Float[ndarray, "r i"]
    """Expected lookups that find each of them."""
    n_none: Float[ndarray, "r"]
    """Expected lookups that find none."""

    @property
    def total(self) -> float:
        """Expected number of all lookups."""
        return float(self.n.sum() + self.n_none.sum())


def expected_lookups(
    subject: Int[ndarray, "p"],
    held: Bool[ndarray, "p i"],
    looked_up_p: Float[ndarray, "p"],
    n_subjects: int,
    publications: Int[ndarray, "i"],
    received_p: Float[ndarray, "i"],
) -> tuple[Float[ndarray, "s i"], Float[ndarray, "s"]]:
    """Expected lookups of one step by the publication that they find, equation (3).

    Parameters
    ----------
    subject
        Subject of each pair.
    held
        Whether the holder of each pair was on the road at each publication, and has not forgotten it since.
    looked_up_p
        Probability that the holder looks the subject up.
    n_subjects
        Number of subjects.
    publications
        As `PublishingSteps.before` gives them.
    received_p
        Probability that a vehicle has received each publication by now.

    Returns
    -------
    Lookups that find each publication, and those that find none, by subject.
    """
    left, found = looked_up_p.copy(), np.zeros((n_subjects, len(publications)))
    for i, (step, p) in enumerate(zip(publications, received_p, strict=True)):
        if step < 0:
            break
        here = left * p * held[:, i]
        found[:, i] = np.bincount(subject, here, n_subjects)
        left -= here
    return found, np.bincount(subject, left, n_subjects)


@dataclass(frozen=True, slots=True)
class EvidenceChances:
    """Chances that subjects are evaluated, by step."""

    log_none: Float[ndarray, "m s t"]
    """Logarithm of the probability that no evaluation of the subject in the step is at the server after 1, 2, ... m
    steps. The last row holds for all later steps too."""

    def lag_class(self, n_lags: int) -> Int[ndarray, "n"]:
        """Row of `log_none` for evidence that is 0, 1, ... steps old; -1 where none can have arrived."""
        return np.minimum(np.arange(n_lags) - 1, len(self.log_none) - 1)


class AgeCounts(NamedTuple):
    """Expected lookups by age in whole steps: of the value, of the newest and of the oldest evaluation behind it."""

    value: Float[ndarray, "t"]
    newest: Float[ndarray, "t"]
    oldest: Float[ndarray, "t"]
    n_unseen: float
    """Lookups that find a publication in which no evaluation of the subject counts, though it had sent detections in a
    step whose evidence counts."""


def ages(evidence: EvidenceChances, looks: ExpectedLookups, window_steps: int, since: Int[ndarray, "s"]) -> AgeCounts:
    """Ages that lookups find, equations (4) to (6).

    Parameters
    ----------
    evidence
        Chances of evaluation.
    looks
        Expected lookups.
    window_steps
        Evidence of this age, or older, does not count when the server publishes.
    since
        Step in which each subject sensed first.

    Notes
    -----
    The newest evaluation behind a publication at step B is j steps old with probability (1 - u(j)) u(1) ... u(j - 1), u
    being the probability that the step B - j brought none (assumption 6: steps are independent, given the traffic).
    """
    n_steps = evidence.log_none.shape[2]
    out = np.zeros((3, n_steps + 1))
    none_p = np.exp(evidence.log_none)
    n_unseen = _ages(
        none_p,
        evidence.lag_class(min(window_steps, n_steps + 1)),
        since,
        looks.subject,
        looks.step,
        looks.publication,
        looks.n,
        out,
    )
    return AgeCounts(out[0], out[1], out[2], n_unseen)


@compiled
def _ages(none_p, lag_class, since, subject, step, publication, n, out):
    unseen = 0.0
    for row in range(len(subject)):
        s = subject[row]
        for i in range(publication.shape[1]):
            b, weight = publication[row, i], n[row, i]
            if weight <= 0.0 or b < 0:
                continue
            passed = step[row] - b
            oldest = min(len(lag_class) - 1, b)
            left = 1.0
            for j in range(1, oldest + 1):
                u = none_p[lag_class[j], s, b - j]
                out[1, passed + j] += weight * left * (1.0 - u)
                left *= u
                if left < 1e-9:
                    left = 0.0
                    break
            if since[s] < b:
                unseen += weight * left
            out[0, passed] += weight * (1.0 - left)
            left = 1.0
            for j in range(oldest, 0, -1):
                u = none_p[lag_class[j], s, b - j]
                out[2, passed + j] += weight * left * (1.0 - u)
                left *= u
                if left < 1e-9:
                    break
    return unseen


class PairSteps(NamedTuple):
    """Chances that an evaluator evaluates the detections of a subject, and the evaluation reaches the server."""

    step: Int[ndarray, "q"]
    """Step of the detections."""
    made: Int[ndarray, "q"]
    """Step of the evaluation."""
    subject: Int[ndarray, "q"]
    pair: Int[ndarray, "q"]
    """Number of the pair of evaluator and subject."""
    log_none: Float[ndarray, "q"]


def behind(
    found: PairSteps,
    pair_subject: Int[ndarray, "k"],
    looks: ExpectedLookups,
    window_steps: int,
    arrived_p: Float[ndarray, "m"],
) -> float:
    """Expected evaluators behind values, summed over lookups, equation (7).

    Parameters
    ----------
    found
        Chances by pair and step.
    pair_subject
        Subject of each pair.
    looks
        Expected lookups.
    window_steps
        As for `ages`.
    arrived_p
        Probability that an evaluation is at the server 1, 2, ... m steps after it was made. The last one holds for all
        later steps too.
    """
    n_subjects = int(pair_subject.max(initial=-1)) + 1
    publications, which = np.unique(looks.publication, return_inverse=True)
    known = (looks.publication >= 0) & (looks.subject < n_subjects)[:, None]
    cell = which.reshape(looks.publication.shape) * n_subjects + looks.subject[:, None]
    n_cells = len(publications) * n_subjects
    weights = np.bincount(cell[known], looks.n[known], n_cells)
    weights = weights.reshape(len(publications), n_subjects)
    made_p = -np.expm1(found.log_none) / arrived_p[-1]
    by_lag = np.append(0.0, arrived_p)
    late = found.made - found.step
    n_lags = np.clip(window_steps - 1 - late, 0, len(arrived_p))  # after which it still counts
    log_none = np.zeros(len(pair_subject))

    def log_after(rows: Int[ndarray, "r"], lag: ndarray | int) -> Float[ndarray, "r"]:
        """Logarithm of the probability that the evaluation is not at the server after so many steps."""
        there_p = made_p[rows] * by_lag[lag]
        return np.log1p(-np.minimum(there_p, 1 - 1e-12))

    arrives, expires = _InOrder(found.made), _InOrder(found.step + window_steps)
    evaluators = 0.0
    for b, weight in zip(publications.tolist(), weights, strict=True):
        for lag in range(1, len(by_lag)):
            rows = arrives.until(b - lag, lag)
            rows = rows[n_lags[rows] >= lag]
            more = log_after(rows, lag) - log_after(rows, lag - 1)
            np.add.at(log_none, found.pair[rows], more)
        rows = expires.until(b)
        had = log_after(rows, n_lags[rows])
        np.add.at(log_none, found.pair[rows], -had)
        each = np.bincount(pair_subject, -np.expm1(np.minimum(log_none, 0.0)), n_subjects)
        evaluators += float(weight @ each)
    return evaluators


class _InOrder:
    """Rows in the order of their steps, to be taken piece by piece."""

    def __init__(self, step: Int[ndarray, "q"]) -> None:
        self._order = np.argsort(step, kind="stable")
        self._step = step[self._order]
        self._taken: dict[int, int] = {}

    def until(self, step: int, reader: int = 0) -> Int[ndarray, "r"]:
        """The rows up to a step that this reader has not taken before."""
        begin = self._taken.get(reader, 0)
        end = int(np.searchsorted(self._step, step, "right"))
        self._taken[reader] = end
        return self._order[begin:end]


class Encounters(NamedTuple):
    """Encounters of equipped vehicles in one direction: the holder would know trust in the subject."""

    holder: Int[ndarray, "n"]
    """Row of `on_road`."""
    subject: Int[ndarray, "n"]
    start: Int[ndarray, "n"]
    """First step."""
    end: Int[ndarray, "n"]
    """One past the last step."""
    first: Int[ndarray, "n"]
    """First row of `lookup_step` that belongs to the two."""
    stop: Int[ndarray, "n"]
    lookup_step: Int[ndarray, "q"]
    """Steps in which the holder may look the subject up, ascending for each two."""
    log_missed: Float[ndarray, "q"]
    """Logarithm of the probability that it does not."""
    began: Int[ndarray, "n"]
    """Step from which on the holder keeps what it received, at the start of the encounter."""
    on_road: Bool[ndarray, "s t"]
    """Whether each vehicle is on the road in each step: a publication does not reach others."""


def without_trust(
    evidence: EvidenceChances, meetings: Encounters, gate: PublishingSteps, window_steps: int, loss_p: float
) -> float:
    """Share of encounters that end before the holder knows trust in the other, equation (8).

    Parameters
    ----------
    evidence
        Chances of evaluation.
    meetings
        Encounters.
    gate
        When the server publishes.
    window_steps
        As for `ages`.
    loss_p
        Probability that a vehicle misses a publication.

    Returns
    -------
    The expected share; nan without encounters.

    Notes
    -----
    Trust is known at the start, or at the first lookup after a publication that rests on an evaluation. Publications
    before the start count at the start, without a message: the newest that was not lost.
    """
    if not len(meetings.subject):
        return float("nan")
    at_last = evidence.log_none[-1]
    nothing = np.zeros((len(at_last), 1))
    summed = np.concatenate([nothing, np.cumsum(at_last, 1)], axis=1)
    total = _without_trust(evidence.log_none, summed, gate.steps, meetings, window_steps, loss_p, n_followed(loss_p))
    return float(total / len(meetings.subject))


@compiled
def _log_nothing(log_none, summed, s, publication, begin, end):
    """Logarithm of the probability that a publication has no evidence of the steps from `begin` to `end`."""
    if begin >= end:
        return 0.0
    late = min(max(publication - len(log_none) + 1, begin), end)  # what was sent before has arrived, or never will
    total = summed[s, late] - summed[s, begin]
    for step in range(late, end):
        total += log_none[publication - step - 1, s, step]
    return total


@compiled
def _without_trust(log_none, summed, gate, meetings, window_steps, loss_p, n_followed):
    total = 0.0
    for row in range(len(meetings.subject)):
        s, start, end = meetings.subject[row], meetings.start[row], meetings.end[row]
        on_road = meetings.on_road[meetings.holder[row]]
        last = np.searchsorted(gate, end - 1, "right") - 1
        last_before = np.searchsorted(gate, start, "left") - 1
        first = held = last_before + 1  # the oldest and the newest publication that the holder may have at the start
        n, k = 0, last_before
        while k >= 0 and gate[k] >= meetings.began[row] and n < n_followed:
            if on_road[gate[k]]:
                first, n = k, n + 1
                if n == 1:
                    held = k
            k -= 1
        latest = gate[min(held, len(gate) - 1)]
        low, published = max(latest - window_steps + 1, 0), -1
        settled = 0.0  # of the steps below `low`, which no later publication counts
        never, before = 0.0, 1.0  # nothing known; no evidence in any publication so far
        for k in range(first, last + 1):
            if k <= last_before and not on_road[gate[k]]:
                continue
            begin = max(gate[k] - window_steps + 1, low)
            if published >= 0:
                settled += _log_nothing(log_none, summed, s, published, low, min(begin, published))
            low, published = begin, gate[k]
            log_now = settled + _log_nothing(log_none, summed, s, published, low, published)
            now = min(np.exp(log_now), before)
            missed = loss_p ** on_road[gate[k : last_before + 1]].sum()
            since = max(k, last_before + 1)  # lookups from this publication on tell
            if since <= last:
                log_missed = 0.0
                for q in range(meetings.first[row], meetings.stop[row]):
                    if gate[since] <= meetings.lookup_step[q] < end:
                        log_missed += meetings.log_missed[q]
                missed *= np.exp(log_missed * (1.0 - loss_p))
            never += (before - now) * missed
            before = now
        total += never + before
    return total


def quantile(age_s: Float[ndarray, "n"], weight: Float[ndarray, "n"], share: float) -> float:
    """The smallest age at which the cumulative weight reaches a share of the total; nan without weight."""
    total = np.cumsum(weight)
    if not len(total) or total[-1] <= 0:
        return float("nan")
    reached = int(np.searchsorted(total, share * total[-1] * (1 - 1e-12)))
    return float(age_s[min(reached, len(age_s) - 1)])
