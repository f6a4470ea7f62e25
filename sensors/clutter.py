"""False boxes: each stands at a real return that deserves none."""

from __future__ import annotations

from math import gcd
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

FLAT = 0.01
"""How far three neighbours may be off one plane, in parts of their distance: 2 cm of noise at 5 m."""

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
    stride = _stride(sweeps.hit.shape[1] * sweeps.hit.shape[2])
    ray = _pick(sweeps.hit, o, u[:, 1], on_road, sightings.o[hidden], sightings.actor[hidden], stride)
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
    """Direction of the surface that a ray met, in the sensor frame; nan where its neighbours met another one.

    Along a flat wall 1 / distance is linear in the sine and cosine of the azimuth.
    """
    grid, n = sweeps.beams, sweeps.hit.shape[1]
    if n < 5:
        return np.full(len(o), np.nan)
    middle = np.clip(column, 2, n - 3)
    with np.errstate(divide="ignore", invalid="ignore"):      # no return, no neighbour
        a, b = (sweeps.points(o, middle + step, row) for step in (-2, 2))
        before, here, after = (1.0 / sweeps.range_m[o, middle + step, row].astype(float) for step in (-2, 0, 2))
        flat = np.abs(before + after - 2.0 * here * np.cos(2.0 * grid.fov_rad / n)) < FLAT * here
        return np.where(flat, np.arctan2(b[:, 1] - a[:, 1], b[:, 0] - a[:, 0]), np.nan)


def _stride(n: int) -> int:
    """A step that visits all of n places and scatters them: next to the golden share of n, without common factor."""
    return next(k for k in range(int(0.618 * n) + 1, 2 * n + 2) if gcd(k, n) == 1)


@njit(cache=True)
def _pick(hit, o, u, on_road, hidden_o, hidden_actor, stride):
    """A ray per draw that met a wall, a hidden actor or (if so wanted) the road; -1 if there is none.

    It is the first of a scattered sequence, so that no ray is picked for the emptiness before it.
    """
    out = np.full(len(o), -1)
    n = hit.shape[1] * hit.shape[2]
    for k in range(len(o)):
        rays = hit[o[k]].ravel()
        first = np.searchsorted(hidden_o, o[k])
        last = np.searchsorted(hidden_o, o[k], side="right")
        ray = int(u[k] * n)
        for _ in range(n):
            ray = (ray + stride) % n
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
