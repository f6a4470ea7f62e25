"""What vehicles state of the accuracy of their detections, and how it decreases with the age of a message."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.config.config import Config
from cosim.messages.content import SELF, SENSED, Detections, velocities
from cosim.messages.etsi import Confidences
from cosim.world import World
from sensors.association import bounded
from sensors.tracking.motion import expected_speed
from sensors.tracking.params import TrackingParams
from sensors.tracking.tracks import ObjectStates

SigmaOf = Callable[[ndarray, ndarray, ndarray], ndarray]
"""Standard deviations, from number of returns, class and distance."""


class DetectorAccuracy(NamedTuple):
    """What a detector knows of its own accuracy, by methods as of `StatisticalDetector`; None where it has none."""

    position_sigma_m: SigmaOf | None = None
    heading_sigma_rad: SigmaOf | None = None
    size_sigma: SigmaOf | None = None
    error_by_score: SigmaOf | None = None

    @staticmethod
    def of(detector: Any) -> "DetectorAccuracy":
        """What this detector knows."""
        return DetectorAccuracy(*(getattr(detector, name, None) for name in DetectorAccuracy._fields))


ALONG_BOTH = np.array([1.0, 0.0, 1.0])
"""Variance xx, xy, yy that is the same along both axes."""
_OWN_SPEED_SIGMA_MPS = 0.1
"""Standard deviation of the speed that a vehicle measures of itself."""
_PLAIN_SIGMA_M, _PLAIN_SIGMA_RAD, _PLAIN_SIZE_SIGMA = 0.3, 0.2, 0.1
"""Standard deviations of position, heading and size that are stated where the detector does not know its own."""
_LEAST_SIGMA_M = 1e-6
"""Positions are not stated more exactly, so that nothing is divided by zero."""


class Reporters(NamedTuple):
    """What the accuracy of D detections depends on, of the vehicles that report them."""

    sensor_m: Float[ndarray, "d 3"]
    """Where each vehicle believes its sensor to be."""
    speed_mps: Float[ndarray, "d"]
    pose: Float[ndarray, "d 2"]
    """As `pose_variance` returns it."""
    after_s: Float[ndarray, "d"]
    """When the sensor looks there, after the time of the sweep."""

    @staticmethod
    def of(world: World, listed: Detections, sensing: Int[ndarray, "s"], sweeps: Any, c: Config) -> "Reporters":
        """Those of these detections; `sensing` are the rows of the world whose `sweeps` these are, ascending."""
        observer = listed.observer
        at = np.searchsorted(sensing, observer)
        return Reporters(
            sensor_m=sweeps.poses.origin_m[at],
            speed_mps=world.speed_mps[observer],
            pose=pose_variance(world.is_roadside[observer], c),
            after_s=sweeps.seen_after_s(at, listed.boxes.xyz_m),
        )


def stated(
    listed: Detections,
    tracks: ObjectStates | None,
    reporters: Reporters,
    limit_mps: Float[ndarray, "d"],
    detector: DetectorAccuracy,
    c: Config,
) -> Detections:
    """The lists with the accuracy that their vehicles state.

    Parameters
    ----------
    listed
        Detections as vehicles list them.
    tracks
        What tracking says of the sensed ones, in their order; None without tracking.
    reporters
        The vehicle of each detection.
    limit_mps
        Speed limit of the road at each detection; NaN where it is not known.
    detector
        What the detector knows of its own accuracy.
    c
        The config.

    Notes
    -----
    The variance of a position is a sum of four parts: the detector's, by class, number of returns and range; that of
    the vehicle's own position; that of its heading, across the line of sight, times the square of the range; and that
    of the velocity, times the square of the time between the moment at which the sensor looked there and that of the
    sweep: objects are reported where they were at the time of the sweep. A self report has the second part alone. A
    detection without a track has the variance of the speeds of its class on the road there, as a new track has it
    (`expected_speed`). Vehicles that attack state the same of what they fabricate, times the `accuracy_factor` of
    their attack. A velocity that is said to be less well known than that of an object without a track counts as one
    that is not stated.

    Relative to the vehicle, there is the first and the last part. There, what the score says about the error counts,
    too; matching does not use it. The heading and the size of a detection have the detector's variance, those of a
    self report none.
    """
    is_self = listed.origin == SELF
    away_m = listed.boxes.xyz_m[:, :2] - reporters.sensor_m[:, :2]
    range_m = np.hypot(*away_m.T)
    seen = listed.n_points, listed.label, range_m
    sigma_m, sigma_rad, size_sigma = (
        np.full(len(listed), plain) if sigma is None else sigma(*seen)
        for sigma, plain in zip(detector[:3], (_PLAIN_SIGMA_M, _PLAIN_SIGMA_RAD, _PLAIN_SIZE_SIGMA), strict=True)
    )
    of_detector = np.where(is_self, 0.0, sigma_m**2)
    of_position, of_heading = reporters.pose.T
    across = np.where(is_self, 0.0, of_heading)
    x, y = away_m.T
    moves = velocities(listed)
    known = np.isfinite(moves).all(axis=1)
    of_class = _velocity_variance(listed, limit_mps, reporters.speed_mps, sigma_rad, c.tracking)
    velocity = np.where(known[:, None], _OWN_SPEED_SIGMA_MPS**2 * ALONG_BOTH, of_class)
    if tracks is not None:
        rows = np.flatnonzero(listed.origin == SENSED)
        of_track = _along_axes(tracks.variance, tracks.axis)
        velocity[rows] = np.where(known[rows, None], of_track, velocity[rows])
    relative_m2 = np.where(is_self, 0.0, reporters.after_s**2)[:, None] * velocity
    at_any_score_m2 = relative_m2 + of_detector[:, None] * ALONG_BOTH
    if detector.error_by_score is not None:
        of_detector = of_detector * detector.error_by_score(listed.score, listed.n_points, listed.label)
    squares = np.stack([y * y, -x * y, x * x])
    of_pose = (across * squares).T + of_position[:, None] * ALONG_BOTH
    if not c.extrapolate:  # the box stays where it was said to be
        east, north = np.where(known[:, None], moves, 0.0).T
        of_motion = east * east, east * north, north * north
        velocity = velocity + np.column_stack(of_motion)
    most = np.maximum(1.0, _mean(of_class) / _mean(velocity))
    told = listed.accuracy_factor**2  # 1 is exact, so that honest statements stay as they are
    said = replace(
        listed,
        variance_m2=bounded((at_any_score_m2 + of_pose) * told[:, None]),
        velocity_variance=velocity * np.minimum(told, most)[:, None],
        relative_m2=(relative_m2 + of_detector[:, None] * ALONG_BOTH) * told[:, None],
        heading_variance=np.where(is_self, 0.0, sigma_rad**2) * told,
        size_variance=np.where(is_self, 0.0, size_sigma**2) * told,
    )
    if c.cpm.accuracy == "exact":
        return said
    read = as_encoded(replace(said, variance_m2=at_any_score_m2 * told[:, None]), of_class)
    return replace(read, variance_m2=bounded(read.variance_m2 + of_pose * told[:, None]))


def as_encoded(said: Detections, velocity_of_class: Float[ndarray, "d 3"]) -> Detections:
    """Detections with the accuracy that a receiver reads from the confidence values of a message.

    Parameters
    ----------
    said
        Detections with what their vehicles would state, relative to the vehicle.
    velocity_of_class
        Variance of the velocity of an object without a track.

    Notes
    -----
    Confidence values are of single axes: correlations are not sent. A velocity whose value is out of range counts as
    that of an object without a track, a heading as any between -90 and 90 degrees. Self reports stay as they are: the
    values of the own vehicle are small, and far from the ends of their ranges. Deviations: what a vehicle states of its
    own position and heading is not rounded, and it reads its own detections with the rounded values.
    """
    of_axes = [0, 2]
    position_std = np.sqrt(said.variance_m2[:, of_axes])
    relative_std = np.sqrt(said.relative_m2[:, of_axes])
    velocity_std = np.sqrt(said.velocity_variance[:, of_axes])
    size_std = np.sqrt(said.size_variance)[:, None] * said.boxes.lwh_m
    values = Confidences.of(position_std, np.sqrt(said.heading_variance), size_std, velocity_std)
    read = values.standard_deviations()
    has_velocity = np.isfinite(velocities(said)).all(axis=1)
    beyond = has_velocity & np.isnan(read.velocity_mps).any(axis=1)
    velocity = np.where(beyond[:, None], velocity_of_class, _of_axes(np.nan_to_num(read.velocity_mps)))
    # What the score says of the error is known to the receiver, as the sender knows it.
    relative_m = read.position_m * relative_std / np.maximum(position_std, _LEAST_SIGMA_M)
    encoded = {
        "variance_m2": _of_axes(read.position_m),
        "relative_m2": _of_axes(relative_m),
        "velocity_variance": np.where(has_velocity[:, None], velocity, said.velocity_variance),
        "heading_variance": np.nan_to_num(read.angle_rad**2, nan=np.pi**2 / 12.0),
        "size_variance": ((read.lwh_m / said.boxes.lwh_m) ** 2).mean(axis=1),
    }
    is_self = said.origin == SELF
    for name, of_message in encoded.items():
        of_self = is_self[:, None] if of_message.ndim == 2 else is_self
        encoded[name] = np.where(of_self, getattr(said, name), of_message)
    return replace(said, **encoded)


def _of_axes(std: Float[ndarray, "d 2"]) -> Float[ndarray, "d 3"]:
    """Variances xx, xy, yy of errors that are independent along the axes."""
    x, y = std.T
    return np.column_stack([x * x, np.zeros(len(x)), y * y])


def pose_variance(is_roadside: Bool[ndarray, "n"], c: Config) -> Float[ndarray, "n 2"]:
    """What vehicles state of their own poses: variances of position (each axis) and heading [m2, rad2].

    Where a roadside unit stands is known.
    """
    of_vehicle = c.gnss.std_m**2, np.deg2rad(c.gnss.heading_std_deg) ** 2
    return np.where(is_roadside[:, None], 0.0, of_vehicle)


def aged(listed: Detections, age_s: Float[ndarray, "d"], params: TrackingParams) -> Detections:
    """Detections whose messages are so old: their positions are less certain.

    Notes
    -----
    The variance grows by that of the velocity times the square of the age, and by the random acceleration of the class,
    with the spectral density q: q age^3 / 3.
    """
    acceleration = np.asarray(params.acceleration_noise)[listed.label]
    at_random = (acceleration * age_s**3 / 3.0)[:, None] * ALONG_BOTH
    more = listed.velocity_variance * (age_s**2)[:, None] + at_random
    return replace(listed, variance_m2=listed.variance_m2 + more, relative_m2=listed.relative_m2 + more)


def _along_axes(
    variance: Float[ndarray, "d 2"],
    axis: Float[ndarray, "d 2"],
) -> Float[ndarray, "d 3"]:
    """Variances xx, xy, yy from those along and across unit vectors."""
    along, across = variance.T
    cos, sin = axis.T
    xx = along * cos * cos + across * sin * sin
    yy = along * sin * sin + across * cos * cos
    return np.column_stack([xx, (along - across) * cos * sin, yy])


def _mean(variance: Float[ndarray, "d 3"]) -> Float[ndarray, "d"]:
    """Mean of the variances along both axes."""
    return 0.5 * (variance[:, 0] + variance[:, 2])


def _velocity_variance(
    listed: Detections,
    limit_mps: Float[ndarray, "d"],
    own_mps: Float[ndarray, "d"],
    sigma_rad: Float[ndarray, "d"],
    params: TrackingParams,
) -> Float[ndarray, "d 3"]:
    """Mean squares of the velocity of objects without a track, whose headings have these errors or are reversed."""
    mean_mps, sigma_mps = expected_speed(listed.label, limit_mps, own_mps, params)
    along = mean_mps**2 + sigma_mps**2
    across = np.asarray(params.across_sigma_mps)[listed.label] ** 2
    sine_square = -0.5 * np.expm1(-2.0 * sigma_rad**2)  # its mean, for a normal error
    aside = sine_square * (along - across)
    yaw = listed.boxes.yaw_rad
    axis = np.column_stack([np.cos(yaw), np.sin(yaw)])
    return _along_axes(np.column_stack([along - aside, across + aside]), axis)
