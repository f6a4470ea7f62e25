"""Tracks of the objects that each vehicle detects: Kalman filters of all vehicles at once.

A track belongs to one observer. It is predicted over the time that has passed since its observer last sensed, so
observers may sense at different moments and rates. Tracks of observers that do not sense are left as they are.

Each track has two filters with nearly constant velocity. One is for an object that keeps its velocity, the other for
one that speeds up, brakes or turns. They exchange what they know, by the probability of each.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
import scipy
from annotated_types import Ge, Gt, Le, Lt
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.kernel import compiled, inlined
from cosim.base.ragged import ranges, rows_of, stable_order
from cosim.base.rows import Rows
from cosim.base.threads import in_ranges

_Positive = Annotated[float, Gt(0), Le(1000)]
Positive = tuple[_Positive, _Positive, _Positive, _Positive]
"""One value per class: car, pedestrian, cyclist, truck."""
_NotNegative = Annotated[float, Ge(0), Le(1000)]
NotNegative = tuple[_NotNegative, _NotNegative, _NotNegative, _NotNegative]
_Share = Annotated[float, Gt(0), Lt(1)]
_LogOdds = Annotated[float, Ge(-100), Le(100)]


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackingParams:
    """How every equipped vehicle tracks the objects that it detects.

    Tuples hold one value per class: car, pedestrian, cyclist, truck. The page on tracking says how the values were
    chosen.
    """

    model: Literal["none", "constant_velocity"] = "none"
    """`none`: detected objects have no velocity. `constant_velocity`: Kalman filters with nearly constant velocity."""
    steady_noise: Positive = (0.001, 0.002, 0.0005, 0.001)
    """Spectral density of the random acceleration of an object that keeps its velocity, along each axis [m2/s3]: by
    this much the variance of the velocity grows per second."""
    acceleration_noise: Positive = (2.5, 0.5, 0.6, 5.0)
    """That of an object that speeds up, brakes or turns [m2/s3]."""
    accelerating_p: Annotated[float, Ge(0), Lt(1)] = 0.2
    """Share of the time in which an object speeds up, brakes or turns."""
    motion_memory_s: Annotated[float, Gt(0), Le(1000)] = 2.0
    """After this time, 1/e of the objects have gone on as they moved without a chance to change [s]."""
    position_sigma_m: Positive = (0.08, 0.1, 0.07, 0.15)
    """Standard deviation of what is new in the error of a detection's position, along each axis [m]: a detector repeats
    a part of its error."""
    along_mean_mps: NotNegative = (6.0, 0.6, 3.0, 6.0)
    """Expected speed of a new track along the heading of its detection [m/s]."""
    along_sigma_mps: Positive = (4.5, 1.0, 3.0, 4.5)
    """Standard deviation of that speed [m/s]."""
    across_sigma_mps: Positive = (0.7, 1.0, 0.7, 0.7)
    """Standard deviation of the velocity across the heading [m/s]; its mean is 0."""
    own_speed_mean: NotNegative = (0.7, 0.0, 0.0, 0.7)
    """Share of the observer's own speed that the expected speed is at least where no map says the speed limit."""
    own_speed_sigma: NotNegative = (0.4, 0.0, 0.0, 0.4)
    """Share of the observer's own speed that the standard deviation of the speed is at least, likewise."""
    gate_p: _Share = 0.99
    """Probability that the next detection of a tracked object is inside the track's gate."""
    other_per_m2: Annotated[float, Gt(0), Le(1)] = 0.001
    """Density of the detections near a track that are not of its object, in one sweep [1/m2]. A detection may continue
    a track only if the track predicts it with a higher density."""
    confirm_hits: Annotated[int, Ge(1), Le(1000)] = 3
    """Number of detections from which on the object has a velocity."""
    keep_s: Annotated[float, Gt(0), Le(1000)] = 2.5
    """A track ends if its object is not detected for longer than this [s]. It must be at least as long as the interval
    between two sweeps."""
    existence_new: _LogOdds = 1.95
    """Log-odds that the object of a new track exists if the score is 0.5."""
    existence_again: _LogOdds = 1.38
    """Log-odds gained if it is detected again with a score of 0.5, long after the last time."""
    existence_score: _NotNegative = 1.9
    """Log-odds gained per log-odds of the score, in both cases."""
    existence_scores: tuple[_Share, _Share] = (0.18, 0.88)
    """Scores below and above these count as these."""
    existence_memory_s: Annotated[float, Ge(0), Le(1000)] = 1.5
    """Time over which a detector repeats its mistakes [s]. A detection t seconds after the last one counts by
    1 - exp(-t / existence_memory_s)."""

    def __post_init__(self) -> None:
        low, high = self.existence_scores
        if not low < high:
            raise ValueError(
                f"tracking.existence_scores = {self.existence_scores}: the first must be smaller than the second."
            )


_CLASS_GROUP = np.array([0, 1, 1, 0], np.uint8)
"""A detector confuses cars with trucks and pedestrians with cyclists. Tracks go on with detections of their group."""
_STREET = np.array([[0.5, 0.4], [0.0, 0.0], [0.0, 0.0], [0.5, 0.4]])
"""By class, shares of the speed limit that are mean and standard deviation of a speed on a street, on which vehicles
stop: between those of a uniform distribution (0.29) and those of vehicles that stand or drive at the limit (0.5)."""
_MOTORWAY = np.array([[0.8, 0.6], [0.0, 0.0], [0.0, 0.0], [0.8, 0.6]])
"""Those on a road on which nobody stops but in a jam: the mean square is that of the limit, and a speed of 0 is not
excluded."""
_MOTORWAY_MPS = 80.0 / 3.6
"""Roads with a greater limit have no traffic lights: Germany's guideline allows lights up to 70 km/h."""
_BLOCK_PAIRS = 2048
"""Pairs of tracks and detections that are assigned at once; the solver's time grows faster than their number."""


@dataclass(frozen=True, slots=True)
class Tracks(Rows):
    """N tracks, sorted by (observer, object_id), in the frame of the detections."""

    observer: Int[ndarray, "n"]
    """Any number that identifies the observer, the same in every call."""
    object_id: Int[ndarray, "n"]
    """Number of the object among those of its observer, from 0; never used twice."""
    label: UInt8[ndarray, "n"]
    """`ObjectClass` of the last detection."""
    n_hits: Int[ndarray, "n"]
    """Number of detections."""
    time_s: Float[ndarray, "n"]
    """Time of the estimates: when the observer last sensed."""
    first_s: Float[ndarray, "n"]
    """Time of the first detection."""
    last_s: Float[ndarray, "n"]
    """Time of the last detection."""
    axis: Float[ndarray, "n 2"]
    """Unit vector along the heading of the first detection. Errors along and across it are independent."""
    motion_p: Float[ndarray, "n 2"]
    """Probabilities that the object keeps its velocity, and that it does not."""
    motion: Float[ndarray, "n 2 2 5"]
    """For each of these cases, along and across `axis`: place, velocity, variance of the place, covariance of both,
    and variance of the velocity."""
    existence: Float[ndarray, "n"]
    """Log-odds that the object exists, at the last detection."""

    def __len__(self) -> int:
        return len(self.observer)

    @staticmethod
    def none() -> Tracks:
        """No tracks."""
        number = np.zeros(0, np.int64)
        real = np.zeros(0)
        return Tracks(
            observer=number,
            object_id=number,
            label=np.zeros(0, np.uint8),
            n_hits=number,
            time_s=real,
            first_s=real,
            last_s=real,
            axis=np.zeros((0, 2)),
            motion_p=np.zeros((0, 2)),
            motion=np.zeros((0, 2, 2, 5)),
            existence=real,
        )


@dataclass(frozen=True, slots=True)
class TrackMemory:
    """What the tracking of all observers passes on from one moment to the next."""

    tracks: Tracks = field(default_factory=Tracks.none)
    known: Int[ndarray, "k"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Observers that have ever had a track, sorted."""
    n_objects: Int[ndarray, "k"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Number of objects that each of them has numbered."""


@dataclass(frozen=True, slots=True)
class Observers:
    """E observers that sense now, sorted by number, each once."""

    number: Int[ndarray, "e"]
    time_s: Float[ndarray, "e"]
    """When each of them senses."""
    speed_mps: Float[ndarray, "e"]
    """How fast each of them drives."""


@dataclass(frozen=True, slots=True)
class Found(Rows):
    """D detections of the observers that sense now, sorted by observer."""

    observer: Int[ndarray, "d"]
    label: UInt8[ndarray, "d"]
    """`ObjectClass`."""
    xy_m: Float[ndarray, "d 2"]
    yaw_rad: Float[ndarray, "d"]
    score: Float[ndarray, "d"]
    limit_mps: Float[ndarray, "d"]
    """Speed limit of the road there; NaN where it is not known."""
    after_s: Float[ndarray, "d"]
    """When the object was there, after the time at which its observer senses: a sweep takes time."""

    def __len__(self) -> int:
        return len(self.observer)


@dataclass(frozen=True, slots=True)
class ObjectStates(Rows):
    """What tracking says about each detection, in the order of the detections."""

    object_id: Int[ndarray, "d"]
    """Number of the object among those of its observer."""
    age_s: Float[ndarray, "d"]
    """Time since the first detection of the object."""
    velocity_mps: Float[ndarray, "d 2"]
    """Velocity along x and y; NaN until the object has been detected `confirm_hits` times."""
    existence_p: Float[ndarray, "d"]
    """Probability that there is an object."""
    axis: Float[ndarray, "d 2"]
    """As in `Tracks`."""
    variance: Float[ndarray, "d 2"]
    """Variance of the velocity, along and across `axis` [m2/s2]."""


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
    velocity_mps = _east_and_north(motion[:, :, _VELOCITY], of_detections.axis)
    velocity_mps[of_detections.n_hits < params.confirm_hits] = np.nan
    order = stable_order(joined.object_id)
    tracks = joined.take(order.take(stable_order(joined.observer.take(order))))
    return TrackMemory(tracks, known, n_objects), ObjectStates(
        object_id=of_detections.object_id,
        age_s=of_detections.time_s - of_detections.first_s,
        velocity_mps=velocity_mps,
        existence_p=scipy.special.expit(of_detections.existence),
        axis=of_detections.axis,
        variance=motion[:, :, _VV],
    )


def _others(rows: Int[ndarray, "m"], n: int) -> Int[ndarray, "k"]:
    """Those of n rows that are not among these, ascending."""
    is_other = np.ones(n, bool)
    is_other[rows] = False
    return np.flatnonzero(is_other)


def predicted(tracks: Tracks, time_s: Float[ndarray, "n"], params: TrackingParams) -> Tracks:
    """The tracks at another time, without detections.

    Parameters
    ----------
    tracks
        The tracks.
    time_s
        The time of each.
    params
        The parameters.

    Returns
    -------
    The tracks with new times and motions.

    Notes
    -----
    Interacting multiple models [1]_: each filter begins with the mixture of what both know, weighted by the chances
    that an object which now moves in its way moved in the other before. In t seconds it has had a chance to change with
    probability 1 - exp(-t / motion_memory_s), and then accelerates with probability `accelerating_p`.
    With q the spectral density: x += v t, P_xx += 2 t P_xv + t² P_vv + q t³ / 3, P_xv += t P_vv + q t² / 2,
    P_vv += q t.   Deviations: mixtures leave the errors along and across the axis independent.

    .. [1] H. A. P. Blom, Y. Bar-Shalom, The interacting multiple model algorithm for systems with Markovian switching
       coefficients, IEEE Transactions on Automatic Control 33(8), 1988.
    """
    motion_p, motion = tracks.motion_p.copy(), tracks.motion.copy()
    noise = np.column_stack([params.steady_noise, params.acceleration_noise])[tracks.label]
    elapsed_s = time_s - tracks.time_s
    usual = np.array([1.0 - params.accelerating_p, params.accelerating_p])
    kept = np.exp(-elapsed_s / params.motion_memory_s)

    def predict(begin: int, end: int) -> None:
        _predict(begin, end, elapsed_s, kept, usual, noise, motion_p, motion)

    in_ranges(predict, len(tracks))
    return replace(tracks, time_s=time_s, motion_p=motion_p, motion=motion)


def updated(tracks: Tracks, found: Found, params: TrackingParams) -> Tracks:
    """The tracks after one detection each, at the time of the tracks.

    Parameters
    ----------
    tracks
        The tracks.
    found
        The detection of each.
    params
        The parameters.

    Returns
    -------
    The tracks with new motions, classes and existence.

    Notes
    -----
    A detection t seconds later measures x + t v, whose covariances with x and v are a = P_xx + t P_xv and
    b = P_xv + t P_vv. With r the variance of a detection, y the innovation and s = a + t b + r, along and across the
    axis: x += a y / s, v += b y / s, P_xx -= a² / s, P_xv -= a b / s, P_vv -= b² / s. The random acceleration within
    the sweep is left out. Bayes' rule changes the probabilities of both motions by the densities of the detection.
    """
    motion_p, motion = tracks.motion_p.copy(), tracks.motion.copy()
    place = _along_and_across(found.xy_m, tracks.axis)
    variance = _position_variance(found.label, params)

    def update(begin: int, end: int) -> None:
        _update(begin, end, place, found.after_s, variance, motion_p, motion)

    in_ranges(update, len(tracks))
    return replace(
        tracks,
        label=found.label,
        n_hits=tracks.n_hits + 1,
        last_s=tracks.time_s,
        motion_p=motion_p,
        motion=motion,
        existence=tracks.existence + existence_gain(found.score, tracks.time_s - tracks.last_s, params),
    )


def mean_motion(tracks: Tracks) -> Float[ndarray, "n 2 5"]:
    """Mean and covariance of place and velocity of each track, along and across its axis, in the order of `motion`."""
    found = np.empty((len(tracks), 2, 5))

    def mix(begin: int, end: int) -> None:
        _mix(begin, end, tracks.motion_p, tracks.motion, found)

    in_ranges(mix, len(tracks))
    return found


def places_m(tracks: Tracks) -> Float[ndarray, "n 2"]:
    """Where each track expects its object, east and north."""
    return _east_and_north(mean_motion(tracks)[:, :, _PLACE], tracks.axis)


_PLACE, _VELOCITY, _XX, _XV, _VV = range(5)
"""Columns of `Tracks.motion`."""


@inlined
def _mixed(steady_p, motion, axis, out):
    """Write mean and covariance of a mixture of both motions along one axis."""
    accelerating_p = 1.0 - steady_p
    steady, accelerating = motion[0, axis], motion[1, axis]
    x = steady[_PLACE] - accelerating[_PLACE]
    v = steady[_VELOCITY] - accelerating[_VELOCITY]
    both_p = steady_p * accelerating_p
    for column in range(5):
        out[column] = steady_p * steady[column] + accelerating_p * accelerating[column]
    out[_XX] += both_p * x * x
    out[_XV] += both_p * x * v
    out[_VV] += both_p * v * v


@compiled
def _mix(begin, end, motion_p, motion, out):
    """Write the mixture of each track."""
    for i in range(begin, end):
        steady_p = motion_p[i, 0]
        for axis in range(2):
            _mixed(steady_p, motion[i], axis, out[i, axis])


@compiled
def _predict(begin, end, elapsed_s, kept, usual, noise, motion_p, motion):
    """Move tracks on, in place; `kept` is the probability that nothing changed, `usual` that of each motion."""
    mixed = np.empty((2, 2, 5))
    steady_p = np.empty(2)
    for i in range(begin, end):
        t = elapsed_s[i]
        for j in range(2):
            changed = (1.0 - kept[i]) * usual[j]
            own = kept[i] * motion_p[i, j]
            total = own + changed
            from_steady = changed * motion_p[i, 0] + (own if j == 0 else 0.0)
            steady_p[j] = total
            share = from_steady / total if total > 0.0 else 1.0 - j
            for axis in range(2):
                _mixed(share, motion[i], axis, mixed[j, axis])
        for j in range(2):
            motion_p[i, j] = steady_p[j]
            q = noise[i, j]
            for axis in range(2):
                x, v, xx, xv, vv = mixed[j, axis]
                later = motion[i, j, axis]
                later[_PLACE] = x + v * t
                later[_VELOCITY] = v
                moved = 2.0 * xv + t * (vv + q * t / 3.0)
                later[_XX] = xx + t * moved
                later[_XV] = xv + t * (vv + q * t / 2.0)
                later[_VV] = vv + q * t


@compiled
def _update(begin, end, place, after_s, variance, motion_p, motion):
    """Give tracks one detection each, in place."""
    log_p = np.empty(2)
    for i in range(begin, end):
        t = after_s[i]
        for j in range(2):
            log_p[j] = 0.0
            for axis in range(2):
                state = motion[i, j, axis]
                x, v, xx, xv, vv = state
                a, b = xx + t * xv, xv + t * vv
                s = a + t * b + variance[i]
                y = place[i, axis] - x - t * v
                log_p[j] -= 0.5 * (y * y / s + np.log(s))
                state[_PLACE] = x + a / s * y
                state[_VELOCITY] = v + b / s * y
                state[_XX] = xx - a / s * a
                state[_XV] = xv - b / s * a
                state[_VV] = vv - b / s * b
        most = max(log_p[0], log_p[1])
        steady = motion_p[i, 0] * np.exp(log_p[0] - most)
        accelerating = motion_p[i, 1] * np.exp(log_p[1] - most)
        motion_p[i, 0] = steady / (steady + accelerating)
        motion_p[i, 1] = 1.0 - motion_p[i, 0]


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
    xx = _position_variance(label, params)[:, None] + t * t * vv
    place = _along_and_across(found.xy_m, axis) - t * v
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
        existence=params.existence_new + _of_score(found.score, params),
    )


def _position_variance(label: UInt8[ndarray, "d"], params: TrackingParams) -> Float[ndarray, "d"]:
    """Variance of the position of detections, along each axis [m2]."""
    sigma_m = np.asarray(params.position_sigma_m)[label]
    return sigma_m**2


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
        expected = replace(found, xy_m=mean_motion(tracks)[:, :, _PLACE])
        tracks = updated(tracks, expected, params)
    return tracks.motion[:, 1, :, _VV]


def existence_gain(
    score: Float[ndarray, "n"], since_s: Float[ndarray, "n"], params: TrackingParams
) -> Float[ndarray, "n"]:
    """Log-odds of existence that a track gains by a further detection.

    Parameters
    ----------
    score
        Score of the detection.
    since_s
        Time since the detection before.
    params
        The parameters.

    Returns
    -------
    One value per detection; negative for low scores.

    Notes
    -----
    Bayes' rule in log-odds: the posterior odds are the prior odds times the likelihood ratio of the detection and its
    score. The idea of a probability of existence per track is that of integrated probabilistic data association [1]_,
    of which we read the abstract only. Deviations: the likelihood ratio is a logistic function of the score, fitted to
    recorded detections. It counts by 1 - exp(-t / existence_memory_s), because misses and false positives of a real
    detector persist. A miss changes nothing: in the fit its coefficient was 0.06.

    .. [1] D. Musicki, R. Evans, S. Stankovic, Integrated probabilistic data association, IEEE Transactions on Automatic
       Control 39(6), 1994.
    """
    gain = params.existence_again + _of_score(score, params)
    memory_s = params.existence_memory_s
    if memory_s == 0:
        return gain
    return -np.expm1(-since_s / memory_s) * gain


def _of_score(score: Float[ndarray, "n"], params: TrackingParams) -> Float[ndarray, "n"]:
    """Log-odds of existence by the score alone; 0 at 0.5."""
    return params.existence_score * scipy.special.logit(np.clip(score, *params.existence_scores))


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
    where_m = _along_and_across(found.xy_m[d], tracks.axis[t])
    after_s, noise_m2 = found.after_s[d], _position_variance(found.label[d], params)
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
    expected = _along_and_across(xy_m, tracks.axis)
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


def _along_and_across(
    vector: Float[ndarray, "n 2"],
    axis: Float[ndarray, "n 2"],
) -> Float[ndarray, "n 2"]:
    """Vectors of the plane, along and across a unit vector."""
    (x, y), (cos, sin) = vector.T, axis.T
    along = cos * x + sin * y
    return np.column_stack([along, cos * y - sin * x])


def _east_and_north(
    along_across: Float[ndarray, "n 2"],
    axis: Float[ndarray, "n 2"],
) -> Float[ndarray, "n 2"]:
    """The inverse of `_along_and_across`."""
    (u, v), (cos, sin) = along_across.T, axis.T
    east = cos * u - sin * v
    return np.column_stack([east, sin * u + cos * v])
