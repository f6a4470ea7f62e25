"""Parameters of matching, evaluation, trust and fusion, with the symbol of the paper where it has one."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

from annotated_types import Ge, Gt, Interval, Le

from cosim.base.bounds import Share

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
"""Final aggregation by name; `trust/README.md` gives each one's formula."""


Kind = Literal["detections", "missing", "speed"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""Kinds of evaluations: of detections, of objects that a message lacks, of claimed velocities."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TruPerceptParams:
    """Parameters of the model `trupercept`."""

    freshness_s: Annotated[float, Gt(0), Le(1e8)] | Literal["off"] = 50.0
    """f: age at which evidence expires in `trupercept` [s]. With "off" it never expires. Other models do not read it:
    most forget by `decay_per_s`."""
    window: Literal["half_open", "closed"] = "half_open"
    """Evidence of age exactly f. `half_open`: it has expired, so that the window has f steps, as in the published code.
    `closed`: it still counts, so that the window has f + 1 steps."""
    grace_s: Annotated[float, Gt(0), Le(1e8)] = 10.0
    """Age at which evidence is added to running sums [s]. Evaluations that arrive later have no effect. This applies to
    models whose evidence does not expire: `beta`, and `trupercept` with `freshness_s = "off"`."""
    unseen: Literal["zero", "skip"] = "zero"
    """A detection that no other vehicle could see. `zero`: its object trust is 0, with full weight. `skip`: it is no
    evidence."""
    weighting: Literal["score", "one"] = "score"
    """Weight of a detection in the trust of its vehicle: its score (equation 4), or 1."""
    least_score: Share = 0.0
    """A detection with a lower score is no evidence: its own sender thinks that it may be nothing. Self reports have
    score 1."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrustParams(TruPerceptParams):
    """Matching, evaluation, trust and fusion, including the parameters of the default trust model."""

    # trust
    unseen: Literal["zero", "skip"] = "skip"
    """A detection that no other vehicle could see. `skip`: it is no evidence. `zero`: its object trust is 0, with full
    weight. This is the paper's rule; `results/FRESHNESS.md` explains why it is not the default."""
    model: str = "trupercept"
    """Name of the trust model, or a class of your own as path.py:Name."""
    host: Literal["central", "local", "none"] = "central"
    """Where trust scores are computed. `central`: on a trust server. `local`: in every vehicle. `none`: nowhere."""
    server_period_s: Annotated[float, Gt(0), Le(1e8)] = 5.0
    """With `host = "central"`: time between two broadcasts of the server's trust values [s]."""
    local_evidence: Literal["received", "own"] = "received"
    """With `host = "local"`: evidence of a vehicle's trust scores. `received`: its own evaluations and all that it
    receives. `own`: its own evaluations only."""
    default_trust: Share = 0.5
    """Trust of a vehicle about which nothing is known."""
    suspect_below: Share = 0.25
    """A vehicle with less trust than this is suspected, in the metrics. Nothing in the run depends on it."""
    suspect_from: Annotated[int, Interval(ge=1, le=1_000_000)] = 1
    """It is suspected if its trust rests on at least as many evaluations. Nothing in the run depends on it."""
    unevaluated: Literal["default", "value"] = "default"
    """Trust of a vehicle without any evaluation by another vehicle that could see its detections. `default`:
    `default_trust`. `value`: the model's value, which for TruPercept is 0 (the paper's rule)."""
    ego_trust: Annotated[float, Gt(0), Le(1e6)] = 1.0
    """Weight of the ego's own evaluations. A value above 1 biases the result towards them."""
    ego_trust_from: Literal["fixed", "computed"] = "fixed"
    """Source of that weight. `fixed`: `ego_trust`. `computed`: the ego's vehicle trust, as the ego knows it."""

    # matching and evaluation
    matching: Literal["iou", "gates"] = "iou"
    """When two detections may be of one object. `iou`: if their boxes overlap (the paper's rule). `gates`: if they are
    as close as the accuracies that their vehicles state allow, or if their boxes overlap."""
    tau: Annotated[float, Interval(ge=0, lt=1)] = 0.1
    """Two detections of one class match if their IoU is strictly greater."""
    gate_p: Annotated[float, Interval(ge=0.5, lt=1)] = 0.99
    """With `gates`: probability that two detections of one object are close enough, if stated accuracies are true."""
    one_per_vehicle: bool = False
    """Whether a group contains at most one detection of each vehicle, the one with the largest IoU, as the paper
    says."""
    eta: Annotated[float, Interval(ge=-1, le=0)] | None = None
    """Evaluation of an unmatched detection. If it is not set, it is 0 for the weighted averages and -1 otherwise."""
    gamma_lower_points: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Number of returns up to which visibility is 0, for car, pedestrian, cyclist, truck."""
    gamma_upper_points: tuple[float, float, float, float] = (100.0, 40.0, 100.0, 100.0)
    """Number of returns from which visibility is 1, for car, pedestrian, cyclist, truck."""
    self_reports: bool = True
    """Whether every vehicle also reports itself, as detection k = 0 with score 1."""
    plausibility_in_evaluation: bool = True
    """Whether an unmatched, implausible detection is evaluated with full visibility."""
    denials: Literal["visibility", "recall"] = "visibility"
    """Weight of the evaluation of an unmatched detection. `visibility`: its visibility, and 1 where free space
    contradicts it (the paper's rule). `recall`: what the evaluator can know from how often its detector misses such
    objects; 0 if it would more likely than not find no match although the object is there."""
    evidence: tuple[Kind, ...] = ("detections",)
    """Kinds of evaluations that are made, sent and counted. `detections`: of received detections. `missing`: of the
    completeness of a message, by the objects that the sender should have detected too. `speed`: of claimed
    velocities, by the evaluator's own tracks. `missing` and `speed` are of messages of the evaluator's own step only:
    with `sensing_phase = "random"`, of vehicles with the same phase."""

    # final aggregation
    method: Method = "trupercept_3"
    """Method by which an ego scores a group of matched detections."""
    plausibility_in_fusion: bool = True
    """Whether an implausible group that the ego did not detect has score 0."""
    blind_points: Annotated[int, Ge(1), Le(1_000_000)] = 10
    """TruPercept 3 uses another vehicle's detection only if the ego has fewer returns from it than this."""
    self_report_poses: bool = True
    """Whether `corrected` may use a vehicle's pose from its self report."""
    fused_boxes: Literal["best", "weighted", "aligned"] = "best"
    """Box of a fused object, with `matching = "gates"`. `best`: that of one detection. `weighted`: mean of all its
    detections, by the inverse of the covariances that their vehicles state. `aligned`: the same, with the pose errors
    of the vehicles estimated from the objects that they have in common."""
    least_overlap: Annotated[float, Interval(ge=0, lt=1)] = 0.0
    """With `weighted` and `aligned`: the score is multiplied by the probability that the box overlaps the object by
    more than this (IoU). 0: it is not multiplied."""
    min_score: Share = 0.01
    """A fused object below this score is not reported."""
    code_parity: bool = False
    """Whether the published code's formulas are used, in which all evaluators have the same weight."""
    code_aggregate: Literal["by_method", "sum", "mean"] = "by_method"
    """With `code_parity`: how evaluations of a detection are combined. `sum`: sum. `mean`: weighted mean. `by_method`:
    mean for the weighted averages, and sum otherwise."""

    @property
    def fixed_ego_trust(self) -> float | None:
        """Trust of every vehicle in itself; None if it is what the vehicle knows, as in the published code too."""
        return None if self.code_parity or self.ego_trust_from == "computed" else self.ego_trust

    def __post_init__(self) -> None:
        for label, low, high in zip(_LABELS, self.gamma_lower_points, self.gamma_upper_points, strict=True):
            if not 0 <= low <= high <= 1e6:
                raise ValueError(
                    f"trust.gamma_lower_points = {low:g} and trust.gamma_upper_points = {high:g} returns of a {label}: "
                    "visibility needs 0 <= lower <= upper <= 1e6."
                )
        is_repeated = len(set(self.evidence)) < len(self.evidence)
        if self.evidence[:1] != ("detections",) or is_repeated:
            raise ValueError(
                f'trust.evidence = {list(self.evidence)}: the list begins with "detections", and names each kind '
                'once. Further kinds are "missing" and "speed".'
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
    "matching",
    "tau",
    "gate_p",
    "one_per_vehicle",
    "eta",
    "gamma_lower_points",
    "gamma_upper_points",
    "self_reports",
    "plausibility_in_evaluation",
    "denials",
    "evidence",
)
"""Parameters that change evaluations: trust variants that share evidence have them in common. `eta` is that of
`eta_of`, so that `method` counts where it decides on it."""


def evidence_values(params: TrustParams) -> dict[str, Any]:
    """Values of `EVIDENCE_KEYS`, in their order. Of `eta`, it is the one in use."""
    return {key: getattr(params, key) for key in EVIDENCE_KEYS} | {"eta": eta_of(params)}


def differing_evidence_key(a: TrustParams, b: TrustParams) -> str | None:
    """First of `EVIDENCE_KEYS` in which two sets of parameters differ, None if they can share evaluations."""
    of_a, of_b = evidence_values(a), evidence_values(b)
    return next((key for key in EVIDENCE_KEYS if of_a[key] != of_b[key]), None)


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
