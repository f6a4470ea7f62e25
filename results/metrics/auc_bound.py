"""How well an ideal observer of the recorded evaluations tells attackers from honest vehicles.

The observer knows how often honest vehicles and attackers receive and make each kind of evaluation. It learns this from
the true roles of all vehicles but the one that it judges.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from results.codes import EvaluationKind
from results.metrics import intervals
from results.metrics.trust import HONEST, watched
from results.run import Run

_EDGES = np.array([-0.95, -0.5, -0.1, 0.0, 0.1, 0.5, 0.95])
"""Evaluation times visibility: edges of its bins; each belongs to the bin below."""
_N_BINS = len(_EDGES) + 1
_N_OTHERS = 3
"""What others say about the same: nothing, against, for."""
_MOST_ROWS = 5_000_000
_PRIOR = 0.5
"""Added to the count of every cell in the mean, so that none has probability 0 (Jeffreys)."""


class Clues(NamedTuple):
    """N pieces of evidence in the order of time."""

    subject: Int[ndarray, "n"]
    """Number of the subject, from 0."""
    step: Int[ndarray, "n"]
    cell: Int[ndarray, "n"]
    """What kind of evidence it is."""


def log_ratios(clues: Clues, attacks: Bool[ndarray, "s"]) -> Float[ndarray, "n"]:
    """Logarithm of the likelihood ratio, attacker to honest, of each clue.

    Parameters
    ----------
    clues
        The evidence.
    attacks
        Whether each subject is an attacker.

    Notes
    -----
    The probability of a cell, given a role, is its share of the clues about all other subjects of this role and about
    one more subject, which has the mean of all other subjects' clues. Clues about one subject resemble each other: the
    number of subjects, not of clues, says how well a share is known. No subject's own clues and role are used for its
    own ratios.
    """
    n = int(clues.cell.max(initial=0)) + 1
    own = np.bincount(clues.subject * n + clues.cell, minlength=len(attacks) * n).reshape(-1, n)
    mean = (own.sum(axis=0) + _PRIOR - own) / max(len(attacks) - 1, 1)
    found = []
    for role in (True, False):
        count = own[attacks == role].sum(axis=0) - own * (attacks == role)[:, None] + mean
        p = count / count.sum(axis=1, keepdims=True)
        found.append(np.log(p)[clues.subject, clues.cell])
    return found[0] - found[1]


def area(clues: Clues, attacks: Bool[ndarray, "s"]) -> intervals.Estimate:
    """Probability that an attacker's likelihood ratio is above an honest subject's; ties count half.

    Ratios are compared after every step in which a subject has new clues, with all clues up to then: their sum, and
    their mean per clue. The larger of the two areas is returned, with its interval clustered by subject.

    Notes
    -----
    If clues are independent given the role, the sum is the statistic of Neyman and Pearson, and no observer of the
    cells has a larger area. If the clues about a subject depend on each other, their sum is too confident where there
    are many, and the mean can be better.
    """
    order = np.lexsort((clues.step, clues.subject))
    subject, step = clues.subject[order], clues.step[order]
    total = np.cumsum(log_ratios(clues, attacks)[order])
    last = np.flatnonzero(np.append((np.diff(subject) != 0) | (np.diff(step) != 0), True)[: len(order)])
    first = np.searchsorted(subject, subject[last])
    before = np.where(first > 0, total[np.maximum(first, 1) - 1], 0.0)
    total, who = np.round(total[last] - before, 9), subject[last]
    lies = attacks[who]
    both = [
        intervals.auc(values[lies], who[lies], values[~lies], who[~lies])
        for values in (total, np.round(total / (last - first + 1), 9))
    ]
    return max(both, key=lambda one: one.value)


def bounds(run: Run) -> pd.DataFrame:
    """The bound for the attackers of each role.

    Returns
    -------
    role; known: the observer also knows the roles of all other vehicles; alone: it does not. Both with intervals
    clustered by subject.

    Notes
    -----
    The clues about a subject are the evaluations of its messages by others, and the evaluations that it makes itself.
    The cell of the former is the kind of evaluation, evaluation times visibility in eight bins, and, if known, whether
    the evaluator attacks. The latter also have what the others say on average about the same detection.
    """
    who = watched(run)
    role = who.role.astype(str).to_numpy()
    rows = []
    for one in run.role_labels:
        mine = np.flatnonzero((role == HONEST) | (role == one))
        if one == HONEST or not (role == one).any():
            continue
        clues = [_clues(run, who.iloc[mine], known) for known in (True, False)]
        found = [area(some, role[mine] == one) for some in clues]
        rows.append({"role": one} | intervals.columns(found[0], "known") | intervals.columns(found[1], "alone"))
    return pd.DataFrame(rows)


def _clues(run: Run, who: pd.DataFrame, known: bool) -> Clues:
    """The clues about these subjects while they are watched."""
    run.require("evaluations")
    stride = max(1, -(-run.n_rows("evaluations") // _MOST_ROWS))
    since, attacks = who.since.to_numpy(), (run.subjects.role != HONEST).to_numpy()
    parts = []
    names = ["step", "evaluator", "observer", "detection_index", "detection_step", "kind", "evaluation", "visibility"]
    for part in run.parts("evaluations", names, pc.field("visibility") > 0):
        part = part[(part.step % stride == 0) & (part.evaluator != part.observer)]
        said = (part.evaluation * part.visibility).to_numpy(float)
        kind = part.kind.cat.codes.to_numpy(np.int64)
        value = kind * _N_BINS + np.searchsorted(_EDGES, said)
        same = [part.detection_step.to_numpy(), part.observer.to_numpy(), part.detection_index.to_numpy(), kind]
        _, claim = np.unique(np.column_stack(same), axis=0, return_inverse=True)
        claim = claim.reshape(-1)
        n, total = np.bincount(claim)[claim] - 1, np.bincount(claim, said)[claim] - said
        others = np.where(n == 0, 0, np.where(total < 0, 1, 2))
        by, of = (run.subjects.index.get_indexer(part[name]) for name in ("evaluator", "observer"))
        cells = (
            value * 2 + (attacks[by] & known),
            len(EvaluationKind) * _N_BINS * 2 + (value * _N_OTHERS + others) * 2 + (attacks[of] & known),
        )
        step = part.step.to_numpy()
        for name, cell in zip(("observer", "evaluator"), cells, strict=True):
            subject = who.index.get_indexer(part[name])
            rows = np.flatnonzero((subject >= 0) & (since[subject] <= step))
            parts.append((subject[rows], step[rows], cell[rows]))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)] if parts else [np.zeros(0, int)] * 3
    return Clues(*columns)
