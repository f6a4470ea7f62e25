"""The predicted metrics of one trust server, from what a replay of the traffic has found."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.law import law
from cosim.addons.law.closed_form import Company, closed_form
from cosim.addons.law.scope import Server
from cosim.config.config import Config
from results.metrics.encounters import DEFINITION, named

_LEAST = 1e-9
"""A value below this is 0: chances that are certain differ from 1 by as much (`fleet`)."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Freshness of one trust variant, as metrics of a run define it."""

    variant: str
    period_s: float
    window_s: float
    age_s: Float[ndarray, "a"]
    """Ages that lookups can find [s]."""
    newest: Float[ndarray, "a"]
    """Expected lookups by the age of the newest evaluation."""
    oldest: Float[ndarray, "a"]
    value: Float[ndarray, "a"]
    metrics: dict[str, float]
    """Values by the identifier of the metric of a run (`cosim measure`), with the state after a colon."""
    low: dict[str, float] = field(default_factory=dict)
    """Lower end of the 95 % interval for one run."""
    high: dict[str, float] = field(default_factory=dict)
    closed: dict[str, float] = field(default_factory=dict)
    """Median and 90th percentile by the closed form."""
    definition: str = ""
    """Name of the definition of an encounter that counts, which is a group of the metric of a run."""


METRICS = {
    "freshness.newest_evaluation_age.median_s": "newest evaluation at lookup, median age [s]",
    "freshness.newest_evaluation_age.p90_s": "newest evaluation at lookup, 90th percentile [s]",
    "freshness.newest_evaluation_age.mean_s": "newest evaluation at lookup, mean age [s]",
    "freshness.oldest_evaluation_age.median_s": "oldest evaluation at lookup, median age [s]",
    "freshness.value_age.median_s": "value at lookup, median age [s]",
    "freshness.lookup_state.share:evaluated": "lookups: evaluated",
    "freshness.lookup_state.share:stale": "lookups: stale",
    "freshness.lookup_state.share:unevaluated": "lookups: unevaluated",
    "freshness.lookup_state.share:no value": "lookups: no value",
    "freshness.evaluators.mean": "evaluators behind a value, mean",
    "freshness.encounters_without_trust.share": "encounters over before trust was known",
}
"""Predicted metrics and their labels."""

_UNEVALUATED = "freshness.lookup_state.share:unevaluated"
"""With `trust.unseen = "zero"` alone there are such lookups; else their share is 0 without any error."""

MODEL_ERROR = {
    "freshness.newest_evaluation_age.median_s": 0.04,
    "freshness.newest_evaluation_age.p90_s": 0.09,
    "freshness.newest_evaluation_age.mean_s": 0.04,
    "freshness.oldest_evaluation_age.median_s": 0.04,
    "freshness.value_age.median_s": 0.06,
    "freshness.lookup_state.share:evaluated": 0.018,
    "freshness.lookup_state.share:stale": 0.01,
    _UNEVALUATED: 0.018,
    "freshness.lookup_state.share:no value": 0.018,
    "freshness.evaluators.mean": 0.055,
    "freshness.encounters_without_trust.share": 0.025,
}
"""How far runs lie outside the range that chance alone explains, in all but one of twenty: as a share of the value, and
for shares of lookups and encounters in absolute terms. The page `models/freshness-law` says from which runs. In these,
no lookup was unevaluated: that error is the one of lookups without a value, which they would be else."""


def with_intervals(own: Prediction, runs: Sequence[Mapping[str, float]]) -> Prediction:
    """The prediction with the range of drawn runs, given the metrics of each, and with the error of the law itself."""
    low, high = {}, {}
    for name, value in own.metrics.items():
        values = np.array([run[name] for run in runs])
        values = values[np.isfinite(values)]
        if len(values) and np.isfinite(value):
            scale, largest = (1.0, 1.0) if "share" in name else (value, np.inf)
            is_none = name == _UNEVALUATED and value == 0
            error = 0.0 if is_none else MODEL_ERROR[name] * scale
            low[name] = max(0.0, float(values.min()) - error)
            high[name] = min(float(values.max()) + error, largest)
    return replace(own, low=low, high=high)


@dataclass(frozen=True, slots=True)
class FleetFindings:
    """What a replay of the traffic has found about one fleet."""

    evidence: law.EvidenceChances
    since: Int[ndarray, "s"]
    """Step in which each subject sensed first."""
    pair_steps: law.PairSteps
    pair_subject: Int[ndarray, "k"]
    """Subject of each pair of `pair_steps`."""
    meetings: law.Encounters
    arrived_p: Float[ndarray, "m"]
    """Probability that an evaluation is at the server 1, 2, ... m steps after it was made."""
    company: Company
    """Chances of evaluation in the words of the closed form."""


def predicted(
    server: Server, config: Config, found: FleetFindings, gate: law.PublishingSteps, looks: law.ExpectedLookups | None
) -> Prediction:
    """The prediction for one server, without intervals.

    Parameters
    ----------
    server
        Server period and window.
    config
        The experiment.
    found
        What the replay has found.
    gate
        When the server publishes.
    looks
        Expected lookups; None if there are no equipped vehicles.
    """
    n_steps = found.evidence.log_none.shape[2]
    schedule, at_s, loss_p = config.schedule, 2 * config.round_s, config.server.cellular.downlink_loss_p
    interval_s, every = schedule.exchange_interval_s, schedule.longest_steps // schedule.exchange_every_steps
    age_s = at_s + interval_s * np.arange(n_steps + 1)
    counts, metrics = counted(server, found, gate, looks, age_s, loss_p)
    window = min(server.window_steps, n_steps)
    closed = closed_form(found.company, gate.period_steps, window, loss_p, n_steps + 1, every)
    median, p90 = list(METRICS)[:2]
    definitions = pd.DataFrame(map(asdict, config.encounters), columns=[*DEFINITION])
    return Prediction(
        variant=server.name,
        period_s=server.period_s,
        window_s=server.window_s,
        age_s=age_s,
        newest=counts.newest,
        oldest=counts.oldest,
        value=counts.value,
        metrics=metrics,
        closed={
            median: law.quantile(age_s, closed, 0.5),
            p90: law.quantile(age_s, closed, 0.9),
        },
        definition=next(iter(named(definitions)), ""),
    )


def counted(
    server: Server,
    found: FleetFindings,
    gate: law.PublishingSteps,
    looks: law.ExpectedLookups | None,
    age_s: Float[ndarray, "a"],
    loss_p: float,
) -> tuple[law.AgeCounts, dict[str, float]]:
    """Expected lookups by age, and the metrics.

    Parameters
    ----------
    server, found, gate, looks
        As for `predicted`.
    age_s
        Ages that lookups can find [s].
    loss_p
        Probability that a vehicle misses a publication.
    """
    evidence = found.evidence
    if looks is None:
        none = np.zeros(len(age_s))
        counts, total, evaluators = law.AgeCounts(none, none, none, 0.0), 0.0, 0.0
    else:
        counts, total = law.ages(evidence, looks, server.window_steps, found.since), looks.total
        evaluators = law.behind(found.pair_steps, found.pair_subject, looks, server.window_steps, found.arrived_p)
    is_fresh = age_s < server.window_s
    known = counts.newest.sum()
    fresh = counts.newest[is_fresh].sum()
    stale = counts.newest[~is_fresh].sum()
    unevaluated = counts.n_unseen if server.zero else 0.0

    def share(n: float) -> float:
        return n / total if total > 0 else float("nan")

    metrics = {
        "freshness.newest_evaluation_age.median_s": law.quantile(age_s, counts.newest, 0.5),
        "freshness.newest_evaluation_age.p90_s": law.quantile(age_s, counts.newest, 0.9),
        "freshness.newest_evaluation_age.mean_s": float(counts.newest @ age_s / known) if known > 0 else float("nan"),
        "freshness.oldest_evaluation_age.median_s": law.quantile(age_s, counts.oldest, 0.5),
        "freshness.value_age.median_s": law.quantile(age_s, counts.value, 0.5),
        "freshness.lookup_state.share:evaluated": share(fresh),
        "freshness.lookup_state.share:stale": share(stale),
        "freshness.lookup_state.share:unevaluated": share(unevaluated),
        "freshness.lookup_state.share:no value": share(max(0.0, total - known - unevaluated)),
        "freshness.evaluators.mean": evaluators / known if known > 0 else float("nan"),
        "freshness.encounters_without_trust.share": law.without_trust(
            evidence, found.meetings, gate, server.window_steps, loss_p
        ),
    }
    rounded = {}
    for name, value in metrics.items():
        rounded[name] = 0.0 if value < _LEAST else float(value)
    return counts, rounded
