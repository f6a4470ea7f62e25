"""False boxes: each stands at a real return that deserves none."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from jaxtyping import Float, Int32, UInt8
from numba import njit
from numpy import ndarray
from scipy.special import expit, ndtri

from sensors.boxes import Boxes
from sensors.evidence import Sightings
from sensors.lidar import Sweeps

N_CLUTTER_DRAWS = 7
"""Per clutter slot: present, which return, class, heading, score, size, on open road."""

HIDDEN = 0.8
"""Occlusion from which an actor may pass for clutter: what is left of it looks like nothing."""


def false_alarms(
    sweeps: Sweeps, sightings: Sightings, u: Float[ndarray, "m k 7"], model: SimpleNamespace
) -> tuple[Int32[ndarray, "c"], UInt8[ndarray, "c"], Boxes, Float[ndarray, "c"]]:
    """Observer, class, box and score of every false box; none where all draws are zero.

    Notes
    -----
    At walls, boxes of vehicles lie along the wall and in front of it, those of people (poles, plants and signs that
    a city has and ours has not) stand upright at it.
    """
    slots = u.shape[1]
    present = u[:, :, 0] > 1.0 - min(1.0, model.clutter_per_sweep / max(slots, 1))
    o, slot = np.nonzero(present)
    u = u[o, slot]
    hidden = sightings.occlusion > HIDDEN
    on_road = u[:, 6] < model.clutter_road_p
    ray = _pick(sweeps.hit, o, u[:, 1], on_road, sightings.o[hidden], sightings.actor[hidden])
    o, u, ray = o[ray >= 0], u[ray >= 0], ray[ray >= 0]
    column, row = np.divmod(ray, sweeps.hit.shape[2])
    share = np.cumsum(model.clutter_mix) / np.sum(model.clutter_mix)
    label = np.searchsorted(share, u[:, 2], side="right").astype(np.uint8)
    lwh = model.mean_lwh_m[label] * np.exp(0.1 * _normal(u[:, 5]))[:, None]

    point = sweeps.points(o, column, row)
    yaw = 2.0 * np.pi * u[:, 3]
    at_wall = sweeps.hit[o, column, row] == 2
    along = _tangent(sweeps, o, column, row)
    yaw = np.where(at_wall & np.isfinite(along), along + np.where(u[:, 3] < 0.5, np.pi, 0.0), yaw)
    # In front of the wall: half the extent of the box across the line of sight towards the sensor.
    bearing = np.arctan2(point[:, 1], point[:, 0])
    skew = np.abs(np.sin(yaw - bearing))
    back = np.where(at_wall, 0.5 * (lwh[:, 1] * skew + lwh[:, 0] * np.sqrt(1.0 - skew**2)), 0.0)
    flat = np.maximum(np.hypot(point[:, 0], point[:, 1]) - back, 1.0)
    heading, origin = sweeps.poses.yaw_rad[o], sweeps.poses.origin_m[o]
    xyz = np.column_stack([
        origin[:, 0] + flat * np.cos(bearing + heading),
        origin[:, 1] + flat * np.sin(bearing + heading),
        sweeps.ground_m[o] + 0.5 * lwh[:, 2],
    ])  # fmt: skip
    yaw = np.pi - (np.pi - yaw - heading) % (2.0 * np.pi)
    score = expit(model.clutter_logit + model.clutter_sigma * _normal(u[:, 4]))
    return o.astype(np.int32), label, Boxes(xyz, lwh, yaw), score


def _normal(u: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    return ndtri(np.clip(u, 1e-12, 1.0 - 1e-12))


def _tangent(sweeps: Sweeps, o: ndarray, column: ndarray, row: ndarray) -> Float[ndarray, "n"]:
    """Direction of the surface from a ray's left to its right neighbour, in the sensor frame; nan where there is none.

    The two ends must be of one surface: a jump in range of more than a metre is an edge.
    """
    n = sweeps.hit.shape[1]
    ends = [np.clip(column + step, 0, n - 1) for step in (-2, 2)]
    with np.errstate(invalid="ignore"):      # no return, no neighbour
        a, b = (sweeps.points(o, end, row) for end in ends)
        near = np.abs(sweeps.range_m[o, ends[0], row] - sweeps.range_m[o, ends[1], row]) < 1.0
        return np.where(near, np.arctan2(b[:, 1] - a[:, 1], b[:, 0] - a[:, 0]), np.nan)


@njit(cache=True)
def _pick(hit, o, u, on_road, hidden_o, hidden_actor):
    """A ray per draw that met a wall, a hidden actor or (if so wanted) the road: the first after a random place.

    -1 if there is none.
    """
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
            if code == 0 or (code == 1 and not on_road[k]):
                continue
            if code >= 3:
                at = first + np.searchsorted(hidden_actor[first:last], code - 3)
                if at == last or hidden_actor[at] != code - 3:
                    continue
            out[k] = ray
            break
    return out
