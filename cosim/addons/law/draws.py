"""Runs that are drawn from the chances of a prediction: what chance alone does to the metrics of one run."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.law import law
from cosim.addons.law.prediction import FleetFindings

N_DRAWS = 39
"""The smallest and the largest of 39 draws hold a further one with a probability of 38 / 40 = 95 %, whatever the
distribution."""
_CERTAIN = -50.0


def drawn(found: FleetFindings, arrived_p: Float[ndarray, "m"], random: np.random.Generator) -> FleetFindings:
    """The evaluations of one run: draws of each pair of evaluator and subject in each step, and of delays.

    Parameters
    ----------
    found
        Chances.
    arrived_p
        Probability that a report is at the server 1, 2, ... m steps after its sweep.
    random
        Source of the draws.
    """
    pairs = found.pair_steps
    p = -np.expm1(pairs.log_none)
    made = np.flatnonzero(random.random(len(p)) < p)
    chosen = law.PairSteps(*(column[made] for column in pairs))
    lag = np.searchsorted(arrived_p / arrived_p[-1], random.random(len(made)), "right")
    log_none = np.zeros(found.evidence.log_none.shape)
    row = np.minimum(chosen.made - chosen.step + lag, len(log_none) - 1)
    log_none[row, chosen.subject, chosen.step] = _CERTAIN
    return replace(
        found,
        evidence=law.EvidenceChances(np.minimum.accumulate(log_none, axis=0)),
        pair_steps=chosen._replace(log_none=np.full(len(made), _CERTAIN)),
    )
