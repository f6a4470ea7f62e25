"""Who is told from whom by trust: liars from honest vehicles, how well and how soon.

A vehicle is a liar from its first lie on; what it was trusted before is left out. Honest vehicles are looked at from
the first lie of anybody on. Trust that rests on no evaluation says nothing about a vehicle, whatever number the ledger
has for it: such a vehicle is not judged, it is neither suspected nor cleared, and it is counted (`judged`).
A vehicle is suspected while it is judged and its trust is below a threshold.
"""

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Float
from numpy import ndarray

from results.metrics import freshness, trust
from results.metrics.survival import kaplan_meier, median
from results.run import Run
from results.tables import ROLES

_DISHONEST = ROLES[1:]


def suspects(run: Run) -> pd.DataFrame:
    """Everybody to be told apart, whenever trust is computed.

    Returns
    -------
    step, vehicle, role, trust (null where the ledger has none), judged.
    """
    known = trust.values(run)
    who = _watched(run).reset_index()
    steps = np.unique(known.step)
    at, row = np.nonzero((who.since.to_numpy() <= steps[:, None]) & (steps[:, None] <= who.until.to_numpy()))
    there = who.iloc[row][["vehicle", "role"]].assign(step=steps[at])
    there = there.merge(known[["step", "vehicle", "trust", "judged"]], "left", ["step", "vehicle"])
    return there.assign(judged=there.judged.eq(True))[["step", "vehicle", "role", "trust", "judged"]]


def separability(run: Run, false_positives: float = 0.05) -> pd.DataFrame:
    """How well trust separates liars from honest vehicles, over all the time that there are liars.

    Parameters
    ----------
    false_positives
        Share of honest vehicles' values that may lie below the threshold.

    Returns
    -------
    role of the liars; n: liars; judged, judged_honest: share of their time on the road with a evaluation behind
    their trust; auc: chance that an honest value is above a liar's (ties count half); auc_unjudged: the same with the
    values that rest on no evaluation, for who takes every value at face value; threshold: the largest with no more false
    positives than allowed; true_positives, false_positives: shares of the judged values below it; caught: share of
    the liars' time on the road in which they are suspected, judged or not.

    Notes
    -----
    Values are pooled over vehicles and time. `auc` is the area under the curve of `roc`, and Mann and Whitney's U
    over the number of pairs (1947): 1 tells all apart, 0.5 none.
    """
    rows = _separated(suspects(run), false_positives, None)
    if not rows:
        raise ValueError(f"{run.path} {_NOBODY_JUDGED}")
    return pd.DataFrame(rows)


def over_time(run: Run, every_s: float = 10.0, false_positives: float = 0.05) -> pd.DataFrame:
    """The same in windows of time: time_s (of their beginning) and the columns of `separability`.

    The threshold is that of the whole time, so that false positives are what they are in each window.
    """
    threshold = float(separability(run, false_positives).threshold.iloc[0])
    frame = suspects(run)
    rows = [
        {"time_s": slot * every_s} | row
        for slot, window in frame.groupby(np.floor(frame.step * run.dt_s / every_s).astype(int))
        for row in _separated(window, false_positives, threshold)
    ]
    return pd.DataFrame(rows)


def roc(run: Run) -> pd.DataFrame:
    """Receiver operating characteristic: role, threshold, false_positives, true_positives; of judged values."""
    frame = suspects(run)
    honest = np.sort(_judged(frame, "honest"))
    rows = []
    for role in _DISHONEST:
        lying = np.sort(_judged(frame, role))
        if len(lying) and len(honest):
            threshold = np.append(np.unique(np.concatenate([lying, honest])), np.inf)
            rows.append(pd.DataFrame({
                "role": role, "threshold": threshold,
                "false_positives": np.searchsorted(honest, threshold) / len(honest),
                "true_positives": np.searchsorted(lying, threshold) / len(lying),
            }))  # fmt: skip
    if not rows:
        raise ValueError(f"{run.path} {_NOBODY_JUDGED}")
    return pd.concat(rows, ignore_index=True)


def below(run: Run, threshold: float = 0.25) -> pd.DataFrame:
    """Share of all values under a threshold, by role: role, n, share, and judged_share, of the judged."""
    frame = trust.values(run)
    low = frame.assign(share=frame.trust < threshold, n=1).groupby("role", observed=True)
    judged = frame[frame.judged]
    of_judged = (judged.trust < threshold).groupby(judged.role, observed=True).mean()
    return low.agg({"n": "size", "share": "mean"}).assign(judged_share=of_judged).reset_index()


def separation(run: Run) -> float:
    """Chance that an honest vehicle's last judged value is above that of a malicious one (ties count half)."""
    last = suspects(run).query("judged").drop_duplicates("vehicle", keep="last")
    return auc(_judged(last, "honest"), _judged(last, "malicious"))


def detection_delay(run: Run, threshold: float = 0.25, at: trust.At = "server") -> pd.DataFrame:
    """Time until a vehicle is suspected: of a liar from its first lie, of others from the first lie of anybody.

    Parameters
    ----------
    at
        At the server, or at the first vehicle that uses a value below the threshold (a default does not count).

    Returns
    -------
    vehicle, role, delay_s, found: where not found, the delay is the time it was watched for (censored).
    """
    who = _watched(run)
    is_low = pc.field("trust") < threshold
    if at == "server":
        low = run.table("trust", ["step", "vehicle"], is_low & (pc.field("n_evaluations") > 0))
    else:
        low = run.table("trust_lookups", ["step", "subject", "source", "age_s"], is_low & pc.field("age_s").is_valid())
        newest_s, _ = freshness.Editions(run).ages(low)
        low = low[~np.isnan(newest_s)].rename(columns={"subject": "vehicle"})
    low = low.merge(who.reset_index(), on="vehicle").query("since <= step <= until")
    first = low.groupby("vehicle").step.min().reindex(who.index)
    found = first.notna()
    delay_s = (first.where(found, who.until) - who.since) * run.dt_s
    return pd.DataFrame({"role": who.role, "delay_s": delay_s, "found": found}).reset_index()


def detection_summary(run: Run, threshold: float = 0.25, at: trust.At = "server") -> pd.DataFrame:
    """Of `detection_delay`: role, n, share that was ever suspected, half_after_s (null: fewer than half were).

    Those not suspected count for as long as they were watched (Kaplan and Meier).
    """
    rows = [
        {"role": role, "n": len(one), "share": one.found.mean(), "half_after_s": median(waiting(one))}
        for role, one in detection_delay(run, threshold, at).groupby("role", observed=True)
    ]
    return pd.DataFrame(rows)


def waiting(delays: pd.DataFrame) -> pd.DataFrame:
    """Share not suspected yet after a time, of rows of `detection_delay`: as of `survival.kaplan_meier`."""
    return kaplan_meier(delays.delay_s.to_numpy(np.float64), delays.found.to_numpy(bool))


def auc(honest: Float[ndarray, "h"], lying: Float[ndarray, "l"]) -> float:
    """Chance that an honest value is above a lying one, ties counting half; NaN where there is none of either."""
    if not len(honest) or not len(lying):
        return float("nan")
    lying = np.sort(lying)
    wins = np.searchsorted(lying, honest, "left") + np.searchsorted(lying, honest, "right")
    return float(wins.mean() / 2 / len(lying))


def threshold_at(honest: Float[ndarray, "h"], false_positives: float) -> float:
    """Largest threshold with at most this share of honest values below it; NaN where there is none."""
    if not len(honest):
        return float("nan")
    allowed = int(false_positives * len(honest) + 1e-9)  # 0.29 * 100 is 28.999...
    return float(np.sort(honest)[allowed]) if allowed < len(honest) else float("inf")


_NOBODY_JUDGED = (
    "holds no evaluations on liars and honest vehicles to compare: nobody who heard them could see what they said. "
    "Raise fleet.penetration_p or traffic.duration_s and run again."
)


def _watched(run: Run) -> pd.DataFrame:
    """Equipped vehicles to be told apart, by id: role, and the steps `since` and `until` which."""
    who = run.table("vehicles", ["vehicle", "equipped", "role", "first_step", "last_step", "attack_start_step"])
    who = who[who.equipped].set_index("vehicle")
    if not who.attack_start_step.notna().any():
        raise ValueError(f"{run.path} holds no lies. Raise fleet.malicious_p, or run past adversary.start_s.")
    honest = who.role == "honest"
    who = who[honest | who.attack_start_step.notna()]
    since = who.attack_start_step.where(who.role != "honest", who.first_step.clip(lower=who.attack_start_step.min()))
    until = who.last_step.clip(upper=run.manifest["steps"] - 1)
    who = pd.DataFrame({"role": who.role, "since": since.astype(int), "until": until})
    return who[who.since <= who.until]


def _judged(frame: pd.DataFrame, role: str) -> Float[ndarray, "n"]:
    return frame.trust[(frame.role == role) & frame.judged].to_numpy(np.float64)


def _separated(frame: pd.DataFrame, false_positives: float, threshold: float | None) -> list[dict[str, float | str]]:
    """Rows of `separability`; the threshold is found where none is given."""
    honest = _judged(frame, "honest")
    limit = threshold_at(honest, false_positives) if threshold is None else threshold
    groups = {role: frame[frame.role == role] for role in ROLES}
    at_face_value = {role: one.trust.dropna().to_numpy(np.float64) for role, one in groups.items()}
    rows: list[dict[str, float | str]] = []
    for role in _DISHONEST:
        if (mine := groups[role]).empty:
            continue
        lying = _judged(mine, role)
        rows.append({
            "role": role, "n": mine.vehicle.nunique(), "judged": len(lying) / len(mine),
            "judged_honest": _share(groups["honest"].judged), "auc": auc(honest, lying),
            "auc_unjudged": auc(at_face_value["honest"], at_face_value[role]), "threshold": limit,
            "true_positives": _share(lying < limit), "false_positives": _share(honest < limit),
            "caught": float("nan") if np.isnan(limit) else float((lying < limit).sum()) / len(mine),
        })  # fmt: skip
    return rows


def _share(which: ndarray | pd.Series) -> float:
    return float(np.mean(which)) if len(which) else float("nan")
