"""Trust in pseudonyms: by role of the vehicle behind them, and over time."""

from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from results.metrics import intervals
from results.run import Run
from results.sensing import interval_steps

At = Literal["server", "vehicles"]
"""Whose trust: that of the trust server, or that which vehicles look up."""

HONEST = "honest"
"""Role that is classified against all others."""

_INSTANTS = 600
"""Steps that suffice to draw trust over time where every vehicle keeps its own."""


class Values(NamedTuple):
    """Trust in pseudonyms while they are in use, by step."""

    step: Int[ndarray, "n"]
    since: Int[ndarray, "n"]
    """First step that the value stands for: `step` itself, or where the interval of a mean begins."""
    subject: Int[ndarray, "n"]
    who: Int[ndarray, "n"]
    """Row of the subject in `Run.subjects`."""
    vehicle: Int[ndarray, "n"]
    """The vehicle behind it. Its pseudonyms are not independent of each other."""
    role: Int[ndarray, "n"]
    """Code of its role, in the order of `Run.role_labels`."""
    trust: Float[ndarray, "n"]
    rated: Bool[ndarray, "n"]
    """Whether the value rests on at least one evaluation by another vehicle that could see."""
    enough: Bool[ndarray, "n"]
    """Whether it rests on as many as suspicion needs (`suspect_from`)."""


def kept_at(run: Run) -> At:
    """Where trust is kept: at the server if it ever computed any."""
    return "server" if len(server_values(run)) else "vehicles"


def suspect_below(run: Run, threshold: float | None = None) -> float:
    """Trust below which a subject is suspected: the given threshold, else that of the run's config."""
    return float(run.config.get("trust", {}).get("suspect_below", 0.25)) if threshold is None else threshold


def suspect_from(run: Run) -> int:
    """Least number of evaluations behind the trust of a subject that is suspected."""
    return int(run.config.get("trust", {}).get("suspect_from", 1))


def server_values(run: Run) -> pd.DataFrame:
    """What metrics need of the table `trust`, of the run's variant; not to be changed."""
    columns = [
        "step",
        "subject",
        "trust",
        "state",
        "n_evaluations",
        "n_evaluators",
        "newest_evaluation_age_s",
        "oldest_evaluation_age_s",
    ]
    return run.once("trust.server_values", lambda: run.variant_table("trust", columns))


def values(run: Run) -> pd.DataFrame:
    """Trust in each pseudonym while it is in use: step, time_s, subject, vehicle, role, trust, rated.

    Every value that the server computed; `rated` says whether it rests on at least one evaluation by another vehicle
    that could see. Without a server, the mean over the receivers that look the subject up and hold such a value of
    their own, at 600 instants at most.
    """
    found, who = in_use(run), run.subjects
    return pd.DataFrame(
        {
            "step": found.step,
            "time_s": found.step * run.dt_s,
            "subject": found.subject,
            "vehicle": found.vehicle,
            "role": who.role.array.take(found.who),
            "trust": found.trust,
            "rated": found.rated,
        }
    )


def in_use(run: Run) -> Values:
    """The rows of `values` as arrays; not to be changed."""
    return run.once("trust.in_use", lambda: _in_use(run))


def _in_use(run: Run) -> Values:
    if kept_at(run) == "server":
        known = server_values(run)
    else:
        known = _own(run)
    n = known.n_evaluations.to_numpy()
    step, subject, trust = (known[name].to_numpy() for name in ("step", "subject", "trust"))
    who = run.subjects
    at = who.index.get_indexer(pd.Index(subject))
    since = known.since.to_numpy() if "since" in known else step
    used = (at >= 0) & (since <= who.to_step.to_numpy()[at])
    at = at[used]
    role = who.role.cat.codes.to_numpy(np.int64)[at]
    n = n[used]
    return Values(
        step=step[used],
        since=since[used],
        subject=subject[used],
        who=at,
        vehicle=who.vehicle.to_numpy()[at],
        role=role,
        trust=trust[used],
        rated=n > 0,
        enough=n >= suspect_from(run),
    )


def in_vehicles(run: Run, step: int) -> pd.Series:
    """Trust in each vehicle at a step, by vehicle: the server's last evaluated value of the pseudonym it has then.

    It is NaN where there is none yet. Of the identities of a Sybil attacker, its own counts. ValueError if the run does
    not have the step.
    """
    who, n_steps = run.subjects, int(run.manifest["steps"])
    if not 0 <= step < n_steps:
        raise ValueError(f"step = {step}: {run.path} has the steps 0 to {n_steps - 1}.")
    has_begun = (who.identity == 0) & (who.from_step <= step)
    now = who[has_begun].sort_values("from_step").drop_duplicates("vehicle", keep="last")
    known = run.once("trust.by_subject", lambda: _by_subject(run))
    subject = known.subject.to_numpy(np.int64)
    of_now = now.index.to_numpy(np.int64)
    key = subject * n_steps + known.step.to_numpy()
    last = np.searchsorted(key, of_now * n_steps + step, "right") - 1  # -1, before the first one, is nobody's
    has_value = np.append(subject, -1)[last] == of_now
    trust = np.append(known.trust, np.nan)[last]
    return pd.Series(np.where(has_value, trust, np.nan), now.vehicle)


def _by_subject(run: Run) -> pd.DataFrame:
    """The server's evaluated values, each subject's in the order of time."""
    known = server_values(run)
    return known[known.n_evaluations > 0].sort_values(["subject", "step"])


def _own(run: Run) -> pd.DataFrame:
    """Means of the values of their own that vehicles look up: step, since, subject, trust, n_evaluations.

    Vehicles may look up in turns, so that a single step has the lookups of some of them. A mean is over a sensing
    interval therefore, as far as the subject is in use in it. `since` is the first step of the interval, and `step` the
    last one with lookups.
    """
    who = run.subjects
    to_step = who.to_step.to_numpy()
    every = int(interval_steps(run, run.roles.index.to_numpy(np.int64)).max(initial=1))
    parts = run.variant_parts("trust_lookups", ["step"])
    of_parts = [part.step.unique() for part in parts]
    steps = np.unique(np.concatenate([[0], *of_parts]))
    last = pd.Series(steps, steps // every).groupby(level=0).max()
    few = last.index[:: -(-len(last) // _INSTANTS)]
    looked = steps[np.isin(steps // every, few)]
    chosen = pc.field("step").isin(looked.tolist())
    chosen &= (pc.field("source") == "own") & (pc.field("n_evaluations") > 0)
    names = ["step", "subject", "trust", "n_evaluations"]
    means, open_rows = [], pd.DataFrame(columns=names)
    for part in run.variant_parts("trust_lookups", names, chosen):
        of_interval = part.step // every
        at = who.index.get_indexer(pd.Index(part.subject))
        rows = part.assign(step=last.loc[of_interval].to_numpy())
        is_used = (at >= 0) & (part.step <= to_step[at])
        rows = rows[is_used]
        rows = rows if open_rows.empty else pd.concat([open_rows, rows])
        is_open = rows.step == rows.step.max()  # an interval may go on in the next block
        means.append(_means(rows[~is_open]))
        open_rows = rows[is_open]
    frame = pd.concat([*means, _means(open_rows)])
    frame["since"] = frame.step // every * every
    if frame.empty:
        raise run.lacks("trust values", _why_no_values(run))
    return frame


def _why_no_values(run: Run) -> str:
    if len(run.subjects) == 1:
        return "there is one vehicle, which no other one evaluates. Raise fleet.penetration_p, or traffic.duration_s."
    if "server" in run.tables and run.variant_table("server", ["n_reports"]).n_reports.any():
        return (
            "vehicles reported to the server, and no trust was computed of it: nobody could judge what another vehicle "
            "reports, or the run is too short. Raise fleet.penetration_p, or run longer than trust.server_period_s and "
            "the delays and outages in [server]."
        )
    return (
        'neither the server nor a vehicle ever computed one. Set trust.host to "central" or "local", equip vehicles, '
        "and run longer than trust.server_period_s."
    )


def _means(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean trust and number of evaluations by step and subject."""
    return rows.groupby(["step", "subject"], as_index=False)[["trust", "n_evaluations"]].mean()


def watched(run: Run) -> pd.DataFrame:
    """Subjects to be classified: attackers from their first attack on, honest subjects from the first attack of any.

    Returns
    -------
    By subject: role, vehicle, and first and last step (`since`, `until`) in which it is watched.

    Raises
    ------
    ValueError
        If the run has no attacks, or nobody is in use any more at the first one.
    """
    return run.once_for_all("trust.watched", lambda: _watched_of(run))


def _why_none_began(run: Run) -> str:
    """Why no vehicle has attacked: there are no attackers, the run ends too early, or they had no occasion."""
    if run.subjects.empty:
        return "no vehicle is equipped. Raise fleet.penetration_p."
    if (run.subjects.role == HONEST).all():
        cure = "Raise the share_p of an attack." if run.config.get("attacks") else "Add a section [[attacks]]."
        return f"no vehicle is an attacker. {cure}"
    start_s = min((attack.get("start_s", 0.0) for attack in run.config.get("attacks", ())), default=0.0)
    end_s = run.manifest["steps"] * run.dt_s
    if start_s >= end_s:
        return f"none has begun: the run ends at {end_s:g} s, and start_s = {start_s:g} s. Lower it, or run longer."
    return "no attacker has attacked: start_s is after the end, no victim was near, or `when` held it back. Run longer."


def _watched_of(run: Run) -> pd.DataFrame:
    who = run.subjects
    if not who.attack_start_step.notna().any():
        raise run.lacks("attacks", _why_none_began(run))
    honest = who.role == HONEST
    who = who[honest | who.attack_start_step.notna()]
    begin = who.attack_start_step.where(who.role != HONEST, who.attack_start_step.min())
    since = np.maximum(who.from_step, begin.astype(int))
    until = who.to_step.clip(upper=run.manifest["steps"] - 1)
    columns = {"role": who.role, "vehicle": who.vehicle, "since": since, "until": until}
    who = pd.DataFrame(columns).rename_axis("subject")
    who = who[who.since <= who.until]
    if who.empty:
        raise run.lacks("pseudonyms in use since the first attack", "it ends too soon after it. Run longer.")
    return who


def by_role(
    run: Run,
    role: Int[ndarray, "n"],
) -> list[tuple[str, Bool[ndarray, "n"]]]:
    """Split rows by role.

    Parameters
    ----------
    role
        Code of the role of each row, in the order of `Run.role_labels`.

    Returns
    -------
    Name of each role that occurs, in the order of the codes, with a mask of its rows.
    """
    masks = ((name, role == code) for code, name in enumerate(run.role_labels))
    return [(name, here) for name, here in masks if here.any()]


def mean(run: Run) -> pd.DataFrame:
    """Mean of all values: role, n, mean with its interval (clustered by vehicle; see `intervals.columns`), note."""
    found = in_use(run)
    rows = []
    for role, here in by_role(run, found.role):
        trust = found.trust[here].astype(np.float64)
        mean = intervals.of_units(trust, found.vehicle[here])
        row = {"role": role, "n": int(here.sum()), "note": _idle(run, role)}
        rows.append(row | intervals.columns(mean, "mean"))
    return pd.DataFrame(rows)


def _idle(run: Run, role: str) -> str:
    """Says of a role that its vehicles behave as honest ones in this run, because none of them has attacked yet."""
    who = run.subjects
    attacked = who.attack_start_step[who.role == role].notna().any()
    return "" if role == HONEST or attacked else "has not attacked"


def over_time(run: Run) -> pd.DataFrame:
    """Quartiles of trust over subjects: time_s, role, n, mean, q25, median, q75."""
    frame = values(run).astype({"trust": np.float64})
    groups = frame.groupby(["time_s", "role"], observed=True).trust
    quartiles = groups.quantile(np.array([0.25, 0.5, 0.75])).unstack()
    quartiles.columns = ["q25", "median", "q75"]
    return groups.agg(n="size", mean="mean").join(quartiles).reset_index()


def last_of_each(who: Int[ndarray, "n"]) -> Int[ndarray, "w"]:
    """Last row of each subject.

    Parameters
    ----------
    who
        Number of the subject of each row, from 0; rows in the order of time.

    Returns
    -------
    Row numbers, ascending: one for each subject that occurs.
    """
    last = np.full(int(who.max(initial=-1)) + 1, -1)
    last[who] = np.arange(len(who))  # the last one stays
    return np.sort(last[last >= 0])


def final(run: Run) -> pd.DataFrame:
    """Quartiles over subjects of the last value of each: role, n, mean, q25, median, q75; mean and median with their
    intervals (see `intervals.columns`); and a note."""
    found, rows = in_use(run), []
    last = last_of_each(found.who)
    role, vehicle = found.role[last], found.vehicle[last]
    trust = found.trust[last].astype(np.float64)
    for name, here in by_role(run, role):
        one, unit = trust[here], pd.factorize(vehicle[here])[0]
        q25, q75 = np.quantile(one, [0.25, 0.75])
        rows.append(
            {"role": name, "n": len(one), "q25": q25, "q75": q75, "note": _idle(run, name)}
            | intervals.columns(intervals.of_units(one, unit), "mean")
            | intervals.columns(intervals.median(one, unit), "median")
        )
    return pd.DataFrame(rows)
