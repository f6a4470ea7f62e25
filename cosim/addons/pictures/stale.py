"""Where and when the trust that receivers look up is stale."""

import pandas as pd

from results.metrics.freshness import FRESH_S
from results.metrics.lookups import no_lookups
from results.run import Run


def placed(run: Run, fresh_s: float = FRESH_S) -> pd.DataFrame:
    """Lookups of trust by place and time.

    Returns
    -------
    A row for each receiver and step: step, x_m and y_m of the receiver, n lookups, n_stale of them.
    """
    found = run.sql(
        """
        SELECT l.step, x_m, y_m, count(*) AS n,
            count(*) - count(*) FILTER (newest_evaluation_age_s <= $fresh_s) AS n_stale
        FROM trust_lookups l JOIN actors a ON a.step = l.step AND a.actor = l.receiver
        WHERE variant = $variant GROUP BY l.step, receiver, x_m, y_m ORDER BY l.step, receiver
    """,
        fresh_s=fresh_s,
    )
    if found.empty:
        raise no_lookups(run)
    return found
