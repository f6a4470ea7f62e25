"""Truth inference step by step: `dawid_skene` with a bounded cost per step."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.trust_models.dawid_skene import Answers, InferenceParams, expected_counts, trust_from
from cosim.base.bounds import PositiveShare
from trust.evaluation_log import StepRows
from trust.models.stepwise import Reading, Stepwise
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class DawidSkeneOnlineParams(InferenceParams):
    """Parameters of the model `dawid_skene_online`."""

    decay_per_s: PositiveShare = 0.95
    """Share of the evidence that is left after 1 s; the default is ours."""


class DawidSkeneOnline(Stepwise):
    """The two-coin model of `dawid_skene`, by online EM [16]_.

    The E-step covers the detections of one step, with the counts of all earlier steps, which decay. Stops and fails as
    `dawid_skene`, but a verdict on a past detection is final: later evidence about an evaluator does not revise it.

    Notes
    -----
    Equations of `dawid_skene`; the counts decay by `decay_per_s`.

    Deviations: [16]_ has one E-step per observation; here the iterations repeat on the detections of the step.

    [16] Cappé, Moulines: On-line Expectation-Maximization Algorithm for Latent Data Models. Journal of the Royal
    Statistical Society B, 2009.
    """

    Params: ClassVar[type] = DawidSkeneOnlineParams

    def start(self) -> Float[ndarray, "p 6"]:
        """Counts of each pair; no pairs yet."""
        return np.zeros((0, 6))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """Counts after a step."""
        p = self.params
        new = with_rows(state * self.decay(p.decay_per_s, n_steps), n_pairs)
        return new + expected_counts(Answers.of(rows), new, p.reliable, p.n_iterations)

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Trust from the decayed counts."""
        p = self.params
        counts = state * self.decay(p.decay_per_s, n_steps)
        weight = counts[:, 4:].sum(axis=1)
        horizon_s = self.horizon_s(p.decay_per_s)
        return Reading(trust_from(counts, p.reliable), weight, None, horizon_s)
