"""What attacks achieve: how often, where and for how long fabricated objects are believed, and real ones lost.

The unit that is counted is a pair: a fabricated (or withheld) detection of a step, and an honest vehicle that received
the message with it (or without it). Lists of attackers are apart. Definitions and sources are in
`results/FRESHNESS.md`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from results.metrics.intervals import by_group, ratio
from results.run import Run
from results.sensing import interval_steps

THRESHOLDS = (0.1, 0.3, 0.5, 0.7)
"""Scores from which an object counts as believed, where none are given."""
HONEST = "honest"

_PAIRS = f"""
WITH pairs AS (
    SELECT o.*, s.vehicle AS attacker, s.role, among, if(r.role = '{HONEST}', '{HONEST}', 'attackers') AS receivers
    FROM attack_outcomes o JOIN subjects s ON s.pseudonym = o.observer
    JOIN vehicles r ON r.vehicle = o.receiver
    JOIN (VALUES ('received'), ('intended')) a(among) ON among = 'received' OR intended
    WHERE variant = $variant AND (effect = 'inserted' OR NOT ego_detected)
), ghosts AS (SELECT * FROM pairs WHERE effect = 'inserted' AND receivers = '{HONEST}')
"""
"""Pairs of the run's variant, once among all that received it, and once more among those at which the attack aims.

Of a removal, only receivers that did not detect the withheld actor themselves: the others do not depend on it.
"""


def success(run: Run, thresholds: Sequence[float] = THRESHOLDS) -> pd.DataFrame:
    """Share of pairs (lie, receiver) in which the attack succeeds, by score threshold.

    An inserted object succeeds if the receiver has it with a score of at least the threshold. A removal succeeds if the
    receiver does not have the withheld actor with such a score.

    Returns
    -------
    effect, role (of the attacker), receivers (honest, or attackers: those of any other role), among (received, or
    intended: those at which the attack aims), threshold, n (pairs: the denominator), share, low, high (95 %, clustered
    by attacker), n_units (attackers).
    """
    return by_group(_success(run, thresholds), ["effect", "role", "receivers", "among", "threshold"])


def curve(run: Run, n_thresholds: int = 51) -> pd.DataFrame:
    """Shares of `success` over thresholds from 0 to 1: effect, role, receivers, among, threshold, share."""
    counts = _success(run, np.linspace(0, 1, n_thresholds).tolist())
    key = ["effect", "role", "receivers", "among", "threshold"]
    total = counts.groupby(key, sort=False)[["top", "bottom"]].sum()
    return (total.top / total.bottom).rename("share").reset_index()


def _success(run: Run, thresholds: Sequence[float]) -> pd.DataFrame:
    """The pairs of each attacker, and in how many of them it succeeds."""
    query = """
        SELECT effect, role, receivers, among, threshold, attacker, count(*) AS bottom,
            count_if(coalesce(score >= threshold, false) = (effect = 'inserted')) AS top
        FROM pairs, (SELECT unnest($thresholds) AS threshold)
        GROUP BY ALL ORDER BY effect, role, receivers, among DESC, threshold, attacker
    """
    return _asked(run, query, thresholds=[float(threshold) for threshold in thresholds])


def per_lie(run: Run, thresholds: Sequence[float] = THRESHOLDS) -> pd.DataFrame:
    """Share of the fabricated detections received by an honest vehicle that at least one of these vehicles believes.

    It grows with the number of receivers.

    Returns
    -------
    role, threshold, n (lies: the denominator), share, low, high, n_units (attackers).
    """
    query = """
        , lies AS (
            SELECT role, attacker, max(score) AS best FROM ghosts WHERE among = 'received'
            GROUP BY role, attacker, detection_step, observer, detection_index
        )
        SELECT role, threshold, attacker, count(*) AS bottom, count_if(coalesce(best >= threshold, false)) AS top
        FROM lies, (SELECT unnest($thresholds) AS threshold) GROUP BY ALL ORDER BY role, threshold, attacker
    """
    lies = _asked(run, query, thresholds=list(thresholds))
    return by_group(lies, ["role", "threshold"])


def believed_duration(run: Run, threshold: float = 0.5) -> pd.DataFrame:
    """How long an honest vehicle goes on believing one attacker: successive sensing steps with a believed lie of it.

    Returns
    -------
    role, among, n (stretches), mean_s, low, high (clustered by attacker), n_units. A stretch that the end of the run
    cuts off counts as long as it was observed.
    """
    query = """
        SELECT DISTINCT role, among, attacker, receiver, step FROM ghosts WHERE score >= $threshold
        ORDER BY among DESC, role, attacker, receiver, step
    """
    steps = _asked(run, query, threshold=threshold)
    every = interval_steps(run, steps.receiver.to_numpy(np.int64))
    same = ["role", "among", "attacker", "receiver"]
    is_first = steps.groupby(same, sort=False).step.diff().isna()
    steps["begins"] = is_first | (steps.step.diff() > every)
    steps["held_s"] = every * run.dt_s
    of_attacker = steps.groupby(same[:3], sort=False).agg(bottom=("begins", "sum"), top=("held_s", "sum"))
    return by_group(of_attacker.reset_index(), ["role", "among"], ratio, "mean_s")


def false_in_path(run: Run, threshold: float = 0.5) -> pd.DataFrame:
    """How wrong a victim's view is: fabricated boxes in the path of honest vehicles that it believes.

    Returns
    -------
    among (every honest vehicle that received a lie in a step, or those at which one was aimed), n (vehicle-steps: the
    denominator), share with a believed fabricated box in the path, low, high (clustered by vehicle), n_units
    (vehicles), boxes_mean (fabricated boxes believed in the path per vehicle-step; a box reported by several attackers
    counts once for each).
    """
    query = """
        , seconds AS (
            SELECT among, receiver, count_if(in_path AND coalesce(score >= $threshold, false)) AS n
            FROM ghosts GROUP BY among, receiver, step
        )
        SELECT among, receiver, count(*) AS bottom, count_if(n > 0) AS top, sum(n)::BIGINT AS boxes
        FROM seconds GROUP BY ALL ORDER BY among DESC, receiver
    """
    seconds = _asked(run, query, threshold=threshold)
    total = seconds.groupby("among", sort=False)[["boxes", "bottom"]].sum()
    found = by_group(seconds, ["among"])
    return found.assign(boxes_mean=(total.boxes / total.bottom).to_numpy())


def damage(run: Run, threshold: float = 0.5) -> pd.DataFrame:
    """Believed ghosts x seconds x victims: each fabricated detection that an honest vehicle believes in a sensing step
    counts for the time to the next one.

    Returns
    -------
    role (of the attacker), among, n (attackers with a lie that an honest vehicle received), total_s, per_attacker_s,
    low, high (clustered by attacker), n_units (these attackers).
    """
    query = """
        SELECT role, among, attacker, receiver, count_if(coalesce(score >= $threshold, false)) AS n
        FROM ghosts GROUP BY ALL ORDER BY among DESC, role, attacker, receiver
    """
    pairs = _asked(run, query, threshold=threshold)
    every = interval_steps(run, pairs.receiver.to_numpy(np.int64))
    pairs["top"] = pairs.n * every * run.dt_s
    of_attacker = pairs.groupby(["role", "among", "attacker"], sort=False).top.sum().reset_index().assign(bottom=1)
    found = by_group(of_attacker, ["role", "among"], ratio, "per_attacker_s")
    return found.assign(total_s=found.per_attacker_s * found.n)


def _asked(run: Run, query: str, **values: Any) -> pd.DataFrame:
    """What SQL answers about pairs. ValueError if the run has none."""
    found = run.sql(_PAIRS + query, **values)
    if found.empty and run.sql(f"{_PAIRS} SELECT * FROM pairs LIMIT 1").empty:
        if run.variant != "base" and run.n_rows("attack_outcomes"):
            raise run.lacks("effect of an attack", "the variant fuses nothing. Give it fused = true and run again.")
        raise run.lacks(
            "effect of an attack",
            "no fabricated object reached another vehicle, and no message that withholds one. Raise the share_p of an "
            "attack that sends some, or run longer than its start_s. Attacks that change real detections or "
            "evaluations have no such effect; the topic misbehaviour measures those.",
        )
    return found
