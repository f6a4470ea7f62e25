"""A 3D object detector as a model of its statistics: who is found, how surely, how exactly, and what is made up."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int, Int32, UInt8
from numpy import ndarray
from scipy.special import expit, ndtr

from sensors.boxes import Boxes
from sensors.clutter import ClutterLuck, false_alarms
from sensors.evidence import Sightings, points_in_boxes
from sensors.lidar import Sweeps

N_SIGHTING_DRAWS = 16
"""Per sighting: found; score; x, y, z; length, width, height; heading; front and rear mistaken; taken for another
class; reported twice, and of the second box the score, x, y and heading."""

Share = Annotated[float, Ge(0), Le(1)]
PerClass = tuple[float, float, float, float]
"""Car, pedestrian, cyclist, truck."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DetectorParams:
    """The detector of every equipped vehicle; whatever is not set is the profile's, from `sensors/profiles`.

    Tuples hold one value per class: car, pedestrian, cyclist, truck.
    """

    profile: Literal["avod", "pointpillars", "ideal"] = "avod"
    """`avod`, `pointpillars`: fitted to the detectors of that name. `ideal`: everything with a return is found,
    exactly, with score 1, and nothing else."""
    found_max_p: PerClass | None = None
    """Chance to find an unoccluded object with very many returns."""
    half_returns: PerClass | None = None
    """Returns at which half of `found_max_p` is reached."""
    steepness: Annotated[float, Gt(0)] | None = None
    """Slope of that curve over the logarithm of the returns."""
    occlusion_loss: PerClass | None = None
    """Share of the chance that full occlusion takes, beyond the returns it takes."""
    score_logit: PerClass | None = None
    """Mean log-odds of the score at `half_returns`."""
    score_gain: Annotated[float, Ge(0)] | None = None
    """Log-odds gained per e-fold of returns."""
    score_occlusion: Annotated[float, Ge(0)] | None = None
    """Log-odds lost at full occlusion."""
    score_error: PerClass | None = None
    """Log-odds lost per unit of squared horizontal error in standard deviations: bad boxes are less sure."""
    score_sigma: Annotated[float, Ge(0)] | None = None
    """Spread of the log-odds."""
    xy_sigma_m: PerClass | None = None
    """Smallest position error along and across the box [m]."""
    xy_sigma_per_m: Annotated[float, Ge(0)] | None = None
    """Position error gained per metre of range [m/m]."""
    xy_sigma_sparse_m: PerClass | None = None
    """Position error of an object with one return, falling with the square root of the returns [m]."""
    z_share: Annotated[float, Ge(0)] | None = None
    """Vertical position error as a share of the horizontal one: the road is well known."""
    size_sigma: PerClass | None = None
    """Relative error of length, width and height of a dense object."""
    size_sigma_sparse: PerClass | None = None
    """Relative size error added at one return, falling with the square root of the returns."""
    yaw_sigma_rad: PerClass | None = None
    """Heading error of a dense object [rad]."""
    yaw_sigma_sparse_rad: Annotated[float, Ge(0)] | None = None
    """Heading error added at one return, falling with the square root of the returns [rad]."""
    flip_p: Share | None = None
    """Chance that front and rear are mistaken."""
    taken_for_p: tuple[PerClass, PerClass, PerClass, PerClass] | None = None
    """Chance that an object of the row's class is reported as one of the column's."""
    duplicate_p: Share | None = None
    """Chance that an object that is found is reported a second time, farther off and less surely."""
    duplicate_logit: Annotated[float, Ge(0)] | None = None
    """Log-odds by which the second report is less sure, on average."""
    duplicate_sigma: Annotated[float, Ge(0)] | None = None
    """Position error of the second report, in lengths and widths of its box."""
    clutter_per_sweep: Annotated[float, Ge(0)] | None = None
    """Mean number of false boxes per sweep."""
    clutter_mix: PerClass | None = None
    """Class shares of false boxes."""
    clutter_road_p: Share | None = None
    """Share of the false boxes that may stand on open road; the others stand at walls and hidden actors."""
    clutter_memory_s: Annotated[float, Gt(0)] | None = None
    """Mean time until the lasting luck with a place is drawn anew [s]."""
    clutter_memory_share: Share | None = None
    """Share of the false boxes that last; the rest are new in every sweep."""
    clutter_shared: Share | None = None
    """Share of the lasting ones that are due to the place, and so befall all who see it from about the same side."""
    clutter_logit: Annotated[float, Ge(-20), Le(20)] | None = None
    """Mean log-odds of a false box's score."""
    clutter_sigma: Annotated[float, Ge(0)] | None = None
    """Spread of those log-odds."""
    mean_lwh_m: tuple[tuple[float, float, float], ...] | None = None
    """Usual size of a class: that of false boxes, and of objects taken for another class [m]."""
    min_score: Share | None = None
    """Boxes below are not reported."""
    memory_s: Annotated[float, Gt(0)] | None = None
    """Time over which luck with the same actor changes [s]; see `cosim.rng.persistent`."""
    memory_share: Share | None = None
    """Share of the variance of that luck that lasts; the rest is new in every sweep."""


@lru_cache(maxsize=8)
def _profile(name: str) -> dict:
    """The parameters of a profile as its file states them; `ideal` sees as AVOD where anybody asks."""
    path = Path(__file__).parent / "profiles" / f"{'avod' if name == 'ideal' else name}.toml"
    stated = tomllib.loads(path.read_text(encoding="utf-8"))
    return stated["first_guess"] | stated["fitted"]


def resolved(params: DetectorParams) -> SimpleNamespace:
    """All numbers of a detector: those set, else the profile's; tuples as arrays."""
    stated = _profile(params.profile)
    own = {f.name: getattr(params, f.name) for f in fields(params) if f.name != "profile"}
    both = {name: stated[name] if value is None else value for name, value in own.items()}
    return SimpleNamespace(**{n: np.array(v) if isinstance(v, list | tuple) else v for n, v in both.items()})


@dataclass(frozen=True, slots=True)
class DetectorDraws:
    """The detector's luck. All zero: everything that can be found is, without error or clutter."""

    sighting: Float[ndarray, "s 16"]
    """Standard normals. An event of chance p happens where |z| is among the p smallest, a mishap where it is among
    the p largest, so that luck that changes slowly changes events slowly."""
    clutter: ClutterLuck | None = None
    """Without it, no false boxes."""


@dataclass(frozen=True, slots=True)
class Reports:
    """Boxes that a detector makes of real actors, in no particular order."""

    o: Int[ndarray, "r"]
    label: UInt8[ndarray, "r"]
    boxes: Boxes
    score: Float[ndarray, "r"]
    actor: Int[ndarray, "r"]


@dataclass(frozen=True, slots=True)
class Detected:
    """Detections of one step, sorted by (o, falling score, x, y): nothing in their order betrays the truth."""

    o: Int32[ndarray, "d"]
    """Observer (index of the sweep)."""
    label: UInt8[ndarray, "d"]
    boxes: Boxes
    score: Float[ndarray, "d"]
    n_points: Int32[ndarray, "d"]
    """Returns of the observer's own sweep inside the reported box."""
    actor: Int32[ndarray, "d"]
    """Truth: actor row that was seen; meaningless where `is_clutter`."""
    is_clutter: Bool[ndarray, "d"]
    """Truth: nothing was there."""


def detect(
    sweeps: Sweeps,
    sightings: Sightings,
    boxes: Boxes,
    label: UInt8[ndarray, "n"],
    draws: DetectorDraws,
    params: DetectorParams,
) -> Detected:
    """What every observer's detector reports.

    Parameters
    ----------
    boxes, label
        All actors: true boxes (world frame) and classes.

    Notes
    -----
    Chance, score and errors are functions of the returns n, the occlusion and the range; errors grow as returns
    thin out and with range. A false box stands at a wall, on the road or in the place of a mostly hidden actor.
    """
    n_seen, n_observers, luck = len(sightings.o), len(sweeps.observers), draws.clutter
    fit = luck is None or (len(luck.own), len(luck.fresh), len(luck.actor)) == (n_observers, n_observers, len(boxes))
    if draws.sighting.shape != (n_seen, N_SIGHTING_DRAWS) or not fit:
        raise ValueError(
            f"detector draws of shape {draws.sighting.shape} or the keys beside them do not fit {n_seen} sightings "
            f"({n_seen}, {N_SIGHTING_DRAWS}) of {len(boxes)} actors by {n_observers} observers."
        )
    if params.profile == "ideal":
        rows = np.flatnonzero(sightings.n_returns > 0)
        o, actor = sightings.o[rows], sightings.actor[rows]
        return _sorted(sweeps, o, label[actor], boxes.take(actor), np.ones(len(o)), actor, np.zeros(len(o), bool))
    model = resolved(params)
    seen = reported(sightings, boxes, label, sweeps.poses.origin_m, draws.sighting, model)
    o, label, made, score, actor = seen.o, seen.label, seen.boxes, seen.score, seen.actor
    if luck is not None:
        c_o, c_label, clutter, c_score = false_alarms(sweeps, sightings, luck, model)
        o, label = np.concatenate([o, c_o]), np.concatenate([label, c_label])
        made, score = Boxes.concat([made, clutter]), np.concatenate([score, c_score])
        actor = np.concatenate([actor, np.zeros(len(c_o), np.int32)])
    is_clutter = np.arange(len(o)) >= len(seen.o)
    return _sorted(sweeps, o.astype(np.int32), label, made, score, actor.astype(np.int32), is_clutter, model.min_score)


def luck(z: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Uniform in [0, 1) of a standard normal, 0 for 0, and continuous."""
    return np.minimum(2.0 * ndtr(np.abs(z)) - 1.0, 1.0 - 1e-16)


def found_p(
    n_returns: Int[ndarray, "s"], occlusion: Float[ndarray, "s"], label: UInt8[ndarray, "s"], model: SimpleNamespace
) -> Float[ndarray, "s"]:
    """Chance that an object is found; 0 without returns."""
    n = np.asarray(n_returns, float) ** model.steepness
    half = model.half_returns[label] ** model.steepness
    return model.found_max_p[label] * n / (n + half) * (1.0 - model.occlusion_loss[label] * occlusion)


def reported(
    sightings: Sightings,
    boxes: Boxes,
    label: UInt8[ndarray, "n"],
    origin_m: Float[ndarray, "m 3"],
    z: Float[ndarray, "s 16"],
    model: SimpleNamespace,
) -> Reports:
    """The boxes that the detector makes of those it finds.

    Parameters
    ----------
    origin_m
        Where the sensor of each observer is.
    """
    chance = found_p(sightings.n_returns, sightings.occlusion, label[sightings.actor], model)
    rows = np.flatnonzero(luck(z[:, 0]) < chance)
    z, o, actor = z[rows], sightings.o[rows], sightings.actor[rows]
    kind, n, occlusion = label[actor], sightings.n_returns[rows], sightings.occlusion[rows]
    said = _class_of(kind, luck(z[:, 10]), model.taken_for_p)
    seen = _as_class(boxes.take(actor), kind, said, origin_m[o], model.mean_lwh_m)
    thin = 1.0 / np.sqrt(n)
    logit = model.score_logit[kind] + model.score_gain * np.log(n / model.half_returns[kind])
    badness = 0.5 * (z[:, 2] ** 2 + z[:, 3] ** 2)
    logit += model.score_sigma * z[:, 1] - model.score_occlusion * occlusion - model.score_error[kind] * badness

    xy = model.xy_sigma_m[kind] + model.xy_sigma_per_m * sightings.range_m[rows] + model.xy_sigma_sparse_m[kind] * thin
    size = model.size_sigma[kind] + model.size_sigma_sparse[kind] * thin
    turn = (model.yaw_sigma_rad[kind] + model.yaw_sigma_sparse_rad * thin) * z[:, 8]
    turn += np.where(luck(z[:, 9]) > 1.0 - model.flip_p, np.pi, 0.0)
    off = z[:, 2:5] * np.column_stack([xy, xy, model.z_share * xy])
    lwh = seen.lwh_m * np.exp(size[:, None] * z[:, 5:8])
    off[:, 2] += 0.5 * (lwh[:, 2] - seen.lwh_m[:, 2])  # the box keeps standing where it stands
    first = _moved(seen, off, lwh, turn)

    twice = np.flatnonzero(luck(z[:, 11]) > 1.0 - model.duplicate_p)
    again = first.take(twice)
    off = np.column_stack([model.duplicate_sigma * z[twice, 13:15] * again.lwh_m[:, :2], np.zeros(len(twice))])
    second = _moved(again, off, again.lwh_m, 0.5 * model.yaw_sigma_rad[kind[twice]] * z[twice, 15])
    less = model.duplicate_logit * np.abs(1.0 + 0.5 * z[twice, 12])
    return Reports(
        np.concatenate([o, o[twice]]),
        np.concatenate([said, said[twice]]),
        Boxes.concat([first, second]),
        expit(np.concatenate([logit, logit[twice] - less])),
        np.concatenate([actor, actor[twice]]),
    )


def _class_of(kind: UInt8[ndarray, "r"], u: Float[ndarray, "r"], taken_for_p: Float[ndarray, "4 4"]) -> ndarray:
    """The class that is reported; without mishap, the right one."""
    share = taken_for_p.copy()
    np.fill_diagonal(share, 0.0)
    bound = 1.0 - np.cumsum(share[:, ::-1], axis=1)[:, ::-1]  # class c where bound[c] <= u < bound[c + 1]
    return np.where(u < bound[kind, 0], kind, (u[:, None] >= bound[kind]).sum(axis=1) - 1).astype(np.uint8)


def _as_class(seen: Boxes, kind: ndarray, said: ndarray, eye_m: Float[ndarray, "r 3"], mean_lwh_m: ndarray) -> Boxes:
    """Boxes of the size that is usual in the reported class, where that is a wrong one; the near corner stays."""
    lwh = np.where((kind == said)[:, None], seen.lwh_m, np.minimum(seen.lwh_m, mean_lwh_m[said]))
    gap = 0.5 * (seen.lwh_m - lwh)
    away = eye_m - seen.xyz_m
    cos, sin = np.cos(seen.yaw_rad), np.sin(seen.yaw_rad)
    along = np.sign(cos * away[:, 0] + sin * away[:, 1]) * gap[:, 0]
    aside = np.sign(cos * away[:, 1] - sin * away[:, 0]) * gap[:, 1]
    return _moved(seen, np.column_stack([along, aside, -gap[:, 2]]), lwh, 0.0)


def _moved(boxes: Boxes, off_m: Float[ndarray, "r 3"], lwh_m: ndarray, turn_rad: ndarray | float) -> Boxes:
    """Boxes moved along their own axes, of a new size, and turned."""
    cos, sin = np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)
    x, y = cos * off_m[:, 0] - sin * off_m[:, 1], sin * off_m[:, 0] + cos * off_m[:, 1]
    return Boxes(boxes.xyz_m + np.column_stack([x, y, off_m[:, 2]]), lwh_m, wrap(boxes.yaw_rad + turn_rad))


def wrap(angle: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """The angle in (-pi, pi]."""
    return np.pi - (np.pi - angle) % (2.0 * np.pi)


def _sorted(sweeps, o, label, boxes, score, actor, is_clutter, min_score=0.0) -> Detected:
    """Canonical order, points counted."""
    order = np.lexsort([boxes.xyz_m[:, 1], boxes.xyz_m[:, 0], -score, o])
    order = order[score[order] >= min_score]
    o, boxes = o[order], boxes.take(order)
    return Detected(
        o, label[order], boxes, score[order], points_in_boxes(sweeps, o, boxes), actor[order], is_clutter[order]
    )
