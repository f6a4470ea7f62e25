"""Amount of traffic."""

import pandas as pd

from cosim.base.codes import OBJECT, PARKED
from results.run import Run


def on_road(run: Run) -> pd.DataFrame:
    """who (all actors, or equipped vehicles), mean: how many of them are on the road, and duration_s of the run."""
    return run.sql(
        """
        SELECT 'all' AS who, coalesce(sum(n_steps), 0) / $steps AS mean, $steps * $dt_s AS duration_s
        FROM vehicles WHERE vehicle_class <> 'roadside_unit' AND NOT starts_with(sumo_id, $parked)
            AND NOT starts_with(sumo_id, $object)
        UNION ALL
        SELECT 'equipped', coalesce(sum(n_steps), 0) / $steps, $steps * $dt_s
        FROM vehicles WHERE vehicle_class <> 'roadside_unit' AND equipped
    """,
        parked=PARKED,
        object=OBJECT,
    )


def equipped(run: Run) -> pd.DataFrame:
    """role, and n: equipped vehicles of this role."""
    return run.roles.value_counts().sort_index().rename("n").reset_index()
