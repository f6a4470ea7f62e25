"""The interface of detectors, the available detectors, and detections in canonical order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, UInt8
from numpy import ndarray

from cosim.base.rows import Rows
from sensors.boxes import Boxes
from sensors.evidence import Observability, points_in_boxes
from sensors.lidar import Sweeps
from sensors.reports import DetectorDraws, Reports
from sensors.statistical_detector import IdealDetector, StatisticalDetector


class Detector(Protocol):
    """A 3D object detector, the same for every observer.

    The class is constructed with an instance of its attribute `Params`, a frozen dataclass. A class without this
    attribute is constructed without arguments. A detector that knows its recall, or how accurate its boxes are, has
    further methods: those of `sensors.statistical_detector.StatisticalDetector`.
    """

    def detect(
        self,
        sweeps: Sweeps,
        seen: Observability,
        boxes: Boxes,
        label: UInt8[ndarray, "n"],
        draws: DetectorDraws,
    ) -> Reports:
        """The reports of all observers in one step.

        Parameters
        ----------
        sweeps
            Range images `range_m[observer, azimuth, elevation]`, the object that each ray met (`hit`), poses and beams.
            A detector that works with true boxes adds `moved_m` to their centres, for sweeps that take time.
            If there are many observers, several threads call this method at the same time, each with a part of them.
        seen
            One row for each (observer, actor) with a ray that could meet the actor: returns, unoccluded returns, range.
        boxes, label
            Ground truth: box (world frame) and `ObjectClass` of every actor.
        draws
            Keys of all random draws. A detector has no random state of its own.

        Returns
        -------
        Reported boxes in any order, world frame.
        """


class KnowsRecall(Protocol):
    """A detector that knows its own recall. `trust.denials = "recall"` needs it."""

    def recall(
        self,
        n_points: Int[ndarray, "n"],
        label: UInt8[ndarray, "n"],
        range_m: Float[ndarray, "n"],
    ) -> Float[ndarray, "n"]:
        """Probability, in [0, 1], that one sweep yields a report of an object with its true class.

        Parameters
        ----------
        n_points
            Returns of the observer's sweep inside the object's box.
        label
            `ObjectClass` of the object.
        range_m
            Distance from the sensor to the centre of the box [m].
        """


DETECTORS: dict[str, Callable[[Any], Detector]] = {
    "avod": StatisticalDetector,
    "pointpillars": StatisticalDetector,
    "pv_rcnn": StatisticalDetector,
    "ideal": IdealDetector,
}
"""Detectors by `detector.model` of the config."""


@dataclass(frozen=True, slots=True)
class DetectedBoxes(Rows):
    """Detections of one step, sorted by (observer, descending score, x, y), so that the order hides true identities."""

    observer: Int32[ndarray, "d"]
    """Row of the sweep."""
    label: UInt8[ndarray, "d"]
    boxes: Boxes
    score: Float[ndarray, "d"]
    n_points: Int32[ndarray, "d"]
    """Returns of the observer's own sweep inside the reported box."""
    actor: Int32[ndarray, "d"]
    """Ground truth: row of the detected actor; not used if `is_false_positive`."""
    is_false_positive: Bool[ndarray, "d"]
    """Ground truth: the box belongs to no actor."""


def detect(
    detector: Detector,
    sweeps: Sweeps,
    seen: Observability,
    boxes: Boxes,
    label: UInt8[ndarray, "n"],
    draws: DetectorDraws,
) -> DetectedBoxes:
    """Run a detector, sort its reports into canonical order and count the points in each box.

    Parameters
    ----------
    detector
        The detector to run.
    sweeps, seen, boxes, label, draws
        As for `Detector.detect`.

    Returns
    -------
    Detections sorted by (observer, descending score, x, y), world frame.

    Raises
    ------
    ValueError
        If the number of keys does not match the observers and actors.
    """
    n_observers, n_actors = len(sweeps.observers), len(boxes)
    sizes = {len(keys) for keys in (draws.observer_step, draws.observer, draws.site_step, draws.site_observer)}
    if sizes != {n_observers} or len(draws.actor) != n_actors:
        raise ValueError(
            f"detector draws with keys of {sorted(sizes)} observers and {len(draws.actor)} actors do not fit "
            f"{n_observers} observers and {n_actors} actors. Give one key for each."
        )
    reports = detector.detect(sweeps, seen, boxes, label, draws)
    x, y, _ = reports.boxes.xyz_m.T
    reports = reports.take(np.lexsort([y, x, -reports.score, reports.observer]))
    return DetectedBoxes(
        reports.observer.astype(np.int32),
        reports.label.astype(np.uint8),
        reports.boxes,
        reports.score.astype(np.float64),
        points_in_boxes(sweeps, reports.observer, reports.boxes),
        reports.actor.astype(np.int32),
        reports.is_false_positive.astype(bool),
    )
