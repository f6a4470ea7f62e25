"""The closed form of the law of freshness: the age of the newest evaluation from a handful of measured numbers."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.law.law import n_followed


class Company(NamedTuple):
    """Chances of evaluation as a Markov chain of two states: in company (likely to be evaluated) and alone."""

    p: tuple[float, float]
    """Probability that the detections of one sweep are evaluated, and that this reaches the server, in each state."""
    looked_up: float
    """Share of the lookups whose subject is in company."""
    ends_p: tuple[float, float]
    """Probability that each state has changed by the next sweep."""

    @staticmethod
    def measured(
        p: Float[ndarray, "k"],
        subject: Int[ndarray, "k"],
        lookups: Float[ndarray, "k"],
    ) -> "Company":
        """The chain of a replay.

        Parameters
        ----------
        p
            Probability that each sweep is evaluated. A subject is in company where it is 1/2 or more.
        subject
            Subject of each sweep. Sweeps are sorted by subject, then by time.
        lookups
            Expected lookups of the subject between this sweep and its next one.
        """
        state = (p < 0.5).astype(np.int64)
        same = subject[1:] == subject[:-1]
        now = state[:-1][same]
        next_one = state[1:][same]
        n = np.bincount(now, minlength=2)
        changed = np.bincount(now, now != next_one, 2)
        asked = np.bincount(state, lookups, 2)
        evaluated = np.bincount(state, lookups * p, 2)
        evaluated_p = evaluated / np.maximum(asked, 1e-300)
        ends_p = changed / np.maximum(n, 1)
        looked_up = float(asked[0] / max(asked.sum(), 1e-300))
        return Company(tuple(evaluated_p.tolist()), looked_up, tuple(ends_p.tolist()))

    @property
    def mean_p(self) -> float:
        """Probability that the newest sweep of the subject of a lookup is evaluated."""
        company_p, alone_p = self.p
        return self.looked_up * company_p + (1 - self.looked_up) * alone_p

    def in_company(self, sweeps: float) -> float:
        """Probability that the subject of a lookup was in company so many sweeps ago."""
        total = sum(self.ends_p)
        settled = self.ends_p[1] / total if total > 0 else self.looked_up
        return settled + (self.looked_up - settled) * max(1.0 - total, 0.0) ** sweeps


def closed_form(
    company: Company, period_steps: int, window_steps: int, loss_p: float, n_ages: int, sense_every_steps: int = 1
) -> Float[ndarray, "n"]:
    """Distribution of the age of the newest evaluation, for subjects in company and alone in turn, equation (9).

    Parameters
    ----------
    company
        Chances of evaluation, and how long they last.
    period_steps
        Server period M, in steps.
    window_steps
        Window, in steps.
    loss_p
        Probability that a vehicle misses a publication.
    n_ages
        Number of ages.
    sense_every_steps
        Sensing interval n of every vehicle, in steps. If it is not 1, phases are random.

    Returns
    -------
    Probability of the age 2 r + a D, by a, given that there is an evaluation in the window.

    Notes
    -----
    The age is 2 r + D (U + M L + W + n G). U is uniform on 0 ... M - 1, the phase of the server period; L is geometric,
    publications lost in a row; W is uniform on 1 ... n, the time from the subject's last sweep to the publication.
    Evaluators have phases of their own, so after W steps the part W / n of them has sensed. If they are many, and
    independent, the last sweep is evaluated with probability 1 - (1 - q)^(W / n), and G = 0; each earlier one is with
    probability q. The window cuts W + n G off. q is that of the state, which is followed back from the lookup.
    """
    gaps = np.stack([_gaps(company, state, window_steps, sense_every_steps) for state in (0, 1)])
    age = np.zeros(n_ages + gaps.shape[1])
    for lost in range(n_followed(loss_p)):
        for phase in range(period_steps):
            shift = phase + lost * period_steps
            if shift >= n_ages:
                break
            there = company.in_company((shift + (sense_every_steps + 1) / 2) / sense_every_steps)
            gap = there * gaps[0] + (1 - there) * gaps[1]
            lost_p = (1 - loss_p) * loss_p**lost
            age[shift : shift + len(gap)] += lost_p * gap
    age = age[:n_ages]
    return age / age.sum() if age.sum() > 0 else age


def _gaps(company: Company, state: int, window_steps: int, every: int) -> Float[ndarray, "w"]:
    """Probability of W + n G for a subject in this state at its last sweep. What the window cuts is missing."""
    p = np.array(company.p)
    parts, meets = company.ends_p
    moves = np.array([[1 - parts, parts], [meets, 1 - meets]])
    gap = np.zeros(max(window_steps, every + 1))
    for w in range(1, every + 1):
        missed = (1 - p[state]) ** (w / every)
        gap[w] += (1 - missed) / every
        left = missed / every * np.eye(2)[state]
        for at in range(w + every, window_steps, every):
            left = left @ moves
            gap[at] += left @ p
            left = left * (1 - p)
    gap[window_steps:] = 0.0
    return gap
