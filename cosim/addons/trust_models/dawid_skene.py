"""Truth inference: the truth of detections and the reliability of evaluators, estimated together."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt, Interval
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.special import expit

from cosim.base.kernel import compiled
from trust.evaluation_log import StepRows, rounded
from trust.models.stepwise import Reading, Stepwise, StepwiseParams


@dataclass(frozen=True, kw_only=True, slots=True)
class InferenceParams(StepwiseParams):
    """What `dawid_skene` and `dawid_skene_online` have in common; the defaults are ours."""

    reliable: Annotated[float, Gt(1)] = 4.0
    """a: prior evidence that an evaluator says what is true, and that a sender's detections are true, against 1 of the
    opposite. It must be above 1: this is what tells truth from its reverse."""
    n_iterations: Annotated[int, Interval(ge=1, le=1000)] = 8
    """Iterations of expectation and maximisation: the bound of the work."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DawidSkeneParams(InferenceParams):
    """Parameters of the model `dawid_skene`."""

    window_s: Annotated[float, Interval(ge=0.001, le=1e4)] = 20.0
    """Age at which evidence is forgotten [s]; the default is ours."""


@dataclass(frozen=True, slots=True)
class Answers:
    """Evaluations of detections, as answers to the question whether each is true."""

    by: Int[ndarray, "k"]  # pair of each answer's evaluator
    object: Int[ndarray, "k"]  # detection, numbered from 0
    pos: Float[ndarray, "k"]
    neg: Float[ndarray, "k"]
    sender: Int[ndarray, "o"]  # pair of each detection's sender

    @staticmethod
    def of(rows: StepRows) -> "Answers":
        """The evaluations of one step."""
        return Answers(rows.by, rows.object, rows.object_pos, rows.object_neg, rows.sender)

    @staticmethod
    def joined(parts: tuple["Answers", ...]) -> "Answers":
        """The evaluations of several steps, whose detections are different ones."""
        first = np.cumsum([0, *(p.sender.size for p in parts)])
        return Answers(
            np.concatenate([p.by for p in parts]),
            np.concatenate([p.object + n for p, n in zip(parts, first, strict=False)]),
            np.concatenate([p.pos for p in parts]),
            np.concatenate([p.neg for p in parts]),
            np.concatenate([p.sender for p in parts]),
        )


Window = tuple[tuple[int, Answers], ...]
"""Answers by step."""


@compiled
def _log_odds(by, to, pos, neg, confirms, denies, prior):
    """Log-odds that each detection is true; `confirms` and `denies` are the weights of each evaluator's answers."""
    odds = np.zeros(prior.size)
    for k in range(by.size):
        evaluator = by[k]
        said = pos[k] * confirms[evaluator] + neg[k] * denies[evaluator]
        odds[to[k]] += rounded(said)
    return prior + odds


@compiled
def _counts(by, to, pos, neg, sender, true, n):
    """The result of `expected_counts`, if the detections are true with these probabilities."""
    counts = np.zeros((n, 6))
    for k in range(by.size):
        q = true[to[k]]
        of = counts[by[k]]
        of[0] += rounded(q * pos[k])
        of[1] += rounded(q * neg[k])
        of[2] += rounded((1 - q) * neg[k])
        of[3] += rounded((1 - q) * pos[k])
    for k in range(sender.size):
        counts[sender[k], 4] += rounded(true[k])
        counts[sender[k], 5] += rounded(1 - true[k])
    return counts


def expected_counts(
    answers: Answers, before: Float[ndarray, "p 6"], reliable: float, n_iterations: int
) -> Float[ndarray, "p 6"]:
    """What the evaluators got right and wrong, by expectation over the unknown truth.

    Parameters
    ----------
    answers
        Evaluations of the detections whose truth is unknown.
    before
        Counts of other detections, in the columns of the result.
    reliable
        Prior evidence that answers and detections are right.
    n_iterations
        Iterations of expectation and maximisation.

    Returns
    -------
    Confirmations and denials of true detections, denials and confirmations of false ones, by evaluator; then true and
    false detections, by sender.
    """
    given = answers.by, answers.object, answers.pos, answers.neg
    sender = answers.sender
    counts = np.zeros((len(before), 6))
    prior_counts = np.tile([reliable, 1.0], 3)
    for _ in range(n_iterations):
        known = before + counts + prior_counts
        total = known[:, 0::2] + known[:, 1::2]
        log_share = np.log(known) - np.log(total.repeat(2, axis=1))
        confirm_true, deny_true, deny_false, confirm_false, true, false = log_share.T
        confirms, denies = confirm_true - confirm_false, deny_true - deny_false
        prior = true - false
        true = expit(_log_odds(*given, confirms, denies, prior[sender]))
        counts = _counts(*given, sender, true, len(before))
    return counts


def trust_from(counts: Float[ndarray, "p 6"], reliable: float) -> Float[ndarray, "p"]:
    """Share of true detections, times what the evaluator's word is worth.

    Parameters
    ----------
    counts
        As `expected_counts` returns them.
    reliable
        As in `InferenceParams`.

    Returns
    -------
    pi times max(0, alpha + beta - 1) (Youden's index) of each pair, in [0, 1].
    """
    known = counts + np.tile([reliable, 1.0], 3)
    right, wrong = known[:, 0::2], known[:, 1::2]
    alpha, beta, pi = (right / (right + wrong)).T
    return pi * np.maximum(alpha + beta - 1.0, 0.0)


def _counted(window: Window, n_pairs: int) -> Int[ndarray, "p 3"]:
    """Evaluations of each pair in a window, newest and oldest step of them."""
    counted = np.zeros((n_pairs, 3), np.int64)
    for step, answers in window:
        n = np.bincount(answers.sender[answers.object], minlength=n_pairs)
        counted[(n > 0) & (counted[:, 0] == 0), 2] = step
        counted[n > 0, 1] = step
        counted[:, 0] += n
    return counted


class DawidSkene(Stepwise):
    """Two-coin model of Dawid and Skene [15]_, by EM over a window of steps.

    It should stop bad-mouthing, random evaluations, and the senders of false content: whoever answers against the truth
    that the others' answers make likely is unreliable, and an evaluator that always says "false" says nothing. It
    cannot stop colluders who make their own truth. This needs no majority: three of ten that never contradict one
    another look more reliable than honest vehicles that miss a quarter. For the same reason Sybil vehicles win where
    few others look. It does not see removal, false speeds, or confirmations of true detections.

    Notes
    -----
    Detection d of sender i is true with probability pi_i. Evaluator v confirms a true one with probability alpha_v and
    denies a false one with beta_v; an evaluation counts pos confirmations and neg denials. E: logit q_d = logit pi_i +
    sum of pos ln(alpha / (1 - beta)) + neg ln((1 - alpha) / beta). M: means with prior counts a and 1. Trust is pi
    max(0, alpha + beta - 1).

    Deviations: priors, because without them truth and falsehood may be exchanged (honest majority); fractional answers;
    a fixed number of iterations.

    [15] Dawid, Skene: Maximum Likelihood Estimation of Observer Error-Rates Using the EM Algorithm. Applied Statistics,
    1979.
    """

    Params: ClassVar[type] = DawidSkeneParams

    def start(self) -> Window:
        """No answers yet."""
        return ()

    def advance(self, state: Window, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> Window:
        """The answers of the window after a step."""
        return (*self._recent(state, step), (step, Answers.of(rows)))

    def read(self, state: Window, n_steps: int, now: int) -> Reading:
        """Trust from the counts of the window."""
        p, n = self.params, len(self.log.pairs)
        counts, recent = np.zeros((n, 6)), self._recent(state, now)
        if recent:
            answers = Answers.joined(tuple(of_step for _, of_step in recent))
            counts = expected_counts(answers, counts, p.reliable, p.n_iterations)
        weight = counts[:, 4:].sum(axis=1)
        return Reading(trust_from(counts, p.reliable), weight, None, p.window_s, _counted(recent, n))

    def _recent(self, state: Window, now: int) -> Window:
        window_s = self.params.window_s
        return tuple(one for one in state if self.is_younger(now - one[0], window_s))
