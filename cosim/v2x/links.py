"""Who could disturb whom: the mean received power of every pair of radios that is worth counting.

    links = between(xyz_m, key, params, chance, sight)

Pairs within reach come from a grid, lines of sight from the city's walls, and what no wall cuts a vehicle may.
Everything here belongs to places: two radios at the same places have the same link in any run of the same seed.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from numba import njit
from numpy import ndarray

from cosim import rng
from cosim.v2x.channel import Links
from cosim.v2x.kernel import kernel
from cosim.v2x.march import runs_into_house
from cosim.v2x.obstruction import Sight, Walls
from cosim.v2x.propagation import (
    PropagationParams,
    blockage_db,
    fading_class,
    link_field,
    mean_loss_db,
    vehicle_in_way,
)

_RING = 6
"""Cells that make up the reach: more of them fit the circle better."""
_SHADOW_LOS, _SHADOW_NLOS, _IN_WAY, _BLOCKAGE = (np.uint64(k) for k in range(4))


@dataclass(frozen=True, slots=True)
class Pairs:
    """M pairs of radios within reach, each once."""

    a: Int[ndarray, "m"]
    b: Int[ndarray, "m"]
    distance_m: Float[ndarray, "m"]
    nlos: Bool[ndarray, "m"]
    """Whether a building stands between them."""
    nlosv: Bool[ndarray, "m"]
    """Whether no building does, but a vehicle."""
    loss_db: Float[ndarray, "m"]
    """Path loss, blockage and shadowing together."""


@dataclass(frozen=True, slots=True)
class Seen:
    """M pairs of places, each once; of those far apart behind a building not all."""

    a: Int[ndarray, "m"]
    b: Int[ndarray, "m"]
    distance_m: Float[ndarray, "m"]
    nlos: Bool[ndarray, "m"]
    """Whether a building stands between them."""


@kernel
def _near(xyz, reach_m, order, start, cell, shape, looks, seen_m, on_grid, filled, a, b, d, hidden):
    """Pairs within reach, at most `_RING` cells apart, but for those beyond `seen_m` that run into a house.

    Points come sorted by cell, and so lie close together in memory; `order` is their rows.
    """
    m = 0
    for p in range(len(order)):
        cx, cy = cell[p, 0], cell[p, 1]
        for gx in range(cx, min(cx + _RING + 1, shape[0])):
            # Of the point's own column only what comes later.
            first, last = cy if gx == cx else max(cy - _RING, 0), min(cy + _RING + 1, shape[1])
            begin = p + 1 if gx == cx else start[gx * shape[1] + first]
            for q in range(begin, start[gx * shape[1] + last]):
                dx, dy, dz = xyz[p, 0] - xyz[q, 0], xyz[p, 1] - xyz[q, 1], xyz[p, 2] - xyz[q, 2]
                square = dx * dx + dy * dy + dz * dz
                if square > reach_m * reach_m:
                    continue
                into = looks and runs_into_house(on_grid, p, q, filled)
                if into and square > seen_m * seen_m:
                    continue
                if m < len(a):
                    a[m], b[m], d[m], hidden[m] = order[p], order[q], np.sqrt(square), into
                m += 1
    return m


@cache
def _no_walls() -> Walls:
    return Walls.of([])


def within(xyz_m: Float[ndarray, "n 3"], reach_m: float) -> tuple[ndarray, ndarray, ndarray]:
    """All pairs of points within reach, each once: rows, rows, distance [m]."""
    return _within(xyz_m, reach_m, None, np.inf)[:3]


def _within(
    xyz_m: Float[ndarray, "n 3"], reach_m: float, sight: Sight | None, reach_nlos_m: float
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """The same, and whether a pair runs into a house; those beyond `reach_nlos_m` that do are left out.

    Only what is cheap to tell is told: other pairs may be parted by a building too.
    """
    n = len(xyz_m)
    if n == 0:
        return np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0), np.zeros(0, bool)
    places = xyz_m if sight is None else sight.snap(xyz_m)
    walls = _no_walls() if sight is None else sight.walls
    low = xyz_m[:, :2].min(0)
    side = max(reach_m / _RING, float(np.ptp(xyz_m[:, :2], axis=0).max()) / 1000)
    cell = ((xyz_m[:, :2] - low) / side).astype(np.int64)
    shape = cell.max(0) + 1
    flat = cell[:, 0] * shape[1] + cell[:, 1]
    order = np.argsort(flat, kind="stable")
    start = np.searchsorted(flat[order], np.arange(shape[0] * shape[1] + 1))
    share = np.pi * min(reach_m, reach_nlos_m) ** 2 / (np.prod(shape) * side**2)  # of all points, if evenly strewn
    cell, on_grid, xyz_m = cell[order], walls.cells(places[order]), xyz_m[order]
    filled = walls.filled(places[:, 2])
    room = int(n * min(n, 256 + 2 * n * share) / 2 + 1024)
    while True:
        a, b, d = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room)
        hidden = np.empty(room, np.bool_)
        m = _near(
            xyz_m, float(reach_m), order, start, cell, shape, sight is not None, float(reach_nlos_m), on_grid, filled,
            a, b, d, hidden,
        )  # fmt: skip
        if m <= room:
            return a[:m], b[:m], d[:m], hidden[:m]
        room = m


@njit(cache=True)
def _both_ways(n, a, b, gain, fading, tx_mw, cutoff_mw):
    """Compressed rows by sender of the links, in both directions, that are not too weak."""
    ptr = np.zeros(n + 1, np.int64)
    for m in range(len(a)):
        ptr[a[m] + 1] += tx_mw[a[m]] * gain[m] >= cutoff_mw
        ptr[b[m] + 1] += tx_mw[b[m]] * gain[m] >= cutoff_mw
    for i in range(n):
        ptr[i + 1] += ptr[i]
    at = ptr[:-1].copy()
    receiver, power = np.empty(ptr[n], np.int32), np.empty(ptr[n], np.float32)
    kind, pair = np.empty(ptr[n], np.uint8), np.empty(ptr[n], np.int32)
    for m in range(len(a)):
        for i, j in ((a[m], b[m]), (b[m], a[m])):
            mw = tx_mw[i] * gain[m]
            if mw >= cutoff_mw:
                k = at[i]
                receiver[k], power[k], kind[k], pair[k] = j, mw, fading[m], m
                at[i] = k + 1
    return ptr, receiver, power, kind, pair


def _linear(db: ndarray | float) -> ndarray:
    return np.exp(np.asarray(db) * (np.log(10) / 10))


def look(
    xyz_m: Float[ndarray, "n 3"], params: PropagationParams, sight: Sight | None = None, near_m: float = 0.0
) -> Seen:
    """Who sees whom: all pairs up to `near_m`, and all that `params` reach."""
    xyz_m = np.ascontiguousarray(xyz_m, np.float64)
    if xyz_m.ndim != 2 or xyz_m.shape[1] != 3 or not np.all(np.isfinite(xyz_m)):
        raise ValueError("xyz_m: antenna positions must be (n, 3) finite numbers [m].")
    if not params.knows_walls:
        sight = None
    a, b, d, nlos = _within(xyz_m, max(params.reach_m, near_m), sight, max(params.reach_nlos_m, near_m))
    return Seen(a, b, d, nlos if sight is None else ~sight.clear(xyz_m, a, b, nlos))


def pairs(
    xyz_m: Float[ndarray, "n 3"],
    params: PropagationParams,
    chance: np.uint64,
    sight: Sight | None = None,
    seen: Seen | None = None,
) -> Pairs:
    """What lies between radios at these antenna positions.

    Parameters
    ----------
    chance
        Key of shadowing and blockage, one for the whole run.
    sight
        The city's walls; without them nothing is behind one. See `PropagationParams.walls` for who minds.
    seen
        What `look` has found, if it has been asked already.
    """
    if seen is None:
        seen = look(xyz_m, params, sight)
    xyz_m = np.ascontiguousarray(xyz_m, np.float64)
    if not params.knows_walls:
        sight = None
    a, b, d, nlos = seen.a, seen.b, seen.distance_m, seen.nlos
    keep = np.flatnonzero((~nlos | (d <= params.reach_nlos_m)) & (d <= params.reach_m))
    a, b, d, nlos = a[keep], b[keep], d[keep], nlos[keep]
    h_a, h_b = xyz_m[a, 2], xyz_m[b, 2]
    by_wall = params.walls == "sommer"
    loss = mean_loss_db(d, nlos & (not by_wall), h_a, h_b, params)
    if by_wall and sight is not None:
        rows = np.flatnonzero(nlos)
        n_walls, inside_m = sight.walls.through(sight.snap(xyz_m), a[rows], b[rows])
        loss[rows] += params.wall_db * n_walls + params.indoors_db_per_m * inside_m  # [4] of `propagation`
    xy = xyz_m[:, :2]

    def field(rows: ndarray, decorrelation_m: float, purpose: np.uint64) -> ndarray:
        return link_field(xy, a[rows], b[rows], d[rows], decorrelation_m, rng.keys(chance, np.array([purpose]))[0])

    nlosv = np.zeros(len(a), bool)
    far = params.decorrelation_nlos_m
    if params.blockage != "none" and params.model in ("urban", "highway"):
        open_ = np.flatnonzero(~nlos)
        nlosv[open_] = vehicle_in_way(d[open_], field(open_, far, _IN_WAY), params)
        rows = np.flatnonzero(nlosv)
        low, high = np.minimum(h_a[rows], h_b[rows]), np.maximum(h_a[rows], h_b[rows])
        loss[rows] += blockage_db(field(rows, far, _BLOCKAGE), np.maximum(d[rows], 1.0), low, high)
    if params.shadowing:
        near = np.flatnonzero(~nlos & ~nlosv)
        loss[near] += params.sigma_los_db * field(near, params.decorrelation_los_m, _SHADOW_LOS)
        rows = np.flatnonzero(nlos | nlosv)
        sigma = np.where(nlos[rows], params.sigma_nlos_db, params.sigma_los_db)
        loss[rows] += sigma * field(rows, far, _SHADOW_NLOS)
    return Pairs(a, b, d, nlos, nlosv, loss)


def between(
    xyz_m: Float[ndarray, "n 3"],
    key: UInt64[ndarray, "n"],
    params: PropagationParams,
    chance: np.uint64,
    sight: Sight | None = None,
    tx_power_dbm: Float[ndarray, "n"] | None = None,
    seen: Seen | None = None,
) -> tuple[Links, Pairs, Int[ndarray, "links"]]:
    """The links between radios at these antenna positions, and the pair behind each link.

    Parameters
    ----------
    tx_power_dbm
        Power of each radio where it differs from the params', as for roadside units or power control.
    """
    found = pairs(xyz_m, params, chance, sight, seen)
    n = len(xyz_m)
    power_dbm = np.full(n, params.tx_power_dbm) if tx_power_dbm is None else np.asarray(tx_power_dbm, float)
    ptr, receiver, power_mw, fading, pair = _both_ways(
        n, found.a, found.b, _linear(-found.loss_db), fading_class(found.distance_m, params.fading),
        _linear(power_dbm), float(_linear(params.cutoff_dbm)),
    )  # fmt: skip
    return Links(key, ptr, receiver, power_mw, fading), found, pair
