"""Link budget: mean received power of every pair of stations above the cut-off.

    links = links_between(xyz_m, key, params, rng_key, los)

A grid finds the pairs in range, and the city's walls decide their line of sight. Vehicles may block links that no
building blocks. A link depends only on the positions of its ends and on the seed: the same two positions have the same
link in every run with the same seed.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim.base import rng
from cosim.base.kernel import compiled, kernel
from cosim.base.ragged import order_by_two
from cosim.base.threads import in_ranges
from cosim.radio.bodies import Bodies, tallest_blocker_m
from cosim.radio.channel import Links
from cosim.radio.propagation import (
    BLOCKER_M,
    PropagationParams,
    blockage_db,
    blocked_by_vehicle,
    fading_class,
    link_field,
    mean_loss_db,
)
from sensors.line_of_sight import LosOfPlaces, WallIndex
from sensors.line_of_sight_kernels import FilledCells, crosses_filled_cell
from sensors.scene import Scene

_RING = 6
"""Cells per range: more of them fit the circle better."""
_SHADOW_LOS, _SHADOW_NLOS, _BLOCKED, _BLOCKAGE = (np.uint64(k) for k in range(4))


@dataclass(frozen=True, slots=True)
class PairLos:
    """M pairs of positions, each once. Some distant pairs without line of sight may be left out."""

    a: Int[ndarray, "m"]
    b: Int[ndarray, "m"]
    distance_m: Float[ndarray, "m"]
    nlos: Bool[ndarray, "m"]
    """Whether a building blocks the line of sight."""


@dataclass(frozen=True, slots=True)
class StationPairs(PairLos):
    """M pairs of stations in range, each once, with their losses."""

    nlosv: Bool[ndarray, "m"]
    """Whether no building but a vehicle blocks it."""
    loss_db: Float[ndarray, "m"]
    """Path loss, blockage and shadowing together."""


class _Cells(NamedTuple):
    """Points sorted by cells of a square grid."""

    order: ndarray  # row of each point
    start: ndarray  # where the points of each cell begin, cell by cell
    cell: ndarray  # column and row of the cell of each point
    shape: ndarray  # number of columns and rows


class _Walls(NamedTuple):
    """The city's grid of cells inside buildings, as `crosses_filled_cell` reads it."""

    exist: bool
    on_grid: ndarray  # of each point
    filled: FilledCells
    nlos_range_m: float  # longer pairs that cross a filled cell are left out


class _Found(NamedTuple):
    """Pairs of points, or room for them."""

    a: ndarray
    b: ndarray
    distance_m: ndarray
    blocked: ndarray  # whether a pair crosses a filled cell

    @staticmethod
    def room(n: int) -> "_Found":
        """For n pairs."""
        return _Found(
            a=np.empty(n, np.int32),
            b=np.empty(n, np.int32),
            distance_m=np.empty(n),
            blocked=np.empty(n, np.bool_),
        )


@kernel
def _pairs(begin, end, xyz, sends, range_m, cells, walls, found):
    """Write the pairs in range of the points `begin` to `end` and later ones, of which at least one sends, into `found`
    and return their number, which may exceed the room there.

    Two points of a pair are at most `_RING` cells apart. Points are sorted by cell, so that neighbours are close
    together in memory.
    """
    order, start, cell, shape = cells.order, cells.start, cells.cell, cells.shape
    nlos_range_m = walls.nlos_range_m
    a, b, d, blocked = found
    m = 0
    for p in range(begin, end):
        cx, cy = cell[p, 0], cell[p, 1]
        for gx in range(cx, min(cx + _RING + 1, shape[0])):
            column = gx * shape[1]
            last = min(cy + _RING + 1, shape[1])
            nearest = start[column + max(cy - _RING, 0)]
            if gx == cx:  # in the point's own column only later points
                nearest = p + 1
            for q in range(nearest, start[column + last]):
                if not (sends[p] or sends[q]):
                    continue
                dx = xyz[p, 0] - xyz[q, 0]
                dy = xyz[p, 1] - xyz[q, 1]
                dz = xyz[p, 2] - xyz[q, 2]
                square = dx * dx + dy * dy + dz * dz
                if square > range_m * range_m:
                    continue
                crosses = walls.exist and crosses_filled_cell(walls.on_grid, p, q, walls.filled)
                if crosses and square > nlos_range_m * nlos_range_m:
                    continue
                if m < len(a):
                    a[m], b[m] = order[p], order[q]
                    d[m] = np.sqrt(square)
                    blocked[m] = crosses
                m += 1
    return m


@cache
def _no_walls() -> WallIndex:
    return WallIndex.of(Scene.empty().buildings)


def pairs_within(xyz_m: Float[ndarray, "n 3"], range_m: float) -> tuple[ndarray, ndarray, ndarray]:
    """All pairs of points whose distance in space is at most `range_m`.

    Returns
    -------
    Rows of the one and of the other point, and their distance [m]. Each pair is there once, in no particular order;
    either of its points may come first.
    """
    return _within(xyz_m, range_m, None, np.inf)[:3]


def neighbours(xy_m: Float[ndarray, "n 2"], range_m: float) -> tuple[ndarray, ndarray, ndarray]:
    """All ordered pairs of stations whose horizontal distance is at most `range_m`.

    Returns
    -------
    Rows of sender and receiver, and their distance [m]; sorted by sender, then receiver.
    """
    xyz_m = np.column_stack([xy_m, np.zeros(len(xy_m))])
    a, b, distance_m = pairs_within(xyz_m, range_m)
    sender = np.concatenate([a, b]).astype(np.int64)
    receiver = np.concatenate([b, a]).astype(np.int64)
    order = order_by_two(sender, receiver, len(xy_m))
    return sender[order], receiver[order], np.concatenate([distance_m, distance_m])[order]


def _sorted_by_cell(xyz_m: Float[ndarray, "n 3"], range_m: float) -> tuple[_Cells, float]:
    """Points sorted by cells, and the width of a cell: at most 1,000 of them along one side of the area."""
    low = xyz_m[:, :2].min(0)
    size_m = np.ptp(xyz_m[:, :2], axis=0)
    side_m = max(range_m / _RING, float(size_m.max()) / 1000)
    cell = ((xyz_m[:, :2] - low) / side_m).astype(np.int64)
    shape = cell.max(0) + 1
    flat = cell[:, 0] * shape[1] + cell[:, 1]
    order = np.argsort(flat, kind="stable")
    start = np.searchsorted(flat[order], np.arange(np.prod(shape) + 1))
    return _Cells(order, start, cell[order], shape), side_m


def _within(
    xyz_m: Float[ndarray, "n 3"],
    range_m: float,
    los: LosOfPlaces | None,
    nlos_range_m: float,
    sends: Bool[ndarray, "n"] | None = None,
) -> _Found:
    """All pairs of points in range, and whether each pair crosses a filled cell (a cell inside buildings).

    Pairs that do and are longer than `nlos_range_m` are left out. A pair that crosses a filled cell has no line of
    sight. Other pairs may have no line of sight either.
    Of each pair at least one point is among `sends`; None: all are.
    """
    n = len(xyz_m)
    sends = np.ones(n, bool) if sends is None else sends
    if n == 0:
        return _Found.room(0)
    places = xyz_m if los is None else los.snap(xyz_m)
    index = _no_walls() if los is None else los.index
    cells, side_m = _sorted_by_cell(xyz_m, range_m)
    order = cells.order
    xyz_m, sends = xyz_m[order], sends[order]
    on_grid = index.cells(places[order])
    filled = index.filled(places[:, 2])
    walls = _Walls(los is not None, on_grid, filled, float(nlos_range_m))
    area_m2 = np.prod(cells.shape) * side_m**2
    in_range = np.pi * min(range_m, nlos_range_m) ** 2 / area_m2  # share of the points, if they were uniform
    parts: dict[tuple[int, int], list[ndarray]] = {}

    def find(begin: int, end: int) -> None:
        per_point = min(n, 256 + 2 * n * in_range)
        room = int((end - begin) * per_point / 2 + 1024)
        while True:
            found = _Found.room(room)
            m = _pairs(begin, end, xyz_m, sends, float(range_m), cells, walls, found)
            if m <= room:
                parts[begin, end] = [column[:m] for column in found]
                return
            room = m

    in_ranges(find, n)
    chunks = [parts[at] for at in sorted(parts)]
    if len(chunks) > 1:
        chunks = [[np.concatenate(column) for column in zip(*chunks, strict=True)]]
    return _Found(*chunks[0])


def from_db(db: ndarray | float) -> ndarray:
    """Power [mW] of a level in dBm, or ratio of a value in dB; -inf gives 0."""
    return np.exp(np.asarray(db) * (np.log(10) / 10))


def los_pairs(
    xyz_m: Float[ndarray, "n 3"],
    params: PropagationParams,
    los: LosOfPlaces | None = None,
    near_m: float = 0.0,
    sends: Bool[ndarray, "n"] | None = None,
) -> PairLos:
    """Line of sight of all pairs up to `near_m`, and of all pairs in the interference range of `params`.

    Parameters
    ----------
    xyz_m
        Antenna positions, world frame.
    los
        Lines of sight in the city. None: every pair has line of sight.
    near_m
        Distance in space.
    sends
        Stations of which each pair has at least one. None: all.

    Raises
    ------
    ValueError
        If `xyz_m` has another shape or is not finite.
    """
    xyz_m = np.ascontiguousarray(xyz_m, np.float64)
    has_shape = xyz_m.ndim == 2 and xyz_m.shape[1] == 3
    if not has_shape or not np.all(np.isfinite(xyz_m)):
        raise ValueError("xyz_m: antenna positions must be (n, 3) finite numbers [m].")
    if not params.knows_walls:
        los = None
    range_m = max(params.interference_range_m, near_m)
    nlos_range_m = max(params.interference_range_nlos_m, near_m)
    a, b, d, nlos = _within(xyz_m, range_m, los, nlos_range_m, sends)
    if los is not None:
        nlos = ~los.has_los(xyz_m, a, b, nlos)
    return PairLos(a, b, d, nlos)


def pairs(
    xyz_m: Float[ndarray, "n 3"],
    params: PropagationParams,
    rng_key: np.uint64,
    los: LosOfPlaces | None = None,
    found: PairLos | None = None,
    above_street_m: Float[ndarray, "n"] | None = None,
    bodies: Bodies | None = None,
) -> StationPairs:
    """Losses between stations at these antenna positions.

    Parameters
    ----------
    xyz_m
        Antenna positions, world frame.
    rng_key
        Key of shadowing and blockage, one for the whole run.
    los
        Lines of sight in the city. None: every pair has line of sight.
    found
        Result of `los_pairs`, if it is known already.
    above_street_m
        Heights of the antennas above the street under them [m]. None: the streets are at height 0.
    bodies
        Road users of all traffic, for blockage by bodies.

    Raises
    ------
    ValueError
        If blockage by bodies is asked for and the bodies are not known.
    """
    if found is None:
        found = los_pairs(xyz_m, params, los)
    xyz_m = np.ascontiguousarray(xyz_m, np.float64)
    if not params.knows_walls:
        los = None
    a, b, d, nlos = found.a, found.b, found.distance_m, found.nlos
    range_m = np.where(nlos, params.interference_range_nlos_m, params.interference_range_m)
    keep = np.flatnonzero((d <= range_m) & (d <= params.interference_range_m))
    a, b = a[keep], b[keep]
    d, nlos = d[keep], nlos[keep]
    height_m = xyz_m[:, 2] if above_street_m is None else np.asarray(above_street_m, float)
    h_a, h_b = height_m[a], height_m[b]
    by_wall = params.walls == "sommer"
    loss = mean_loss_db(d, nlos & (not by_wall), h_a, h_b, params)
    if by_wall and los is not None:
        rows = np.flatnonzero(nlos)
        n_walls, inside_m = los.walls_crossed(xyz_m, a[rows], b[rows])
        loss[rows] += params.wall_db * n_walls + params.indoors_db_per_m * inside_m  # [4] of `propagation`
    xy = xyz_m[:, :2]

    def field(rows: ndarray, decorrelation_m: float, purpose: np.uint64) -> ndarray:
        key = rng.keys(rng_key, np.array([purpose]))[0]
        return link_field(xy, a[rows], b[rows], d[rows], decorrelation_m, key)

    nlosv = np.zeros(len(a), bool)
    far = params.decorrelation_nlos_m
    if params.blockage != "none" and params.model in ("urban", "highway"):
        rows = np.flatnonzero(~nlos)
        if params.blockage == "bodies":
            if bodies is None:
                raise ValueError(
                    'radio.propagation.blockage = "bodies" needs the bodies of the traffic, which these stations lack. '
                    "Set stations.bodies, or use probabilistic."
                )
            blocker_m = tallest_blocker_m(xyz_m, a[rows], b[rows], bodies)
        else:
            is_blocked = blocked_by_vehicle(d[rows], field(rows, far, _BLOCKED), params)
            blocker_m = np.where(is_blocked, BLOCKER_M, 0.0)
        rows, blocker_m = rows[blocker_m > 0], blocker_m[blocker_m > 0]
        nlosv[rows] = True
        normal = field(rows, far, _BLOCKAGE)
        length_m = np.maximum(d[rows], 1.0)
        loss[rows] += blockage_db(normal, length_m, h_a[rows], h_b[rows], blocker_m)
    if params.shadowing:
        near = np.flatnonzero(~nlos & ~nlosv)
        loss[near] += params.sigma_los_db * field(near, params.decorrelation_los_m, _SHADOW_LOS)
        rows = np.flatnonzero(nlos | nlosv)
        sigma = np.where(nlos[rows], params.sigma_nlos_db, params.sigma_los_db)
        loss[rows] += sigma * field(rows, far, _SHADOW_NLOS)
    return StationPairs(a, b, d, nlos, nlosv, loss)


def links_between(
    xyz_m: Float[ndarray, "n 3"],
    key: UInt64[ndarray, "n"],
    params: PropagationParams,
    rng_key: np.uint64,
    los: LosOfPlaces | None = None,
    found: PairLos | None = None,
    above_street_m: Float[ndarray, "n"] | None = None,
    bodies: Bodies | None = None,
    sends: Bool[ndarray, "n"] | None = None,
) -> Links:
    """Links between stations at these antenna positions, sorted by sender.

    Parameters
    ----------
    xyz_m, key
        Antenna positions [m] and keys of the N stations.
    params, rng_key, los, found, above_street_m, bodies
        As for `pairs`.
    sends
        Stations whose links are computed. The others have no links as senders. None: all.
    """
    if found is None:
        found = los_pairs(xyz_m, params, los, sends=sends)
    losses = pairs(xyz_m, params, rng_key, los, found, above_street_m, bodies)
    sends = np.ones(len(xyz_m), bool) if sends is None else sends
    received_mw = from_db(-losses.loss_db) * from_db(params.tx_power_dbm)
    fading = fading_class(losses.distance_m, params.fading)
    arrives = received_mw >= from_db(params.cutoff_dbm)
    ptr, receiver, pair = _directed(losses.a, losses.b, arrives, sends)
    return Links(key, ptr, receiver, received_mw[pair].astype(np.float32), fading[pair])


@compiled
def _directed(a, b, arrives, sends):
    """Links in the directions of each pair that send, if its signals arrive: where each sender's links begin, receiver
    and row of the pair.
    """
    n = len(sends)
    ptr = np.zeros(n + 1, np.int64)
    for pair in np.flatnonzero(arrives):
        for sender in (a[pair], b[pair]):
            ptr[sender + 1] += sends[sender]
    for i in range(n):
        ptr[i + 1] += ptr[i]
    at, m = ptr.copy(), ptr[n]
    receiver = np.empty(m, np.int32)
    of_pair = np.empty(m, np.int64)
    for pair in np.flatnonzero(arrives):
        i, j = a[pair], b[pair]
        for sender, other in ((i, j), (j, i)):
            if sends[sender]:
                receiver[at[sender]] = other
                of_pair[at[sender]] = pair
                at[sender] += 1
    return ptr, receiver, of_pair
