"""Tracks of the objects that each vehicle detects, of all vehicles at once.

A track belongs to one observer. It is predicted over the time that has passed since its observer last sensed, so
observers may sense at different moments and rates. Tracks of observers that do not sense are left as they are.
"""

import numpy as np
import scipy
from jaxtyping import Int
from numpy import ndarray

from cosim.base.ragged import ranges, rows_of, stable_order
from sensors.tracking.assignment import assigned
from sensors.tracking.motion import mean_motion, predicted, updated
from sensors.tracking.new_tracks import begun
from sensors.tracking.params import TrackingParams
from sensors.tracking.tracks import VELOCITY, VV, Found, ObjectStates, Observers, TrackMemory, Tracks, east_and_north


def track(
    memory: TrackMemory, observers: Observers, found: Found, params: TrackingParams
) -> tuple[TrackMemory, ObjectStates]:
    """Continue the tracks of all observers that sense now with what they detect.

    Parameters
    ----------
    memory
        Result of the call before; `TrackMemory()` at the beginning.
    observers
        Those that sense now, also those that detect nothing.
    found
        Their detections. Every detection continues a track or begins one.
    params
        The parameters.

    Returns
    -------
    The new memory, and the state of the object of each detection.

    Raises
    ------
    ValueError
        If an observer senses before the time of its tracks, a detection belongs to an observer that does not sense, or
        rows are not sorted.

    Notes
    -----
    Each track has two Kalman filters with nearly constant velocity (continuous white-noise acceleration), a textbook's
    [1]_, which interact: `predicted`. Tests compare a single one with Stone Soup. Noise is the same along both axes of
    the plane, and errors along and across the first heading count as independent, so that a filter has two times three
    covariances instead of sixteen. Assignment: `assigned`. Existence: `existence_gain`.   Deviations: the expected
    speed of a new track is ours.

    .. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001.
    """
    is_each_once = (np.diff(observers.number) > 0).all()
    if not is_each_once or (np.diff(found.observer) < 0).any():
        raise ValueError("observers are sorted by number, each once, and detections by observer; these are not.")
    row, senses = rows_of(found.observer, observers.number)
    if not senses.all():
        raise ValueError(
            f"a detection belongs to observer {found.observer[np.argmin(senses)]}, which does not sense now."
        )
    old = memory.tracks
    # Tracks of observers that sense now are due; the others wait.
    at, due = rows_of(old.observer, observers.number)
    now_s = np.full(len(old), observers.time_s.max(initial=-np.inf))
    now_s[due] = observers.time_s[at[due]]
    if (now_s[due] < old.time_s[due]).any():
        raise ValueError("an observer senses before the time of its own tracks: time goes forward.")
    kept = now_s - old.last_s <= params.keep_s + 1e-9  # those of observers that have left end here too
    waiting = old.take(np.flatnonzero(kept & ~due))
    rows = np.flatnonzero(kept & due)
    tracks = predicted(old.take(rows), now_s[rows], params)
    t, d = assigned(tracks, found, params)
    again = updated(tracks.take(t), found.take(d), params)
    missed, fresh = _others(t, len(tracks)), _others(d, len(found))
    known, n_objects, object_id = _numbered(memory, found.observer[fresh])
    new = begun(found.take(fresh), object_id, observers, row[fresh], params)
    joined = Tracks.concat([again, new, tracks.take(missed), waiting])
    of_detection = np.empty(len(found), np.int64)
    of_detection[np.append(d, fresh)] = np.arange(len(found))
    of_detections = joined.take(of_detection)
    motion = mean_motion(of_detections)
    velocity_mps = east_and_north(motion[:, :, VELOCITY], of_detections.axis)
    velocity_mps[of_detections.n_hits < params.confirm_hits] = np.nan
    order = stable_order(joined.object_id)
    tracks = joined.take(order.take(stable_order(joined.observer.take(order))))
    return TrackMemory(tracks, known, n_objects), ObjectStates(
        object_id=of_detections.object_id,
        age_s=of_detections.time_s - of_detections.first_s,
        velocity_mps=velocity_mps,
        existence_p=scipy.special.expit(of_detections.existence),
        axis=of_detections.axis,
        variance=motion[:, :, VV],
    )


def _others(rows: Int[ndarray, "m"], n: int) -> Int[ndarray, "k"]:
    """Those of n rows that are not among these, ascending."""
    is_other = np.ones(n, bool)
    is_other[rows] = False
    return np.flatnonzero(is_other)


def _numbered(
    memory: TrackMemory, observer: Int[ndarray, "d"]
) -> tuple[Int[ndarray, "k"], Int[ndarray, "k"], Int[ndarray, "d"]]:
    """The observers with numbered objects, how many each has, and the numbers of the new objects."""
    of, n = np.unique(observer, return_counts=True)
    known = np.union1d(memory.known, of)
    n_objects = np.zeros(len(known), np.int64)
    n_objects[np.searchsorted(known, memory.known)] = memory.n_objects
    at = np.searchsorted(known, of)
    object_id = ranges(n_objects[at], n)
    n_objects[at] += n
    return known, n_objects, object_id
