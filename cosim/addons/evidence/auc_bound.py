"""How well an ideal observer of the recorded evaluations tells attackers from honest vehicles.

The observer knows how often honest vehicles and attackers receive and make each kind of evaluation. It learns this from
the true roles of all vehicles but the one that it judges.
"""

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.codes import EvaluationKind
from results.metrics import intervals
from results.metrics.trust import HONEST, watched
from results.run import Run
from results.sensing import sampling_stride

_EDGES = np.array([-0.95, -0.5, -0.1, 0.0, 0.1, 0.5, 0.95])
"""Evaluation times visibility: edges of its bins; each belongs to the bin below."""
_N_BINS = len(_EDGES) + 1
_N_OTHERS = 3
"""What others say about the same: nothing, against, for."""
_MOST_ROWS = 5_000_000
_PRIOR = 0.5
"""Added to the count of every kind in the mean, so that none has probability 0 (Jeffreys)."""


def area(
    counts: Int[ndarray, "s c"],
    attacks: Bool[ndarray, "s"],
    vehicle: Int[ndarray, "s"],
) -> intervals.ClusteredEstimate:
    """Probability that an attacker's likelihood ratio is above an honest subject's; ties count half.

    Parameters
    ----------
    counts
        How many clues of each of C kinds there are about each of S subjects.
    attacks
        Whether each subject is an attacker.
    vehicle
        Number of the vehicle of each subject.

    Returns
    -------
    The larger of the areas of two statistics: the sum of the logarithms of the likelihood ratios of a subject's clues,
    and their mean. NaN without two vehicles of each role.

    Notes
    -----
    If clues are independent given the role, the sum is the statistic of Neyman and Pearson, and no observer of these
    kinds has a larger area. If the clues about a subject depend on each other, their sum is too confident where there
    are many, and the mean can be better; then more can be known.

    The probability of a kind given a role is its share of the clues about the subjects of this role, plus one more
    subject that has the mean of all others' clues: clues about one subject resemble each other, so the number of
    subjects says how well a share is known. A pair of an attacker and an honest subject is compared with shares from
    which both are left out [1]_, with all other subjects of their vehicles; leaving out one would favour the other.

    References
    ----------
    .. [1] Airola et al., "An experimental comparison of cross-validation techniques for estimating the area under the
       ROC curve", Computational Statistics and Data Analysis 55(4), 2011.
    """
    _, vehicle = np.unique(vehicle, return_inverse=True)
    log_attacker = _log_shares(counts, attacks, vehicle)[attacks]
    log_honest = _log_shares(counts, ~attacks, vehicle)[~attacks]
    attacker = counts[attacks].astype(float)
    honest = counts[~attacks].astype(float)
    n_attackers = len(np.unique(vehicle[attacks]))
    n_others = len(np.unique(vehicle[~attacks]))
    n_units = min(n_attackers, n_others)
    if n_units < 2:
        return intervals.UNKNOWN
    own = (attacker * log_attacker).sum(axis=1)
    of_attacker = own[:, None] - attacker @ log_honest.T
    of_honest = log_attacker @ honest.T - (honest * log_honest).sum(axis=1)
    n, m = (np.maximum(one.sum(axis=1), 1.0) for one in (attacker, honest))
    sums = of_attacker - of_honest
    means = of_attacker / n[:, None] - of_honest / m
    found = []
    for above in (sums, means):
        wins = 0.5 * (1.0 + np.sign(np.round(above, 9)))
        value = float(wins.mean())
        variance = intervals.variance(wins.mean(axis=1) - value, vehicle[attacks])
        variance += intervals.variance(wins.mean(axis=0) - value, vehicle[~attacks])
        about = intervals.around(value, variance**0.5, n_units - 1, (0.0, 1.0))
        found.append(about._replace(n_units=n_units))
    return max(found, key=lambda one: one.value)


def _log_shares(
    counts: Int[ndarray, "s c"],
    of_role: Bool[ndarray, "s"],
    vehicle: Int[ndarray, "s"],
) -> Float[ndarray, "s c"]:
    """Logarithm of each kind's share of the clues about a role's subjects, for each without those of its vehicle."""

    def of_others(values: Int[ndarray, "s k"]) -> Int[ndarray, "s k"]:
        of_vehicle = np.zeros((len(values), values.shape[1]), np.int64)
        np.add.at(of_vehicle, vehicle, values)
        return values.sum(axis=0) - of_vehicle[vehicle]

    n_others = of_others(np.ones((len(counts), 1), np.int64))
    mean = (of_others(counts) + _PRIOR) / np.maximum(n_others, 1)
    others = of_others(counts * of_role[:, None]) + mean
    return np.log(others / others.sum(axis=1, keepdims=True))


def bounds(run: Run) -> pd.DataFrame:
    """The bound for the attackers of each role.

    Returns
    -------
    role; known: the observer also knows the roles of all other vehicles; alone: it does not. Both with intervals
    clustered by vehicle. No rows without attacks. Of few attackers, more cells say less, so `known` is at
    least `alone`.

    Notes
    -----
    The clues about a subject are the evaluations of its messages by others, and the evaluations that it makes itself.
    The kind of the former is that of the evaluation, evaluation times visibility in eight bins, and, if known, whether
    the evaluator attacks. That of the latter has also what the others say on average about the same detection.
    """
    if not run.subjects.attack_start_step.notna().any():
        return pd.DataFrame()
    who = watched(run)
    role = who.role.astype(str).to_numpy()
    vehicle = who.vehicle.to_numpy(np.int64)
    counts = _counts(run, who)
    rows = []
    for one in run.role_labels:
        mine = np.flatnonzero((role == HONEST) | (role == one))
        if one == HONEST or not (role == one).any():
            continue
        of_roles, attacks = counts[mine], role[mine] == one
        known = area(_of_kinds(of_roles.reshape(len(mine), -1)), attacks, vehicle[mine])
        alone = area(_of_kinds(of_roles.sum(axis=-1)), attacks, vehicle[mine])
        known = max(known, alone, key=lambda one: one.value)  # one can leave out what one knows
        row: dict[str, object] = {"role": one}
        rows.append(row | intervals.columns(known, "known") | intervals.columns(alone, "alone"))
    return pd.DataFrame(rows)


def _of_kinds(counts: Int[ndarray, "s c"]) -> Int[ndarray, "s k"]:
    """Counts of the kinds of which there is a clue about any subject."""
    return counts[:, counts.any(axis=0)]


def _counts(run: Run, who: pd.DataFrame) -> Int[ndarray, "s c 2"]:
    """The clues about these subjects while they are watched, by kind, and by whether the other one is an attacker."""
    run.require("evaluations")
    stride = sampling_stride(run, -(-run.n_rows("evaluations") // _MOST_ROWS))
    since, until = who.since.to_numpy(), who.until.to_numpy()
    attackers = run.subjects.index[run.subjects.role != HONEST]
    n_received = len(EvaluationKind) * _N_BINS
    n_kinds = n_received * (1 + _N_OTHERS)
    counts = np.zeros(len(who) * n_kinds * 2, np.int64)
    names = ["step", "evaluator", "observer", "detection_index", "detection_step", "kind", "evaluation", "visibility"]
    # Others may evaluate the same detection in another step, and so in another block.
    parts = run.parts("evaluations", names, pc.field("visibility") > 0)
    kept = []
    for part in parts:
        is_sampled = part.detection_step % stride == 0
        kept.append(part[is_sampled & (part.evaluator != part.observer)])
    clues = pd.concat(kept)
    said = clues.evaluation.to_numpy(float) * clues.visibility.to_numpy(float)
    kind = clues.kind.cat.codes.to_numpy(np.int64)
    value = kind * _N_BINS + np.searchsorted(_EDGES, said)
    claim = clues.assign(kind=kind).groupby(["detection_step", "observer", "detection_index", "kind"], sort=False)
    others = _of_others(claim.ngroup().to_numpy(), said)
    others[kind == EvaluationKind.MISSING] = 0  # each evaluator counts objects in an order of its own
    made = n_received + value * _N_OTHERS + others
    step = clues.step.to_numpy()
    for name, other, cell in (("observer", "evaluator", value), ("evaluator", "observer", made)):
        subject = who.index.get_indexer(pd.Index(clues[name]))
        is_watched = (since[subject] <= step) & (step <= until[subject])
        rows = np.flatnonzero((subject >= 0) & is_watched)
        by_attacker = clues[other].isin(attackers).to_numpy()[rows]
        kinds = (subject[rows] * n_kinds + cell[rows]) * 2 + by_attacker
        counts += np.bincount(kinds, minlength=len(counts))
    return counts.reshape(len(who), n_kinds, 2)


def _of_others(
    claim: Int[ndarray, "n"],
    said: Float[ndarray, "n"],
) -> Int[ndarray, "n"]:
    """What the others say on average about the same claim: 0 if there is none, 1 if against it, 2 otherwise."""
    n = np.bincount(claim)[claim] - 1
    total = np.bincount(claim, said)[claim] - said
    return np.where(n == 0, 0, np.where(total < 0, 1, 2))
