"""Misbehaviour detection by trust: how well it separates attackers from honest vehicles, and how soon.

The unit is a pseudonym, because trust knows nothing else. One is watched from the first attack of its vehicle on;
what it was trusted before is left out. Honest ones are watched from the first attack of any vehicle on. Trust that
rests on no evaluation says nothing about a subject, whatever number the ledger has for it: such a subject is not
rated, it is neither suspected nor cleared, and it is counted (`rated`). A subject is suspected while it is rated and
its trust is below a threshold.
"""

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy import ndarray

from results.metrics import intervals, lookups, trust
from results.metrics.survival import kaplan_meier, median, median_band
from results.run import Run

HONEST = "honest"
"""Role that is classified against all others."""


def scored_vehicles(run: Run) -> pd.DataFrame:
    """Every watched subject whenever trust is computed.

    Returns
    -------
    step, subject, role, trust (null where the ledger has none), rated.
    """
    return run.once("misbehaviour.scored_vehicles", lambda: _scored(run))


def _scored(run: Run) -> pd.DataFrame:
    known = trust.values(run)
    who = watched(run).reset_index()
    steps = np.unique(known.step)
    at, row = np.nonzero((who.since.to_numpy() <= steps[:, None]) & (steps[:, None] <= who.until.to_numpy()))
    there = who.iloc[row][["subject", "role"]].assign(step=steps[at])
    there = there.merge(known[["step", "subject", "trust", "rated"]], "left", ["step", "subject"])
    return there.assign(rated=there.rated.eq(True))[["step", "subject", "role", "trust", "rated"]]


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
    rows = _classified(scored_vehicles(run), false_positives, None)
    if not rows:
        raise ValueError(f"{run.path} {_NONE_RATED}")
    return pd.DataFrame(rows)


def recall_over_time(run: Run, every_s: float = 10.0, false_positives: float = 0.05) -> pd.DataFrame:
    """The same in windows of time: time_s (of their start) and the columns of `classification`.

    The threshold is that of the whole time, so that false positives are what they are in each window.
    """
    threshold = float(classification(run, false_positives).threshold.iloc[0])
    frame = scored_vehicles(run)
    rows = [
        {"time_s": slot * every_s} | row
        for slot, window in frame.groupby(np.floor(frame.step * run.dt_s / every_s).astype(int))
        for row in _classified(window, false_positives, threshold)
    ]
    return pd.DataFrame(rows)


def roc(run: Run) -> pd.DataFrame:
    """Receiver operating characteristic: role, threshold, false_positives, true_positives; of rated values."""
    frame = scored_vehicles(run)
    honest = np.sort(_rated(frame, HONEST))
    rows = []
    for role in run.role_labels:
        attacking = np.sort(_rated(frame, role))
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
    rows = []
    for role, frame in trust.values(run).groupby("role", observed=True):
        row: dict[str, object] = {"role": role, "n": len(frame)}
        for name, some in (("share", frame), ("rated_share", frame[frame.rated])):
            low = (some.trust < threshold).to_numpy()
            row |= intervals.columns(intervals.of_units(low, some.subject.to_numpy()), name)
        rows.append(row)
    return pd.DataFrame(rows)


def separation(run: Run) -> intervals.Estimate:
    """Probability that the last rated value of an honest subject is above that of a malicious one (ties half)."""
    last = scored_vehicles(run).query("rated").drop_duplicates("subject", keep="last")
    honest, attacking = _rated(last, HONEST), _rated(last, "malicious")
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
    """Step and subject of the values below a threshold that rest on an evaluation."""
    if at == "vehicles":
        found = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
        for part in lookups.blocks(run, ["step", "subject", "trust", "n_evaluations"], may_be_none=True):
            is_low = (part["trust"].astype(np.float64) < threshold) & (part["n_evaluations"] > 0)
            found.append((part["step"][is_low], part["subject"][is_low]))
        step, subject = (np.concatenate(one) for one in zip(*found, strict=True))
        return step, subject
    known = trust.values(run) if trust.kept_at(run) == "server" else trust.server_values(run).assign(rated=False)
    low = known[(known.trust.to_numpy(np.float64) < threshold) & known.rated.to_numpy(bool)]
    return low.step.to_numpy(np.int64), low.subject.to_numpy(np.int64)


def detection_summary(run: Run, threshold: float = 0.25, at: trust.At = "server") -> pd.DataFrame:
    """Of `detection_delay`: role, n, share that was ever suspected, median_s (null: fewer than half were); both with
    intervals.

    Those not suspected count for as long as they were watched (Kaplan and Meier).
    """
    return summary_of(detection_delay(run, threshold, at))


def summary_of(delays: pd.DataFrame) -> pd.DataFrame:
    """Rows of `detection_summary`, of any delays: subject, role, delay_s, found."""
    rows = []
    for role, one in delays.groupby("role", observed=True):
        curve = waiting(one)
        rows.append(
            {"role": role, "n": len(one)}
            | intervals.columns(intervals.of_units(one.found.to_numpy(bool), one.subject.to_numpy()), "share")
            | intervals.columns(intervals.Estimate(median(curve), *median_band(curve), len(one)), "median_s")
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


def watched(run: Run) -> pd.DataFrame:
    """Subjects to be classified, by number: role, and the steps `since` and `until` which they are watched."""
    return run.once_for_all("misbehaviour.watched", lambda: _watched_of(run))


def _watched_of(run: Run) -> pd.DataFrame:
    who = run.subjects
    if not who.attack_start_step.notna().any():
        raise ValueError(f"{run.path} holds no attacks. Raise the share_p of an attack, or run past its start_s.")
    honest = who.role == HONEST
    who = who[honest | who.attack_start_step.notna()]
    begin = who.attack_start_step.where(who.role != HONEST, who.attack_start_step.min())
    since = np.maximum(who.from_step, begin.astype(int))
    until = who.to_step.clip(upper=run.manifest["steps"] - 1)
    who = pd.DataFrame({"role": who.role, "since": since, "until": until}).rename_axis("subject")
    return who[who.since <= who.until]


def _rated(frame: pd.DataFrame, role: str) -> Float[ndarray, "n"]:
    return frame.trust[(frame.role == role) & frame.rated].to_numpy(np.float64)


def _classified(frame: pd.DataFrame, false_positives: float, threshold: float | None) -> list[dict[str, float | str]]:
    """Rows of `classification`; the threshold is found where none is given."""
    rated, scored = frame[frame.rated], frame[frame.trust.notna()]
    honest = _rated(frame, HONEST)
    limit = threshold_at(honest, false_positives) if threshold is None else threshold
    groups = {str(role): one for role, one in frame.groupby("role", observed=False)}
    rows: list[dict[str, float | str]] = []
    for role, mine in groups.items():
        if role == HONEST or mine.empty:
            continue
        attacking = rated[rated.role == role]
        low = (attacking.trust < limit).to_numpy()
        suspected = mine.rated & (mine.trust < limit)
        of_time = intervals.of_units(suspected.to_numpy(bool), mine.subject.to_numpy())
        if np.isnan(limit):
            of_time = intervals.UNKNOWN
        rows.append({
            "role": role, "n": mine.subject.nunique(), "rated": len(attacking) / len(mine),
            "rated_honest": _share(groups[HONEST].rated), **intervals.columns(_auc(rated, role), "auc"),
            **intervals.columns(_auc(scored, role), "auc_unrated"), "threshold": limit,
            **intervals.columns(intervals.of_units(low, attacking.subject.to_numpy()), "true_positives"),
            "false_positives": _share(honest < limit), **intervals.columns(of_time, "suspected"),
        })  # fmt: skip
    return rows


def _auc(frame: pd.DataFrame, role: str) -> intervals.Estimate:
    """Of the honest values of a frame above those of a role."""
    honest, attacking = frame[frame.role == HONEST], frame[frame.role == role]
    return intervals.auc(
        honest.trust.to_numpy(np.float64), honest.subject.to_numpy(),
        attacking.trust.to_numpy(np.float64), attacking.subject.to_numpy(),
    )  # fmt: skip


def _share(which: ndarray | pd.Series) -> float:
    return float(np.mean(which)) if len(which) else float("nan")
