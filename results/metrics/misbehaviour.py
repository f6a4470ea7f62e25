"""Misbehaviour detection by trust: how well it separates attackers from honest vehicles, and how soon.

Metrics count pseudonyms, because trust knows no other identity. An attacker's pseudonym is watched from the first
attack of its vehicle on; earlier trust is left out. An honest pseudonym is watched from the first attack of any vehicle
on. A value without an evaluation tells nothing about its subject: it counts as not evaluated, and the subject is
neither suspected nor cleared. A subject is suspected while its value is below a threshold and rests on at least
`trust.suspect_from` evaluations. Intervals are clustered by vehicle: its pseudonyms are not independent.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from results.metrics import intervals, lookups, trust
from results.metrics.survival import kaplan_meier, median, median_estimate
from results.metrics.trust import HONEST, watched
from results.run import Run


class Scored(NamedTuple):
    """Every watched subject whenever trust is computed."""

    step: Int[ndarray, "n"]
    subject: Int[ndarray, "n"]
    vehicle: Int[ndarray, "n"]
    role: Int[ndarray, "n"]
    """Code of its role, in the order of `Run.role_labels`."""
    trust: Float[ndarray, "n"]
    """NaN where the ledger has none."""
    rated: Bool[ndarray, "n"]
    enough: Bool[ndarray, "n"]
    """Whether as many evaluations stand behind it as suspicion needs."""

    def take(self, rows: ndarray) -> "Scored":
        """The chosen rows (a mask or row numbers)."""
        return Scored(*(column[rows] for column in self))


def scored_vehicles(run: Run) -> pd.DataFrame:
    """Every watched subject whenever trust is computed.

    Returns
    -------
    step, subject, vehicle, role, trust (null where the ledger has none), rated, enough.
    """
    found = scored(run)
    labels = pd.CategoricalDtype(list(run.role_labels))
    role = pd.Categorical.from_codes(found.role.tolist(), dtype=labels)
    return pd.DataFrame(found._asdict() | {"role": role})


def scored(run: Run) -> Scored:
    """The rows of `scored_vehicles` as arrays; not to be changed."""
    return run.once("misbehaviour.scored", lambda: _scored(run))


def _scored(run: Run) -> Scored:
    known, who = trust.in_use(run), watched(run)
    steps, first, at = np.unique(known.step, return_index=True, return_inverse=True)
    since = known.since[first]
    row = who.index.get_indexer(run.subjects.index)[known.who]
    value = np.full((len(steps), len(who)), np.nan, known.trust.dtype)
    rated, enough = np.zeros((2, len(steps), len(who)), bool)
    there = row >= 0
    cell = at[there], row[there]
    value[cell] = known.trust[there]
    rated[cell] = known.rated[there]
    enough[cell] = known.enough[there]
    has_begun = who.since.to_numpy() <= steps[:, None]
    goes_on = since[:, None] <= who.until.to_numpy()
    at, row = np.nonzero(has_begun & goes_on)
    cell = at, row
    role = who.role.cat.codes.to_numpy(np.int64)
    return Scored(
        step=steps[at],
        subject=who.index.to_numpy()[row],
        vehicle=who.vehicle.to_numpy()[row],
        role=role[row],
        trust=value[cell],
        rated=rated[cell],
        enough=enough[cell],
    )


def classification(run: Run, false_positives: float = 0.05) -> pd.DataFrame:
    """How well a threshold on trust separates attackers from honest vehicles, over all the time with attacks.

    Parameters
    ----------
    false_positives
        Share of honest values that may lie below the threshold.

    Returns
    -------
    role of the attackers; n: subjects; evaluated, evaluated_honest: share of their watched time with an evaluation
    behind their trust; auc: probability that an honest value is above an attacker's (ties count half);
    auc_unevaluated: the same with the values that rest on no evaluation; threshold: the largest with no more false
    positives than allowed; true_positives, false_positives: shares of the evaluated values below it (recall, false
    positive rate); suspected: share of the attackers' watched time in which they are suspected. auc, true_positives
    and suspected have intervals; those of shares take the threshold as given.

    Notes
    -----
    Values are pooled over subjects and time. `auc` is the area under the curve of `roc`, and Mann and Whitney's U
    over the number of pairs (1947): 1 separates all, 0.5 none.
    """
    found = scored(run)
    is_honest, has_trust = _of_role(run, found, HONEST), ~np.isnan(found.trust)
    honest = _rated(run, found, HONEST)
    limit = threshold_at(honest, false_positives)
    rows: list[dict[str, float | str]] = []
    for role, mine in trust.by_role(run, found.role):
        if role == HONEST:
            continue
        attacking = found.take(mine & found.rated)
        suspected = found.enough[mine] & (found.trust[mine] < limit)
        of_time = intervals.of_units(suspected, found.vehicle[mine])
        found_out = intervals.of_units(attacking.trust < limit, attacking.vehicle)
        if np.isnan(limit):
            of_time = found_out = intervals.UNKNOWN
        rows.append(
            {
                "role": role,
                "n": len(np.unique(found.subject[mine])),
                "evaluated": len(attacking.step) / int(mine.sum()),
                "evaluated_honest": _share(found.rated[is_honest]),
                **intervals.columns(_auc(found, is_honest & found.rated, mine & found.rated), "auc"),
                **intervals.columns(_auc(found, is_honest & has_trust, mine & has_trust), "auc_unevaluated"),
                "threshold": limit,
                **intervals.columns(found_out, "true_positives"),
                "false_positives": _share(honest < limit),
                **intervals.columns(of_time, "suspected"),
            }
        )
    if not rows:
        raise run.lacks(*_NONE_RATED)
    return pd.DataFrame(rows)


def evaluated(run: Run) -> pd.DataFrame:
    """role, and share of the watched time of its subjects in which an evaluation is behind their trust."""
    found = scored(run)
    rows = []
    for role, mine in trust.by_role(run, found.role):
        rows.append({"role": role, "share": _share(found.rated[mine])})
    return pd.DataFrame(rows)


def roc(run: Run) -> pd.DataFrame:
    """Receiver operating characteristic: role, threshold, false_positives, true_positives; of rated values."""
    found, rows = scored(run), []
    honest = np.sort(_rated(run, found, HONEST))
    for role in run.role_labels:
        attacking = np.sort(_rated(run, found, role))
        if role != HONEST and len(attacking) and len(honest):
            threshold = np.append(np.unique(np.concatenate([attacking, honest])), np.inf)
            rows.append(
                pd.DataFrame(
                    {
                        "role": role,
                        "threshold": threshold,
                        "false_positives": np.searchsorted(honest, threshold) / len(honest),
                        "true_positives": np.searchsorted(attacking, threshold) / len(attacking),
                    }
                )
            )
    if not rows:
        raise run.lacks(*_NONE_RATED)
    return pd.concat(rows, ignore_index=True)


def below(run: Run, threshold: float | None = None) -> pd.DataFrame:
    """Share of values below a threshold, by role.

    Returns
    -------
    role, n, share of all values, and evaluated_share of the evaluated ones; both with intervals.
    """
    found, rows = trust.in_use(run), []
    for role, here in trust.by_role(run, found.role):
        row: dict[str, object] = {"role": role, "n": int(here.sum())}
        for name, some in (("share", here), ("evaluated_share", here & found.rated)):
            low = found.trust[some].astype(np.float64) < trust.suspect_below(run, threshold)
            row |= intervals.columns(intervals.of_units(low, found.vehicle[some]), name)
        rows.append(row)
    return pd.DataFrame(rows)


def separation(run: Run) -> intervals.ClusteredEstimate:
    """Probability that the last rated value of an honest subject is above that of a malicious one (ties half)."""
    rated = scored(run)
    rated = rated.take(rated.rated)
    _, subject = np.unique(rated.subject, return_inverse=True)
    last = rated.take(trust.last_of_each(subject))
    return _auc(last, _of_role(run, last, HONEST), _of_role(run, last, "malicious"))


def detection_delay(run: Run, threshold: float | None = None, at: trust.At = "server") -> pd.DataFrame:
    """Time until a subject is suspected.

    It begins with the first attack of the subject; for honest subjects, with the first attack of any.

    Parameters
    ----------
    threshold
        Trust below which a subject is suspected; by default `trust.suspect_below` of the run.
    at
        Who suspects: the server, or the first vehicle that looks up a value below the threshold (a default does not
        count).

    Returns
    -------
    subject, vehicle, role, delay_s, found. If a subject was not found, delay_s is the time for which it was watched
    (censored).
    """
    who = watched(run)
    step, subject = _low_values(run, threshold, at)
    row = who.index.get_indexer(pd.Index(subject))
    since, until = who.since.to_numpy(), who.until.to_numpy()
    there = (row >= 0) & (since[row] <= step)
    there &= step <= until[row]
    first = np.full(len(who), np.inf)
    np.minimum.at(first, row[there], step[there])
    found = np.isfinite(first)
    delay_s = (np.where(found, first, until) - since) * run.dt_s
    return who[["vehicle", "role"]].assign(delay_s=delay_s, found=found).reset_index()


def _low_values(
    run: Run,
    threshold: float | None,
    at: trust.At,
) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"]]:
    """Step and subject of values below a threshold that rest on enough evaluations.

    Of the values that vehicles look up, only some are there, but always the first of each subject.
    """
    threshold = trust.suspect_below(run, threshold)
    if at == "vehicles":
        return lookups.first_lows(run, threshold)
    if trust.kept_at(run) != "server":
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    known = trust.in_use(run)
    low = (known.trust.astype(np.float64) < threshold) & known.enough
    return known.step[low], known.subject[low]


def at_lookup(run: Run, threshold: float | None = None) -> pd.DataFrame:
    """Classification at the place where trust is used: of the values that vehicles look up.

    A lookup counts from the moment at which its subject is watched. Central and local trust are measured alike and can
    be compared. `classification` takes the server's values, or means over receivers, which no vehicle holds.

    Returns
    -------
    role; n (lookups of watched subjects); evaluated: share of them that rest on an evaluation; suspected: share of
    them that rest on enough evaluations and lie below the threshold; auc: probability that an evaluated value of an
    honest subject is above one of this role, ties counting half (NaN for honest subjects); auc_error: largest error
    of auc from rounding values (0 if none was rounded); and auc_note, which says so. evaluated, suspected and auc
    have intervals.
    """
    watched(run)  # says so where there are no attacks
    found, scores = lookups.sums(run, threshold=threshold), lookups.scores(run)
    _, role_of, vehicle = lookups.subjects(run)
    role_of_score = role_of[scores.who]
    honest = role_of_score == _code(run, HONEST)
    rows = []
    for code, role in enumerate(run.role_labels):
        mine = (role_of == code) & (found.n_watched > 0)
        if not mine.any():
            continue
        n, here = found.n_watched[mine], role_of_score == code
        row: dict[str, object] = {"role": role, "n": int(n.sum())}
        for name, counted in (("evaluated", found.n_evaluated), ("suspected", found.n_low)):
            row |= intervals.columns(_share_of(vehicle[mine], counted[mine], n), name)
        area = intervals.UNKNOWN
        if role != HONEST:
            area = _auc_of_scores(scores, vehicle, honest, here)
        row |= intervals.columns(area, "auc")
        row["auc_error"] = _tied(scores, honest, here)
        rows.append(row)
    if not rows:
        raise run.lacks(*_NONE_RATED)
    table = pd.DataFrame(rows)
    off_by = table.auc_error.max()
    return table.assign(auc_note=f"off by {off_by:.2g} at most" if off_by > 0 else "")


def compared_at_lookup(run: Run, false_positives: float = 0.05) -> dict[str, intervals.ClusteredEstimate]:
    """Classification of all attackers together, of the values that vehicles look up. It compares hosts and models.

    Parameters
    ----------
    false_positives
        Largest share of honest subjects' evaluated lookups that may lie below the threshold of recall.

    Returns
    -------
    auc, as in `at_lookup`; recall: share of the attackers' evaluated lookups below that threshold, the largest that is
    allowed; mistaken: share of the pairs of a receiver and an honest subject in which the receiver ever suspects the
    subject (`detection_per_receiver`).
    """
    watched(run)
    scores, (_, role_of, vehicle) = lookups.scores(run), lookups.subjects(run)
    honest = role_of[scores.who] == _code(run, HONEST)
    if honest.all() or not honest.any():
        raise run.lacks(*_NONE_RATED)
    value, times = scores.trust[honest], scores.n[honest]
    order = np.argsort(value)
    allowed = int(false_positives * times.sum() + 1e-9)
    at = np.searchsorted(np.cumsum(times[order]), allowed, "right")
    limit = np.append(value[order], np.inf)[at]
    who, n = scores.who[~honest], scores.n[~honest]
    low = n * (scores.trust[~honest] < limit)
    found = lookups.sums(run)
    mine = role_of == _code(run, HONEST)
    return {
        "auc": _auc_of_scores(scores, vehicle, honest, ~honest),
        "recall": _share_of(vehicle[who], low, n),
        "mistaken": _share_of(vehicle[mine], found.pairs_found[mine], found.pairs[mine]),
    }


def _share_of(
    vehicle: Int[ndarray, "n"], top: Int[ndarray, "n"], bottom: Int[ndarray, "n"]
) -> intervals.ClusteredEstimate:
    """Share of counts, each of which belongs to a vehicle."""
    return intervals.share(np.bincount(vehicle, top), np.bincount(vehicle, bottom))


def _auc_of_scores(
    scores: lookups.Scores,
    vehicle: Int[ndarray, "p"],
    honest: Bool[ndarray, "n"],
    attacking: Bool[ndarray, "n"],
) -> intervals.ClusteredEstimate:
    """Of values that were looked up, each as often as it was; `vehicle` is that of each pseudonym."""
    high, low = scores.trust[honest], scores.trust[attacking]
    times = scores.n[honest], scores.n[attacking]
    unit = vehicle[scores.who]
    return intervals.auc(high, unit[honest], low, unit[attacking], times)


def _tied(scores: lookups.Scores, one: Bool[ndarray, "n"], other: Bool[ndarray, "n"]) -> float:
    """Half the share of pairs whose values are equal after rounding; 0 where none was rounded."""
    if not scores.is_rounded or not (scores.n[one].sum() and scores.n[other].sum()):
        return 0.0
    _, value = np.unique(scores.trust, return_inverse=True)
    n_values = value.max() + 1
    of_one = np.bincount(value[one], scores.n[one], n_values)
    of_other = np.bincount(value[other], scores.n[other], n_values)
    n_ties = (of_one * of_other).sum()
    return float(n_ties / of_one.sum() / of_other.sum() / 2)


def detection_per_receiver(run: Run, threshold: float | None = None) -> pd.DataFrame:
    """Time until each vehicle suspects each subject that it looks up.

    It begins with the first lookup while the subject is watched, and ends with the first value below the threshold
    that rests on enough evaluations. If there is none, it ends with the last lookup (censored).

    Returns
    -------
    role, n (pairs of receiver and subject), share of the pairs in which the receiver ever suspects, median_s
    (Kaplan-Meier; NaN if the share that does not suspect yet stays above one half).
    """
    found = lookups.sums(run, threshold=threshold)
    _, role_of, vehicle = lookups.subjects(run)
    rows = []
    for code, role in enumerate(run.role_labels):
        counts = found.waited[code]
        if not counts.any():
            continue
        steps = np.arange(counts.shape[1])
        lasted = np.concatenate([np.repeat(steps, counts[seen]) for seen in (0, 1)])
        over = np.repeat([False, True], counts.sum(axis=1))
        mine = role_of == code
        of_pairs = _share_of(vehicle[mine], found.pairs_found[mine], found.pairs[mine])
        share = intervals.columns(of_pairs, "share")
        median_s = median(kaplan_meier(lasted * run.dt_s, over))
        rows.append({"role": role, "n": int(counts.sum())} | share | {"median_s": median_s})
    return pd.DataFrame(rows, columns=["role", "n", "share", "share_low", "share_high", "share_units", "median_s"])


def detection_summary(run: Run, threshold: float | None = None, at: trust.At = "server") -> pd.DataFrame:
    """Delays of `detection_delay` by role.

    Subjects that are not suspected count for as long as they were watched (Kaplan and Meier).

    Returns
    -------
    role, n, share that was ever suspected, median_s (null if the share not suspected yet stays above one half); both
    with intervals, clustered by vehicle.
    """
    return summary_of(detection_delay(run, threshold, at))


def detection_times(run: Run, threshold: float | None = None, false_positives: float = 0.05) -> pd.DataFrame:
    """The rows of `detection_summary` for what metrics ask: at (threshold, at_fpr, at_vehicle) and its columns.

    `at_fpr` has the threshold of `classification`, and no rows without one. `at_vehicle` has the lookups of a run with
    a server.
    """
    limit = threshold_at(_rated(run, scored(run), HONEST), false_positives)
    kept = trust.kept_at(run)
    asked: dict[str, tuple[float | None, trust.At]] = {"threshold": (threshold, kept)}
    if not np.isnan(limit):
        asked["at_fpr"] = (limit, kept)
    if kept == "server" and "trust_lookups" in run.tables:
        asked["at_vehicle"] = (threshold, "vehicles")
    found = {at: detection_summary(run, *how) for at, how in asked.items()}
    return pd.concat([of.assign(at=at) for at, of in found.items()], ignore_index=True)


def summary_of(delays: pd.DataFrame) -> pd.DataFrame:
    """The rows of `detection_summary` for any delays with columns vehicle, role, delay_s and found."""
    code, vehicle = delays.role.cat.codes.to_numpy(), delays.vehicle.to_numpy()
    delay_s, found = delays.delay_s.to_numpy(np.float64), delays.found.to_numpy(bool)
    rows = []
    for number, role in enumerate(delays.role.cat.categories):
        here = code == number
        n = int(here.sum())
        if not n:
            continue
        curve = kaplan_meier(delay_s[here], found[here], vehicle[here])
        share = intervals.of_units(found[here], vehicle[here])
        median_s = median_estimate(curve, share.n_units)
        estimates = intervals.columns(share, "share") | intervals.columns(median_s, "median_s")
        rows.append({"role": role, "n": n} | estimates)
    return pd.DataFrame(rows)


def waiting(delays: pd.DataFrame) -> pd.DataFrame:
    """Share of subjects that are not suspected yet, over time.

    Parameters
    ----------
    delays
        Rows of `detection_delay`.

    Returns
    -------
    As `survival.kaplan_meier`.
    """
    delay_s, found = delays.delay_s.to_numpy(np.float64), delays.found.to_numpy(bool)
    return kaplan_meier(delay_s, found, delays.vehicle.to_numpy())


def threshold_at(honest: Float[ndarray, "h"], false_positives: float) -> float:
    """Largest threshold below which lies at most a given share of the honest values.

    Parameters
    ----------
    honest
        Trust in honest subjects, in any order.
    false_positives
        Largest share of these values that may lie below the threshold, in [0, 1].

    Returns
    -------
    NaN without values; infinite if all of them may lie below.
    """
    if not len(honest):
        return float("nan")
    allowed = int(false_positives * len(honest) + 1e-9)  # 0.29 * 100 is 28.999...
    return float(np.sort(honest)[allowed]) if allowed < len(honest) else float("inf")


_NONE_RATED = (
    "evaluations of both attackers and honest vehicles to compare",
    "there are none of one of them, or no receiver of their messages could see what they reported. Raise "
    "fleet.penetration_p or traffic.duration_s, or lower the share_p of an attack, and run again.",
)


def _code(run: Run, role: str) -> int:
    """Place of a role in `Run.role_labels`; -1 if no vehicle has it."""
    return run.role_labels.index(role) if role in run.role_labels else -1


def _of_role(run: Run, found: Scored, role: str) -> Bool[ndarray, "n"]:
    return found.role == _code(run, role)


def _rated(run: Run, found: Scored, role: str) -> Float[ndarray, "n"]:
    return found.trust[_of_role(run, found, role) & found.rated].astype(np.float64)


def _auc(found: Scored, honest: Bool[ndarray, "n"], attacking: Bool[ndarray, "n"]) -> intervals.ClusteredEstimate:
    """Of some values above others."""
    high = found.trust[honest].astype(np.float64)
    low = found.trust[attacking].astype(np.float64)
    return intervals.auc(high, found.vehicle[honest], low, found.vehicle[attacking])


def _share(which: ndarray) -> float:
    return float(np.mean(which)) if len(which) else float("nan")
