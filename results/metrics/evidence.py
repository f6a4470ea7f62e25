"""Audit of evidence: how often one look counts more than once on its way into trust values and fused scores."""

import numpy as np
import pandas as pd

from results.run import Run


def multiplicity(run: Run) -> pd.DataFrame:
    """One row: trust and fused (how often a look counts), echoes (share of the evaluations), copies (per evaluation).

    NaN where there is nothing to count; of the run's variant.
    """
    return pd.DataFrame([_ratios(_counts(run).sum())])


def evaluators_per_object(run: Run) -> float:
    """Mean number of evaluators behind a fused object, of the run's variant; NaN where no objects were fused."""
    n_objects = sum(len(part) for part in run.variant_parts("fused", ["step"]))
    return float(run.variant_table("fused_evidence").n_evaluators.sum() / n_objects) if n_objects else np.nan


def over_time(run: Run, every_s: float = 10.0) -> pd.DataFrame:
    """The same in windows of time: time_s (of their start) and the columns of `multiplicity`."""
    counts = _counts(run)
    slots = counts.groupby(np.floor(counts.index * run.dt_s / every_s) * every_s).sum()
    return pd.DataFrame([{"time_s": time_s} | _ratios(total) for time_s, total in slots.iterrows()])


def _counts(run: Run) -> pd.DataFrame:
    """Counts of both tables by step; those of fused objects as n_fused_evaluations and n_fused_evaluators."""
    fused = run.variant_table("fused_evidence", ["step", "n_evaluations", "n_evaluators"]).set_index("step")
    fused.columns = ["n_fused_evaluations", "n_fused_evaluators"]
    return run.evidence.set_index("step").join(fused)


def _ratios(total: pd.Series) -> dict[str, float]:
    def over(a: str, b: str) -> float:
        return float(total[a] / total[b]) if total[b] else float("nan")

    return {
        "trust": over("n_evaluations", "n_looks"),
        "fused": over("n_fused_evaluations", "n_fused_evaluators"),
        "echoes": over("n_echoes", "n_evaluations"),
        "copies": over("n_copies", "n_evaluations"),
    }
