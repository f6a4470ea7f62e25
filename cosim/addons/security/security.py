"""Trust as a classifier of vehicles: confusion matrix and what follows from it, precision and recall, false exclusions.

A subject (a pseudonym) is watched as in `misbehaviour`. It is positive if its vehicle attacks; a message is positive if
anything in it is a lie. A subject is excluded while it is suspected: its trust is below a threshold and rests
on at least `trust.suspect_from` evaluations.
"""

import math

import numpy as np
import pandas as pd
from numpy import ndarray

from cosim.base.codes import BASE_VARIANT
from results.metrics import intervals, misbehaviour
from results.metrics.misbehaviour import scored_vehicles, summary_of
from results.metrics.trust import HONEST, suspect_below, watched
from results.run import Run


def excluded(run: Run, threshold: float | None = None) -> pd.DataFrame:
    """Rows of `misbehaviour.scored_vehicles`, with `attacker` (its vehicle attacks) and `excluded` (at that moment).

    Parameters
    ----------
    threshold
        Threshold on trust; by default `trust.suspect_below` of the run.
    """
    frame = scored_vehicles(run).astype({"trust": np.float64})
    low = frame.trust < suspect_below(run, threshold)
    return frame.assign(attacker=frame.role != HONEST, excluded=frame.enough & low)


def confusion(run: Run, threshold: float | None = None) -> pd.DataFrame:
    """Confusion matrix by value, by pseudonym and by message.

    Returns
    -------
    unit: "value" (a subject whenever trust is computed), "pseudonym" (a subject at the last such moment), and "message"
    if the run holds detections (positive if it holds a lie, whoever sent it); tp, fp, fn, tn; and what `rates` returns.
    precision, recall and fpr have intervals clustered by vehicle. A subject without enough evaluations is not excluded.
    """
    frame = excluded(run, threshold)
    rows = []
    units = [("value", frame), ("pseudonym", frame.drop_duplicates("subject", keep="last"))]
    if "detections" in run.tables:
        units.append(("message", messages(run, frame)))
    for unit, some in units:
        counts = pd.crosstab(some.attacker, some.excluded).reindex(
            index=[False, True], columns=[False, True], fill_value=0
        )
        (tn, fp), (fn, tp) = counts.to_numpy().tolist()
        counted = {"unit": unit, "tp": tp, "fp": fp, "fn": fn, "tn": tn}
        rows.append(counted | rates(tp, fp, fn, tn))
        for name, value, among in (
            ("precision", some.attacker, some.excluded),
            ("recall", some.excluded, some.attacker),
            ("fpr", some.excluded, ~some.attacker),
        ):
            found = intervals.of_units(value[among].to_numpy(bool), some.vehicle[among].to_numpy())
            rows[-1] |= intervals.columns(found, name)
    return pd.DataFrame(rows)


def messages(run: Run, frame: pd.DataFrame) -> pd.DataFrame:
    """Messages with detections of watched subjects: step, subject, vehicle, attacker (it holds a lie), excluded.

    Parameters
    ----------
    frame
        Of `excluded`: a message is excluded if its sender was when trust was last computed before it was sent.
    """
    listed = run.table("detections", ["step", "observer", "lied", "transmitted"])
    listed = listed.astype({"step": np.int64, "observer": np.int64})
    message = listed.groupby(["step", "observer"])[["lied", "transmitted"]].any()
    lied = message.lied[message.transmitted]  # what is withheld from a message is no less a lie
    sent = lied.rename("attacker").rename_axis(["step", "subject"]).reset_index()
    sent = sent.merge(watched(run).drop(columns="role").reset_index(), on="subject")
    is_watched = (sent.since <= sent.step) & (sent.step <= sent.until)
    sent = sent[is_watched].sort_values("step")
    known = frame[["step", "subject", "excluded"]].astype({"step": np.int64, "subject": np.int64}).sort_values("step")
    found = pd.merge_asof(sent, known, on="step", by="subject")
    return found.assign(excluded=found.excluded.eq(True))[["step", "subject", "vehicle", "attacker", "excluded"]]


def exclusion_delay(run: Run) -> pd.DataFrame:
    """Time until receivers drop the messages of a vehicle because one of its pseudonyms was revoked.

    Returns
    -------
    vehicle, role, delay_s (of attackers from their first attack, of others from the first of any), found:
    where not found, the time it was watched for (censored). ValueError where the run revokes nothing.
    """
    policy = run.config.get("pseudonyms", {}).get("revocation", "none")
    if policy == "none":
        raise ValueError(f'{run.path} revokes no pseudonyms. Set pseudonyms.revocation, for example to "immediate".')
    who = watched(run).join(run.subjects.refused_step)
    who = who.groupby("vehicle").agg(
        role=("role", "first"), since=("since", "min"), until=("until", "max"), refused=("refused_step", "min")
    )
    found = who.refused.notna()
    end_step = who.refused.where(found, who.until).astype(float)
    delay_s = (end_step - who.since).clip(lower=0) * run.dt_s
    return pd.DataFrame({"role": who.role, "delay_s": delay_s, "found": found}).reset_index()


def exclusion_times(run: Run) -> pd.DataFrame:
    """The delays of `exclusion_delay` by role, as `misbehaviour.summary_of`; no rows where nothing is revoked."""
    if run.variant != BASE_VARIANT or run.config.get("pseudonyms", {}).get("revocation", "none") == "none":
        return pd.DataFrame()
    return summary_of(exclusion_delay(run))


def rates(tp: float, fp: float, fn: float, tn: float) -> dict[str, float]:
    """precision, recall, fpr, f1, mcc (Matthews 1975), informedness (recall - fpr); NaN where not defined."""

    def over(a: float, b: float) -> float:
        return a / b if b else math.nan

    recall = over(tp, tp + fn)
    fpr = over(fp, fp + tn)
    product = (tp + fp) * (tp + fn) * (tn + fp)
    product *= tn + fn
    return {
        "precision": over(tp, tp + fp),
        "recall": recall,
        "fpr": fpr,
        "f1": over(2 * tp, 2 * tp + fp + fn),
        "mcc": over(tp * tn - fp * fn, math.sqrt(product)),
        "informedness": recall - fpr,
    }


def average_precision(run: Run) -> float:
    """Area under the curve of precision over recall, as a sum of precision over steps of recall.

    Every evaluated value of a watched subject is a threshold: a subject is excluded while its value rests on an
    evaluation and is at or below it. 0 if no value rests on an evaluation; NaN without attackers.
    """
    found = misbehaviour.scored(run)
    attacks = found.role != run.role_labels.index(HONEST)
    rated = found.rated & ~np.isnan(found.trust)
    if not rated.any():
        return 0.0
    if not attacks.any():
        return math.nan
    threshold = np.unique(found.trust[rated])

    def excluded_at(of: ndarray) -> ndarray:
        return np.searchsorted(np.sort(found.trust[of]), threshold, "right")

    n_attackers, n = excluded_at(rated & attacks), excluded_at(rated)
    gained = np.diff(n_attackers, prepend=0)
    return float((n_attackers / n * gained).sum() / attacks.sum())


def false_exclusions(run: Run, threshold: float | None = None) -> intervals.ClusteredEstimate:
    """Times that an honest vehicle becomes excluded, per hour that honest vehicles are watched for.

    Who is excluded at the first moment may have become so earlier, in time that is not watched.
    """
    frame = excluded(run, threshold)
    honest = frame[~frame.attacker].sort_values(["subject", "step"])
    before = honest.excluded.groupby(honest.subject).shift(fill_value=True)
    times = (honest.excluded & ~before).groupby(honest.subject).sum()
    watched = honest.groupby("subject").agg(vehicle=("vehicle", "first"), min=("step", "min"), max=("step", "max"))
    hours = (watched["max"] - watched["min"]) * run.dt_s / 3600
    of_vehicle = pd.DataFrame({"times": times, "hours": hours}).groupby(watched.vehicle).sum()
    return intervals.ratio(of_vehicle.times.to_numpy(float), of_vehicle.hours.to_numpy())


def trust_error(run: Run) -> pd.DataFrame:
    """By role: mean distance of evaluated trust from 1 (honest) or 0 (attackers), with its interval by vehicle."""
    frame = scored_vehicles(run).query("rated")
    error = (frame.trust.astype(float) - (frame.role == HONEST)).abs()
    rows = []
    for role, one in frame.groupby("role", observed=True):
        errors = error[one.index].to_numpy(float)
        found = intervals.of_units(errors, one.vehicle.to_numpy())
        rows.append({"role": role} | intervals.columns(found, "error"))
    return pd.DataFrame(rows)
