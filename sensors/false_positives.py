"""False positives: boxes at real returns where there is no actor of that kind. They persist at their sites.

A site is the walls of a cell of the ground, the open road of a cell, or a mostly hidden actor. An aspect is a site as
seen from one of four sides. The probability of a false positive follows from the aspect's share of the sweep's returns.
Its draws persist for some time, and some of them are common to all observers.
"""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int, UInt64
from numpy import ndarray

from cosim.base.hash_rng import mix, uniforms, unit
from cosim.base.kernel import compiled, inlined, kernel
from cosim.base.plane import wrapped
from cosim.base.ragged import expand, ptr_of
from sensors.boxes import Boxes
from sensors.evidence import Observability
from sensors.lidar import Beams, Sweeps
from sensors.range_steps import metres
from sensors.raycast.column import actor_columns, columns_of
from sensors.reports import DetectorDraws, Reports
from sensors.scene import Hit

CELL_M = 2.0
"""Edge of a cell [m]: larger than a pedestrian, smaller than a car."""

FLAT = 0.01
"""Tolerance of three neighbouring returns that count as one plane, relative to their distance: 2 cm of noise at 5 m."""

HIDDEN = 0.8
"""Occlusion from which an actor is a site of false positives."""

FARTHEST_CELLS = 512
"""Distance up to which cells are told apart; returns from beyond count to the last one."""

COLUMN_STEP, ROW_STEP = 4, 2
"""Every fourth column and every second row of a sweep suffice to compute shares of the returns."""

INITIAL_CAPACITY = 16
"""False positives per sweep that memory is allocated for at first."""

_ROUNDED, _ROUNDED_M2 = 1.0 + 1e-9, 1e-6
"""More than a squared distance is rounded by, relative and absolute: coordinates have up to eight digits."""

_WALL, _ROAD, _ACTOR = range(3)

_N_PACES = 1024
_PACE_BITS = np.uint64(10)
_PHASE_BITS = np.uint64(54)
_S11 = np.uint64(11)
_S32 = np.uint64(32)
_LOW_32 = np.int64(0xFFFFFFFF)
_TO_UNIT = 2.0**-53
_TO_UNIT_32 = 2.0**-32


def false_positives(sweeps: Sweeps, seen: Observability, draws: DetectorDraws, model: SimpleNamespace) -> Reports:
    """All false positives of one step.

    Notes
    -----
    At an aspect, a false positive occurs with probability p: `false_positive_per_sweep` times the aspect's share of the
    returns, and at most 1. Of this, the share `false_positive_road_p` is distributed over all returns, and the rest
    over the returns of walls and hidden actors.

    A false positive occurs where U < p. U is the least of three values 1 - (1 - u)^(1 / s); it is uniform for any
    shares s that add up to 1. Of the three u, one belongs to the aspect and persists, one belongs to the observer and
    the aspect and persists, and one is new in each sweep. A persistent u is unchanged after t seconds with probability
    exp(-t / T), with T = `false_positive_memory_s`; otherwise it is drawn anew. With q = 1 - p, there is no false
    positive at both moments with probability q^2 times the product of exp(-t / T) (q^-s - 1) + 1 over the two
    persistent shares.

    The score depends in part on U / p. The larger the share of an aspect, the higher its score, and false positives
    appear and disappear at low scores. At walls, boxes of vehicles lie along the wall and in front of it. Boxes of
    pedestrians stand upright at it (they are poles, plants and signs, which a city has and this scene lacks).
    """
    persistent, shared = model.false_positive_memory_share, model.false_positive_shared
    shares = np.array([persistent * shared, persistent * (1.0 - shared), 1.0 - persistent])
    found = _at_sites(sweeps, seen, draws, model, shares)
    o = found.observer
    # Three uniforms that belong to the site for good: class, size, heading. The hashes before them are keys of its
    # aspects (0 to 3) and of its point (6).
    u_class, u_size, u_heading = uniforms(found.site, 11)[:, 8:].T
    share = np.cumsum(model.false_positive_mix) / np.sum(model.false_positive_mix)
    label = np.searchsorted(share, u_class, side="right").astype(np.uint8)
    size = np.exp(0.1 * _normal(u_size))
    lwh = model.mean_lwh_m[label] * size[:, None]
    boxes = _at_returns(sweeps, o, found.ray, lwh, u_heading)
    constant = np.sqrt(persistent) * _normal(found.rank)
    z = np.sqrt(1.0 - persistent) * _normal(found.noise) - constant
    score = scipy.special.expit(model.false_positive_logit + model.false_positive_sigma * z)
    return Reports.of_false_positives(o, label, boxes, score)


def _at_returns(
    sweeps: Sweeps,
    o: Int[ndarray, "c"],
    ray: Int[ndarray, "c"],
    lwh: Float[ndarray, "c 3"],
    u: Float[ndarray, "c"],
) -> Boxes:
    """Boxes of these sizes in the world frame: each at the return of a ray, or in front of it where it met a wall.

    `u` are uniforms: the heading as a share of a full turn; at a wall, which of its two directions.
    """
    column, row = np.divmod(ray, sweeps.hit.shape[2])
    heading, origin = sweeps.poses.yaw_rad[o], sweeps.poses.origin_m[o]
    yaw = 2.0 * np.pi * u - heading  # in the sensor frame, as `along` and `bearing`
    at_wall = sweeps.hit[o, column, row] == Hit.BUILDING
    along = _tangent(sweeps, o, column, row)
    turned = along + np.where(u < 0.5, np.pi, 0.0)
    yaw = np.where(at_wall & np.isfinite(along), turned, yaw)

    x, y, _ = sweeps.points(o, column, row).T
    length, width, height = lwh.T
    bearing = np.arctan2(y, x)
    # In front of the wall: half the extent of the box across the line of sight towards the sensor.
    skew = np.abs(np.sin(yaw - bearing))
    extent = width * skew + length * np.sqrt(1.0 - skew**2)
    back = np.where(at_wall, 0.5 * extent, 0.0)
    flat = np.maximum(np.hypot(x, y) - back, 1.0)
    ahead = bearing + heading
    east = origin[:, 0] + flat * np.cos(ahead)
    north = origin[:, 1] + flat * np.sin(ahead)
    up = sweeps.ground_m[o] + 0.5 * height
    return Boxes(np.column_stack([east, north, up]), lwh, wrapped(yaw + heading))


def _normal(u: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    return scipy.special.ndtri(np.clip(u, 1e-12, 1.0 - 1e-12))


def _tangent(sweeps: Sweeps, o: ndarray, column: ndarray, row: ndarray) -> Float[ndarray, "n"]:
    """Direction of the surface that a ray met, in the sensor frame; nan where its neighbours met another one.

    Along a flat wall 1 / distance is linear in the sine and cosine of the azimuth.
    """
    n = sweeps.hit.shape[1]
    if n < 5:
        return np.full(len(o), np.nan)
    here = np.clip(column, 2, n - 3)
    left, right = here - 2, here + 2
    with np.errstate(divide="ignore", invalid="ignore"):  # no return, no neighbour
        x0, y0, _ = sweeps.points(o, left, row).T
        x1, y1, _ = sweeps.points(o, right, row).T
        w0 = _inverse_range(sweeps, o, left, row)
        w = _inverse_range(sweeps, o, here, row)
        w1 = _inverse_range(sweeps, o, right, row)
        w0_and_w1 = 2.0 * w * np.cos(2.0 * sweeps.beams.fov_rad / n)  # their sum along a flat wall
        is_flat = np.abs(w0 + w1 - w0_and_w1) < FLAT * w
        return np.where(is_flat, np.arctan2(y1 - y0, x1 - x0), np.nan)


def _inverse_range(sweeps: Sweeps, o: ndarray, column: ndarray, row: ndarray) -> Float[ndarray, "n"]:
    """1 / range of rays [1/m]."""
    return 1.0 / metres(sweeps.range_steps[o, column, row], sweeps.step_m).astype(float)


class _Occurrences(NamedTuple):
    """Where false positives occur, sorted by observer."""

    observer: Int[ndarray, "c"]
    site: UInt64[ndarray, "c"]
    """Key of the site."""
    ray: Int[ndarray, "c"]
    """The site's nearest return, column * number of rows + row."""
    rank: Float[ndarray, "c"]
    """U / p."""
    noise: Float[ndarray, "c"]
    """Another uniform, new in each sweep."""


def _at_sites(
    sweeps: Sweeps, seen: Observability, draws: DetectorDraws, model: SimpleNamespace, shares: Float[ndarray, "3"]
) -> _Occurrences:
    """Where false positives occur. `shares` are those of the three u of an aspect: its own, the observer's, the new."""
    hidden = (seen.occlusion > HIDDEN) & (seen.n_returns > 0)
    ptr = ptr_of(seen.observer[hidden], len(sweeps.observers))
    actors = _Hidden(ptr, seen.actor[hidden], seen.n_returns[hidden])
    pace = _paces(float(model.false_positive_memory_s))
    keys = _SiteKeys(draws.site, draws.site_observer, draws.site_step, draws.actor, draws.time_s, pace)
    rates = _Rates(shares, float(model.false_positive_per_sweep), float(model.false_positive_road_p))
    ranges, poses = (sweeps.range_steps, sweeps.step_m), sweeps.poses
    seen_by = ranges, sweeps.hit, poses.origin_m, poses.yaw_rad, sweeps.beams
    max_range_m = float(sweeps.max_range_m)
    capacity = INITIAL_CAPACITY
    while True:
        n, site, ray, uniform = _all_sweeps(*seen_by, max_range_m, actors, keys, rates, capacity)
        if n.max(initial=0) <= capacity:
            break
        capacity = int(n.max())
    number, o = expand(np.zeros_like(n), n)
    rank, noise = uniform[o, number].T
    return _Occurrences(o, site[o, number], ray[o, number], rank, noise)


@lru_cache(maxsize=4)
def _paces(memory_s: float) -> Float[ndarray, "k"]:
    """Draws per second of persistent uniforms, in equiprobable levels; see `_persistent`."""
    return 1.0 / (memory_s * scipy.special.gammaincinv(2.0, (np.arange(_N_PACES) + 0.5) / _N_PACES))


@inlined
def _persistent(drawn, pace, time_s):
    """A uniform that is renewed at some moments, from the first hash of its key and its renewals per second.

    The moments are evenly spaced at random phase, their spacing a constant of the key, Gamma distributed of shape 2 and
    of the memory's scale, as is the gap of a Poisson process around a given moment: over all keys, the probability that
    none of them falls into t seconds is exp(-t / memory).
    """
    phase = (drawn << _PACE_BITS >> _S11) * _TO_UNIT  # the highest bits are the spacing, all the others the phase
    return unit(mix(drawn, np.int64(np.floor(time_s * pace + phase))))


@inlined
def _first_hashes(aspect, observer, step):
    """Of the three uniforms of an aspect: first hashes of those that last, common and of the observer; and the new."""
    return mix(aspect, 0), mix(mix(observer, aspect), 0), unit(mix(step, aspect))


@kernel
def _rank(draws, shares, p):
    """U of an aspect, where it is below p; else p."""
    best = p
    for k in range(3):
        u, share = draws[k], shares[k]
        if share > 0.0 and u < best:  # otherwise 1 - (1 - u)^(1 / share) is not below it, either
            best = min(best, 1.0 - (1.0 - u) ** (1.0 / share))
    return best


@inlined
def _side(x, y):
    """The side, of four, from which the origin is seen from (x, y)."""
    along = abs(x) >= abs(y)
    return 2 * (not along) + ((x if along else y) < 0.0)


@inlined
def _aspect(at, here, of_kind):
    """Kind and cell of a place, a point of the cell, and the keys of the site and of the aspect."""
    x, y, x0, y0, bits = here
    kind, cell = at & 1, at >> 1
    i = x0 + (cell >> bits)
    j = y0 + (cell & (1 << bits) - 1)
    key_of_kind = of_kind[_ROAD] if kind == _ROAD else of_kind[_WALL]
    key = mix(key_of_kind, (i << 32) ^ (j & _LOW_32))
    spot = mix(key, 6)
    to_x = (i + (spot >> _S32) * _TO_UNIT_32) * CELL_M
    to_y = (j + (spot & np.uint64(_LOW_32)) * _TO_UNIT_32) * CELL_M
    aspect = mix(key, _side(x - to_x, y - to_y))
    return kind, i, j, to_x, to_y, key, aspect


@compiled
def _likely(met, count, here, of_kind, drawn_by, body_rate, road_rate):
    """Whether any of the three uniforms is below the probability, for each place.

    Looking up is a loop of its own, so that the others become vector instructions.
    """
    observer, step, time_s, pace = drawn_by
    n = len(met)
    lasting = np.empty(n, np.uint64)
    own = np.empty(n, np.uint64)
    new, p = np.empty(n), np.empty(n)
    lasting_pace, own_pace = np.empty(n), np.empty(n)
    likely = np.empty(n, np.bool_)
    for k in range(n):
        aspect = _aspect(np.int64(met[k]), here, of_kind)[6]
        lasting[k], own[k], new[k] = _first_hashes(aspect, observer, step)
    for k in range(n):
        rate = road_rate if met[k] & 1 == _ROAD else body_rate
        p[k] = count[np.uint64(met[k])] * rate
        lasting_pace[k] = pace[lasting[k] >> _PHASE_BITS]
        own_pace[k] = pace[own[k] >> _PHASE_BITS]
    for k in range(n):
        u = _persistent(lasting[k], lasting_pace[k], time_s)
        v = _persistent(own[k], own_pace[k], time_s)
        likely[k] = min(u, v, new[k]) < p[k]
    return likely


@kernel
def _places(steps, hits, cos_el, x, y, along_x, along_y, top, width, place):
    """Cell and kind (wall, road) in which each of some rays of a column ended, after one place per row for all others.

    `cos_el` are lengths per step. In single precision, counted in cells from the corner of all of them: right to a
    hundredth of a millimetre.
    """
    zero, first = np.float32(0.0), np.int32(len(place))
    for r in range(np.uint64(len(place))):
        flat = np.float32(steps[r]) * cos_el[r]
        i = np.int32(min(max(x + flat * along_x, zero), top))
        j = np.int32(min(max(y + flat * along_y, zero), top))
        is_road = hits[r] == Hit.GROUND
        is_wall = hits[r] == Hit.BUILDING
        cell = i * width + j
        at = np.int32(2) * cell + np.int32(is_road) * np.int32(_ROAD)
        # If all others had one place in common, adding to it would wait for the addition before.
        place[r] = at + first if is_road | is_wall else np.int32(r)


class _Sweep(NamedTuple):
    """One sweep."""

    steps: ndarray
    """Range of each ray in steps, column by row."""
    step_m: float
    hits: ndarray
    """What each ray met, as in `Sweeps`."""
    beams: Beams
    x: float
    """Position of the sensor in the world [m]."""
    y: float
    cos: float
    """Cosine and sine of its heading."""
    sin: float


@inlined
def _heading(sweep, column):
    """Direction of the rays of a column in the world: its cosine and sine."""
    cos, sin = sweep.beams.cos_az[column], sweep.beams.sin_az[column]
    cos_of_ray = sweep.cos * cos - sweep.sin * sin
    sin_of_ray = sweep.sin * cos + sweep.cos * sin
    return cos_of_ray, sin_of_ray


@compiled
def _tally(sweep, x0, y0, side, bits):
    """Of some rays of a sweep: cells and kinds (wall, road), in the order met; returns of each; and by kind."""
    cos_el = (sweep.step_m * sweep.beams.cos_el[::ROW_STEP]).astype(np.float32)
    n_columns = (len(sweep.hits) + COLUMN_STEP - 1) // COLUMN_STEP
    n_rows = len(cos_el)
    width = np.int32(1 << bits)
    some_steps = np.empty(n_rows, sweep.steps.dtype)
    some_hits = np.empty(n_rows, sweep.hits.dtype)
    count = np.zeros(n_rows + 2 * side * width, np.int32)  # by place
    met, k = np.empty(n_columns * n_rows + 1, np.int32), 0
    place = np.empty(n_rows, np.int32)
    x = np.float32(sweep.x / CELL_M - x0)
    y = np.float32(sweep.y / CELL_M - y0)
    top = np.float32(side - 0.5)
    for column in range(n_columns):
        c = np.uint64(column * COLUMN_STEP)
        along_x, along_y = _heading(sweep, c)
        along_x = np.float32(along_x / CELL_M)
        along_y = np.float32(along_y / CELL_M)
        for r in range(np.uint64(n_rows)):  # next to each other: what follows becomes vector instructions
            row = r * np.uint64(ROW_STEP)
            some_steps[r] = sweep.steps[c, row]
            some_hits[r] = sweep.hits[c, row]
        _places(some_steps, some_hits, cos_el, x, y, along_x, along_y, top, width, place)
        last, n_last = np.uint32(0), np.int32(0)  # rays of one wall end in one place: added at once
        for r in range(np.uint64(n_rows)):
            at = np.uint32(place[r])
            if at != last:
                count[last] += n_last
                met[np.uint64(k)] = at
                k += count[at] == 0
                last, n_last = at, np.int32(0)
            n_last += 1
        count[last] += n_last
    n, total = 0, np.zeros(2, np.int64)
    for at in met[:k]:
        if at >= n_rows:
            met[n] = at - n_rows
            total[met[n] % 2] += count[at]
            n += 1
    return met[:n], count[n_rows:], total


@kernel
def _nearest(sweep, first, end, code, to_x, to_y):
    """The ray in columns `first` up to `end` that met `code` and ended nearest to a point; -1 if none did.

    The column towards the point is looked at first. Columns that pass the point farther away are then left out.
    """
    dx, dy = to_x - sweep.x, to_y - sweep.y
    ahead = sweep.cos * dx + sweep.sin * dy
    left = sweep.cos * dy - sweep.sin * dx
    turn_rad = np.arctan2(left, ahead) - sweep.beams.azimuth_rad[0]
    at = turn_rad / sweep.beams.fov_rad * len(sweep.hits)
    middle = max(min(np.int64(at), end - 1), first)
    behind = min(middle + 1, end)
    _, enough = _nearest_of(sweep, middle, behind, code, to_x, to_y, np.inf)
    best, _ = _nearest_of(sweep, first, end, code, to_x, to_y, enough)
    return best


@kernel
def _nearest_of(sweep, first, end, code, to_x, to_y, enough):
    """As `_nearest`, among rays whose squared distance is at most `enough`; the squared distance of the nearest."""
    best, least = -1, np.inf
    hits, x, y = sweep.hits, sweep.x, sweep.y
    for c in range(first, end):
        along_x, along_y = _heading(sweep, c)
        aside = along_x * (to_y - y) - along_y * (to_x - x)
        if aside * aside > min(enough, least) * _ROUNDED + _ROUNDED_M2:
            continue
        of_column, is_met = hits[c], np.int16(0)
        for r in range(len(of_column)):  # in vector instructions
            is_met |= np.int16(of_column[r] == code)
        if not is_met:
            continue
        for r in range(hits.shape[1]):
            if hits[c, r] == code:
                range_m = sweep.steps[c, r] * sweep.step_m
                flat = range_m * sweep.beams.cos_el[r]
                gap_x = x + flat * along_x - to_x
                gap_y = y + flat * along_y - to_y
                gap = gap_x * gap_x + gap_y * gap_y
                if gap < least:
                    best, least = c * hits.shape[1] + r, gap
    return best, least


@kernel
def _nearest_in_cell(sweep, i, j, code, to_x, to_y):
    """As `_nearest`, in the columns that cross a cell; in all of them, where the cell stands for what is farther."""
    dx = (i + 0.5) * CELL_M - sweep.x
    dy = (j + 0.5) * CELL_M - sweep.y
    columns = columns_of(sweep.beams)
    first, end, second_first, second_end = actor_columns(dx, dy, CELL_M, sweep.cos, sweep.sin, columns)
    best = _nearest(sweep, first, end, code, to_x, to_y)
    if second_end > second_first or best < 0:
        best = _nearest(sweep, np.int64(0), len(sweep.hits), code, to_x, to_y)
    return best


class _SiteKeys(NamedTuple):
    """Keys of the draws of sites, as in `DetectorDraws`, and how fast lasting ones change."""

    common: np.uint64
    observer: ndarray
    step: ndarray
    actor: ndarray
    time_s: float
    pace: ndarray
    """Renewals per second of lasting ones, in equiprobable levels."""


class _Rates(NamedTuple):
    """How many false positives there are, and where."""

    shares: ndarray
    per_sweep: float
    road_p: float


class _Hidden(NamedTuple):
    """Partly hidden actors of all observers: row and returns, by observer."""

    ptr: ndarray
    actor: ndarray
    n_returns: ndarray


@compiled
def _one_sweep(sweep, half, hidden, observer, step, keys, rates, site, ray, uniform):
    """Number of false positives of one sweep; as many as fit are written to `site`, `ray` and `uniform`."""
    actor, n_returns = hidden
    common, _, _, actor_key, time_s, pace = keys
    shares, rate, road_p = rates
    side, sampled = 2 * half + 1, 1.0 / (COLUMN_STEP * ROW_STEP)
    x, y = sweep.x, sweep.y
    x0 = np.int64(np.floor(x / CELL_M)) - half
    y0 = np.int64(np.floor(y / CELL_M)) - half
    bits = np.int64(np.ceil(np.log2(side)))
    met, count, n = _tally(sweep, x0, y0, side, bits)
    bodies = float(n[_WALL])
    for s in range(len(actor)):
        bodies += sampled * n_returns[s]
    road_rate = rate * road_p / max(bodies + n[_ROAD], sampled)
    body_rate = road_rate + rate * (1.0 - road_p) / max(bodies, sampled)
    of_kind = mix(common, _WALL), mix(common, _ROAD), mix(common, _ACTOR)
    here = x, y, x0, y0, bits
    drawn_by = observer, step, time_s, pace
    likely = _likely(met, count, here, of_kind, drawn_by, body_rate, road_rate)
    found = 0
    for k in range(len(met) + len(actor)):
        if k < len(met):
            if not likely[k]:
                continue
            at = np.int64(met[k])
            kind, i, j, to_x, to_y, key, aspect = _aspect(at, here, of_kind)
            p = count[met[k]] * (road_rate if kind == _ROAD else body_rate)
        else:
            s, i, j, to_x, to_y = k - len(met), 0, 0, x, y
            kind = _ACTOR
            key = aspect = mix(of_kind[_ACTOR], actor_key[actor[s]])
            p = sampled * n_returns[s] * body_rate
        p = min(1.0, p)
        first, second, new = _first_hashes(aspect, observer, step)
        lasting = _persistent(first, pace[first >> _PHASE_BITS], time_s)
        own = _persistent(second, pace[second >> _PHASE_BITS], time_s)
        rank = _rank((lasting, own, new), shares, p)
        if rank < p:
            if found < len(site):
                site[found] = key
                uniform[found, 0] = rank / p
                uniform[found, 1] = unit(mix(mix(step, aspect), 1))
                if kind == _ACTOR:
                    code = Hit.ACTOR + actor[k - len(met)]
                    ray[found] = _nearest(sweep, np.int64(0), len(sweep.hits), code, to_x, to_y)
                else:
                    code = Hit.GROUND.value if kind == _ROAD else Hit.BUILDING.value
                    ray[found] = _nearest_in_cell(sweep, i, j, code, to_x, to_y)
            found += 1
    return found


@compiled
def _all_sweeps(ranges, hit, origin_m, yaw_rad, beams, max_range_m, hidden, keys, rates, capacity):
    """Per sweep: number of false positives; of the first `capacity`: key of the site, ray, U / p and a uniform."""
    n_sweeps = len(hit)
    half = min(int(max_range_m / CELL_M) + 2, FARTHEST_CELLS)
    found = np.empty(n_sweeps, np.int64)
    site = np.empty((n_sweeps, capacity), np.uint64)
    ray = np.empty((n_sweeps, capacity), np.int64)
    uniform = np.empty((n_sweeps, capacity, 2))
    steps, step_m = ranges
    for o in range(n_sweeps):
        x = origin_m[o, 0]
        y = origin_m[o, 1]
        yaw = yaw_rad[o]
        cos, sin = np.cos(yaw), np.sin(yaw)
        sweep = _Sweep(steps[o], step_m, hit[o], beams, x, y, cos, sin)
        first, last = hidden.ptr[o], hidden.ptr[o + 1]
        actors = hidden.actor[first:last], hidden.n_returns[first:last]
        observer, step = keys.observer[o], keys.step[o]
        found[o] = _one_sweep(sweep, half, actors, observer, step, keys, rates, site[o], ray[o], uniform[o])
    return found, site, ray, uniform
