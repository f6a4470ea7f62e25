"""Distributions of durations of encounters and of the times between them, fitted under censoring."""

import pandas as pd

from cosim.addons.durations.fit import fits as fits_of
from cosim.addons.durations.goodness import kolmogorov_smirnov, product_limit
from cosim.addons.durations.samples import What, definitions, of_run
from results.metrics.encounters import DEFINITION, Departure
from results.run import Run


def fits(run: Run, what: What = "duration", departure: Departure = "ends", ks_draws: int = 0) -> pd.DataFrame:
    """Families of distributions by definition of an encounter, the one with the lowest AIC first.

    Parameters
    ----------
    run
        An opened run.
    what
        `duration` of encounters (of links, if the hysteresis is 0), or `inter_contact`: the times between them.
    departure
        Whether an actor that leaves the simulation ends its encounters, or censors them.
    ks_draws
        Draws of the parametric bootstrap of the Kolmogorov-Smirnov distance.

    Returns
    -------
    The columns of `DEFINITION`; family; n, n_ended; aic, bic and delta_aic (to the best family); ks, the
    Kolmogorov-Smirnov distance to the Kaplan-Meier curve, and ks_p; parameters, as a dictionary of names and (value,
    low, high). A definition with too few ends has no rows.
    """
    rows = []
    for _, definition in definitions(run).iterrows():
        sample = of_run(run, what, definition, departure)
        try:
            found = fits_of(sample)
        except ValueError:
            continue
        for one in found:
            ks = kolmogorov_smirnov(sample, one, ks_draws)
            rows.append(
                {column: definition[column] for column in DEFINITION}
                | {
                    "family": one.family.label,
                    "n": one.n,
                    "n_ended": one.n_ended,
                    "aic": one.aic,
                    "bic": one.bic,
                    "delta_aic": one.aic - found[0].aic,
                    "ks": ks.value,
                    "ks_p": ks.p_value,
                    "parameters": one.parameters(),
                }
            )
    columns = [*DEFINITION, "family", "n", "n_ended", "aic", "bic", "delta_aic", "ks", "ks_p", "parameters"]
    return pd.DataFrame(rows, columns=columns)


def survival(run: Run, what: What = "duration", departure: Departure = "ends") -> pd.DataFrame:
    """Kaplan-Meier curves by definition of an encounter, see `cosim.addons.durations.goodness.product_limit`."""
    parts = []
    for _, definition in definitions(run).iterrows():
        curve = product_limit(of_run(run, what, definition, departure))
        parts.append(curve.assign(**{column: definition[column] for column in DEFINITION}))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
