"""Audit of evidence: how often one look counts more than once on its way into trust values and fused scores."""

import pandas as pd

from results.run import WINDOW_S, Run

_RATIOS = """
    sum(e.n_evaluations) / nullif(sum(n_looks), 0) AS trust,
    sum(f.n_evaluations) / nullif(sum(n_evaluators), 0) AS fused,
    sum(n_echoes) / nullif(sum(e.n_evaluations), 0) AS echoes,
    sum(n_copies) / nullif(sum(e.n_evaluations), 0) AS copies
    FROM evidence e LEFT JOIN (FROM fused_evidence WHERE variant = $variant) f USING (step)
"""


def multiplicity(run: Run) -> pd.DataFrame:
    """One row: trust and fused (how often a look counts), echoes (share of the evaluations), copies (per evaluation).

    NaN where there is nothing to count; of the run's variant.
    """
    return run.sql(f"SELECT {_RATIOS}")


def evaluators_per_object(run: Run) -> float:
    """Mean number of evaluators behind a fused object, of the run's variant; NaN where no objects were fused."""
    found = run.sql("""
        SELECT (SELECT sum(n_evaluators) FROM fused_evidence WHERE variant = $variant) / nullif(count(*), 0) AS mean
        FROM fused WHERE variant = $variant
    """)
    return float(found["mean"].iloc[0])


def over_time(run: Run, every_s: float = 10.0) -> pd.DataFrame:
    """A row per window of time: time_s (of their start) and the columns of `multiplicity`."""
    return run.sql(f"SELECT {WINDOW_S} AS time_s, {_RATIOS} GROUP BY time_s ORDER BY time_s", every_s=every_s)
