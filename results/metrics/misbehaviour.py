"""Misbehaviour detection by trust: how well it separates attackers from honest vehicles, and how soon.

The unit is a pseudonym, because trust knows nothing else. One is watched from the first attack of its vehicle on;
what it was trusted before is left out. Honest ones are watched from the first attack of any vehicle on. Trust that
rests on no evaluation says nothing about a subject, whatever number the ledger has for it: such a subject is not
rated, it is neither suspected nor cleared, and it is counted (`rated`). A subject is suspected while it is rated and
its trust is below a threshold.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from results.metrics import intervals, lookups, trust
from results.metrics.survival import kaplan_meier, median, median_band
from results.metrics.trust import HONEST, watched
from results.run import Run


class Scored(NamedTuple):
    """Every watched subject whenever trust is computed."""

    step: Int[ndarray, "n"]
    subject: Int[ndarray, "n"]
    role: Int[ndarray, "n"]
    """Code of its role, in the order of `Run.role_labels`."""
    trust: Float[ndarray, "n"]
    """NaN where the ledger has none."""
    rated: Bool[ndarray, "n"]

    def take(self, rows: ndarray) -> "Scored":
        return Scored(*(column[rows] for column in self))


def scored_vehicles(run: Run) -> pd.DataFrame:
    """Every watched subject whenever trust is computed.

    Returns
    -------
    step, subject, role, trust (null where the ledger has none), rated.
    """
    found = scored(run)
    role = pd.CategoricalDtype(list(run.role_labels))
    return pd.DataFrame(found._asdict() | {"role": pd.Categorical.from_codes(found.role.tolist(), dtype=role)})


def scored(run: Run) -> Scored:
    """The same as arrays; not to be changed."""
    return run.once("misbehaviour.scored", lambda: _scored(run))


def _scored(run: Run) -> Scored:
    known, who = trust.in_use(run), watched(run)
    steps, at = np.unique(known.step, return_inverse=True)
    row = who.index.get_indexer(run.subjects.index)[known.who]
    value, rated = np.full((len(steps), len(who)), np.nan, known.trust.dtype), np.zeros((len(steps), len(who)), bool)
    there = row >= 0
    value[at[there], row[there]], rated[at[there], row[there]] = known.trust[there], known.rated[there]
    at, row = np.nonzero((who.since.to_numpy() <= steps[:, None]) & (steps[:, None] <= who.until.to_numpy()))
    role = who.role.cat.codes.to_numpy(np.int64)
    return Scored(steps[at], who.index.to_numpy()[row], role[row], value[at, row], rated[at, row])


def classification(run: Run, false_positives: float = 0.05) -> pd.DataFrame:
    """How well a threshold on trust separates attackers from honest vehicles, over all the time with attacks.

    Parameters
    ----------
    false_positives
        Share of honest values that may lie below the threshold.

    Returns
    -------
    role of the attackers; n: subjects; rated, rated_honest: share of their time in use with an evaluation behind
    their trust; auc: probability that an honest value is above an attacker's (ties count half); auc_unrated: the same
    with the values that rest on no evaluation; threshold: the largest with no more false positives than allowed;
    true_positives, false_positives: shares of the rated values below it (recall, false positive rate); suspected:
    share of the attackers' time in use in which they are suspected, rated or not. auc, true_positives and suspected
    have intervals clustered by subject; those of shares take the threshold as given.

    Notes
    -----
    Values are pooled over subjects and time. `auc` is the area under the curve of `roc`, and Mann and Whitney's U
    over the number of pairs (1947): 1 separates all, 0.5 none.
    """
    rows = _classified(run, scored(run), false_positives, None)
    if not rows:
        raise ValueError(f"{run.path} {_NONE_RATED}")
    return pd.DataFrame(rows)


def recall_over_time(run: Run, every_s: float = 10.0, false_positives: float = 0.05) -> pd.DataFrame:
    """The same in windows of time: time_s (of their start) and the columns of `classification`.

    The threshold is that of the whole time, so that false positives are what they are in each window.
    """
    threshold = float(classification(run, false_positives).threshold.iloc[0])
    found = scored(run)
    slot = np.floor(found.step * run.dt_s / every_s).astype(int)
    rows = [
        {"time_s": one * every_s} | row
        for one in np.unique(slot) for row in _classified(run, found.take(slot == one), false_positives, threshold)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def roc(run: Run) -> pd.DataFrame:
    """Receiver operating characteristic: role, threshold, false_positives, true_positives; of rated values."""
    found, rows = scored(run), []
    honest = np.sort(_rated(run, found, HONEST))
    for role in run.role_labels:
        attacking = np.sort(_rated(run, found, role))
        if role != HONEST and len(attacking) and len(honest):
            threshold = np.append(np.unique(np.concatenate([attacking, honest])), np.inf)
            rows.append(pd.DataFrame({
                "role": role, "threshold": threshold,
                "false_positives": np.searchsorted(honest, threshold) / len(honest),
                "true_positives": np.searchsorted(attacking, threshold) / len(attacking),
            }))  # fmt: skip
    if not rows:
        raise ValueError(f"{run.path} {_NONE_RATED}")
    return pd.concat(rows, ignore_index=True)


def below(run: Run, threshold: float = 0.25) -> pd.DataFrame:
    """Share of all values below a threshold, by role: role, n, share, and rated_share, of the rated; both with
    intervals clustered by subject."""
    found, rows = trust.in_use(run), []
    for role, here in trust.by_role(run, found.role):
        row: dict[str, object] = {"role": role, "n": int(here.sum())}
        for name, some in (("share", here), ("rated_share", here & found.rated)):
            low = found.trust[some] < threshold
            row |= intervals.columns(intervals.of_units(low, found.subject[some]), name)
        rows.append(row)
    return pd.DataFrame(rows)


def separation(run: Run) -> intervals.Estimate:
    """Probability that the last rated value of an honest subject is above that of a malicious one (ties half)."""
    rated = scored(run)
    rated = rated.take(rated.rated)
    last = rated.take(trust.last_of_each(np.unique(rated.subject, return_inverse=True)[1]))
    honest, attacking = _rated(run, last, HONEST), _rated(run, last, "malicious")
    return intervals.auc(honest, np.arange(len(honest)), attacking, np.arange(len(attacking)))


def detection_delay(run: Run, threshold: float = 0.25, at: trust.At = "server") -> pd.DataFrame:
    """Time until a subject is suspected: of attackers from their first attack, of others from the first of any.

    Parameters
    ----------
    at
        At the server, or at the first vehicle that looks up a value below the threshold (a default does not count).

    Returns
    -------
    subject, role, delay_s, found: where not found, the delay is the time it was watched for (censored).
    """
    who = watched(run)
    step, subject = _low_values(run, threshold, at)
    row, since, until = who.index.get_indexer(pd.Index(subject)), who.since.to_numpy(), who.until.to_numpy()
    there = (row >= 0) & (since[row] <= step) & (step <= until[row])
    first = np.full(len(who), np.inf)
    np.minimum.at(first, row[there], step[there])
    found = np.isfinite(first)
    delay_s = (np.where(found, first, until) - since) * run.dt_s
    return pd.DataFrame({"role": who.role, "delay_s": delay_s, "found": found}).reset_index()


def _low_values(run: Run, threshold: float, at: trust.At) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    """Step and subject of values below a threshold that rest on an evaluation; of those that vehicles look up, the
    first of each subject is there."""
    if at == "vehicles":
        lows = lookups.lows(run)
        low = lows.trust.astype(np.float64) < threshold
        return lows.step[low], lows.subject[low]
    if trust.kept_at(run) != "server":
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    known = trust.in_use(run)
    low = (known.trust.astype(np.float64) < threshold) & known.rated
    return known.step[low], known.subject[low]


def detection_summary(run: Run, threshold: float = 0.25, at: trust.At = "server") -> pd.DataFrame:
    """Of `detection_delay`: role, n, share that was ever suspected, median_s (null: fewer than half were); both with
    intervals.

    Those not suspected count for as long as they were watched (Kaplan and Meier).
    """
    return summary_of(detection_delay(run, threshold, at))


def summary_of(delays: pd.DataFrame) -> pd.DataFrame:
    """Rows of `detection_summary`, of any delays: subject, role, delay_s, found."""
    code, subject = delays.role.cat.codes.to_numpy(), delays.subject.to_numpy()
    delay_s, found = delays.delay_s.to_numpy(np.float64), delays.found.to_numpy(bool)
    rows = []
    for number, role in enumerate(delays.role.cat.categories):
        if (here := code == number).any():
            curve = kaplan_meier(delay_s[here], found[here])
            rows.append(
                {"role": role, "n": int(here.sum())}
                | intervals.columns(intervals.of_units(found[here], subject[here]), "share")
                | intervals.columns(intervals.Estimate(median(curve), *median_band(curve), int(here.sum())), "median_s")
            )
    return pd.DataFrame(rows)


def waiting(delays: pd.DataFrame) -> pd.DataFrame:
    """Share not suspected yet after a time, of rows of `detection_delay`: as of `survival.kaplan_meier`."""
    return kaplan_meier(delays.delay_s.to_numpy(np.float64), delays.found.to_numpy(bool))


def threshold_at(honest: Float[ndarray, "h"], false_positives: float) -> float:
    """Largest threshold with at most this share of honest values below it; NaN where there is none."""
    if not len(honest):
        return float("nan")
    allowed = int(false_positives * len(honest) + 1e-9)  # 0.29 * 100 is 28.999...
    return float(np.sort(honest)[allowed]) if allowed < len(honest) else float("inf")


_NONE_RATED = (
    "holds no evaluations of attackers and honest vehicles to compare: no receiver of their messages could see what "
    "they reported. "
    "Raise fleet.penetration_p or traffic.duration_s and run again."
)


def _of_role(run: Run, found: Scored, role: str) -> Bool[ndarray, "n"]:
    return found.role == (run.role_labels.index(role) if role in run.role_labels else -1)


def _rated(run: Run, found: Scored, role: str) -> Float[ndarray, "n"]:
    return found.trust[_of_role(run, found, role) & found.rated].astype(np.float64)


def _classified(
    run: Run, found: Scored, false_positives: float, threshold: float | None
) -> list[dict[str, float | str]]:
    """Rows of `classification`; the threshold is found where none is given."""
    is_honest, has_trust = _of_role(run, found, HONEST), ~np.isnan(found.trust)
    honest = _rated(run, found, HONEST)
    limit = threshold_at(honest, false_positives) if threshold is None else threshold
    rows: list[dict[str, float | str]] = []
    for role, mine in trust.by_role(run, found.role):
        if role == HONEST:
            continue
        attacking = found.take(mine & found.rated)
        suspected = found.rated[mine] & (found.trust[mine] < limit)
        of_time = intervals.of_units(suspected, found.subject[mine])
        if np.isnan(limit):
            of_time = intervals.UNKNOWN
        rows.append({
            "role": role, "n": len(np.unique(found.subject[mine])), "rated": len(attacking.step) / int(mine.sum()),
            "rated_honest": _share(found.rated[is_honest]),
            **intervals.columns(_auc(found, is_honest & found.rated, mine & found.rated), "auc"),
            **intervals.columns(_auc(found, is_honest & has_trust, mine & has_trust), "auc_unrated"),
            "threshold": limit,
            **intervals.columns(intervals.of_units(attacking.trust < limit, attacking.subject), "true_positives"),
            "false_positives": _share(honest < limit), **intervals.columns(of_time, "suspected"),
        })  # fmt: skip
    return rows


def _auc(found: Scored, honest: Bool[ndarray, "n"], attacking: Bool[ndarray, "n"]) -> intervals.Estimate:
    """Of some values above others."""
    return intervals.auc(
        found.trust[honest].astype(np.float64), found.subject[honest], found.trust[attacking].astype(np.float64),
        found.subject[attacking],
    )  # fmt: skip


def _share(which: ndarray) -> float:
    return float(np.mean(which)) if len(which) else float("nan")
