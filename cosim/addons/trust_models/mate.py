"""MATE: Beta distributions for vehicles and for objects, each from the other."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Gt
from jaxtyping import Float
from numpy import ndarray

from cosim.base.bounds import Share
from trust.evaluation_log import StepRows, exact_sums
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows

PRIOR = 0.5
"""alpha and beta without evidence."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MateParams(StepwiseParams):
    """Parameters of the model `mate`."""

    negative_gain: Annotated[float, Ge(1)] = 4.0
    """n of a measurement of a vehicle below `negative_below`; 1 above."""
    negative_below: Share = 0.4
    """v below which a measurement of a vehicle counts as negative."""
    propagation_s: Annotated[float, Gt(1)] = 10.0
    """1 / `propagation_s` of the distance to the prior is lost in 1 s."""


def gained(v: ndarray, c: ndarray, n: ndarray | float) -> tuple[ndarray, ndarray]:
    """What measurements add to alpha and beta.

    Parameters
    ----------
    v, c
        Value and confidence of each measurement, in [0, 1].
    n
        Gain of each measurement; above 1 it gives beta more than alpha.

    Returns
    -------
    n / (n + 1) c v for alpha, and n^2 / (n + 1) c (1 - v) for beta.
    """
    alpha = n / (n + 1) * c * v
    beta = n * n / (n + 1) * c * (1 - v)
    return alpha, beta


def mean(alpha_beta: Float[ndarray, "... 2"]) -> Float[ndarray, "..."]:
    """Mean of Beta distributions, alpha / (alpha + beta), in (0, 1); the last axis is (alpha, beta)."""
    return alpha_beta[..., 0] / alpha_beta.sum(axis=-1)


def confidence(alpha_beta: Float[ndarray, "... 2"]) -> Float[ndarray, "..."]:
    """Confidence in Beta distributions, clip(1 - 2 std, 1e-4, 0.9999); the last axis is (alpha, beta)."""
    total = alpha_beta.sum(axis=-1)
    variance = alpha_beta.prod(axis=-1) / (total**2 * (total + 1))
    return np.clip(1 - 2 * np.sqrt(variance), 1e-4, 0.9999)


class Mate(Stepwise):
    """Trust of vehicles and objects from multi-agent consistency, as in MATE [4]_.

    Notes
    -----
    A measurement v of confidence c: alpha += n / (n + 1) c v, beta += n^2 / (n + 1) c (1 - v).
    Object: v = 1 from its detector and from evaluators that matched it, 0 from those that could see it and did not;
    c = mean of the vehicle before the step, n = 1; it begins at alpha = beta = 0.5.
    Vehicle: v = mean of the object for those with v = 1, else 1 - mean; c = clip(1 - 2 std, 1e-4, 0.9999) of the
    object; n = 4 if v < 0.4, else 1. alpha and beta return to 0.5 by 1 / 10 of the distance per second.
    Trust is the mean of the vehicle; uncertainty 2 std; weight alpha + beta - 1.

    Deviations: an object is a detection of one step, the evaluators' matching groups being unknown to a server; in
    view is visibility above 0, as the evaluator states it, where the source traces rays through the agent's own point
    cloud; objects in view that a message lacks count only with `trust.evidence` "missing"; the published pull dt / 10
    s depends on the step, here it is 1 - 0.9^dt, the same at 1 s; a vehicle that is absent is kept, where the
    published code deletes it at once.

    [4] Hallyburton, Pajic: Security-Aware Sensor Fusion with MATE: the Multi-Agent Trust Estimator. CCS, 2025, and
    published code.
    """

    Params: ClassVar[type] = MateParams

    def start(self) -> Float[ndarray, "p 2"]:
        """alpha and beta of each pair, less the prior; no pairs yet."""
        return np.zeros((0, 2))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """alpha and beta of each pair after a step, less the prior."""
        new = with_rows(self._pulled(state, n_steps), n_pairs)
        trusted = mean(new + PRIOR)
        by, of = rows.by, rows.sender
        matched, missed = rows.object_pos > 0, rows.object_neg > 0
        confirmed = trusted[of] + rows.per_object(trusted[by] * matched)
        denied = rows.per_object(trusted[by] * missed)
        objects = PRIOR + 0.5 * np.column_stack([confirmed, denied])
        v, c = mean(objects), confidence(objects)
        evaluated = np.bincount(rows.object[matched | missed], minlength=of.size) > 0
        self._measured(new, of[evaluated], v[evaluated], c[evaluated])
        for agrees, value in ((matched, v), (missed, 1 - v)):
            at = rows.object[agrees]
            self._measured(new, by[agrees], value[at], c[at])
        return new

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Mean of the vehicle's Beta distribution; uncertainty is 2 std."""
        excess = self._pulled(state, n_steps)
        alpha_beta = excess + PRIOR
        total = alpha_beta.sum(axis=1)
        std = np.sqrt(alpha_beta.prod(axis=1) / (total**2 * (total + 1)))
        return Reading(mean(alpha_beta), excess.sum(axis=1), 2 * std, self.horizon_s(self._per_s))

    @property
    def _per_s(self) -> float:
        return 1 - 1 / self.params.propagation_s

    def _pulled(self, state: ndarray, n_steps: int) -> ndarray:
        return state * self.decay(self._per_s, n_steps)

    def _measured(self, state: ndarray, vehicle: ndarray, v: ndarray, c: ndarray) -> None:
        """Add measurements of vehicles."""
        p = self.params
        n = np.where(v < p.negative_below, p.negative_gain, 1.0)
        for column, gain in enumerate(gained(v, c, n)):
            state[:, column] += exact_sums(vehicle, gain, len(state))
