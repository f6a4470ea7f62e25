"""Parameters of matching, evaluation, trust and fusion, with the symbol of the paper where it has one."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Interval, Le

Method = Literal[
    "trupercept_1",
    "trupercept_2",
    "trupercept_3",
    "corrected",
    "trupercept_3_corrected",
    "trupercept_1_local_bias",
    "local",
    "any",
    "any_confirmed",
    "confirmed_or_local",
    "local_confirmed",
    "averaging",
    "additive",
    "half_additive",
]
"""Names of the final aggregation methods; `trust/README.md` gives the formula of each."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TruPerceptParams:
    """Parameters of the model `trupercept`."""

    freshness_s: Annotated[float, Gt(0), Le(1e8)] | Literal["off"] = 50.0
    """Window f: age at which evidence expires [s]; "off" means that it never expires."""
    window: Literal["half_open", "closed"] = "half_open"
    """Whether evidence of age exactly f has expired (`half_open`: f steps, as in the published code) or still counts
    (`closed`: f + 1 steps, [-f, 0])."""
    grace_s: Annotated[float, Gt(0), Le(1e8)] = 10.0
    """Age at which evidence is added to running sums [s]. Evaluations that arrive later have no effect.
    For models whose evidence does not expire: `beta`, and `trupercept` with `freshness_s = "off"`."""
    unseen: Literal["zero", "skip"] = "zero"
    """How a detection counts that only its detector could see: `zero` is object trust 0 with full weight, `skip` is no
    evidence."""
    weighting: Literal["score", "one"] = "score"
    """Weight of a detection in its vehicle's trust: its score (equation 4), or 1."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrustParams(TruPerceptParams):
    """Matching, evaluation, trust and fusion; the parameters of the default trust model included."""

    # trust
    unseen: Literal["zero", "skip"] = "skip"
    """How a detection counts that only its detector could see: `skip` is no evidence, `zero` is object trust 0 with
    full weight. `zero` is the paper's rule; `results/FRESHNESS.md` explains why it is not the default."""
    model: str = "trupercept"
    """Trust model by name."""
    host: Literal["central", "local", "none"] = "central"
    """Where trust scores are computed: on a trust server, in every vehicle, or nowhere."""
    server_period_s: Annotated[float, Gt(0), Le(1e8)] = 5.0
    """Time between two broadcasts of the server's trust values [s]; `host = "central"` only."""
    local_evidence: Literal["received", "own"] = "received"
    """Evidence for a vehicle's trust: all evaluations that it receives, or only its own; `host = "local"` only."""
    default_trust: Annotated[float, Interval(ge=0, le=1)] = 0.5
    """Trust of a vehicle about which nothing is known."""
    unjudged: Literal["default", "value"] = "default"
    """What is used if a value rests on no evaluation by another vehicle that could see: `default_trust`, or the value
    itself. For TruPercept this value is 0 (the paper's rule)."""
    ego_trust: Annotated[float, Gt(0), Le(1e6)] = 1.0
    """Weight of the ego's own evaluations; above 1 biases towards them."""
    ego_trust_from: Literal["fixed", "computed"] = "fixed"
    """Weight of the ego's own evaluations: `ego_trust`, or the trust in itself that the ego knows."""

    # matching and evaluation
    tau: Annotated[float, Interval(ge=0, lt=1)] = 0.1
    """Two detections of one class match if their IoU is strictly greater."""
    one_per_vehicle: bool = False
    """At most one detection of each vehicle joins a group: the one with the largest IoU, as the paper says."""
    eta: Annotated[float, Interval(ge=-1, le=0)] | None = None
    """Evaluation of an unmatched detection; unset: 0 for the weighted averages, else -1."""
    gamma_lower_points: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Returns up to which a box counts as invisible: car, pedestrian, cyclist, truck."""
    gamma_upper_points: tuple[float, float, float, float] = (100.0, 40.0, 100.0, 100.0)
    """Returns from which a box counts as fully visible: car, pedestrian, cyclist, truck."""
    self_reports: bool = True
    """Every vehicle also sends a report of itself, as detection 0 with score 1."""
    plausibility_in_evaluation: bool = True
    """An unmatched, implausible detection is evaluated with full visibility."""
    denials: Literal["visibility", "recall"] = "visibility"
    """Weight of the evaluation of an unmatched, plausible detection. `visibility` is the paper's rule. `recall` lowers
    this weight if the evaluator's detector often misses such objects."""

    # final aggregation
    method: Method = "trupercept_3"
    """How an ego scores a group."""
    plausibility_in_fusion: bool = True
    """An implausible group that the ego did not detect scores 0."""
    blind_points: Annotated[int, Ge(1), Le(1_000_000)] = 10
    """TruPercept 3 takes another vehicle's detection only where the ego has fewer returns than this."""
    self_report_poses: bool = True
    """Corrected may take a vehicle's pose from that vehicle's own report."""
    min_score: Annotated[float, Interval(ge=0, le=1)] = 0.01
    """A fused object below this score is not reported."""
    code_parity: bool = False
    """Use the formulas of the published code, where all evaluators have the same weight."""
    code_aggregate: Literal["by_method", "sum", "mean"] = "by_method"
    """Evaluations per detection under `code_parity`: sum, weighted mean, or mean for the averages only."""

    def __post_init__(self) -> None:
        for label, low, high in zip(_LABELS, self.gamma_lower_points, self.gamma_upper_points, strict=True):
            if not 0 <= low <= high <= 1e6:
                raise ValueError(
                    f"trust.gamma_lower_points = {low:g} and trust.gamma_upper_points = {high:g} returns of a {label}: "
                    "visibility needs 0 <= lower <= upper <= 1e6."
                )


_LABELS = ("car", "pedestrian", "cyclist", "truck")

AVERAGES: frozenset[Method] = frozenset({"trupercept_1", "trupercept_1_local_bias"})
"""Methods whose score is a weighted average, hence eta = 0."""


def eta_of(params: TrustParams) -> float:
    """Evaluation of an unmatched detection, tied to the method unless set."""
    if params.eta is not None:
        return params.eta
    return 0.0 if params.method in AVERAGES else -1.0


EVIDENCE_KEYS: tuple[str, ...] = (
    "tau",
    "one_per_vehicle",
    "eta",
    "gamma_lower_points",
    "gamma_upper_points",
    "self_reports",
    "plausibility_in_evaluation",
    "denials",
)
"""Parameters that change evaluations. Trust variants that share evidence must have the same values. `eta` means the
result of `eta_of`, which may depend on `method`."""


def differing_evidence_key(a: TrustParams, b: TrustParams) -> str | None:
    """First of `EVIDENCE_KEYS` in which two sets of parameters differ, None if they can share evaluations."""
    for key in EVIDENCE_KEYS:
        if (eta_of(a) != eta_of(b)) if key == "eta" else (getattr(a, key) != getattr(b, key)):
            return key
    return None


def window_steps(params: TruPerceptParams, dt_s: float) -> int:
    """Number of steps, the present one included, whose evidence is fresh.

    Evidence of step g is fresh at step t iff (t - g) dt < f (half open) or <= f (closed).
    """
    assert params.freshness_s != "off"
    return _steps(params.freshness_s, dt_s, params.window == "closed")


def window_of(params: TruPerceptParams) -> float:
    """Age from which on evidence is outside the window [s]."""
    if params.freshness_s == "off":
        return float("inf")
    slack_s = 1e-9 * params.freshness_s  # of rounding
    return params.freshness_s + (slack_s if params.window == "closed" else -slack_s)


def grace_steps(grace_s: float, dt_s: float) -> int:
    """Number of steps, the present one included, that are younger than `grace_s`."""
    return _steps(grace_s, dt_s, False)


def open_window_steps(params: TruPerceptParams, dt_s: float) -> int:
    """Number of steps, the present one included, whose evidence may still change."""
    return grace_steps(params.grace_s, dt_s) if params.freshness_s == "off" else window_steps(params, dt_s)


def _steps(age_s: float, dt_s: float, closed: bool) -> int:
    exact = age_s / dt_s
    nearest = round(exact)
    if math.isclose(exact, nearest, rel_tol=1e-9):
        return max(1, nearest + closed)
    return math.floor(exact) + 1 if closed else math.ceil(exact)
