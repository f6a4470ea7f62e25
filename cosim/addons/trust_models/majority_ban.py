"""Majority ban: who loses votes about contradicted objects too often is banned."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Interval
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.bounds import PositiveShare
from trust.evaluation_log import StepRows, exact_sums
from trust.models.beta import read_beta
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class MajorityBanParams(StepwiseParams):
    """Parameters of the model `majority_ban`; all defaults are ours."""

    ban_strikes: Annotated[int, Ge(1)] = 20
    """Strikes within `strike_window_s` that ban a vehicle for good."""
    strike_window_s: Annotated[float, Interval(ge=0.001, le=1e8)] = 20.0
    """Age at which a strike is forgotten [s]."""
    decay_per_s: PositiveShare = 0.98
    """Share of the Beta evidence that is left after 1 s."""


@dataclass(frozen=True, slots=True)
class Strikes:
    """Beta evidence, bans, and the strikes that are not forgotten."""

    evidence: Float[ndarray, "p 2"]
    banned: Bool[ndarray, "p"]
    history: tuple[tuple[int, ndarray, ndarray], ...] = ()  # step, pairs, their strikes


class MajorityBan(Stepwise):
    """Ban by majority vote on contradicted objects, after CATS [9]_.

    Notes
    -----
    Trust is that of `beta`, and 0 once banned. About every detection that an evaluator contradicts (neg > 0), its
    detector and all evaluators that could see it have one vote each, the banned ones none; those of the smaller side
    get a strike each, nobody at a tie. A vehicle with `ban_strikes` strikes within `strike_window_s` is banned.

    Deviations: only the abstract could be read, which gives a mean time to ban below 58 s; the rules are ours.

    [9] CATS, 2025 (abstract).
    """

    Params: ClassVar[type] = MajorityBanParams

    def start(self) -> Strikes:
        """Nobody banned."""
        return Strikes(np.zeros((0, 2)), np.zeros(0, bool))

    def advance(self, state: Strikes, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> Strikes:
        """Votes of a step counted."""
        evidence = with_rows(state.evidence * self.decay(self.params.decay_per_s, n_steps), n_pairs)
        evidence[:, 0] += rows.per_observer(rows.pos, len(evidence))
        evidence[:, 1] += rows.per_observer(rows.neg, len(evidence))
        banned = with_rows(state.banned, len(evidence))
        strikes = self._strikes(rows, banned)
        at = np.flatnonzero(strikes)
        window_s = self.params.strike_window_s
        kept = [one for one in state.history if self.is_younger(step - one[0], window_s)]
        history = (*kept, (step, at, strikes[at]))
        total = np.zeros(len(banned), np.int64)
        for _, row, n in history:
            total[row] += n
        return Strikes(evidence, banned | (total >= self.params.ban_strikes), history)

    def read(self, state: Strikes, n_steps: int, now: int) -> Reading:
        """Expectation of the Beta distribution, 0 for the banned."""
        per_s = self.params.decay_per_s
        beta = read_beta(state.evidence * self.decay(per_s, n_steps), np.inf)
        return Reading(np.where(state.banned, 0.0, beta.trust), beta.weight, beta.uncertainty)

    def _strikes(self, rows: StepRows, banned: Bool[ndarray, "p"]) -> Int[ndarray, "p"]:
        """Strikes of one step."""
        by, of = rows.by, rows.sender
        may = ~banned[by]
        agrees = (rows.object_pos > 0) & may
        denies = (rows.object_neg > 0) & may
        in_favour = ~banned[of] + rows.per_object(agrees.astype(float))
        against = rows.per_object(denies.astype(float))
        true, false = in_favour > against, against > in_favour
        loses = false & (against > 0)
        n = exact_sums(of[loses], np.ones(int(loses.sum())), banned.size)
        for side, lost in ((agrees, false), (denies, true)):
            loses = side & lost[rows.object]
            n += exact_sums(by[loses], np.ones(int(loses.sum())), banned.size)
        return n.astype(np.int64)
