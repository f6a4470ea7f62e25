"""A 3D object detector as a model of its statistics: who is found, how surely, how exactly, and what is made up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int32, UInt8
from numba import njit
from numpy import ndarray
from scipy.special import expit, ndtri

from sensors.boxes import Boxes
from sensors.evidence import Sightings, points_in_boxes
from sensors.lidar import Sweeps

N_SIGHTING_DRAWS = 10
"""Per sighting: found, score, x, y, z, length, width, height, heading, front and rear mistaken."""
N_CLUTTER_DRAWS = 6
"""Per clutter slot: present, which return, class, heading, score, size."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DetectorParams:
    """The detector of every equipped vehicle; tuples hold one value per class: car, pedestrian, cyclist, truck.

    The numbers describe AVOD, the detector of the TruPercept paper, in order of magnitude. They are estimates, not
    yet calibrated against its output: the paper gives only its AP (car 66.8 / 62.8 / 52.1 %, pedestrian
    84.2 / 78.7 / 75.1 %, easy / moderate / hard).
    """

    profile: Literal["avod", "ideal"] = "avod"
    """`avod`: the model below. `ideal`: everything with a return is found, exactly, with score 1, and nothing else."""
    found_max_p: tuple[float, float, float, float] = (0.97, 0.94, 0.90, 0.95)
    """Chance to find an unoccluded object with very many returns. Estimate."""
    half_returns: tuple[float, float, float, float] = (12.0, 8.0, 9.0, 20.0)
    """Returns at which half of `found_max_p` is reached. Estimate: KITTI's hard cars carry some ten returns."""
    steepness: Annotated[float, Gt(0)] = 1.5
    """Slope of that curve over the logarithm of the returns. Estimate."""
    occlusion_loss: Annotated[float, Ge(0), Le(1)] = 0.35
    """Share of the chance that full occlusion takes, beyond the returns it takes. Estimate: AP easy to hard."""
    score_logit: Annotated[float, Ge(-20), Le(20)] = 0.5
    """Mean log-odds of the score at `half_returns`. Estimate."""
    score_gain: Annotated[float, Ge(0)] = 1.0
    """Log-odds gained per e-fold of returns. Estimate."""
    score_occlusion: Annotated[float, Ge(0)] = 1.0
    """Log-odds lost at full occlusion. Estimate."""
    score_sigma: Annotated[float, Ge(0)] = 0.8
    """Spread of the log-odds. Estimate."""
    xy_sigma_m: tuple[float, float, float, float] = (0.06, 0.05, 0.06, 0.10)
    """Smallest position error along and across the box [m]. Estimate."""
    xy_sigma_per_m: Annotated[float, Ge(0)] = 0.001
    """Position error gained per metre of range [m/m]. Estimate."""
    xy_sigma_sparse_m: tuple[float, float, float, float] = (0.6, 0.25, 0.35, 1.0)
    """Position error of an object with one return, falling with the square root of the returns [m]. Estimate."""
    z_share: Annotated[float, Ge(0)] = 0.5
    """Vertical position error as a share of the horizontal one: the road is well known. Estimate."""
    size_sigma: Annotated[float, Ge(0)] = 0.04
    """Relative error of length, width and height of a dense object. Estimate."""
    size_sigma_sparse: Annotated[float, Ge(0)] = 0.15
    """Relative size error added at one return, falling with the square root of the returns. Estimate."""
    yaw_sigma_rad: tuple[float, float, float, float] = (0.03, 0.30, 0.10, 0.03)
    """Heading error of a dense object [rad]. Estimate; pedestrians are nearly round."""
    yaw_sigma_sparse_rad: Annotated[float, Ge(0)] = 0.3
    """Heading error added at one return, falling with the square root of the returns [rad]. Estimate."""
    flip_p: Annotated[float, Ge(0), Le(1)] = 0.02
    """Chance that front and rear are mistaken. Estimate: AVOD's orientation similarity is about 0.98 of its AP."""
    clutter_per_sweep: Annotated[float, Ge(0)] = 0.5
    """Mean number of false boxes per sweep, at most the number of clutter slots drawn. Estimate."""
    clutter_mix: tuple[float, float, float, float] = (0.55, 0.30, 0.15, 0.0)
    """Class shares of false boxes. Estimate."""
    clutter_logit: Annotated[float, Ge(-20), Le(20)] = -1.8
    """Mean log-odds of a false box's score. Estimate."""
    clutter_lwh_m: tuple[tuple[float, float, float], ...] = (
        (4.2, 1.75, 1.5), (0.7, 0.6, 1.75), (1.75, 0.6, 1.7), (9.0, 2.5, 3.3),
    )  # fmt: skip
    """Mean size of a false box per class [m]. The first three: mean label sizes of KITTI, rounded."""
    min_score: Annotated[float, Ge(0), Le(1)] = 0.01
    """Boxes below are not reported, as in the paper's output."""


@dataclass(frozen=True, slots=True)
class DetectorDraws:
    """The detector's luck: uniforms in [0, 1). All zero: everything that can be found is, without error or clutter."""

    sighting: Float[ndarray, "s 10"]
    clutter: Float[ndarray, "m k 6"]


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
    thin out and with range. A false box sits on a return of a wall, of the road or of a mostly hidden actor.
    Simple: classes are never confused, one box per actor, errors are independent from step to step.
    """
    n_seen, n_observers = len(sightings.o), len(sweeps.observers)
    if draws.sighting.shape != (n_seen, N_SIGHTING_DRAWS) or draws.clutter.shape[::2] != (n_observers, N_CLUTTER_DRAWS):
        raise ValueError(
            f"detector draws of shapes {draws.sighting.shape} and {draws.clutter.shape} do not fit {n_seen} sightings "
            f"({n_seen}, {N_SIGHTING_DRAWS}) of {n_observers} observers ({n_observers}, slots, {N_CLUTTER_DRAWS})."
        )
    if params.profile == "ideal":
        rows = np.flatnonzero(sightings.n_returns > 0)
        o, actor = sightings.o[rows], sightings.actor[rows]
        return _sorted(sweeps, o, label[actor], boxes.take(actor), np.ones(len(o)), actor, np.zeros(len(o), bool))
    o, actor, seen, score = _found(sightings, boxes, label, draws.sighting, params)
    c_o, c_label, clutter, c_score = _clutter(sweeps, sightings, draws.clutter, params)
    return _sorted(
        sweeps,
        np.concatenate([o, c_o]),
        np.concatenate([label[actor], c_label]),
        Boxes.concat([seen, clutter]),
        np.concatenate([score, c_score]),
        np.concatenate([actor, np.zeros(len(c_o), np.int32)]),
        np.arange(len(o) + len(c_o)) >= len(o),
        params.min_score,
    )


def normal(u: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Standard normal of a uniform, with 0 for 0: a draw of zero is no error."""
    return ndtri(np.clip((u + 0.5) % 1.0, 1e-12, 1.0 - 1e-12))


def found_p(
    n_returns: Int32[ndarray, "s"], occlusion: Float[ndarray, "s"], label: UInt8[ndarray, "s"], params: DetectorParams
) -> Float[ndarray, "s"]:
    """Chance that an object is found; 0 without returns."""
    n = n_returns**params.steepness
    half = np.array(params.half_returns)[label] ** params.steepness
    return np.array(params.found_max_p)[label] * n / (n + half) * (1.0 - params.occlusion_loss * occlusion)


def _found(sightings, boxes, label, u, params):
    """The sightings that the detector finds, as it reports them."""
    chance = found_p(sightings.n_returns, sightings.occlusion, label[sightings.actor], params)
    rows = np.flatnonzero(u[:, 0] < chance)
    u, actor, kind = u[rows], sightings.actor[rows], label[sightings.actor[rows]]
    n, occlusion = sightings.n_returns[rows], sightings.occlusion[rows]
    true = boxes.take(actor)
    thin = 1.0 / np.sqrt(n)
    error = normal(u[:, 1:9])
    logit = params.score_logit + params.score_gain * np.log(n / np.array(params.half_returns)[kind])
    score = expit(logit - params.score_occlusion * occlusion + params.score_sigma * error[:, 0])
    xy = (
        np.array(params.xy_sigma_m)[kind]
        + params.xy_sigma_per_m * sightings.range_m[rows]
        + np.array(params.xy_sigma_sparse_m)[kind] * thin
    )
    offset = error[:, 1:4] * np.column_stack([xy, xy, params.z_share * xy])
    size = params.size_sigma + params.size_sigma_sparse * thin
    lwh = true.lwh_m * np.exp(size[:, None] * error[:, 4:7])
    flip = np.where(u[:, 9] > 1.0 - params.flip_p, np.pi, 0.0)
    turn = (np.array(params.yaw_sigma_rad)[kind] + params.yaw_sigma_sparse_rad * thin) * error[:, 7] + flip
    offset[:, 2] += 0.5 * (lwh[:, 2] - true.lwh_m[:, 2])      # the box keeps standing where it stands
    cos, sin = np.cos(true.yaw_rad), np.sin(true.yaw_rad)
    along = np.column_stack([cos * offset[:, 0] - sin * offset[:, 1], sin * offset[:, 0] + cos * offset[:, 1]])
    moved = true.xyz_m + np.column_stack([along, offset[:, 2]])
    return sightings.o[rows], actor, Boxes(moved, lwh, wrap(true.yaw_rad + turn)), score


def wrap(angle: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """The angle in (-pi, pi]."""
    return np.pi - (np.pi - angle) % (2.0 * np.pi)


def _clutter(sweeps, sightings, u, params):
    """False boxes, each on a real return that deserves no box."""
    slots = u.shape[1]
    present = u[:, :, 0] > 1.0 - min(1.0, params.clutter_per_sweep / max(slots, 1))
    o, slot = np.nonzero(present)
    u = u[o, slot]
    hidden = sightings.occlusion > 0.8
    ray = _pick(sweeps.hit, o, u[:, 1], sightings.o[hidden], sightings.actor[hidden])
    o, u, ray = o[ray >= 0], u[ray >= 0], ray[ray >= 0]
    column, row = np.divmod(ray, sweeps.hit.shape[2])
    share = np.cumsum(params.clutter_mix) / np.sum(params.clutter_mix)
    label = np.searchsorted(share, u[:, 2], side="right").astype(np.uint8)
    lwh = np.array(params.clutter_lwh_m)[label] * np.exp(0.1 * normal(u[:, 5]))[:, None]
    xyz = np.empty((len(o), 3))
    cos, sin = np.cos(sweeps.poses.yaw_rad[o]), np.sin(sweeps.poses.yaw_rad[o])
    point = sweeps.points(o, column, row)
    xyz[:, 0] = sweeps.poses.origin_m[o, 0] + cos * point[:, 0] - sin * point[:, 1]
    xyz[:, 1] = sweeps.poses.origin_m[o, 1] + sin * point[:, 0] + cos * point[:, 1]
    xyz[:, 2] = sweeps.ground_m[o] + 0.5 * lwh[:, 2]
    score = expit(params.clutter_logit + params.score_sigma * normal(u[:, 4]))
    return o.astype(np.int32), label, Boxes(xyz, lwh, wrap(2.0 * np.pi * u[:, 3])), score


@njit(cache=True)
def _pick(hit, o, u, hidden_o, hidden_actor):
    """A ray per draw that met a wall, the road or a hidden actor: the first one after a random place; -1 if none."""
    out = np.full(len(o), -1)
    n = hit.shape[1] * hit.shape[2]
    for k in range(len(o)):
        rays = hit[o[k]].ravel()
        first = np.searchsorted(hidden_o, o[k])
        last = np.searchsorted(hidden_o, o[k], side="right")
        start = int(u[k] * n)
        for i in range(n):
            ray = (start + i) % n
            code = rays[ray]
            if code == 0:
                continue
            if code >= 3:
                at = first + np.searchsorted(hidden_actor[first:last], code - 3)
                if at == last or hidden_actor[at] != code - 3:
                    continue
            out[k] = ray
            break
    return out


def _sorted(sweeps, o, label, boxes, score, actor, is_clutter, min_score=0.0) -> Detected:
    """Canonical order, points counted."""
    order = np.lexsort([boxes.xyz_m[:, 1], boxes.xyz_m[:, 0], -score, o])
    order = order[score[order] >= min_score]
    o, boxes = o[order], boxes.take(order)
    return Detected(
        o, label[order], boxes, score[order], points_in_boxes(sweeps, o, boxes), actor[order], is_clutter[order]
    )
