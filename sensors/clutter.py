"""False boxes: each stands at a real return that deserves none, and clings to its place.

A place is a cell of the ground as seen from one of four sides, its walls and its open road apart, or a mostly hidden
actor. How often it is taken for something follows from its share of the sweep's returns; when, is luck that lasts for a
while, in part the same for all observers.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from jaxtyping import Float, Int, Int32, UInt8, UInt64
from numba import njit, prange
from numpy import ndarray
from scipy.special import expit, ndtri

from sensors.boxes import Boxes
from sensors.chance import joined, unit
from sensors.evidence import Sightings
from sensors.lidar import Sweeps

CELL_M = 2.0
"""Edge of a place: more than a person, less than a car."""

FLAT = 0.01
"""How far three neighbours may be off one plane, in parts of their distance: 2 cm of noise at 5 m."""

HIDDEN = 0.8
"""Occlusion from which an actor may pass for clutter: what is left of it looks like nothing."""

COLUMN_STEP, ROW_STEP = 4, 2
"""Every how many columns and rows returns are counted: near enough for a share, and much faster than all."""

FARTHEST_CELLS = 512
"""How far cells are told apart; what returns from beyond counts to the last one."""

ROOM = 16
"""False boxes of a sweep that room is made for at first."""

_WALL, _ROAD, _ACTOR = range(3)


@dataclass(frozen=True, slots=True)
class ClutterLuck:
    """Keys that the luck with false boxes is a function of."""

    place: np.uint64
    """Of what is the same for all observers."""
    own: UInt64[ndarray, "m"]
    """Of what lasts, by observer."""
    fresh: UInt64[ndarray, "m"]
    """Of what is new in this sweep, by observer."""
    actor: UInt64[ndarray, "n"]
    """Name of every actor: a place that moves."""
    time_s: float


def false_alarms(
    sweeps: Sweeps, sightings: Sightings, luck: ClutterLuck, model: SimpleNamespace
) -> tuple[Int32[ndarray, "c"], UInt8[ndarray, "c"], Boxes, Float[ndarray, "c"]]:
    """Observer, class, box and score of every false box.

    Notes
    -----
    A place is taken for something with chance p, `clutter_per_sweep` times its share of the returns and at most 1;
    `clutter_road_p` of that is spread over all returns, the rest over those of walls and hidden actors. It is so where
    U < p. U is the least of three 1 - (1 - u)^(1 / s), which makes it uniform for any shares s that add up to 1: one u
    is the place's, lasting, one the observer's with that place, lasting, and one is new in each sweep. What lasts is
    the same after t seconds with chance exp(-t / `clutter_memory_s`), else drawn anew. With q = 1 - p, nothing is seen
    at both moments with chance q^2 times the product of exp(-t / T) (q^-s - 1) + 1 over the two lasting shares.

    The score follows from U / p, in part: who sees more of a place is surer, and what appears and fades does so with
    low scores. At walls, boxes of vehicles lie along the wall and in front of it, those of people (poles, plants and
    signs that a city has and ours has not) stand upright at it.
    """
    lasting, shared = model.clutter_memory_share, model.clutter_shared
    shares = np.array([lasting * shared, lasting * (1.0 - shared), 1.0 - lasting])
    o, spot, ray, rank, noise = _found(sweeps, sightings, luck, model, shares)
    column, row = np.divmod(ray, sweeps.hit.shape[2])
    u = _of_spot(spot)
    share = np.cumsum(model.clutter_mix) / np.sum(model.clutter_mix)
    label = np.searchsorted(share, u[:, 0], side="right").astype(np.uint8)
    lwh = model.mean_lwh_m[label] * np.exp(0.1 * _normal(u[:, 1]))[:, None]

    point = sweeps.points(o, column, row)
    heading, origin = sweeps.poses.yaw_rad[o], sweeps.poses.origin_m[o]
    yaw = 2.0 * np.pi * u[:, 2] - heading
    at_wall = sweeps.hit[o, column, row] == 2
    along = _tangent(sweeps, o, column, row)
    yaw = np.where(at_wall & np.isfinite(along), along + np.where(u[:, 2] < 0.5, np.pi, 0.0), yaw)
    # In front of the wall: half the extent of the box across the line of sight towards the sensor.
    bearing = np.arctan2(point[:, 1], point[:, 0])
    skew = np.abs(np.sin(yaw - bearing))
    back = np.where(at_wall, 0.5 * (lwh[:, 1] * skew + lwh[:, 0] * np.sqrt(1.0 - skew**2)), 0.0)
    flat = np.maximum(np.hypot(point[:, 0], point[:, 1]) - back, 1.0)
    xyz = np.column_stack([
        origin[:, 0] + flat * np.cos(bearing + heading),
        origin[:, 1] + flat * np.sin(bearing + heading),
        sweeps.ground_m[o] + 0.5 * lwh[:, 2],
    ])  # fmt: skip
    yaw = np.pi - (np.pi - yaw - heading) % (2.0 * np.pi)
    z = np.sqrt(1.0 - lasting) * _normal(noise) - np.sqrt(lasting) * _normal(rank)
    score = expit(model.clutter_logit + model.clutter_sigma * z)
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
    with np.errstate(divide="ignore", invalid="ignore"):  # no return, no neighbour
        a, b = (sweeps.points(o, middle + step, row) for step in (-2, 2))
        before, here, after = (1.0 / sweeps.range_m[o, middle + step, row].astype(float) for step in (-2, 0, 2))
        flat = np.abs(before + after - 2.0 * here * np.cos(2.0 * grid.fov_rad / n)) < FLAT * here
        return np.where(flat, np.arctan2(b[:, 1] - a[:, 1], b[:, 0] - a[:, 0]), np.nan)


def _found(
    sweeps: Sweeps, sightings: Sightings, luck: ClutterLuck, model: SimpleNamespace, shares: Float[ndarray, "3"]
) -> tuple[Int[ndarray, "c"], UInt64[ndarray, "c"], Int[ndarray, "c"], Float[ndarray, "c"], Float[ndarray, "c"]]:
    """Places taken for something: observer, what is there, the return that is nearest to it, U / p, another uniform."""
    hidden = (sightings.occlusion > HIDDEN) & (sightings.n_returns > 0)
    actor, n_returns = sightings.actor[hidden], sightings.n_returns[hidden]
    ptr = np.searchsorted(sightings.o[hidden], np.arange(len(sweeps.observers) + 1))
    room = ROOM
    while True:
        n, spot, ray, uniform = _survey(
            sweeps.range_m, sweeps.hit, sweeps.poses.origin_m, sweeps.poses.yaw_rad, sweeps.beams,
            float(sweeps.max_range_m), ptr, actor, n_returns, luck.place, luck.own, luck.fresh, luck.actor, luck.time_s,
            float(model.clutter_memory_s), shares, float(model.clutter_per_sweep), float(model.clutter_road_p), room,
        )  # fmt: skip
        if n.max(initial=0) <= room:
            break
        room = int(n.max())
    o = np.repeat(np.arange(len(n)), n)
    at = o, np.arange(len(o)) - np.repeat(np.cumsum(n) - n, n)
    return o, spot[at], ray[at], uniform[at][:, 0], uniform[at][:, 1]


@njit(cache=True)
def _of_spot(spot):
    """Three uniforms that belong to what is there: class, size, heading."""
    out = np.empty((len(spot), 3))
    for k in range(len(spot)):
        for j in range(3):
            out[k, j] = unit(joined(spot[k], 8 + j))
    return out


@njit(cache=True)
def _lasting(key, time_s, memory_s):
    """A uniform that is drawn anew every now and then.

    The moments are evenly spaced at random phase, their spacing a constant of the key, Gamma distributed of shape 2 and
    scale `memory_s`, as is the gap of a Poisson process around a given moment: over all keys, the chance that none of
    them falls into t seconds is exp(-t / memory_s).
    """
    spacing_s = memory_s * (1e-9 - np.log((1.0 - unit(joined(key, 0))) * (1.0 - unit(joined(key, 1)))))
    return unit(joined(joined(key, 3), np.int64(np.floor(time_s / spacing_s + unit(joined(key, 2))))))


@njit(cache=True)
def _rank(place, own, fresh, time_s, memory_s, shares, p):
    """U of a place, where it is below p; else p."""
    best = p
    for k in range(3):
        if shares[k] > 0.0:
            if k == 0:
                u = _lasting(place, time_s, memory_s)
            elif k == 1:
                u = _lasting(joined(own, place), time_s, memory_s)
            else:
                u = unit(joined(fresh, place))
            if u < best:  # else 1 - (1 - u)^(1 / share) is not, either
                best = min(best, 1.0 - (1.0 - u) ** (1.0 / shares[k]))
    return best


@njit(cache=True)
def _side(x, y):
    """From which of four sides a place at the origin is seen from (x, y)."""
    if abs(x) >= abs(y):
        return 0 if x >= 0.0 else 1
    return 2 if y >= 0.0 else 3


@njit(cache=True)
def _tally(ranges, hits, beams, x, y, cos, sin, x0, y0, side):
    """Cells and kinds (walls, road) that one sweep met: which, returns, first and last column; and how many of each."""
    seen = np.zeros(2 * side * side, np.int32)  # number in the list, from 1
    met = np.empty((4, 1 + hits.size // COLUMN_STEP), np.int32)
    total = np.zeros(2, np.int64)
    k = 0
    x, y, top = x / CELL_M - x0, y / CELL_M - y0, side - 0.5
    for c in range(0, hits.shape[0], COLUMN_STEP):
        along_x = (cos * beams.cos_az[c] - sin * beams.sin_az[c]) / CELL_M
        along_y = (sin * beams.cos_az[c] + cos * beams.sin_az[c]) / CELL_M
        for r in range(0, hits.shape[1], ROW_STEP):
            code = hits[c, r]
            if code == 1 or code == 2:
                flat = ranges[c, r] * beams.cos_el[r]
                i, j = int(min(max(x + flat * along_x, 0.0), top)), int(min(max(y + flat * along_y, 0.0), top))
                kind = _ROAD if code == 1 else _WALL
                at = 2 * (i * side + j) + kind
                if seen[at] == 0:
                    met[0, k], met[1, k], met[2, k] = at, 0, c
                    k += 1
                    seen[at] = k
                met[1, seen[at] - 1] += 1
                met[3, seen[at] - 1] = c
                total[kind] += 1
    return met[:, :k], total


@njit(cache=True)
def _nearest(ranges, hits, beams, x, y, cos, sin, first, last, code, to_x, to_y):
    """The ray in some columns that met something and ended nearest to a point."""
    best, least = -1, np.inf
    for c in range(first, last + 1):
        along_x = cos * beams.cos_az[c] - sin * beams.sin_az[c]
        along_y = sin * beams.cos_az[c] + cos * beams.sin_az[c]
        for r in range(hits.shape[1]):
            if hits[c, r] == code:
                flat = ranges[c, r] * beams.cos_el[r]
                gap_x, gap_y = x + flat * along_x - to_x, y + flat * along_y - to_y
                gap = gap_x * gap_x + gap_y * gap_y
                if gap < least:
                    best, least = c * hits.shape[1] + r, gap
    return best


@njit(cache=True)
def _look(
    ranges, hits, beams, x, y, yaw, actor, n_returns, world, own, fresh, name, time_s, memory_s, shares, rate, road_p,
    half, spot, ray, uniform,
):  # fmt: skip
    """Number of places of one sweep that are taken for something; as many as there is room for are written down."""
    side, sampled = 2 * half + 1, 1.0 / (COLUMN_STEP * ROW_STEP)
    cos, sin = np.cos(yaw), np.sin(yaw)
    x0, y0 = np.int64(np.floor(x / CELL_M)) - half, np.int64(np.floor(y / CELL_M)) - half
    met, n = _tally(ranges, hits, beams, x, y, cos, sin, x0, y0, side)
    bodies = float(n[_WALL])
    for s in range(len(actor)):
        bodies += sampled * n_returns[s]
    road_rate = rate * road_p / max(bodies + n[_ROAD], sampled)
    body_rate = road_rate + rate * (1.0 - road_p) / max(bodies, sampled)
    found, n_cells = 0, met.shape[1]
    for k in range(n_cells + len(actor)):
        if k < n_cells:
            at, a, b = met[0, k], met[2, k], met[3, k]
            kind, i, j = at % 2, x0 + at // 2 // side, y0 + at // 2 % side
            code = 1 if kind == _ROAD else 2
            what = joined(joined(joined(world, kind), i), j)
            to_x, to_y = (i + unit(joined(what, 6))) * CELL_M, (j + unit(joined(what, 7))) * CELL_M
            place = joined(what, _side(x - to_x, y - to_y))
            p = met[1, k] * (road_rate if kind == _ROAD else body_rate)
        else:
            s = k - n_cells
            code, a, b, to_x, to_y = actor[s] + 3, 0, len(hits) - 1, x, y
            what = place = joined(joined(world, _ACTOR), name[actor[s]])
            p = sampled * n_returns[s] * body_rate
        p = min(1.0, p)
        rank = _rank(place, own, fresh, time_s, memory_s, shares, p)
        if rank < p:
            if found < len(spot):
                spot[found] = what
                ray[found] = _nearest(ranges, hits, beams, x, y, cos, sin, a, b, code, to_x, to_y)
                uniform[found, 0], uniform[found, 1] = rank / p, unit(joined(joined(fresh, place), 1))
            found += 1
    return found


@njit(cache=True, parallel=True)
def _survey(
    range_m, hit, origin_m, yaw_rad, beams, max_range_m, ptr, actor, n_returns, world, own, fresh, name, time_s,
    memory_s, shares, rate, road_p, room,
):  # fmt: skip
    """Per sweep: number of places taken for something; the first `room` of them: what, ray, U / p and a uniform."""
    n_sweeps, half = len(hit), min(np.int64(max_range_m / CELL_M) + 2, FARTHEST_CELLS)
    found = np.empty(n_sweeps, np.int64)
    spot, ray = np.empty((n_sweeps, room), np.uint64), np.empty((n_sweeps, room), np.int64)
    uniform = np.empty((n_sweeps, room, 2))
    for o in prange(n_sweeps):
        first, last = ptr[o], ptr[o + 1]
        found[o] = _look(
            range_m[o], hit[o], beams, origin_m[o, 0], origin_m[o, 1], yaw_rad[o], actor[first:last],
            n_returns[first:last], world, own[o], fresh[o], name, time_s, memory_s, shares, rate, road_p,
            half, spot[o], ray[o], uniform[o],
        )  # fmt: skip
    return found, spot, ray, uniform
