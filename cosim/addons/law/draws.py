"""Runs that are drawn from the chances of a prediction: what chance alone does to the metrics of one run."""

from dataclasses import replace

import numpy as np

from cosim.addons.law import law
from cosim.addons.law.prediction import FleetFindings

N_DRAWS = 39
"""The smallest and the largest of 39 draws hold a further one with a probability of 38 / 40 = 95 %, whatever the
distribution."""
_CERTAIN = -50.0


def drawn(found: FleetFindings, random: np.random.Generator) -> FleetFindings:
    """The evaluations of one run: draws of each pair of evaluator and subject in each step, and of delays.

    Parameters
    ----------
    found
        Chances.
    random
        Source of the draws.
    """
    pairs, arrived_p = found.pair_steps, found.arrived_p
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
        pair_steps=chosen._replace(made=chosen.made + lag, log_none=np.full(len(made), _CERTAIN)),
        arrived_p=np.ones(1),
    )
