"""Multifaceted trust of Minhas et al.: experiences with forgetting, and majorities with role and experience."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Interval
from jaxtyping import Bool, Float
from numpy import ndarray

from cosim.base.bounds import PositiveShare
from trust.evaluation_log import StepRows
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class MinhasParams(StepwiseParams):
    """Parameters of the model `minhas`; all defaults are ours."""

    gain: Annotated[float, Interval(gt=0, lt=1)] = 0.1
    """alpha: step of a good experience."""
    loss: Annotated[float, Interval(gt=-1, lt=0)] = -0.3
    """beta: step of a bad experience, larger than `gain` in size."""
    forgetting_per_s: PositiveShare = 0.98
    """lambda: share of a trust value that is left when the next experience comes 1 s later."""
    consensus_margin: Annotated[float, Interval(ge=0, lt=0.5)] = 0.3
    """epsilon: a majority is one with at least 1 - epsilon of the votes."""

    def __post_init__(self) -> None:
        if -self.loss <= self.gain:
            raise ValueError(
                f"trust.loss = {self.loss:g}: a bad experience must weigh more than a good one, gain = {self.gain:g}. "
                f"Set trust.loss below {-self.gain:g}."
            )


def experienced(
    trust: Float[ndarray, "n"],
    good: Bool[ndarray, "n"],
    kept: Float[ndarray, "n"],
    p: MinhasParams,
) -> Float[ndarray, "n"]:
    """Trust after an experience.

    Parameters
    ----------
    trust
        T before the experience, in [-1, 1].
    good
        Whether the experience is good.
    kept
        lambda^t for the time t since the last experience.
    p
        Steps of good and bad experiences.

    Returns
    -------
    T after the experience, clipped to [-1, 1].
    """
    step = np.where(good, p.gain, p.loss)
    with np.errstate(over="ignore", divide="ignore"):
        from_trust = kept * (1 - step) * trust + step
        from_distrust = (1 + step) * trust / kept + step
        new = np.where(trust >= 0, from_trust, from_distrust)
    return np.clip(new, -1.0, 1.0)


class Minhas(Stepwise):
    """Experience-based trust with majority opinion of Minhas et al. [5]_.

    Notes
    -----
    T in [-1, 1] per (holder, subject), 0 at first contact. Good experience: T <- l^t (1 - a) T + a for T >= 0 and
    l^-t (1 + a) T + a for T < 0; bad: the same with b < 0 for a, abs(b) > abs(a); t is the time since the last one.
    The experience of a step is the majority of its evaluators, one vote each, for (pos > neg) or against (neg > pos),
    of weight (1 + T) / 2 of the evaluator before the step: good or bad if the larger side has 1 - epsilon of the sum,
    else none. Reported are trust (1 + T) / 2 and, as weight, abs(T).

    Deviations: equations from memory of the paper; T is clipped to [-1, 1]; votes have weight (1 + T) / 2, since all
    votes of first contacts would weigh 0; evaluations of one step are equally new and near, so that the closeness
    in time and place that divides the votes is 1; one experience per step, so that order changes nothing.

    [5] Minhas, Zhang, Tran, Cohen: A Multifaceted Approach to Modeling Agent Trust for Effective Communication in the
    Application of Mobile Ad Hoc Vehicular Networks. IEEE Transactions on Systems, Man, and Cybernetics C, 2011.
    """

    Params: ClassVar[type] = MinhasParams

    def start(self) -> Float[ndarray, "p 2"]:
        """T of each pair, and 1 + the step of its last experience (0: none); no pairs yet."""
        return np.zeros((0, 2))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """State after a step: T changes for each pair about which the evaluators agree."""
        new = with_rows(state, n_pairs).copy()
        vote = ((1 + new[:, 0]) / 2)[rows.evaluator]
        in_favour = rows.per_observer(vote * (rows.pos > rows.neg), len(new))
        against = rows.per_observer(vote * (rows.neg > rows.pos), len(new))
        total = in_favour + against
        least = (1 - self.params.consensus_margin) * total
        agreed = np.maximum(in_favour, against) >= least
        at = np.flatnonzero(agreed & (total > 0))
        last = new[at, 1]
        since = np.where(last > 0, step + 1 - last, 0)
        kept = self.params.forgetting_per_s ** (since * self.dt_s)
        good = in_favour[at] > against[at]
        new[at, 0] = experienced(new[at, 0], good, kept, self.params)
        new[at, 1] = step + 1
        return new

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Trust as the last experience left it, mapped to [0, 1]."""
        trust = state[:, 0]
        return Reading((1 + trust) / 2, np.abs(trust))
