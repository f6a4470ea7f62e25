"""Fits families to durations that are censored and truncated, by maximum likelihood."""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import optimize, stats

from cosim.addons.durations.dyads import sum_of_products
from cosim.addons.durations.families import FAMILIES, Family, Free
from cosim.addons.durations.samples import Durations
from results.metrics.intervals import LEVEL

FEWEST_ENDED = 20
"""With fewer observed ends, nothing is fitted."""
_STEP = 1e-4
"""Step of the numerical derivatives, in free parameters."""
_TEN, _TWO = np.polynomial.legendre.leggauss(10), np.polynomial.legendre.leggauss(2)
_NEAR_STEPS = 10
"""Below so many steps, the mean of a survival function over a step is computed with more points."""


@dataclass(frozen=True, slots=True)
class _Distinct:
    """The different rows of a sample, and how often each occurs."""

    low_s: Float[ndarray, "m"]
    high_s: Float[ndarray, "m"]
    entry_s: Float[ndarray, "m"]
    n: Float[ndarray, "m"]
    row: Int[ndarray, "n"]
    """Which of them each row of the sample is."""
    edges_s: Float[ndarray, "e"]
    """The different ends and entries."""
    at: Int[ndarray, "3 m"]
    """Where among them the lower end, the upper end and the entry of each row are."""
    step_s: float

    @staticmethod
    def of(sample: Durations) -> "_Distinct":
        rows = np.column_stack([sample.low_s, sample.high_s, sample.entry_s])
        rows, row, n = np.unique(rows, axis=0, return_inverse=True, return_counts=True)
        edges_s, at = np.unique(rows.T, return_inverse=True)
        return _Distinct(
            low_s=rows[:, 0],
            high_s=rows[:, 1],
            entry_s=rows[:, 2],
            n=n.astype(float),
            row=row.ravel(),
            edges_s=edges_s,
            at=at.reshape(3, -1),
            step_s=sample.step_s,
        )


@dataclass(frozen=True, slots=True)
class Fit:
    """A family with its most likely parameters."""

    name: str
    """Key of `FAMILIES`."""
    free: Free
    covariance: Float[ndarray, "k k"]
    """Of the free parameters; NaN where the likelihood has no maximum inside."""
    independent: Float[ndarray, "k k"]
    """Their covariance if durations were independent."""
    rows: _Distinct = field(repr=False)
    """The sample."""
    log_likelihood: float
    n: int
    n_ended: int
    n_units: int
    """Actors in the sample."""

    @property
    def family(self) -> Family:
        return FAMILIES[self.name]

    @property
    def aic(self) -> float:
        """Akaike's information criterion: -2 log-likelihood + 2 parameters."""
        return 2 * len(self.free) - 2 * self.log_likelihood

    @property
    def bic(self) -> float:
        """Bayesian information criterion, with the number of observed ends as sample size [1]_.

        References
        ----------
        .. [1] Volinsky, Raftery, "Bayesian information criterion for censored survival models", Biometrics 56, 2000.
        """
        return len(self.free) * math.log(self.n_ended) - 2 * self.log_likelihood

    def parameters(self) -> dict[str, tuple[float, float, float]]:
        """Value, lower and upper end of the interval of each parameter, by name.

        Notes
        -----
        The interval holds the values whose profile likelihood is near the maximum: twice the difference of logarithms
        is at most t^2, after it is scaled to the covariance of dependent durations [1]_. n actors make n / 2 pairs that
        share none, at least, so Student's t has n / 2 - k degrees of freedom, for k parameters. The covariance is taken
        larger by n / (n - 2 k), because the scores were fitted to the sample.

        References
        ----------
        .. [1] Chandler, Bate, "Inference for clustered data using the independence loglikelihood", Biometrika 94(1),
           2007.
        """
        values = self.family.natural(self.free).tolist()
        found = {}
        for i, name in enumerate(self.family.parameters):
            ends = self._end(i, -1), self._end(i, 1)
            found[name] = values[i], *ends
        return found

    def _end(self, i: int, sign: int) -> float:
        """End of the interval of a parameter on one side: NaN if not known, the parameter's bound if there is none."""
        k = len(self.free)
        variance, pairs = self.covariance[i, i], self.n_units / 2
        if not variance > 0 or pairs <= k:
            return float("nan")
        others = np.delete(np.arange(k), i)
        slope = self.independent[others, i] / self.independent[i, i]  # of the others along the profile
        freedom = pairs - k
        quantile = stats.t.ppf((1 + LEVEL) / 2, freedom)
        half = quantile * math.sqrt(variance * pairs / freedom)
        fall = half**2 / self.independent[i, i] / 2

        def beyond(away: float) -> float:
            """How far the profile likelihood is below the end of the interval."""
            free = self.free.copy()
            free[i] += sign * away

            def minus(rest: Free) -> float:
                free[others] = rest
                value = float(self.rows.n @ _log_likelihoods(self.family, self.rows, free))
                return -value if np.isfinite(value) else 1e12

            guess = self.free[others] + sign * away * slope
            least = minus(guess)
            if len(others):
                found = optimize.minimize(minus, guess, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-5})
                least = float(found.fun)
            return least + self.log_likelihood - fall

        free, far = self.free.copy(), half
        while beyond(far) < 0:
            far *= 1.5
            if far > 20 * half:
                free[i] = sign * math.inf
                return float(self.family.natural(free)[i])
        free[i] += sign * optimize.brentq(beyond, 0.0, far, xtol=1e-3 * half)
        return float(self.family.natural(free)[i])

    def survival(self, x_s: Float[ndarray, "n"], entry_s: float = 0.0) -> Float[ndarray, "n"]:
        """Share that lasts longer than `x_s`, of those that last longer than `entry_s`, as the sample counts them."""
        edges_s = np.r_[entry_s, np.maximum(x_s, entry_s)]
        with np.errstate(divide="ignore"):  # nothing may last so long
            given, *logs = log_counted(self.family, self.free, edges_s, self.rows.step_s)
        return np.exp(np.minimum(np.array(logs) - given, 0.0))


def log_counted(family: Family, free: Free, edges_s: Float[ndarray, "e"], step_s: float) -> Float[ndarray, "e"]:
    """Logarithm of the probability that a duration is counted as longer than each edge.

    Parameters
    ----------
    edges_s
        Edges of intervals, ascending from the first that is not below half a step.
    step_s
        Length of the steps in which durations are counted. With 0 this is the survival function.

    Notes
    -----
    Steps that fall anywhere add to a duration a time that is uniform between minus and plus half a step, so the
    probability is the mean of the survival function over one step around the edge. Gauss-Legendre quadrature with two
    points has an error of h^4 S'''' / 4320; ten points serve near 0, where derivatives may be infinite.
    """
    if step_s == 0.0:
        return family.log_sf(edges_s, free)
    near = edges_s < _NEAR_STEPS * step_s
    rules = ((near, _TEN), (~near, _TWO))
    at = []
    for rows, (x, _) in rules:
        offset_s = x[:, None] * step_s / 2
        at.append(np.maximum(edges_s[rows] + offset_s, 0.0))
    log_sf = family.log_sf(np.concatenate([points.ravel() for points in at]), free)
    logs = np.empty(len(edges_s))
    each = np.split(log_sf, [at[0].size])
    for (rows, (_, weight)), points, values in zip(rules, at, each, strict=True):
        values = values.reshape(points.shape)
        most = np.where(np.isfinite(values[0]), values[0], 0.0)  # at the first point, beyond which fewer are left
        mean = weight / 2 @ np.exp(values - most)
        logs[rows] = most + np.log(mean)
    return logs


def fit(sample: Durations, name: str) -> Fit:
    """The most likely distribution of a family.

    Parameters
    ----------
    sample
        Durations in intervals.
    name
        Key of `FAMILIES`.

    Raises
    ------
    ValueError
        In one line, if too few ends were observed.

    Notes
    -----
    Each duration contributes (S(low) - S(high)) / S(entry), with S(inf) = 0. SciPy's `CensoredData` has no entries,
    so the likelihood is written here, and the distributions and the optimisation are SciPy's.

    The covariance is H^-1 M H^-1 [1]_, where H is the second derivative of the log-likelihood and M the sum of products
    of the scores of any two durations that share an actor [2]_. For independent durations M estimates H, and the
    intervals are the usual ones.

    References
    ----------
    .. [1] White, "Maximum likelihood estimation of misspecified models", Econometrica 50(1), 1982.
    .. [2] Aronow, Samii, Assenova, "Cluster-robust variance estimation for dyadic data", Political Analysis 23, 2015.
    """
    n_ended = int(sample.ended.sum())
    if n_ended < FEWEST_ENDED:
        raise ValueError(f"{n_ended} observed ends are too few to fit a distribution; {FEWEST_ENDED} are needed.")
    family, distinct = FAMILIES[name], _Distinct.of(sample)

    def minus(free: Free) -> float:
        value = float(distinct.n @ _log_likelihoods(family, distinct, free))
        return -value if np.isfinite(value) else 1e12

    low_s, high_s = distinct.low_s, distinct.high_s
    middle = np.where(np.isinf(high_s), low_s, (low_s + high_s) / 2)
    order = np.argsort(middle)
    n_up_to = np.cumsum(distinct.n[order])
    half = np.searchsorted(n_up_to, distinct.n.sum() / 2)
    median_s = float(middle[order][half])
    # Total time over observed ends: the estimate of the mean if the distribution is exponential.
    mean_s = float(distinct.n @ (middle - distinct.entry_s)) / n_ended
    starts = family.starts(max(median_s, 1e-9), max(mean_s, 1e-9))
    best = min((_climb(minus, start) for start in starts), key=minus)
    covariance, independent = _covariances(family, distinct, sample, best)
    return Fit(
        name=name,
        free=best,
        covariance=covariance,
        independent=independent,
        rows=distinct,
        log_likelihood=-minus(best),
        n=len(sample),
        n_ended=n_ended,
        n_units=len(np.unique(np.r_[sample.a, sample.b])),
    )


def fits(sample: Durations) -> list[Fit]:
    """All families, the one with the lowest AIC first."""
    return sorted((fit(sample, name) for name in FAMILIES), key=lambda found: found.aic)


def _climb(minus, start: Free) -> Free:
    """The nearest minimum: without derivatives, which the edges of a family's support have not, then polished."""
    rough = optimize.minimize(
        minus, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-6, "maxiter": 4000}
    )
    fine = optimize.minimize(minus, rough.x, method="BFGS", options={"gtol": 1e-5})
    return fine.x if fine.fun < rough.fun else rough.x


def _log_likelihoods(family: Family, rows: _Distinct, free: Free) -> Float[ndarray, "m"]:
    with np.errstate(all="ignore"):
        values = log_counted(family, free, rows.edges_s, rows.step_s)
        low, high, entry = values[rows.at]
        return low + np.log1p(-np.exp(high - low)) - entry


def _covariances(
    family: Family, rows: _Distinct, sample: Durations, free: Free
) -> tuple[Float[ndarray, "k k"], Float[ndarray, "k k"]]:
    """Sandwich covariance of the free parameters, and that of independent durations; NaN where the likelihood is flat
    or has no maximum."""
    k = len(free)
    unknown = np.full((k, k), np.nan)
    steps = np.eye(k) * _STEP

    def at(shift: ndarray) -> Float[ndarray, "m"]:
        return _log_likelihoods(family, rows, free + shift)

    slopes = [at(step) - at(-step) for step in steps]
    scores = np.column_stack(slopes) / (2 * _STEP)
    hessian = np.empty((k, k))
    for i in range(k):
        for j in range(i + 1):
            both = steps[i] + steps[j]
            apart = steps[i] - steps[j]
            mixed = at(both) - at(apart) - at(-apart)
            second = mixed + at(-both)
            curvature = float(rows.n @ second) / (4 * _STEP**2)
            hessian[i, j] = hessian[j, i] = curvature
    # Where a parameter says nothing (two equal means), its curvature is the rounding of a sum of logarithms.
    log_likelihood = float(rows.n @ at(np.zeros(k)))
    noise = 1e-15 * abs(log_likelihood) / _STEP**2
    if not np.isfinite(hessian).all() or not np.isfinite(scores).all():
        return unknown, unknown
    if np.linalg.eigvalsh(-hessian).min() <= max(1e-3, noise):
        return unknown, unknown
    inverse = np.linalg.inv(-hessian)
    meat = sum_of_products(scores[rows.row], sample.a, sample.b)
    return inverse @ meat @ inverse, inverse
