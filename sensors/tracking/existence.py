"""How likely it is that the object of a track exists."""

import numpy as np
import scipy
from jaxtyping import Float
from numpy import ndarray

from sensors.tracking.params import TrackingParams


def existence_gain(
    score: Float[ndarray, "n"], since_s: Float[ndarray, "n"], params: TrackingParams
) -> Float[ndarray, "n"]:
    """Log-odds of existence that a track gains by a further detection.

    Parameters
    ----------
    score
        Score of the detection.
    since_s
        Time since the detection before.
    params
        The parameters.

    Returns
    -------
    One value per detection; negative for low scores.

    Notes
    -----
    Bayes' rule in log-odds: the posterior odds are the prior odds times the likelihood ratio of the detection and its
    score. The idea of a probability of existence per track is that of integrated probabilistic data association [1]_,
    of which we read the abstract only. Deviations: the likelihood ratio is a logistic function of the score, fitted to
    recorded detections. It counts by 1 - exp(-t / existence_memory_s), because misses and false positives of a real
    detector persist. A miss changes nothing: in the fit its coefficient was 0.06.

    .. [1] D. Musicki, R. Evans, S. Stankovic, Integrated probabilistic data association, IEEE Transactions on Automatic
       Control 39(6), 1994.
    """
    gain = params.existence_again + existence_of_score(score, params)
    memory_s = params.existence_memory_s
    if memory_s == 0:
        return gain
    return -np.expm1(-since_s / memory_s) * gain


def existence_of_score(score: Float[ndarray, "n"], params: TrackingParams) -> Float[ndarray, "n"]:
    """Log-odds of existence by the score alone; 0 at 0.5."""
    return params.existence_score * scipy.special.logit(np.clip(score, *params.existence_scores))
