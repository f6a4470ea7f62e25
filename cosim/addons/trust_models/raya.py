"""Data-centric trust of Raya et al.: reports about one object combined into the score of the object."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.base.bounds import Share
from trust.models.beta import Beta, BetaParams
from trust.object_reports import ObjectReports


@dataclass(frozen=True, kw_only=True, slots=True)
class RayaParams(BetaParams):
    """Parameters of the models `raya_*`; those of `beta` are for the trust in vehicles."""

    trust_from: Literal["fixed", "vehicle"] = "fixed"
    """Trustworthiness of a report: `report_trust`, or the ego's trust in the vehicle."""
    report_trust: Share = 0.8
    """tau: trustworthiness of every report; the default is ours."""


_LARGE = 700.0
"""The exponential of more is no double."""

Combine = Callable[
    [ObjectReports, Float[ndarray, "r"]],
    Float[ndarray, "g"],
]
"""Arguments: reports, and the weight F in (0, 1) of each. Result: score in [0, 1] of each group."""


def _two_sums(reports: ObjectReports, values: ndarray) -> tuple[ndarray, ndarray]:
    """Sum of values in favour and against, per group."""
    a, b = (
        np.bincount(reports.group[side], values[side], reports.n_groups)
        for side in (reports.in_favour, ~reports.in_favour)
    )
    return a.astype(float), b.astype(float)


def _share(a: ndarray, b: ndarray) -> ndarray:
    """a / (a + b); 0 where there is nothing."""
    total = a + b
    return np.divide(a, total, out=np.zeros_like(a), where=total > 0)


def majority(reports: ObjectReports, weight: ndarray) -> ndarray:
    """Share of the reports that are in favour, whatever their weight.

    Returns
    -------
    Score of each group; 0 without reports.
    """
    return _share(*_two_sums(reports, np.ones_like(weight)))


def most_trusted(reports: ObjectReports, weight: ndarray) -> ndarray:
    """Largest weight in favour, as a share of the sum of the largest in favour and the largest against.

    Returns
    -------
    Score of each group; 0 without reports.
    """
    best = np.zeros((2, reports.n_groups))
    np.maximum.at(best, (np.where(reports.in_favour, 0, 1), reports.group), weight)
    return _share(*best)


def weighted(reports: ObjectReports, weight: ndarray) -> ndarray:
    """Sum of the weights in favour, as a share of the sum of all weights.

    Returns
    -------
    Score of each group; 0 without reports.
    """
    return _share(*_two_sums(reports, weight))


def bayes(reports: ObjectReports, weight: ndarray) -> ndarray:
    """Posterior probability of the object with prior 1/2.

    Returns
    -------
    Score of each group, with P(report in favour / object) = P(report against / no object) = F; 1/2 without reports.
    """
    a, b = _two_sums(reports, np.log(weight) - np.log1p(-weight))
    return 0.5 * (1 + np.tanh((a - b) / 2))


def dempster_shafer(reports: ObjectReports, weight: ndarray) -> ndarray:
    """Belief in the object by Dempster's rule.

    Returns
    -------
    Score of each group. A report gives the mass F to what it says, and 1 - F to "either"; 0 without reports.
    """
    a, b = _two_sums(reports, np.log1p(-weight))
    # With p = exp(a) and q = exp(b), the masses left on "either" by all reports in favour and by all against, this is
    # (1 - p) q / (p + q - p q), divided by q, so that nothing cancels where both are small.
    p_over_q = np.exp(np.minimum(a - b, _LARGE))
    return np.abs(np.expm1(a)) / (1 - p_over_q * np.expm1(b))


class Raya(Beta):
    """Scores of objects by the decision logics of Raya et al. [10]_; trust in vehicles is that of `beta`.

    Notes
    -----
    F = clip(Phi tau, 0.01, 0.99) of every vehicle with a report in favour (detectors, evaluators that matched) or
    against (could see the place and did not). Each vehicle has one report per object. `raya_majority`: n+ / (n+ + n-);
    `raya_most_trusted`: max F+ / (max F+ + max F-); `raya_weighted`: sum F+ / sum F; `raya_bayes`: posterior with prior
    1/2 and P(report / event) = F; `raya_dempster_shafer`: m(A) = F, m(Omega) = 1 - F, Dempster's rule, score = belief.

    Deviations: equations from memory of the paper; the decision (score above 1/2 for the first four) is given as a
    score; the paper's event-specific trust and its decay in time and distance are Phi here.

    [10] Raya, Papadimitratos, Gligor, Hubaux: On Data-Centric Trust Establishment in Ephemeral Ad Hoc Networks.
    INFOCOM, 2008.
    """

    Params: ClassVar[type] = RayaParams
    combine: ClassVar[Combine] = staticmethod(majority)  # of `raya_majority`

    def score_objects(self, reports: ObjectReports) -> Float[ndarray, "g"]:
        """Score of each group by the decision logic of the class; see `ScoresObjects`."""
        tau = reports.trust if self.params.trust_from == "vehicle" else self.params.report_trust
        return type(self).combine(reports, np.clip(reports.visibility * tau, 0.01, 0.99))


class RayaMostTrusted(Raya):
    """`raya_most_trusted`."""

    combine: ClassVar[Combine] = staticmethod(most_trusted)


class RayaWeighted(Raya):
    """`raya_weighted`."""

    combine: ClassVar[Combine] = staticmethod(weighted)


class RayaBayes(Raya):
    """`raya_bayes`."""

    combine: ClassVar[Combine] = staticmethod(bayes)


class RayaDempsterShafer(Raya):
    """`raya_dempster_shafer`."""

    combine: ClassVar[Combine] = staticmethod(dempster_shafer)
