"""EigenTrust: the stationary distribution of trust passed on along local trust values."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.bounds import PositiveShare
from trust.evaluation_log import StepRows, exact_sums
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class EigenTrustParams(StepwiseParams):
    """Parameters of the model `eigentrust`."""

    restart_p: PositiveShare = 0.5
    """a: share of every vehicle's trust that goes to the pre-trusted, here all alike."""
    tolerance: Annotated[float, Gt(0)] = 1e-6
    """Change of the vector, summed, at which the iteration ends."""
    decay_per_s: PositiveShare = 1.0
    """Share of the local trust that is left after 1 s; the paper has no decay."""


def eigentrust(
    source: Int[ndarray, "e"],
    target: Int[ndarray, "e"],
    local: Float[ndarray, "e"],
    pretrust: Float[ndarray, "n"],
    block: Int[ndarray, "n"],
    restart_p: float,
    tolerance: float,
) -> Float[ndarray, "n"]:
    """Trust vectors of separate networks at once: t <- (1 - a) C' t + a p.

    Parameters
    ----------
    source, target
        Node that trusts and node that is trusted, for each edge: rows of `pretrust`. Both are in the same network.
    local
        s_ij from `source` to `target`; c_ij = max(s_ij, 0) / row sum, and p where a row has no sum.
    pretrust
        p, which sums to 1 in every network.
    block
        Network of each node, from 0.
    restart_p, tolerance
        As in `EigenTrustParams`.

    Returns
    -------
    t, which sums to 1 in every network. Each network is iterated until it changes by less than `tolerance`.
    """
    n, n_blocks = pretrust.size, int(block.max(initial=-1)) + 1
    positive = np.maximum(local, 0.0)
    row = np.bincount(source, positive, n)
    used = positive > 0
    source, target = source[used], target[used]
    c = positive[used] / row[source]
    empty = row == 0
    t = pretrust.copy()
    moving = np.ones(n, bool)
    while moving.any():
        given_back = exact_sums(block, t * empty, n_blocks)
        received = exact_sums(target, c * t[source], n)
        passed = received + given_back[block] * pretrust
        new = (1 - restart_p) * passed + restart_p * pretrust
        moving &= (exact_sums(block, np.abs(new - t), n_blocks) >= tolerance)[block]
        t = np.where(moving, new, t)
    return t


class EigenTrust(Stepwise):
    """EigenTrust [7]_ on the evaluations that a holder has received.

    Notes
    -----
    s_ij = sum of pos - neg of evaluator i about subject j; c_ij = max(s_ij, 0) / row sum, rows without any = p;
    t <- (1 - a) C' t + a p until it changes by less than 1e-6; p is the same for all n vehicles that the holder has a
    row for. Trust is n t / (1 + n t): 1/2 for an average vehicle. Weight n t.

    Deviations: n t itself may exceed 1, and trust is in [0, 1]; sums are exact to 2^-32, so that order changes nothing.

    [7] Kamvar, Schlosser, Garcia-Molina: The EigenTrust Algorithm for Reputation Management in P2P Networks. WWW, 2003.
    """

    Params: ClassVar[type] = EigenTrustParams

    def start(self) -> Float[ndarray, "edges"]:
        """Sum of pos - neg (s_ij) of each (evaluator, subject); no evidence yet."""
        return np.zeros(0)

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """Sum of pos - neg of each (evaluator, subject) after a step."""
        left = state * self.decay(self.params.decay_per_s, n_steps)
        new = with_rows(left, len(self.log.edges))
        new[rows.edge] += rows.pos - rows.neg
        return new

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Trust n t / (1 + n t), with the trust vector t of every holder's network."""
        holder, _, row = self.log.pairs.sorted()
        block = np.empty(row.size, np.int64)
        _, block[row] = np.unique(holder, return_inverse=True)
        n = np.bincount(block)[block]
        source, target, edge = self.log.edges.sorted()
        known = edge < state.size
        source, target = source[known], target[known]
        local = state[edge[known]]
        p = self.params
        t = eigentrust(source, target, local, 1 / n, block, p.restart_p, p.tolerance)
        return Reading(n * t / (1 + n * t), n * t)
