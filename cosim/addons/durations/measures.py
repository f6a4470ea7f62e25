"""Figures of contacts that stand beside published ones in `cosim compare`.

Contacts are those of the run's definition with the largest radius, and of these that with the least hysteresis.
Definitions that count pedestrians stand back behind those of vehicles alone.
"""

from dataclasses import replace

import numpy as np
import pandas as pd

from cosim.addons.durations.fit import fit, fits
from cosim.addons.durations.goodness import product_limit
from cosim.addons.durations.samples import Durations, What, definitions, of_run
from results.metrics.survival import median
from results.run import Run


def family_rank(run: Run, *, what: What, family: str) -> list[float]:
    """Rank of a family of distributions by AIC; 1 is the best."""
    return [1.0 + [one.name for one in fits(_sample(run, what, ""))].index(family)]


def tail_shape(run: Run, *, what: What, has_los: bool = False, vehicle_class: str = "") -> list[float]:
    """Shape of the generalised Pareto distribution beyond the median of the observed ends.

    0 is an exponential tail, above 0 a power law.

    Parameters
    ----------
    has_los
        Contacts that need a line of sight.
    vehicle_class
        Only contacts of two vehicles of this class; all if empty.
    """
    sample = _sample(run, what, vehicle_class, has_los)
    if not sample.ended.any():
        raise ValueError(f"{run.path.name}: no end of a contact was observed. Run longer.")
    ends_s = np.sort(sample.low_s[sample.ended])
    split_s = float(ends_s[len(ends_s) // 2])
    tail = sample.take(sample.low_s >= split_s - 1e-9)
    tail = replace(tail, entry_s=np.minimum(np.maximum(tail.entry_s, split_s), tail.low_s))
    return [fit(tail, "generalised_pareto").parameters()["shape"][0]]


def median_duration(run: Run) -> list[float]:
    """Median duration of contacts (Kaplan-Meier) [s]; NaN if more than half last longer than what was observed."""
    sample = _sample(run, "duration", "")
    return [median(product_limit(sample)) - sample.step_s / 2]  # ends are at the upper edges of steps


def _sample(run: Run, what: What, vehicle_class: str, has_los: bool = False) -> Durations:
    sample = of_run(run, what, _definition(run, has_los))
    if not vehicle_class:
        return sample
    vehicles = run.table("vehicles", ["vehicle", "vehicle_class"])
    some = vehicles.vehicle[vehicles.vehicle_class == vehicle_class].to_numpy()
    return sample.take(np.isin(sample.a, some) & np.isin(sample.b, some))


def _definition(run: Run, has_los: bool) -> pd.Series:
    found = definitions(run)
    found = found[found.pairs.isin(("los", "all_los")) == has_los]
    if found.empty:
        kind = "with" if has_los else "without regard to"
        raise ValueError(
            f"{run.path.name} has no encounters {kind} line of sight. Add such a section to [[encounters]]."
        )
    return found.sort_values(["pedestrians", "radius_m", "hysteresis_s"], ascending=[True, False, True]).iloc[0]
