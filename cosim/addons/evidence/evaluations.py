"""How right evaluations are: how often honest vehicles deny what is true, and confirm what is not there.

These rates decide every trust value. Evaluations are those that honest vehicles make, with visibility above 0, of
detections that vehicles sent; unless said otherwise, those that another vehicle sent. An evaluation denies a detection
if it is negative: the detection matches none of the evaluator's own. It confirms it if it is positive. An evaluator
that finds no match but knows nothing about the place (visibility 0, see `trust.denials`) neither denies nor confirms.
"""

from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from results.metrics.intervals import by_group, columns, share
from results.metrics.trust import HONEST
from results.run import Run
from results.sensing import sampling_stride

KINDS = ("self report", "true detection", "false positive", "fabricated")
"""What is evaluated: the sender's report of itself, a box of its detector that belongs to an actor, one that belongs to
none, and one that an attack made up. Of the first three, only those count that no attack changed."""
SPLITS = ("evaluator", "class", "visibility", "distance", "role")
_BY = ("all", *SPLITS)
"""Properties in the order of the rows; the first splits nothing."""
EVALUATORS = ("the sender", "another vehicle")
_VISIBILITY = (0.0, 0.25, 0.5, 0.75, 1.0)
_DISTANCE_M = (0.0, 20.0, 40.0, 60.0, np.inf)
_MOST_ROWS = 5_000_000
"""Evaluations that suffice: of a run with more, those of evenly spread steps."""


def rates(run: Run) -> pd.DataFrame:
    """Rates of evaluations by what is evaluated, of all and split by one property after another.

    Returns
    -------
    kind (`KINDS`); by ("all" or one of `SPLITS`: whether another vehicle evaluates or the sender its own list, class of
    the detection, visibility and distance of the evaluator to the box, role of the vehicle that sent it); value;
    n (evaluations); denied and confirmed: shares of them; missed: share of the denials in which the evaluator's own
    detector reported nothing of that actor in that step (in the others, its box lies too far away to match). Shares
    have intervals clustered by evaluator.
    """
    counts = run.once_for_all("evaluations.rates", lambda: _counts(run))
    rows = []
    for (by, kind, value), of in counts.groupby(["by", "kind", "value"], sort=True):
        n, denied = of.n.to_numpy(), of.denied.to_numpy()
        row = {"kind": kind, "by": by, "value": value, "n": int(n.sum())}
        row |= columns(share(denied, n), "denied")
        row |= columns(share(of.confirmed.to_numpy(), n), "confirmed")
        row |= columns(share(of.missed.to_numpy(), denied), "missed")
        rows.append(row)

    def place(row: dict[str, Any]) -> tuple[int, int]:
        return _BY.index(row["by"]), KINDS.index(row["kind"])

    rows.sort(key=place)
    return pd.DataFrame(rows)


def boxes_of_no_actor(run: Run) -> pd.DataFrame:
    """Share of boxes that belong to no actor, among the boxes of their detectors that honest vehicles sent.

    Returns
    -------
    class (or "all"), n, share, with its interval clustered by the vehicle that sent them.
    """
    found = run.sql(f"""
        SELECT coalesce(class, 'all') AS class, vehicle, count_if(truth_actor IS NULL) AS top, count(*) AS bottom
        FROM detections JOIN subjects ON pseudonym = observer AND role = '{HONEST}'
        WHERE origin = 'sensed' AND transmitted AND NOT lied
        GROUP BY GROUPING SETS ((vehicle), (class, vehicle)) ORDER BY ALL
    """)
    if found.empty:
        raise ValueError(f"{run.path} holds no detections of honest vehicles. Equip vehicles, or set sensing = true.")
    return by_group(found, ["class"])


def named_rates(run: Run) -> pd.DataFrame:
    """The rows of `rates` that are metrics, with a name of each as `group`."""
    found = rates(run)
    usual = found.by.isin(["all", "evaluator"])
    fabricated = found.kind == KINDS[-1]
    split = ", " + found.by + " " + found.value
    found["group"] = found.kind + split.where(found.by != "all", "")
    found.loc[~usual, "confirmed"] = np.nan
    has_no_missed = fabricated | (found.kind == KINDS[2]) | (found.by != "all")
    found.loc[has_no_missed, "missed"] = np.nan
    return found[usual | ~fabricated]


def _counts(run: Run) -> pd.DataFrame:
    """by, kind, value, vehicle (that evaluates), n, denied, confirmed, missed."""
    run.require("actors")
    whole = of_blocks(run, _QUERY)
    if whole.empty:
        raise ValueError(
            f"{run.path} holds no evaluations by honest vehicles. Equip vehicles, lower the share_p of an attack, or "
            "raise radio.range_m."
        )
    return whole.groupby(["by", "kind", "value", "vehicle"], as_index=False).sum()


def of_blocks(run: Run, query: str) -> pd.DataFrame:
    """What SQL answers about evaluations, block by block.

    Parameters
    ----------
    query
        Asks for the evaluations of the steps from `$begin` to `$last`; their detections are of the steps from `$first`
        to `$last`. It may count one in `$every` of something, so that not many more count than suffice.
    """
    run.require("evaluations", "detections")
    every = sampling_stride(run, -(-run.n_rows("evaluations") // _MOST_ROWS))
    found = []
    for part in run.inventory.of("evaluations"):
        begin, last = part.first_step, part.last_step
        first = run.sql_of_steps(_EARLIEST, begin, last).first.item()
        found.append(run.sql_of_steps(query, min(first, begin), last, begin=begin, every=every))
    return pd.concat(found, ignore_index=True)


_EARLIEST = """
SELECT coalesce(min(detection_step), $first) AS first FROM evaluations WHERE step BETWEEN $first AND $last
"""


def _bins(value: str, edges: tuple[float, ...], unit: str) -> str:
    """SQL that names the bin of a value; each bin is without its lower edge and with its upper one."""
    cases = ""
    for low, high in pairwise(edges):
        if high < np.inf:
            cases += f" WHEN {value} <= {high} THEN '{low:g} to {high:g}{unit}'"
        else:
            cases += f" ELSE 'over {low:g}{unit}'"
    return f"CASE{cases} END"


_AWAY_M = "sqrt((d.x_m - a.x_m)::DOUBLE ** 2 + (d.y_m - a.y_m)::DOUBLE ** 2)::FLOAT"


def _group(by: str, value: str, among: str = f"WHERE evaluator = '{EVALUATORS[1]}'") -> str:
    """SQL that counts evaluations by one property."""
    return (
        f"SELECT '{by}' AS by, kind, {value} AS value, vehicle, count(*) AS n, count_if(denied) AS denied, "
        f"count_if(confirmed) AS confirmed, count_if(missed) AS missed FROM looked {among} GROUP BY ALL"
    )


_GROUPS = " UNION ALL ".join(
    (
        _group("evaluator", "evaluator", ""),
        _group("all", "'all'"),
        *map(_group, SPLITS[1:], SPLITS[1:]),
    )
)
_QUERY = f"""
WITH said AS MATERIALIZED (
    SELECT e.*, vehicle FROM evaluations e JOIN subjects s ON s.pseudonym = e.evaluator AND s.role = '{HONEST}'
    WHERE e.visibility > 0 AND NOT e.lied AND e.kind = 'detection' AND e.step % $every = 0
        AND e.step BETWEEN $begin AND $last
), made AS (
    SELECT * FROM detections WHERE step BETWEEN $first AND $last
), looked AS MATERIALIZED (
    SELECT s.vehicle,
        CASE WHEN d.origin = 'self' THEN '{KINDS[0]}' WHEN d.origin = 'fabricated' THEN '{KINDS[3]}'
            WHEN d.truth_actor IS NOT NULL THEN '{KINDS[1]}' ELSE '{KINDS[2]}' END AS kind,
        if(of.vehicle = s.vehicle, '{EVALUATORS[0]}', '{EVALUATORS[1]}') AS evaluator,
        d.class, of.role, {_bins("s.visibility", _VISIBILITY, "")} AS visibility,
        {_bins(_AWAY_M, _DISTANCE_M, " m")} AS distance,
        s.evaluation < 0 AS denied, s.evaluation > 0 AS confirmed, s.evaluation < 0 AND own.step IS NULL AS missed
    FROM said s
    JOIN made d ON d.step = s.detection_step AND d.observer = s.observer AND d.detection_index = s.detection_index
    JOIN (SELECT * FROM actors WHERE step BETWEEN $begin AND $last) a ON a.step = s.step AND a.actor = s.vehicle
    JOIN subjects of ON of.pseudonym = s.observer
    LEFT JOIN (SELECT DISTINCT step, observer, truth_actor FROM made WHERE origin = 'sensed') own
        ON own.step = s.step AND own.observer = s.evaluator AND own.truth_actor = d.truth_actor
    WHERE d.transmitted AND (NOT d.lied OR d.origin = 'fabricated')
)
{_GROUPS}
"""
"""The evaluations of some steps that count, counted by kind and by one property after another."""
