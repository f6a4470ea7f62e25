"""What a vehicle expects of an object that it has just discovered."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from sensors.tracking.existence import existence_of_score
from sensors.tracking.motion import mean_motion, position_variance, predicted, updated
from sensors.tracking.params import TrackingParams
from sensors.tracking.tracks import PLACE, VV, Found, Observers, Tracks, along_and_across

_STREET = np.array([[0.5, 0.4], [0.0, 0.0], [0.0, 0.0], [0.5, 0.4]])
"""By class, shares of the speed limit that are mean and standard deviation of a speed on a street, on which vehicles
stop: between those of a uniform distribution (0.29) and those of vehicles that stand or drive at the limit (0.5)."""
_MOTORWAY = np.array([[0.8, 0.6], [0.0, 0.0], [0.0, 0.0], [0.8, 0.6]])
"""Those on a road on which nobody stops but in a jam: the mean square is that of the limit, and a speed of 0 is not
excluded."""
_MOTORWAY_MPS = 80.0 / 3.6
"""Roads with a greater limit have no traffic lights: Germany's guideline allows lights up to 70 km/h."""


def begun(
    found: Found, object_id: Int[ndarray, "d"], observers: Observers, row: Int[ndarray, "d"], params: TrackingParams
) -> Tracks:
    """New tracks, one per detection.

    Parameters
    ----------
    found
        The detections.
    object_id
        The number of each new object.
    observers, row
        Those that sense, and the row of each detection's observer.
    params
        The parameters.

    Returns
    -------
    Tracks with the positions of the detections and the expected velocities.
    """
    label, time_s = found.label, observers.time_s[row]
    mean_mps, sigma_mps = expected_speed(label, found.limit_mps, observers.speed_mps[row], params)
    axis = np.column_stack([np.cos(found.yaw_rad), np.sin(found.yaw_rad)])
    t = found.after_s[:, None]
    v = np.column_stack([mean_mps, np.zeros(len(found))])
    vv = np.column_stack([sigma_mps, np.asarray(params.across_sigma_mps)[label]]) ** 2
    xx = position_variance(label, params)[:, None] + t * t * vv
    place = along_and_across(found.xy_m, axis) - t * v
    motion = np.stack([place, v, xx, -t * vv, vv], axis=2)
    usual = 1.0 - params.accelerating_p, params.accelerating_p
    return Tracks(
        observer=found.observer,
        object_id=object_id,
        label=label,
        n_hits=np.ones(len(found), np.int64),
        time_s=time_s,
        first_s=time_s,
        last_s=time_s,
        axis=axis,
        motion_p=np.tile(usual, (len(found), 1)),
        motion=np.repeat(motion[:, None], 2, axis=1),
        existence=params.existence_new + existence_of_score(found.score, params),
    )


def expected_speed(
    label: UInt8[ndarray, "d"],
    limit_mps: Float[ndarray, "d"],
    own_mps: Float[ndarray, "d"],
    params: TrackingParams,
) -> tuple[Float[ndarray, "d"], Float[ndarray, "d"]]:
    """Mean and standard deviation of the speed of an object that nobody has tracked yet [m/s].

    Parameters
    ----------
    label
        `ObjectClass`.
    limit_mps
        Speed limit of the road there, or NaN.
    own_mps
        Speed of the observer. It counts where the limit is not known.
    params
        The parameters. Those of the class are the least values.
    """
    is_mapped = ~np.isnan(limit_mps)
    shares = np.column_stack([params.own_speed_mean, params.own_speed_sigma])[label]
    shares[is_mapped] = _STREET[label[is_mapped]]
    is_fast = limit_mps > _MOTORWAY_MPS
    shares[is_fast] = _MOTORWAY[label[is_fast]]
    road_mps = np.where(is_mapped, limit_mps, own_mps)
    of_class = np.column_stack([params.along_mean_mps, params.along_sigma_mps])[label]
    mean_mps, sigma_mps = np.maximum(of_class, shares * road_mps[:, None]).T
    return mean_mps, sigma_mps


def confirmed_variance(params: TrackingParams, interval_s: float) -> Float[ndarray, "4 2"]:
    """Variance of the velocity along and across the axis, by class, when a track first has a velocity [m2/s2].

    It is that of an object which speeds up, brakes or turns, after `confirm_hits` detections `interval_s` apart where
    they were expected.
    """
    n = len(params.position_sigma_m)
    label = np.arange(n, dtype=np.uint8)
    number, zero = np.arange(n), np.zeros(n)
    half, unknown = np.full(n, 0.5), np.full(n, np.nan)
    found = Found(number, label, np.zeros((n, 2)), zero, half, unknown, zero)
    tracks = begun(found, number, Observers(number, zero, zero), number, params)
    for hit in range(1, params.confirm_hits):
        tracks = predicted(tracks, np.full(n, hit * interval_s), params)
        expected = replace(found, xy_m=mean_motion(tracks)[:, :, PLACE])
        tracks = updated(tracks, expected, params)
    return tracks.motion[:, 1, :, VV]
