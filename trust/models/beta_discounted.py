"""Beta reputation in which an evaluation counts as much as its evaluator is trusted."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from trust.evaluation_log import StepRows
from trust.models.beta import BetaParams, expectation, read_beta
from trust.models.stepwise import Reading, Stepwise
from trust.pair_index import with_rows


class BetaDiscounted(Stepwise):
    """Beta reputation with discounted feedback [2]_.

    Notes
    -----
    As `beta`, with pos and neg of an evaluation multiplied by the holder's trust in the evaluator: the expectation
    (r + 1) / (r + s + 2) as it was before the step, 1/2 for an evaluator about whom nothing is known.

    Deviations: the source discounts opinions, so that feedback of an unknown evaluator counts nothing at all; a server
    has no experience of its own to begin with, and the expectation stands for the belief.

    [2] Jøsang, Ismail: The Beta Reputation System. 15th Bled Electronic Commerce Conference, 2002.
    """

    Params: ClassVar[type] = BetaParams

    def start(self) -> Float[ndarray, "p 2"]:
        """r and s of each pair."""
        return np.zeros((0, 2))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """r and s after a step."""
        new = with_rows(state * self.decay(self.params.decay_per_s, n_steps), n_pairs)
        trust = expectation(new)[rows.evaluator]
        new[:, 0] += rows.per_observer(trust * rows.pos, len(new))
        new[:, 1] += rows.per_observer(trust * rows.neg, len(new))
        return new

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Expectation of the Beta distribution."""
        per_s = self.params.decay_per_s
        return read_beta(state * self.decay(per_s, n_steps), self.horizon_s(per_s))
