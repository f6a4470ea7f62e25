"""Own sweep first: what the holder sees itself overrules the others, and judges them as evaluators."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.trust_models.evaluator_trust import EvaluatorTrust, EvaluatorTrustParams
from trust.evaluation_log import StepRows


@dataclass(frozen=True, kw_only=True, slots=True)
class SelfFirstParams(EvaluatorTrustParams):
    """Parameters of the model `self_first`; the defaults are ours."""

    own_weight: Annotated[float, Gt(0)] = 20.0
    """Weight of the holder's own evaluations. Those of others have at most 1."""


class SelfFirst(EvaluatorTrust):
    """As `evaluator_trust`, with the holder's own evaluations as the anchor of truth.

    The holder's own evaluations have `own_weight`: whoever contradicts what the holder sees is not believed about what
    the holder does not see. This is the private experience of [12]_.

    With `trust.host = "local"` it should stop what `evaluator_trust` stops, and also colluding majorities and Sybil
    vehicles, for every holder that sees some of what they talk about. It cannot help a holder that sees nothing of it,
    or against liars who are honest where the holder looks. A trust server has no sweep: there the model equals
    `evaluator_trust`.

    Notes
    -----
    Equations of `evaluator_trust` with w = `own_weight` for the holder's own rows.

    Deviations: as `evaluator_trust`; [12]_ weighs private and public reputation by a share that depends on the number
    of ratings, and here the own evaluation of the same detection outweighs all others.
    """

    Params: ClassVar[type] = SelfFirstParams

    def weight(self, weight: Float[ndarray, "p"], rows: StepRows) -> Float[ndarray, "n"]:
        """Reliability of the evaluators, and `own_weight` for the holder itself."""
        return np.where(rows.is_own, self.params.own_weight, weight[rows.evaluator])
