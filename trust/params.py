"""Every knob of the trust model, with the paper's symbol where it has one."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Interval

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


@dataclass(frozen=True, kw_only=True, slots=True)
class TrustParams:
    """Whom to believe, from what evidence, for how long, and to what effect."""

    # where trust lives
    where: Literal["central", "local", "none"] = "central"
    """One ledger on a server, one per vehicle (its peers only), or none: everybody has `default_trust`."""
    server_period_s: Annotated[float, Gt(0)] = 5.0
    """Time between two broadcasts of the server's trust values [s]; `where = "central"` only."""
    local_evidence: Literal["heard", "own"] = "heard"
    """What a vehicle's own ledger is fed: every verdict it hears, or its own alone; `where = "local"` only."""

    # object trust and vehicle trust
    freshness_s: Annotated[float, Gt(0)] = 50.0
    """f: age at which evidence is forgotten [s]."""
    window: Literal["half_open", "closed"] = "half_open"
    """Evidence of age exactly f is gone (f steps, the published code) or still counts (f + 1, [-f, 0])."""
    unseen: Literal["zero", "skip"] = "zero"
    """A detection that only its detector could see: object trust 0 with its full weight, or no evidence."""
    weighting: Literal["score", "one"] = "score"
    """Weight of a detection in its vehicle's trust: its score (equation 4), or 1."""
    default_trust: Annotated[float, Interval(ge=0, le=1)] = 0.5
    """Trust of a vehicle without fresh evidence."""
    ego_trust: Annotated[float, Gt(0)] = 1.0
    """Weight of the ego's own verdicts; above 1 biases towards them."""
    ego_trust_from: Literal["fixed", "computed"] = "fixed"
    """`ego_trust`, or the ego's own vehicle trust as it knows it."""

    # matching and evaluation
    tau: Annotated[float, Interval(ge=0, lt=1)] = 0.1
    """Two detections of one class match if their IoU is strictly greater."""
    one_per_vehicle: bool = False
    """At most one detection of each vehicle joins a group, the one of largest IoU (the paper's sentence)."""
    eta: Annotated[float, Interval(ge=-1, le=0)] | None = None
    """Evaluation of an unmatched detection; unset: 0 for the weighted averages, else -1."""
    gamma_lower_points: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Returns up to which a box counts as invisible: car, pedestrian, cyclist, truck."""
    gamma_upper_points: tuple[float, float, float, float] = (100.0, 40.0, 100.0, 100.0)
    """Returns from which a box counts as fully visible: car, pedestrian, cyclist, truck."""
    self_reports: bool = True
    """Every vehicle also sends itself, as detection k = 0 with score 1."""
    certify_own_lies: bool = True
    """A liar answers for its fabricated detections: e = 1 with full visibility."""
    plausibility_in_evaluation: bool = True
    """An unmatched, implausible detection is denied with full visibility."""

    # final aggregation
    method: Method = "trupercept_3"
    """How an ego scores a group."""
    plausibility_in_fusion: bool = True
    """An implausible group that the ego did not open scores 0."""
    blind_points: Annotated[int, Ge(1)] = 10
    """TruPercept 3 takes a foreign detection only where the ego has fewer returns than this."""
    self_report_poses: bool = True
    """Corrected may take a vehicle's pose from that vehicle's own report."""
    min_score: Annotated[float, Interval(ge=0, le=1)] = 0.01
    """A fused object below this score is not reported."""
    code_parity: bool = False
    """The published code's formulas: verdicts weigh the same whoever gives them."""
    code_aggregate: Literal["by_method", "sum", "mean"] = "by_method"
    """Verdicts per detection under `code_parity`: sum, weighted mean, or mean for the averages only."""


AVERAGES: frozenset[Method] = frozenset({"trupercept_1", "trupercept_1_local_bias"})
"""Methods whose score is a weighted average, hence eta = 0."""


def eta_of(params: TrustParams) -> float:
    """Evaluation of an unmatched detection, tied to the method unless set."""
    if params.eta is not None:
        return params.eta
    return 0.0 if params.method in AVERAGES else -1.0


def window_steps(params: TrustParams, dt_s: float) -> int:
    """Number of steps, the present one included, whose evidence is fresh.

    Evidence of step g is fresh at step t iff (t - g) dt < f (half open) or <= f (closed).
    """
    f = params.freshness_s / dt_s
    near = round(f)
    if math.isclose(f, near, rel_tol=1e-9):
        return max(1, near + (params.window == "closed"))
    return math.ceil(f) if params.window == "half_open" else math.floor(f) + 1
