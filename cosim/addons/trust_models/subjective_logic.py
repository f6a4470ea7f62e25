"""Subjective logic: opinions on objects, discounted by trust in who holds them, fused to an opinion on their sender."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Gt
from jaxtyping import Float
from numpy import ndarray

from cosim.addons.trust_models import opinions
from cosim.base.bounds import PositiveShare
from trust.evaluation_log import StepRows, exact_sums
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class SubjectiveLogicParams(StepwiseParams):
    """Parameters of the model `subjective_logic`."""

    discounting: Literal["probability", "opposite", "none"] = "probability"
    """Effect of the holder's opinion on an evaluator on that evaluator's opinion (b', d', u') on an object.
    `probability`: it becomes less certain, b = P b' and d = P d'. `opposite`: so far as the evaluator is disbelieved,
    its belief counts as disbelief and its disbelief as belief. `none`: no effect."""
    check_base: Annotated[float, Gt(1)] = 1.3
    """1 - check_base^-S: belief or disbelief that checks of total weight S give."""
    decay_per_s: PositiveShare = 0.98
    """Share of the evidence (b / u, d / u) that is left after 1 s; the default is ours."""


class SubjectiveLogic(Stepwise):
    """Trust of a sender from opinions on the objects that it reports, as in CONNECT's trust framework [3]_.

    Notes
    -----
    Opinion of an evaluator on an object: S = pos + neg, g = 1 - 1.3^-S, b = (pos / S) g, d = (neg / S) g, u = 1 - g. It
    is discounted by P = b + u / 2 of the holder's opinion on the evaluator before the step, and all of them are fused
    cumulatively to the opinion on the sender. Cumulative fusion adds (b / u, d / u), which is how it is computed, so
    that no order of arrival matters. Trust is P; uncertainty u; weight (b + d) / u.

    Deviations: the framework's checks of one receiver are here the evaluation by each evaluator, one check of weight
    pos + neg; evidence decays (the framework begins anew with every object); P above 1/2 is trustworthy, where the
    published code compares with 1, which nothing exceeds.

    [3] CONNECT, trust assessment framework of the EU project, published code; Jøsang: Subjective Logic, 2016.
    """

    Params: ClassVar[type] = SubjectiveLogicParams

    def start(self) -> Float[ndarray, "p 2"]:
        """b / u and d / u of each pair; no pairs yet."""
        return np.zeros((0, 2))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """b / u and d / u of each pair after a step."""
        p = self.params
        new = with_rows(state * self.decay(p.decay_per_s, n_steps), n_pairs)
        on_evaluator = opinions.of_evidence(new)[rows.by]
        on_object = opinions.of_check(rows.object_pos, rows.object_neg, p.check_base)
        if p.discounting == "probability":
            on_object = opinions.discounted(opinions.projected(on_evaluator), on_object)
        elif p.discounting == "opposite":
            on_object = opinions.discounted_opposite(on_evaluator, on_object)
        for column, evidence in enumerate(opinions.evidence_of(on_object).T):
            new[:, column] += exact_sums(rows.about, evidence, len(new))
        return new

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Projected probability of the opinion on each subject, and its uncertainty u."""
        evidence = state * self.decay(self.params.decay_per_s, n_steps)
        opinion = opinions.of_evidence(evidence)
        return Reading(
            trust=opinions.projected(opinion),
            weight=evidence.sum(axis=1),
            uncertainty=opinion[:, 2],
            horizon_s=self.horizon_s(self.params.decay_per_s),
        )
