"""What a detector finds in the merged point clouds of several sensors: early fusion, as in Cooper [1]_.

References
----------
.. [1] Q. Chen, S. Tang, Q. Yang, S. Fu, "Cooper: Cooperative perception for connected autonomous vehicles based on 3D
   point clouds", ICDCS 2019.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.base.plane import turned_by
from cosim.base.ragged import differs_from_last, owner_of_rows
from cosim.base.rows import Rows
from sensors.boxes import Boxes
from sensors.evidence import Observability
from sensors.reports import DetectorDraws, Reports
from sensors.statistical_detector import StatisticalDetector


@dataclass(frozen=True, slots=True)
class Views(Rows):
    """V views of actors in clouds that M observers merge. A view is the returns of one sweep from one actor."""

    observer: Int[ndarray, "v"]
    """Whose merged cloud it is."""
    actor: Int[ndarray, "v"]
    """Row of the actor."""
    n_returns: Int[ndarray, "v"]
    """At least 1."""
    n_unoccluded: Int[ndarray, "v"]
    """As in `Observability`."""
    range_m: Float[ndarray, "v"]
    """Distance from the sensor of the sweep to the actor."""
    off_m: Float[ndarray, "v 2"]
    """Displacement of the returns from the actor's box, east and north."""


@dataclass(frozen=True, slots=True)
class Merged:
    """S actors in merged clouds, sorted by (observer, actor)."""

    seen: Observability
    """Returns of all sweeps together, the occlusion of the best view, and the mean distance of the returns."""
    off_m: Float[ndarray, "s 2"]
    """Mean displacement of the returns, east and north."""
    larger_m: Float[ndarray, "s 2"]
    """Twice the standard deviation of the displacements along the actor's length and width."""
    n_sweeps: Int[ndarray, "s"]
    """Sweeps with a return from the actor."""


def merged(views: Views, yaw_rad: Float[ndarray, "n"]) -> Merged:
    """The views of each observer and actor as one.

    Parameters
    ----------
    views
        Views in any order. One view alone stays as it is, in every bit.
    yaw_rad
        Heading of each actor.
    """
    v = views.take(np.lexsort([views.actor, views.observer]))
    is_first = differs_from_last(v.observer) | differs_from_last(v.actor)
    begin = np.flatnonzero(is_first)
    n_sweeps = np.diff(np.append(begin, len(v.actor)))
    group = owner_of_rows(n_sweeps)
    weight = v.n_returns.astype(np.float64)
    n = np.bincount(group, weight, len(begin))

    def mean(values: Float[ndarray, "v"]) -> Float[ndarray, "s"]:
        first = values[begin]
        beyond = weight * (values - first[group])
        return first + np.bincount(group, beyond, len(begin)) / n

    occlusion = np.full(len(begin), np.inf)
    np.minimum.at(occlusion, group, 1.0 - v.n_returns / v.n_unoccluded)
    east_m, north_m = v.off_m.T
    off_m = np.column_stack([mean(east_m), mean(north_m)])
    from_mean_m = v.off_m - off_m[group]
    along, across = turned_by(-yaw_rad[v.actor], from_mean_m).T
    variance = np.column_stack([mean(along**2), mean(across**2)])
    larger_m = 2.0 * np.sqrt(np.maximum(variance, 0.0))
    seen = Observability(
        observer=v.observer[begin],
        actor=v.actor[begin],
        n_returns=n.astype(np.int64),
        n_unoccluded=np.rint(n / (1.0 - occlusion)),
        range_m=mean(v.range_m),
    )
    return Merged(seen, off_m, larger_m, n_sweeps)


@dataclass(frozen=True, slots=True)
class EarlyReports:
    """R boxes that a detector finds in merged clouds; none is a false positive."""

    reports: Reports
    n_returns: Int[ndarray, "r"]
    """Returns of all sweeps together from the actor."""
    n_sweeps: Int[ndarray, "r"]
    """Sweeps with a return from it."""


def detect(
    detector: StatisticalDetector,
    views: Views,
    boxes: Boxes,
    label: UInt8[ndarray, "n"],
    origin_m: Float[ndarray, "m 3"],
    draws: DetectorDraws,
) -> EarlyReports:
    """Ask the detector about merged clouds.

    Parameters
    ----------
    detector
        A detector whose reports follow from returns, occlusion and distance.
    views
        Views of the observers' own sweeps and of those that they have received.
    boxes, label
        Ground truth: box (world frame) and `ObjectClass` of every actor.
    origin_m
        Position of each observer's own sensor.
    draws
        Keys of the observers' draws: those of their own detections.

    Notes
    -----
    Returns that are displaced, by errors of pose or because the object moved since an older sweep, displace the box by
    their share of the returns, and lengthen and widen it by twice their standard deviation.   Deviations from [1]_: no
    network looks at points; false positives, which one pass over the merged cloud makes, are left to the caller.
    """
    cloud = merged(views, boxes.yaw_rad)
    reports = detector.of_actors(cloud.seen, boxes, label, origin_m, draws)
    reports = reports.take(np.flatnonzero(reports.score >= detector.model.min_score))
    n_actors = len(boxes)
    pair = cloud.seen.observer.astype(np.int64) * n_actors + cloud.seen.actor
    reported = reports.observer.astype(np.int64) * n_actors + reports.actor
    row = np.searchsorted(pair, reported)
    off_m = np.column_stack([cloud.off_m[row], np.zeros(len(row))])
    reports = reports.moved(off_m)
    lwh_m = reports.boxes.lwh_m.copy()
    lwh_m[:, :2] += cloud.larger_m[row]
    reports = replace(reports, boxes=replace(reports.boxes, lwh_m=lwh_m))
    return EarlyReports(reports, cloud.seen.n_returns[row], cloud.n_sweeps[row])
