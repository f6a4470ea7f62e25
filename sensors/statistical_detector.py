"""A statistical model of a 3D object detector: detection probability, score and error of each box, false positives."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import numpy as np
import scipy
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.base.bounds import NotNegative100, NotNegative1000, Positive100, Share
from cosim.base.hash_rng import normals, persistent_normals
from cosim.base.plane import turned_by, wrapped
from sensors.boxes import Boxes
from sensors.evidence import Observability
from sensors.false_positives import false_positives
from sensors.lidar import Sweeps
from sensors.reports import DetectorDraws, Reports

N_DRAWS = 16
"""Per (observer, actor): detected; score; x, y, z; length, width, height; heading; heading flipped; class confused;
duplicated, and of the duplicate the score, x, y and heading."""

Shares = tuple[Share, Share, Share, Share]
"""One value per class: car, pedestrian, cyclist, truck."""
NotNegative = tuple[NotNegative1000, NotNegative1000, NotNegative1000, NotNegative1000]
_Positive = Annotated[float, Gt(0), Le(1_000_000)]
Positive = tuple[_Positive, _Positive, _Positive, _Positive]
_LogOdds = Annotated[float, Ge(-100), Le(100)]
LogOdds = tuple[_LogOdds, _LogOdds, _LogOdds, _LogOdds]
Size = tuple[Positive100, Positive100, Positive100]


@dataclass(frozen=True, kw_only=True, slots=True)
class DetectorParams:
    """The detector of every equipped vehicle. The profile in `sensors/profiles` gives the values that are not set.

    Tuples hold one value per class: car, pedestrian, cyclist, truck.
    """

    model: str = "avod"
    """`avod`, `pointpillars`, `pv_rcnn`: fitted to the detectors of that name, `avod` to one row of a synthetic data
    set, `pv_rcnn` to figures on KITTI at two overlaps. `ideal`: every actor with a return is detected, exactly and with
    score 1, and nothing else. Your own class: path.py:Name."""
    found_max_p: Shares | None = None
    """Probability to detect an unoccluded object with very many returns."""
    half_returns: Positive | None = None
    """Returns at which half of `found_max_p` is reached."""
    steepness: Positive100 | None = None
    """Slope of that curve over the logarithm of the returns."""
    occlusion_loss: Shares | None = None
    """Share of that probability that is lost at full occlusion, in addition to the effect of the lost returns."""
    score_logit: LogOdds | None = None
    """Mean log-odds of the score at `half_returns`."""
    score_gain: NotNegative100 | None = None
    """Log-odds gained per e-fold of returns."""
    score_occlusion: NotNegative100 | None = None
    """Log-odds lost at full occlusion."""
    score_error: NotNegative | None = None
    """Log-odds lost per unit of squared horizontal error in standard deviations: inaccurate boxes score lower."""
    score_sigma: NotNegative100 | None = None
    """Spread of the log-odds."""
    xy_sigma_m: NotNegative | None = None
    """Smallest position error along and across the box [m]."""
    xy_sigma_per_m: Annotated[float, Ge(0), Le(1)] | None = None
    """Position error gained per metre of range [m/m]."""
    xy_sigma_sparse_m: NotNegative | None = None
    """Position error of an object with one return, falling with the square root of the returns [m]."""
    z_share: NotNegative100 | None = None
    """Vertical position error as a share of the horizontal one: the height of the road is well known."""
    size_sigma: Shares | None = None
    """Relative error of length, width and height of a dense object."""
    size_sigma_sparse: Shares | None = None
    """Relative size error added at one return, falling with the square root of the returns."""
    yaw_sigma_rad: NotNegative | None = None
    """Heading error of a dense object [rad]."""
    yaw_sigma_sparse_rad: Annotated[float, Ge(0), Le(10)] | None = None
    """Heading error added at one return, falling with the square root of the returns [rad]."""
    flip_p: Share | None = None
    """Probability that the heading is reversed."""
    confusion_p: tuple[Shares, Shares, Shares, Shares] | None = None
    """Probability that an object of the row's class is reported as one of the column's."""
    duplicate_p: Share | None = None
    """Probability that a detected object is reported a second time, with a larger error and a lower score."""
    duplicate_logit: NotNegative100 | None = None
    """Mean log-odds by which the second report scores lower."""
    duplicate_sigma: NotNegative100 | None = None
    """Position error of the second report, in lengths and widths of its box."""
    false_positive_per_sweep: Annotated[float, Ge(0), Le(200)] | None = None
    """Mean number of false positives per sweep."""
    false_positive_mix: Shares | None = None
    """Class shares of false positives."""
    false_positive_road_p: Share | None = None
    """Share of the false positives that may stand on open road; the others stand at walls and hidden actors."""
    false_positive_memory_s: Annotated[float, Ge(0.001), Le(1e7)] | None = None
    """Mean time until the persistent draw of a site is renewed [s]."""
    false_positive_memory_share: Share | None = None
    """Share of the false positives that persist; the rest are drawn anew in every sweep."""
    false_positive_shared: Share | None = None
    """Share of the persistent false positives that all observers on the same side of the site have in common."""
    false_positive_logit: Annotated[float, Ge(-20), Le(20)] | None = None
    """Mean log-odds of a false positive's score."""
    false_positive_sigma: NotNegative100 | None = None
    """Spread of those log-odds."""
    mean_lwh_m: tuple[Size, Size, Size, Size] | None = None
    """Mean size of a class [m], for false positives and for objects that are reported as another class."""
    min_score: Share | None = None
    """Boxes with a lower score are not reported."""
    memory_s: Annotated[float, Ge(0.001), Le(1e7)] | None = None
    """Time over which the draws of one (observer, actor) change [s]; see `cosim.base.hash_rng.persistent_normals`."""
    memory_share: Share | None = None
    """Share of the variance of those draws that persists; the rest is new in every sweep."""
    object_share: Share | None = None
    """Share of the persistent variance that belongs to the object, and that all observers have in common: what is dark
    or unusual is missed by all. 0: observers err independently of each other."""

    def __post_init__(self) -> None:
        mix = self.false_positive_mix
        if mix is not None and not 0 < sum(mix) <= 1 + 1e-9:
            raise ValueError(f"detector.false_positive_mix = {mix}: shares of classes add up to 1.")
        for row in self.confusion_p or ():
            if sum(row) > 1 + 1e-9:
                raise ValueError(f"detector.confusion_p: the row {row} adds up to more than 1.")


@lru_cache(maxsize=8)
def _profile(name: str) -> dict:
    """The parameters of a profile as its file states them; those of `ideal`, which it does not use, are AVOD's."""
    path = Path(__file__).parent / "profiles" / f"{'avod' if name == 'ideal' else name}.toml"
    stated = tomllib.loads(path.read_text(encoding="utf-8"))
    return stated["first_guess"] | stated["fitted"]


def resolved(params: DetectorParams) -> SimpleNamespace:
    """All parameters of a model: those set, else those of its profile; tuples as arrays."""
    stated = _profile(params.model)
    model = {}
    for field in fields(params):
        name = field.name
        if name == "model":
            continue
        value = getattr(params, name)
        if value is None:
            value = stated[name]
        model[name] = np.array(value) if isinstance(value, list | tuple) else value
    return SimpleNamespace(**model)


_NORMAL_PEAK = 1.0 / np.sqrt(2.0 * np.pi)
_LEAST_ERROR_SHARE, _MOST_ERROR_SHARE = 0.1, 5.0
"""A score is not believed to say more than this about the squared error."""


class StatisticalDetector:
    """A detector whose detection probability, scores and errors are functions of returns, occlusion and range.

    Errors grow with range and with fewer returns. False positives are at walls, on the road or at mostly hidden actors.
    """

    Params = DetectorParams

    def __init__(self, params: DetectorParams) -> None:
        self.model = resolved(params)

    def detect(
        self,
        sweeps: Sweeps,
        seen: Observability,
        boxes: Boxes,
        label: UInt8[ndarray, "n"],
        draws: DetectorDraws,
    ) -> Reports:
        """See `sensors.detector.Detector`."""
        found = self.of_actors(seen, boxes, label, sweeps.poses.origin_m, draws)
        found = found.moved(sweeps.moved_m(found.observer, boxes, found.actor))
        every = Reports.concat([found, false_positives(sweeps, seen, draws, self.model)])
        return every.take(np.flatnonzero(every.score >= self.model.min_score))

    def of_actors(
        self,
        seen: Observability,
        boxes: Boxes,
        label: UInt8[ndarray, "n"],
        origin_m: Float[ndarray, "m 3"],
        draws: DetectorDraws,
    ) -> Reports:
        """Reports of actors by what is seen of them, at any score; `origin_m` is the position of each sensor."""
        with_returns = seen.take(np.flatnonzero(seen.n_returns > 0))
        detected = _detected(with_returns, label, draws, self.model)
        z = pair_normals(detected, draws, self.model)
        return reports_of_actors(detected, boxes, label, origin_m, z, self.model)

    def recall(
        self,
        n_points: Int[ndarray, "n"],
        label: UInt8[ndarray, "n"],
        range_m: Float[ndarray, "n"],
    ) -> Float[ndarray, "n"]:
        """See `sensors.detector.KnowsRecall`.

        Notes
        -----
        The recall is `detection_p` times the probability that the class is right. Range matters only through the number
        of returns. The observer does not know what hides a part of the object, so occlusion is taken as 0; it only
        reduces the returns.
        """
        confused = self.model.confusion_p.copy()
        np.fill_diagonal(confused, 0.0)
        found = detection_p(n_points, np.zeros(len(n_points)), label, self.model)
        return found * (1.0 - confused.sum(axis=1)[label])

    def position_sigma_m(
        self,
        n_points: Int[ndarray, "n"],
        label: UInt8[ndarray, "n"],
        range_m: Float[ndarray, "n"],
    ) -> Float[ndarray, "n"]:
        """Standard deviation of the position of a detection along each axis [m]; arguments as `KnowsRecall.recall`."""
        sparse = 1.0 / np.sqrt(np.maximum(n_points, 1))
        by_returns = self.model.xy_sigma_m[label] + self.model.xy_sigma_sparse_m[label] * sparse
        return by_returns + self.model.xy_sigma_per_m * range_m

    def heading_sigma_rad(
        self,
        n_points: Int[ndarray, "n"],
        label: UInt8[ndarray, "n"],
        range_m: Float[ndarray, "n"],
    ) -> Float[ndarray, "n"]:
        """Standard deviation of the heading modulo pi [rad]: a reversed heading is no error of it."""
        sparse = 1.0 / np.sqrt(np.maximum(n_points, 1))
        return self.model.yaw_sigma_rad[label] + self.model.yaw_sigma_sparse_rad * sparse

    def size_sigma(
        self,
        n_points: Int[ndarray, "n"],
        label: UInt8[ndarray, "n"],
        range_m: Float[ndarray, "n"],
    ) -> Float[ndarray, "n"]:
        """Relative standard deviation of length, width and height, each."""
        sparse = 1.0 / np.sqrt(np.maximum(n_points, 1))
        return self.model.size_sigma[label] + self.model.size_sigma_sparse[label] * sparse

    def error_by_score(
        self,
        score: Float[ndarray, "n"],
        n_points: Int[ndarray, "n"],
        label: UInt8[ndarray, "n"],
    ) -> Float[ndarray, "n"]:
        """Mean squared error of the position of detections with this score, in units of that at any score.

        Notes
        -----
        The log-odds of a score are m + s n - k e: m by class and returns, n standard normal, and e half the squared
        normalised error, which has an exponential distribution of mean 1. So given the log-odds l, e is normal with
        mean (m - l) / k - (s / k)^2 and standard deviation s / k, cut off below 0. The result is the mean of that. The
        observer does not know what hides a part of the object: occlusion is taken as 0.
        """
        model = self.model
        log_n = np.log(np.maximum(n_points, 1) / model.half_returns[label])
        expected = model.score_logit[label] + model.score_gain * log_n
        slope = np.maximum(model.score_error[label], 1e-3)
        sigma = max(model.score_sigma, 1e-3) / slope
        log_odds = scipy.special.logit(np.clip(score, 1e-6, 1.0 - 1e-6))
        mean = (expected - log_odds) / slope - sigma**2
        z = mean / sigma
        # the density of z at 0, over the share that is above
        log_above = scipy.special.log_ndtr(z)
        density = np.exp(-0.5 * z * z - log_above) * _NORMAL_PEAK
        return np.clip(mean + sigma * density, _LEAST_ERROR_SHARE, _MOST_ERROR_SHARE)


class IdealDetector:
    """Reports every actor with at least one return exactly and with score 1, and nothing else."""

    Params = DetectorParams

    def __init__(self, params: DetectorParams) -> None:
        pass

    def detect(
        self,
        sweeps: Sweeps,
        seen: Observability,
        boxes: Boxes,
        label: UInt8[ndarray, "n"],
        draws: DetectorDraws,
    ) -> Reports:
        """See `sensors.detector.Detector`."""
        rows = np.flatnonzero(seen.n_returns > 0)
        actor, score = seen.actor[rows], np.ones(len(rows))
        found = Reports.of_actors(seen, rows, label[actor], boxes.take(actor), score)
        return found.moved(sweeps.moved_m(found.observer, boxes, actor))

    def recall(
        self,
        n_points: Int[ndarray, "n"],
        label: UInt8[ndarray, "n"],
        range_m: Float[ndarray, "n"],
    ) -> Float[ndarray, "n"]:
        """See `sensors.detector.KnowsRecall`: 1 with a return, 0 without."""
        return (n_points > 0).astype(float)

    def position_sigma_m(
        self,
        n_points: Int[ndarray, "n"],
        label: UInt8[ndarray, "n"],
        range_m: Float[ndarray, "n"],
    ) -> Float[ndarray, "n"]:
        """As that of `StatisticalDetector`: detections are exact."""
        return np.zeros(len(n_points))

    heading_sigma_rad = size_sigma = position_sigma_m


def _detected(
    seen: Observability, label: UInt8[ndarray, "n"], draws: DetectorDraws, model: SimpleNamespace
) -> Observability:
    """The rows of `seen` that are detected. Only these need further draws."""
    p = detection_p(seen.n_returns, seen.occlusion, label[seen.actor], model)
    u = uniform_of(pair_normals(seen, draws, model, 1)[:, 0])
    return seen.take(np.flatnonzero(u < p))


def pair_normals(
    seen: Observability, draws: DetectorDraws, model: SimpleNamespace, n: int = N_DRAWS
) -> Float[ndarray, "s n"]:
    """Standard normal draws for each (observer, actor), partly new in this step and partly persistent.

    Returns
    -------
    Row i belongs to row i of `seen`. The columns are the first `n` of those that `N_DRAWS` lists.

    Notes
    -----
    An event of probability p happens if |z| is below the p quantile of |z|, and a gross error if it is above the 1 - p
    quantile. Draws that change slowly thus change events slowly. If all draws are zero, every object is detected
    without error. Of one object, the draws of two observers have the correlation `memory_share` x `object_share`.
    """
    fresh = normals(draws.pair_step(seen), n)
    lasting = persistent_normals(draws.pair(seen), n, draws.time_s, model.memory_s)
    if model.object_share > 0.0:  # sqrt(1) times a number and nothing is that number, but takes time
        common = persistent_normals(draws.object(seen), n, draws.time_s, model.memory_s)
        lasting = _mixed(model.object_share, common, lasting)
    return _mixed(model.memory_share, lasting, fresh)


def _mixed(
    share: float,
    one: Float[ndarray, "s n"],
    other: Float[ndarray, "s n"],
) -> Float[ndarray, "s n"]:
    """Standard normal draws of which `one` makes this share of the variance and `other` the rest."""
    return np.sqrt(1.0 - share) * other + np.sqrt(share) * one


def uniform_of(z: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Uniform draws from standard normal ones.

    Returns
    -------
    Probability of a smaller |z|, in [0, 1): 0 for z = 0, and growing with |z|.
    """
    return np.minimum(2.0 * scipy.special.ndtr(np.abs(z)) - 1.0, 1.0 - 1e-16)


def detection_p(
    n_returns: Int[ndarray, "s"],
    occlusion: Float[ndarray, "s"],
    label: UInt8[ndarray, "s"],
    model: SimpleNamespace,
) -> Float[ndarray, "s"]:
    """Probability that an object is detected.

    Parameters
    ----------
    n_returns, occlusion
        Returns from the object, and the share of its unoccluded returns that are missing, in [0, 1].
    label
        `ObjectClass` of the object.
    model
        As `resolved` returns it.

    Returns
    -------
    Probability for each object; 0 without returns.

    Notes
    -----
    Of n returns: found_max_p n^s / (n^s + half_returns^s) (1 - occlusion_loss occlusion), s the steepness.
    """
    with np.errstate(divide="ignore"):  # no returns are infinitely fewer than half
        log_n = np.log(np.asarray(n_returns, float))
    log_odds = model.steepness * (log_n - np.log(model.half_returns[label]))
    share = scipy.special.expit(log_odds)
    return model.found_max_p[label] * share * (1.0 - model.occlusion_loss[label] * occlusion)


def reports_of_actors(
    seen: Observability,
    boxes: Boxes,
    label: UInt8[ndarray, "n"],
    origin_m: Float[ndarray, "m 3"],
    z: Float[ndarray, "s 16"],
    model: SimpleNamespace,
) -> Reports:
    """Reports of the actors that are detected; those of duplicates follow all others.

    Parameters
    ----------
    origin_m
        Position of each observer's sensor.
    """
    p = detection_p(seen.n_returns, seen.occlusion, label[seen.actor], model)
    rows = np.flatnonzero(uniform_of(z[:, 0]) < p)
    z = z[rows]
    observer, actor = seen.observer[rows], seen.actor[rows]
    n, occlusion = seen.n_returns[rows], seen.occlusion[rows]
    true_label = label[actor]
    reported = _confused(true_label, uniform_of(z[:, 10]), model.confusion_p)
    sized = _as_class(boxes.take(actor), true_label, reported, origin_m[observer], model.mean_lwh_m)
    sparse = 1.0 / np.sqrt(n)
    log_n = np.log(n / model.half_returns[true_label])
    logit = model.score_logit[true_label] + model.score_gain * log_n
    error = 0.5 * (z[:, 2] ** 2 + z[:, 3] ** 2)
    lost = model.score_error[true_label] * error
    noise = model.score_sigma * z[:, 1]
    logit += noise - model.score_occlusion * occlusion - lost

    # Standard deviations of position, size and heading, and the box with errors drawn from them.
    xy = model.xy_sigma_m[true_label] + model.xy_sigma_per_m * seen.range_m[rows]
    xy = xy + model.xy_sigma_sparse_m[true_label] * sparse
    size = model.size_sigma[true_label] + model.size_sigma_sparse[true_label] * sparse
    yaw = model.yaw_sigma_rad[true_label] + model.yaw_sigma_sparse_rad * sparse
    is_flipped = uniform_of(z[:, 9]) > 1.0 - model.flip_p
    turn = yaw * z[:, 8] + np.where(is_flipped, np.pi, 0.0)
    sigma_m = np.column_stack([xy, xy, model.z_share * xy])
    offset = z[:, 2:5] * sigma_m
    log_ratio = size[:, None] * z[:, 5:8]
    lwh = sized.lwh_m * np.exp(log_ratio)
    higher = lwh[:, 2] - sized.lwh_m[:, 2]
    offset[:, 2] += 0.5 * higher  # the bottom of the box stays on the road
    first = _moved(sized, offset, lwh, turn)

    # Duplicates.
    again = np.flatnonzero(uniform_of(z[:, 11]) > 1.0 - model.duplicate_p)
    base = first.take(again)
    share_of_size = model.duplicate_sigma * z[again, 13:15]
    offset_xy = share_of_size * base.lwh_m[:, :2]
    offset = np.column_stack([offset_xy, np.zeros(len(again))])
    turn = 0.5 * model.yaw_sigma_rad[true_label[again]] * z[again, 15]
    second = _moved(base, offset, base.lwh_m, turn)
    lower = model.duplicate_logit * np.abs(1.0 + 0.5 * z[again, 12])
    return Reports.of_actors(
        seen,
        np.concatenate([rows, rows[again]]),
        np.concatenate([reported, reported[again]]),
        Boxes.concat([first, second]),
        scipy.special.expit(np.concatenate([logit, logit[again] - lower])),
    )


def _confused(
    true_label: UInt8[ndarray, "r"], u: Float[ndarray, "r"], confusion_p: Float[ndarray, "4 4"]
) -> UInt8[ndarray, "r"]:
    """The class that is reported; the true one for u = 0."""
    share = confusion_p.copy()
    np.fill_diagonal(share, 0.0)
    from_class_on = np.cumsum(share[:, ::-1], axis=1)[:, ::-1]
    bound = 1.0 - from_class_on  # class c where bound[c] <= u < bound[c + 1]
    other = (u[:, None] >= bound[true_label]).sum(axis=1) - 1
    return np.where(u < bound[true_label, 0], true_label, other).astype(np.uint8)


def _as_class(
    true: Boxes,
    true_label: UInt8[ndarray, "r"],
    reported: UInt8[ndarray, "r"],
    origin_m: Float[ndarray, "r 3"],
    mean_lwh_m: Float[ndarray, "4 3"],
) -> Boxes:
    """Boxes at most as large as the mean of a wrongly reported class; the corner nearest to the sensor stays."""
    right = (true_label == reported)[:, None]
    lwh = np.where(right, true.lwh_m, np.minimum(true.lwh_m, mean_lwh_m[reported]))
    gap_l, gap_w, gap_h = (0.5 * (true.lwh_m - lwh)).T
    towards_m = turned_by(-true.yaw_rad, origin_m - true.xyz_m)
    along, aside = np.sign(towards_m.T) * (gap_l, gap_w)
    return _moved(true, np.column_stack([along, aside, -gap_h]), lwh, 0.0)


def _moved(boxes: Boxes, off_m: Float[ndarray, "r 3"], lwh_m: ndarray, turn_rad: ndarray | float) -> Boxes:
    """Boxes moved along their own axes, of a new size, and turned."""
    east_north_m = turned_by(boxes.yaw_rad, off_m)
    xyz_m = boxes.xyz_m + np.column_stack([east_north_m, off_m[:, 2]])
    return Boxes(xyz_m, lwh_m, wrapped(boxes.yaw_rad + turn_rad))
