"""Independent sources: a detection counts as true or false only where several vehicles say so."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge
from jaxtyping import Float
from numpy import ndarray

from cosim.base.bounds import PositiveShare
from trust.evaluation_log import StepRows, exact_sums
from trust.models.beta import expectation
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class MisoVParams(StepwiseParams):
    """Parameters of the model `miso_v`; the defaults are ours."""

    n_sources: Annotated[int, Ge(1)] = 2
    """N: vehicles, the sender included, that must agree."""
    decay_per_s: PositiveShare = 0.98
    """Share of the experiences that is left after 1 s."""


class MisoV(Stepwise):
    """Confirmation by N independent sources, after MISO-V [13]_.

    It should stop ghosts, replays and offsets wherever N vehicles look, however loudly a single liar confirms them, and
    single bad-mouthers: one denial decides nothing. It cannot stop N colluders or Sybil vehicles at one place, and it
    says nothing about detections that fewer than N vehicles could see. It does not see removal, false speeds, or
    confirmations of true detections.

    Notes
    -----
    Each evaluator has one vote on a detection, for (pos > neg) or against (neg > pos), and the sender one for it. A
    detection is true if at least N votes are for it and these are more than those against, false if at least N are
    against it and these are more, else undecided. Every vote on a decided detection is a good or a bad experience with
    the voter. Trust is (g + 1) / (g + b + 2) of the decayed numbers of the votes as sender, times (g' + 1) /
    (g' + b' + 1) of those as evaluator.

    Deviations: [13]_ compares overlapping fields of view of two or more senders; here the evaluators have done so. It
    judges senders only. From memory of the paper; the score is ours.

    [13] Ansari, Petit, Monteuuis, Chen: MISO-V: Misbehavior Detection for Collective Perception Services in Vehicular
    Communications. IEEE Intelligent Vehicles Symposium, 2021.
    """

    Params: ClassVar[type] = MisoVParams

    def start(self) -> Float[ndarray, "p 4"]:
        """Good and bad experiences with each sender, and with each evaluator; no pairs yet."""
        return np.zeros((0, 4))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """Experiences after a step."""
        new = with_rows(state * self.decay(self.params.decay_per_s, n_steps), n_pairs)
        confirms, denies = rows.object_pos > rows.object_neg, rows.object_neg > rows.object_pos
        n_for = 1 + rows.per_object(confirms.astype(float))
        n_against = rows.per_object(denies.astype(float))
        true = (n_for >= self.params.n_sources) & (n_for > n_against)
        false = (n_against >= self.params.n_sources) & (n_against > n_for)
        good = (confirms & true[rows.object]) | (denies & false[rows.object])
        bad = (confirms & false[rows.object]) | (denies & true[rows.object])
        counts = [
            (rows.sender, true),
            (rows.sender, false),
            (rows.by, good),
            (rows.by, bad),
        ]
        columns = [exact_sums(who, which.astype(float), len(new)) for who, which in counts]
        return new + np.stack(columns, axis=1)

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Product of the reputations as sender and as evaluator."""
        per_s = self.params.decay_per_s
        left = state * self.decay(per_s, n_steps)
        as_sender = left[:, :2]
        good, bad = left[:, 2:].T
        trust = expectation(as_sender) * (good + 1) / (good + bad + 1)
        return Reading(trust, as_sender.sum(axis=1), None, self.horizon_s(per_s))
