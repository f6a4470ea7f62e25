"""How objects move: what is expected of a new track, and two interacting Kalman filters per track.

Each track has two filters with nearly constant velocity. One is for an object that keeps its velocity, the other for
one that speeds up, brakes or turns. They exchange what they know, by the probability of each.
"""

from dataclasses import replace

import numpy as np
import scipy
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.base.kernel import compiled, inlined
from cosim.base.threads import in_ranges
from sensors.tracking.params import TrackingParams
from sensors.tracking.tracks import PLACE, VELOCITY, VV, XV, XX, Found, Observers, Tracks

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
        existence=params.existence_new + _existence_of_score(found.score, params),
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
    place = along_and_across(found.xy_m, tracks.axis)
    variance = position_variance(found.label, params)

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
    return east_and_north(mean_motion(tracks)[:, :, PLACE], tracks.axis)


def position_variance(label: UInt8[ndarray, "d"], params: TrackingParams) -> Float[ndarray, "d"]:
    """Variance of the position of detections, along each axis [m2]."""
    sigma_m = np.asarray(params.position_sigma_m)[label]
    return sigma_m**2


@inlined
def _mixed(steady_p, motion, axis, out):
    """Write mean and covariance of a mixture of both motions along one axis."""
    accelerating_p = 1.0 - steady_p
    steady, accelerating = motion[0, axis], motion[1, axis]
    x = steady[PLACE] - accelerating[PLACE]
    v = steady[VELOCITY] - accelerating[VELOCITY]
    both_p = steady_p * accelerating_p
    for column in range(5):
        out[column] = steady_p * steady[column] + accelerating_p * accelerating[column]
    out[XX] += both_p * x * x
    out[XV] += both_p * x * v
    out[VV] += both_p * v * v


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
                later[PLACE] = x + v * t
                later[VELOCITY] = v
                moved = 2.0 * xv + t * (vv + q * t / 3.0)
                later[XX] = xx + t * moved
                later[XV] = xv + t * (vv + q * t / 2.0)
                later[VV] = vv + q * t


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
                state[PLACE] = x + a / s * y
                state[VELOCITY] = v + b / s * y
                state[XX] = xx - a / s * a
                state[XV] = xv - b / s * a
                state[VV] = vv - b / s * b
        most = max(log_p[0], log_p[1])
        steady = motion_p[i, 0] * np.exp(log_p[0] - most)
        accelerating = motion_p[i, 1] * np.exp(log_p[1] - most)
        motion_p[i, 0] = steady / (steady + accelerating)
        motion_p[i, 1] = 1.0 - motion_p[i, 0]


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
    gain = params.existence_again + _existence_of_score(score, params)
    memory_s = params.existence_memory_s
    if memory_s == 0:
        return gain
    return -np.expm1(-since_s / memory_s) * gain


def _existence_of_score(score: Float[ndarray, "n"], params: TrackingParams) -> Float[ndarray, "n"]:
    """Log-odds of existence by the score alone; 0 at 0.5."""
    return params.existence_score * scipy.special.logit(np.clip(score, *params.existence_scores))


def along_and_across(
    vector: Float[ndarray, "n 2"],
    axis: Float[ndarray, "n 2"],
) -> Float[ndarray, "n 2"]:
    """Vectors of the plane, along and across a unit vector."""
    (x, y), (cos, sin) = vector.T, axis.T
    along = cos * x + sin * y
    return np.column_stack([along, cos * y - sin * x])


def east_and_north(
    along_across: Float[ndarray, "n 2"],
    axis: Float[ndarray, "n 2"],
) -> Float[ndarray, "n 2"]:
    """The inverse of `along_and_across`."""
    (u, v), (cos, sin) = along_across.T, axis.T
    east = cos * u - sin * v
    return np.column_stack([east, sin * u + cos * v])
