"""Tracks of the objects that each vehicle detects, of all vehicles at once.

A track belongs to one observer. It is predicted over the time that has passed since its observer last sensed, so
observers may sense at different moments and rates. Tracks of observers that do not sense are left as they are.
"""

from itertools import pairwise

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.base.ragged import ranges, rows_of
from cosim.base.threads import in_ranges
from sensors.tracking.motion import (
    along_and_across,
    begun,
    east_and_north,
    mean_motion,
    places_m,
    position_variance,
    predicted,
    updated,
)
from sensors.tracking.params import TrackingParams
from sensors.tracking.tracks import VELOCITY, VV, Found, ObjectStates, Observers, TrackMemory, Tracks

_CLASS_GROUP = np.array([0, 1, 1, 0], np.uint8)
"""A detector confuses cars with trucks and pedestrians with cyclists. Tracks go on with detections of their group."""
_BLOCK_PAIRS = 2048
"""Pairs of tracks and detections that are assigned at once; the solver's time grows faster than their number."""


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
    rows = rows[np.lexsort((old.object_id[rows], old.observer[rows]))]
    tracks = predicted(old.take(rows), now_s[rows], params)
    t, d = assigned(tracks, found, params)
    again = updated(tracks.take(t), found.take(d), params)
    missed, fresh = _others(t, len(tracks)), _others(d, len(found))
    known, n_objects, object_id = _numbered(memory, found.observer[fresh])
    new = begun(found.take(fresh), object_id, observers, row[fresh], params)
    of_detection = np.empty(len(found), np.int64)
    of_detection[np.append(d, fresh)] = np.arange(len(found))
    of_detections = Tracks.concat([again, new]).take(of_detection)
    motion = mean_motion(of_detections)
    velocity_mps = east_and_north(motion[:, :, VELOCITY], of_detections.axis)
    velocity_mps[of_detections.n_hits < params.confirm_hits] = np.nan
    memory = TrackMemory(Tracks.concat([waiting, of_detections, tracks.take(missed)]), known, n_objects)
    return memory, ObjectStates(
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


def assigned(
    tracks: Tracks,
    found: Found,
    params: TrackingParams,
) -> tuple[Int[ndarray, "m"], Int[ndarray, "m"]]:
    """The detections that continue tracks of the same observer: global nearest neighbour, all observers at once.

    Parameters
    ----------
    tracks
        The tracks at the time of the detections, sorted by observer.
    found
        The detections.
    params
        The parameters.

    Returns
    -------
    Rows of `tracks`, ascending, and the row of `found` of each. Each row occurs at most once.

    Notes
    -----
    A pair is possible if both are in one group of classes, the squared Mahalanobis distance d² of the innovation is in
    the gate for one of the two motions, and the predicted density exceeds `other_per_m2`, that of other detections. It
    is the mean over the motions of exp(-d² / 2) / (2 pi sqrt(det S)), by their probabilities. Among the possible pairs,
    the assignment has the largest product of the ratios of the two densities. Their term det S keeps uncertain tracks
    from taking the detections of certain ones [1]_.   Deviations: the detection probability is taken as 1/2, so that
    it cancels; the gate is ours.

    .. [1] R. Altendorfer, S. Wirkert, A complete derivation of the association log-likelihood distance for
       multi-object tracking, arXiv 1508.04124, 2015.
    """
    gate = -2 * np.log1p(-params.gate_p)
    xy_m = places_m(tracks), np.ascontiguousarray(found.xy_m)
    first, end = (np.searchsorted(found.observer, tracks.observer, side) for side in ("left", "right"))
    groups = _CLASS_GROUP[tracks.label], _CLASS_GROUP[found.label]
    reach_m = _reach_m(tracks, xy_m[0], found, params)
    t, d = _near(first, end, *xy_m, reach_m * reach_m, *groups)
    where_m = along_and_across(found.xy_m[d], tracks.axis[t])
    after_s, noise_m2 = found.after_s[d], position_variance(found.label[d], params)
    squared, log_density = np.empty(len(t)), np.empty(len(t))

    def compare(begin: int, end: int) -> None:
        _compare(begin, end, t, where_m, after_s, noise_m2, tracks.motion_p, tracks.motion, squared, log_density)

    in_ranges(compare, len(t))
    gain = 2.0 * (log_density - np.log(2.0 * np.pi * params.other_per_m2))
    rows = np.flatnonzero((squared < gate) & (gain > 0))
    t, d, gain = t[rows], d[rows], gain[rows]
    n_of_track, n_of_detection = np.bincount(t), np.bincount(d)
    contested = (n_of_track[t] > 1) | (n_of_detection[d] > 1)
    chosen = ~contested
    pairs = np.flatnonzero(contested)
    for block in _blocks(tracks.observer[t[pairs]]):
        rows = pairs[block]
        chosen[rows] = _largest_sum(t[rows], d[rows], gain[rows])
    return t[chosen], d[chosen]


def _reach_m(tracks: Tracks, xy_m: Float[ndarray, "n 2"], found: Found, params: TrackingParams) -> Float[ndarray, "n"]:
    """How far from where it is expected (`xy_m`) no detection can be in the gate of a track.

    That is the longer half axis of the gate of each motion, from where that motion expects the object.
    """
    gate = -2 * np.log1p(-params.gate_p)
    after_s = np.abs(found.after_s).max(initial=0.0)
    place, velocity, xx, xv, vv = np.moveaxis(tracks.motion, 3, 0)
    moved_m2 = after_s * (2.0 * np.abs(xv) + after_s * vv)
    most_m2 = (xx + moved_m2).max(axis=2) + max(params.position_sigma_m) ** 2
    expected = along_and_across(xy_m, tracks.axis)
    apart_m = np.abs(place - expected[:, None])
    along_m, across_m = np.moveaxis(apart_m + after_s * np.abs(velocity), 2, 0)
    reach_m = np.sqrt(gate * most_m2) + np.hypot(along_m, across_m)
    return reach_m.max(axis=1) * (1 + 1e-9)


@compiled
def _compare(begin, end, track, where, after_s, noise, motion_p, motion, squared, log_density):
    """Write for pairs the smaller squared distance of both motions, and the logarithm of 2 pi times their density."""
    for k in range(begin, end):
        i, t = track[k], after_s[k]
        squared[k] = np.inf
        density = 0.0
        for j in range(2):
            if motion_p[i, j] == 0.0:
                continue
            distance = 0.0
            volume = 1.0
            for axis in range(2):
                x, v, xx, xv, vv = motion[i, j, axis]
                moved = 2.0 * xv + t * vv
                s = xx + t * moved + noise[k]
                y = where[k, axis] - x - t * v
                distance += y * y / s
                volume *= s
            squared[k] = min(squared[k], distance)
            of_motion = np.exp(-0.5 * distance) / np.sqrt(volume)
            density += motion_p[i, j] * of_motion
        log_density[k] = np.log(density) if density > 0.0 else -np.inf


def _blocks(observer: Int[ndarray, "p"]) -> list[slice]:
    """Slices of whole observers with some `_BLOCK_PAIRS` pairs each."""
    first = np.flatnonzero(np.diff(observer, prepend=-1 - observer[:1]))
    begins_block = np.diff(first // _BLOCK_PAIRS, prepend=-1) > 0
    edges = np.append(first[begins_block], len(observer))
    return [slice(a, b) for a, b in pairwise(edges)]


def _largest_sum(
    t: Int[ndarray, "p"],
    d: Int[ndarray, "p"],
    gain: Float[ndarray, "p"],
) -> Bool[ndarray, "p"]:
    """Whether each pair is in the assignment with the largest sum of gains, which are positive. Pairs are sorted by t.

    Every row of the matrix also has a column of its own that means: no detection.
    """
    rows, i = np.unique(t, return_inverse=True)
    columns, j = np.unique(d, return_inverse=True)
    most, n, m = 1.0 + gain.max(), len(rows), len(columns)
    cost = np.concatenate([most - gain, np.full(n, most)])
    own = np.arange(n)
    of = np.append(i, own), np.append(j, m + own)
    _, column = scipy.sparse.csgraph.min_weight_full_bipartite_matching(
        scipy.sparse.csr_array((cost, of), shape=(n, m + n))
    )
    return column[i] == j


@compiled
def _near(first, end, track_xy, found_xy, most_m2, group_of_track, group_of_found):
    """Pairs, sorted, of a track and one of its observer's detections `first` to `end`, of one group of classes and
    nearer to each other than the track's limit."""
    room = (end - first).sum()
    t = np.empty(room, np.int64)
    d = np.empty(room, np.int64)
    n = 0
    for i in range(len(first)):
        for k in range(first[i], end[i]):
            dx = found_xy[k, 0] - track_xy[i, 0]
            dy = found_xy[k, 1] - track_xy[i, 1]
            is_near = dx * dx + dy * dy < most_m2[i]
            if is_near and group_of_track[i] == group_of_found[k]:
                t[n], d[n] = i, k
                n += 1
    return t[:n], d[:n]
