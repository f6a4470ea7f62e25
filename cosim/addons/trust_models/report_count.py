"""Report count: the more misbehaviour reports, the more guilty."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt
from jaxtyping import Float
from numpy import ndarray

from trust.evaluation_log import StepRows
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class ReportCountParams(StepwiseParams):
    """Parameters of the model `report_count`."""

    guilty_above: Annotated[float, Gt(0)] = 5.0
    """Reports above which a vehicle is guilty; its trust is then below 1/2."""


class ReportCount(Stepwise):
    """Misbehaviour authority that counts reports, as in F2MD [8]_.

    Notes
    -----
    A report is an evaluator's message of one step that is against the subject (neg > pos). With n reports trust is
    5 / (5 + n): below 1/2 exactly where the vehicle is guilty, n > 5. Weight: reports.

    Deviations: reports come from evaluations instead of plausibility checks; sanctions are left out; the trust
    value is ours.

    [8] F2MD: a framework for misbehaviour detection in VANETs, published code of its authority.
    """

    Params: ClassVar[type] = ReportCountParams

    def start(self) -> Float[ndarray, "p"]:
        """Number of reports about each pair; no pairs yet."""
        return np.zeros(0)

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """Number of reports about each pair after a step."""
        new = with_rows(state, n_pairs)
        return new + rows.per_observer((rows.neg > rows.pos).astype(float), len(new))

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """limit / (limit + reports), with limit = `guilty_above`."""
        limit = self.params.guilty_above
        return Reading(limit / (limit + state), state)
