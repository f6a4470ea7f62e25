"""Median of groups: one value per line of sight, and the median over them."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.bounds import PositiveShare, Share
from trust.evaluation_log import StepRows
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class MedianGroupsParams(StepwiseParams):
    """Parameters of the model `median_groups`; the defaults are ours."""

    prior_share: Share = 0.5
    """Share of confirmations in one further group, which has no evaluator."""
    decay_per_s: PositiveShare = 0.98
    """Share of the evidence that is left after 1 s."""


def medians(
    group: Int[ndarray, "n"], value: Float[ndarray, "n"], n_groups: int, further: float
) -> Float[ndarray, "n_groups"]:
    """Median of the values of each group and of one further value.

    Parameters
    ----------
    group
        Group of each value, from 0.
    value
        Any numbers, in any order.
    n_groups
        Number of medians.
    further
        A value that is in every group.

    Returns
    -------
    The middle value, or the mean of the two in the middle.
    """
    group = np.concatenate([group, np.arange(n_groups)])
    value = np.concatenate([value, np.full(n_groups, further)])
    value = value[np.lexsort((value, group))]
    size = np.bincount(group, minlength=n_groups)
    first = np.cumsum(size) - size
    lower = value[first + (size - 1) // 2]
    upper = value[first + size // 2]
    return (lower + upper) / 2


class MedianGroups(Stepwise):
    """Median of means [14]_ over evaluators, each of which is one line of sight.

    The evaluations that one vehicle makes of another in successive steps share a line of sight, and are no independent
    evidence. They form one group with one value, however many they are, and the median over the groups cannot be moved
    by fewer than half of them. A vehicle is judged as evaluator by the same means.

    It should stop bad-mouthing and false confirmations by fewer than half of a vehicle's evaluators, however many
    messages they send, and the senders of false content. It cannot stop a local majority (Sybil vehicles), random
    evaluations whose means look ordinary, removal, false speeds, or confirmations of true detections.

    Notes
    -----
    s_vi = r_vi / (r_vi + s_vi) of the decayed sums of pos and neg of evaluator v about sender i. o_i is the median of
    s_vi over v and of `prior_share`. d_v is the median of abs(s_vi - o_i) over i and of 0. Trust is o (1 - d).

    Deviations: [14]_ forms groups at random; here they are the evaluators, whose evaluations are dependent. The
    part about evaluators is ours.

    [14] Lugosi, Mendelson: Mean Estimation and Regression Under Heavy-Tailed Distributions: A Survey. Foundations of
    Computational Mathematics, 2019.
    """

    Params: ClassVar[type] = MedianGroupsParams

    def start(self) -> Float[ndarray, "e 2"]:
        """pos and neg of each edge (evaluator, sender); no edges yet."""
        return np.zeros((0, 2))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """pos and neg of each edge after a step."""
        left = state * self.decay(self.params.decay_per_s, n_steps)
        new = with_rows(left, len(self.log.edges))
        new[rows.edge, 0] += rows.pos
        new[rows.edge, 1] += rows.neg
        return new

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Median over the evaluators, less what the subject itself deviates as an evaluator."""
        source, target, edge = self.log.edges.sorted()
        known = edge < len(state)
        source, target = source[known], target[known]
        sums = state[edge[known]]
        total = sums.sum(axis=1)
        said = total > 0
        source, target, total = source[said], target[said], total[said]
        share = sums[said, 0] / total
        n = len(self.log.pairs)
        sender = medians(target, share, n, self.params.prior_share)
        deviation = medians(source, np.abs(share - sender[target]), n, 0.0)
        weight = np.bincount(target, minlength=n).astype(float)
        return Reading(sender * (1 - deviation), weight, None, self.horizon_s(self.params.decay_per_s))
