"""What makes encounters long: a proportional hazards model of their end (Cox 1972). statsmodels is known here alone."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy import stats

from results.durations.dyads import sum_of_products

LEVEL = 0.95
MISSING = (
    "A proportional hazards model needs statsmodels, which is not installed. Install it with: pip install "
    '"cosim-perception[hazards]"'
)


def proportional_hazards(frame: pd.DataFrame, covariates: Sequence[str]) -> pd.DataFrame:
    """Hazard ratios of the end of encounters, per standard deviation of each covariate.

    Parameters
    ----------
    frame
        One row per encounter: `lasted_steps`, `ended` (whether the end was observed), `a` and `b` (numbers of the two
        actors, unique over all cities), the covariates, and `city`. Each city has a baseline hazard of its own.
    covariates
        Columns that may change the hazard. A column that does not vary within any city is refused.

    Returns
    -------
    covariate, mean, sd, hazard_ratio with low and high (95 %), p. A ratio below 1 makes encounters longer. The standard
    deviation is that within cities.

    Raises
    ------
    ValueError
        In one line: statsmodels is missing, or a covariate says nothing.

    Notes
    -----
    Ties are handled as by Efron. The variance is the sandwich of score residuals, in which encounters that share an
    actor depend on each other (`dyads.sum_of_products`).
    """
    try:
        from statsmodels.duration.hazard_regression import PHReg
    except ImportError:
        raise ValueError(MISSING) from None
    centred = frame[[*covariates]] - frame.groupby("city")[[*covariates]].transform("mean")
    sd = centred.std()
    if (flat := [name for name in covariates if not sd[name] > 1e-12]) or len(frame) < 10 * len(covariates):
        raise ValueError(
            f"{', '.join(flat) or 'the covariates'} cannot be estimated from {len(frame)} encounters: no variation "
            "within a city. Use more runs, or leave the covariate out."
        )
    model = PHReg(
        frame.lasted_steps.to_numpy(float), (centred / sd).to_numpy(float), status=frame.ended.to_numpy(int),
        strata=pd.factorize(frame.city)[0], ties="efron",
    )  # fmt: skip
    found = model.fit(disp=0)
    inverse = np.asarray(found.cov_params())
    scores = np.nan_to_num(np.asarray(found.score_residuals))
    covariance = inverse @ sum_of_products(scores, frame.a.to_numpy(), frame.b.to_numpy()) @ inverse
    n_units = len(np.unique(np.r_[frame.a, frame.b]))
    error = np.sqrt(np.diag(covariance))
    half = stats.t.ppf((1 + LEVEL) / 2, n_units - 1) * error
    return pd.DataFrame({
        "covariate": list(covariates), "mean": frame[[*covariates]].mean().to_numpy(), "sd": sd.to_numpy(),
        "hazard_ratio": np.exp(found.params), "low": np.exp(found.params - half), "high": np.exp(found.params + half),
        "p": 2 * stats.t.sf(np.abs(found.params) / error, n_units - 1),
    })  # fmt: skip
