"""Beta reputation by kind of evaluation, of which the worst counts."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from trust.evaluation_log import StepRows, exact_sums
from trust.models.beta import BetaParams, expectation
from trust.models.stepwise import Reading, Stepwise
from trust.pair_index import with_rows
from trust.params import KINDS, Kind


@dataclass(frozen=True, kw_only=True, slots=True)
class BetaByKindParams(BetaParams):
    """Parameters of the model `beta_by_kind`."""

    evidence: tuple[Kind, ...] = ("detections",)
    """Kinds of evaluations that are made; the same as `trust.evidence`."""


class BetaByKind(Stepwise):
    """Beta reputation of [2]_, kept for each kind of evaluation.

    Notes
    -----
    As `beta`, with sums r and s for each kind: of detections, of objects that a message lacks, of velocities. Trust is
    the smallest of the expectations (r + 1) / (r + s + 2) of the kinds in `evidence`; a kind without evidence has 1/2.
    With detections alone it is `beta`. It should stop attackers that lie in one respect and tell the truth in all
    others, whose lie is lost in a sum. It cannot stop those who lie about others: false evaluations of any one kind
    suffice to lower trust.

    Deviations: the source has one kind of feedback.

    [2] Jøsang, Ismail: The Beta Reputation System. 15th Bled Electronic Commerce Conference, 2002.
    """

    Params: ClassVar[type] = BetaByKindParams

    def start(self) -> Float[ndarray, "p 6"]:
        """r and s of each pair and kind; no pairs yet."""
        return np.zeros((0, 2 * len(KINDS)))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """r and s of each pair and kind after a step."""
        new = with_rows(state * self.decay(self.params.decay_per_s, n_steps), n_pairs)
        kind = np.zeros(len(rows.index), np.int64)
        if len(self.params.evidence) > 1:
            kind = rows.index % len(KINDS)
        for k in range(len(KINDS)):
            some = kind == k
            about = rows.about[some]
            for column, values in enumerate((rows.object_pos, rows.object_neg)):
                gain = exact_sums(about, values[some], len(new))
                new[:, 2 * k + column] += gain
        return new

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """The smallest expectation of the kinds that are made; weight and uncertainty of all evidence together."""
        per_s = self.params.decay_per_s
        left = state * self.decay(per_s, n_steps)
        expected = []
        for k, kind in enumerate(KINDS):
            if kind in self.params.evidence:
                expected.append(expectation(left[:, 2 * k : 2 * k + 2]))
        trust = np.min(expected, axis=0)
        weight = left.sum(axis=1)
        return Reading(trust, weight, 2 / (weight + 2), self.horizon_s(per_s))
