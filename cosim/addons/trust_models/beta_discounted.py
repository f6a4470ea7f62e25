"""Beta reputation in which an evaluation counts as much as its evaluator is trusted."""

from jaxtyping import Float
from numpy import ndarray

from trust.evaluation_log import StepRows
from trust.models.beta import Beta, expectation


class BetaDiscounted(Beta):
    """Beta reputation with discounted feedback [2]_.

    Notes
    -----
    As `beta`, with pos and neg of an evaluation multiplied by the holder's trust in the evaluator: the expectation
    (r + 1) / (r + s + 2) as it was before the step, 1/2 for an evaluator about whom nothing is known.

    Deviations: the source discounts opinions, so that feedback of an unknown evaluator counts nothing at all; a server
    has no experience of its own to begin with, and the expectation stands for the belief.

    [2] Jøsang, Ismail: The Beta Reputation System. 15th Bled Electronic Commerce Conference, 2002.
    """

    def weight(self, state: ndarray, rows: StepRows) -> Float[ndarray, "n"]:
        """The holder's trust in the evaluator of each row before the step, in (0, 1)."""
        return expectation(state)[rows.evaluator]
