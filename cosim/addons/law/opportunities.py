"""Opportunities to evaluate: with which probability each vehicle evaluates a detection of each other one in a step.

They follow from the poses of one step. Assumptions have the numbers of the page `models/freshness-law`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.base.ragged import owner_of_rows, ptr_of
from cosim.config.config import Config
from cosim.world import World
from sensors import lidar
from sensors.evidence import AreaParams, edge_slope
from sensors.evidence_kernels import in_area
from sensors.expected_returns import ExpectedReturns, expected_returns
from sensors.line_of_sight import WallIndex
from sensors.neighbours import neighbours
from sensors.scene import prisms
from sensors.statistical_detector import IdealDetector, StatisticalDetector, detection_p

DetectedP = Callable[
    [
        ExpectedReturns,
        Int[ndarray, "k"],
        Float[ndarray, "k"],
    ],
    Float[ndarray, "k"],
]
"""From expected returns, class and distance of bodies: the probability that a detector reports each one."""


class ViewTimes(NamedTuple):
    """What E observers can see, compressed rows: bodies of observer i are ptr[i]:ptr[i + 1], ascending."""

    own: Int[ndarray, "e"]
    """Row of the world of each observer."""
    ptr: Int[ndarray, "e+1"]
    body: Int[ndarray, "k"]
    """Row of the world."""
    seen_p: Float[ndarray, "k"]
    """Probability of at least one return from the body, 0 outside the area in which the observer evaluates."""
    inside: Bool[ndarray, "k"]
    """Whether the body is in that area."""
    detected_p: Float[ndarray, "k"]
    """Probability that the observer's detector reports the body."""
    n_false: float
    """Expected false positives of one observer."""

    @property
    def n_listed(self) -> Float[ndarray, "e"]:
        """Expected number of detections of each observer, false positives included."""
        observer = owner_of_rows(np.diff(self.ptr))
        return self.n_false + np.bincount(observer, self.detected_p, len(self.own))


@dataclass(frozen=True, slots=True)
class Sensing:
    """Sensor, evaluation area and detector of every equipped vehicle, and the buildings."""

    beams: lidar.Beams
    params: lidar.LidarParams
    area: AreaParams
    detected_p: DetectedP
    n_false: float
    """Expected false positives of one sweep."""
    walls: WallIndex

    @staticmethod
    def of(config: Config, detector: Any, walls: WallIndex) -> "Sensing":
        """The sensing that a config names.

        Raises
        ------
        ValueError
            If the detector does not say how often it misses an object.
        """
        n_false = float(detector.model.false_positive_per_sweep) if isinstance(detector, StatisticalDetector) else 0.0
        return Sensing(lidar.beams(config.lidar), config.lidar, config.area, detected_p_of(detector), n_false, walls)

    def views(self, world: World, observers: Int[ndarray, "e"]) -> ViewTimes:
        """What the vehicles in these rows of the world can see."""
        boxes, range_m = world.boxes, self.params.max_range_m
        poses = lidar.mount(boxes, observers, self.params)
        near = neighbours(poses.origin_m, boxes, range_m)
        bodies = prisms(world.shape, boxes)
        returns = expected_returns(poses, observers, self.beams, near, boxes, bodies, self.walls, range_m)
        o = owner_of_rows(np.diff(near.ptr))
        no_bodies, fov_rad, area = np.zeros((0, 3)), self.beams.fov_rad, self.area
        inside = in_area(
            poses.pairs(o, boxes, near.row),
            lidar.height_of_road_m(boxes, observers) - poses.origin_m[:, 2],
            np.zeros(0, bool),
            no_bodies,
            no_bodies,
            area.range_m + area.slack_m,
            area.height_m,
            fov_rad,
            edge_slope(fov_rad),
            area.slack_m,
            area.own_radius_m,
        )
        is_evaluated = inside & (near.row != observers[o])
        rows = np.flatnonzero((returns.n > 0) | is_evaluated)
        o, inside = o[rows], inside[rows]
        body = near.row[rows]
        found = ExpectedReturns(returns.n[rows], returns.n_unoccluded[rows])
        apart_m = np.linalg.norm(boxes.xyz_m[body] - poses.origin_m[o], axis=1)
        return ViewTimes(
            own=observers,
            ptr=ptr_of(o, len(observers)),
            body=body,
            seen_p=found.seen_p * inside,
            inside=inside,
            detected_p=self.detected_p(found, world.label[body], apart_m),
            n_false=self.n_false,
        )


def detected_p_of(detector: Any) -> DetectedP:
    """The probability that a detector reports a body, as a function of expected returns.

    Raises
    ------
    ValueError
        If the detector does not say how often it misses an object.
    """
    if isinstance(detector, StatisticalDetector):
        return partial(_statistical_p, detector.model)
    if isinstance(detector, IdealDetector):
        return lambda found, *_: found.seen_p
    if not hasattr(detector, "recall"):
        raise ValueError(
            f"the detector {type(detector).__name__} has no method recall(n_points, label, range_m): how often it "
            "misses an object is not known, so nothing can be predicted. Add it (sensors.detector.KnowsRecall)."
        )
    return partial(_own_p, detector)


def _statistical_p(model: Any, found: ExpectedReturns, label: ndarray, range_m: ndarray) -> ndarray:
    return found.seen_p * detection_p(np.maximum(found.n, 1.0), found.occlusion, label, model)  # type: ignore[arg-type]


def _own_p(detector: Any, found: ExpectedReturns, label: ndarray, range_m: ndarray) -> ndarray:
    n_points = np.maximum(np.rint(found.n), 1).astype(np.int64)
    return found.seen_p * np.asarray(detector.recall(n_points, label, range_m), float)


class Chances(NamedTuple):
    """For each pair of a subject and an evaluator that received the subject's message."""

    none_p: Float[ndarray, "p"]
    """Probability that the evaluator evaluates no detection of the subject with visibility above 0."""
    n_listed: Float[ndarray, "p"]
    """Expected number of all evaluations, those with visibility 0 included."""


def chances(views: ViewTimes, subject: Int[ndarray, "p"], evaluator: Int[ndarray, "p"], self_reports: bool) -> Chances:
    """Chances that evaluators evaluate subjects, given that they receive their messages.

    Parameters
    ----------
    views
        What every equipped vehicle can see.
    subject, evaluator
        Rows of `views`, per pair.
    self_reports
        Whether vehicles report themselves.

    Notes
    -----
    An evaluator v evaluates a subject s if it sees s itself (whose box s reports), if s detects v (whose box v knows
    without error), or if v sees a third body that s detects. These are taken as independent (assumption 5):
    none = (1 - V[v, s]) (1 - D[s, v]) product over bodies o of (1 - V[v, o] D[s, o]).
    """
    found = Chances(*np.empty((2, len(subject))))
    _chances(views, subject, evaluator, self_reports, found)
    return found


@compiled
def _chances(views, subject, evaluator, self_reports, found):
    own, ptr, body = views.own, views.ptr, views.body
    seen_p, inside, detected_p = views.seen_p, views.inside, views.detected_p
    for pair in range(len(subject)):
        s, v = subject[pair], evaluator[pair]
        none, n_listed = 1.0, 0.0
        k, end = ptr[v], ptr[v + 1]  # what the evaluator can see
        i, stop = ptr[s], ptr[s + 1]  # what the subject can see
        while k < end or i < stop:
            is_left = k < end  # the evaluator has bodies left
            if i >= stop or (is_left and body[k] < body[i]):
                if self_reports and body[k] == own[s]:
                    none *= 1.0 - seen_p[k]
                    n_listed += inside[k]
                k += 1
                continue
            if self_reports and body[i] == own[v]:
                none *= 1.0 - detected_p[i]
                n_listed += detected_p[i]
            elif is_left and body[k] == body[i]:
                none *= 1.0 - detected_p[i] * seen_p[k]
                n_listed += detected_p[i] * inside[k]
                k += 1
            i += 1
        found.none_p[pair], found.n_listed[pair] = none, n_listed
