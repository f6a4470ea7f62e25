"""Lines of sight between points, which buildings or the bodies of actors can block.

`WallIndex` is exact; `LosOfPlaces` rounds positions to a grid. The radio and the encounters use both.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int, Int32, UInt8, UInt64
from numpy import ndarray

from cosim.base.ragged import expand, offsets
from cosim.base.threads import in_ranges
from sensors import line_of_sight_kernels as kernels
from sensors.boxes import Boxes
from sensors.line_of_sight_kernels import FilledCells, Grid, Walls
from sensors.neighbours import neighbours
from sensors.scene import Buildings, Scene, prisms
from sensors.trees import trees_near


@dataclass(frozen=True, slots=True)
class WallIndex:
    """Grid index of the walls of all buildings, for straight lines between points. `WallIndex.of` builds it.

    A wall blocks from its base to its top. A point inside a building has no line of sight to any other point.
    """

    grid: Grid
    walls: Walls
    solid: Int32[ndarray, "s"]
    """Cells that a building fills, ascending: cell (i, j) has the number i * ny + j."""
    base: UInt8[ndarray, "s"]
    top: UInt8[ndarray, "s"]
    """Base and top of that building, as `_level` gives them; the base is above the top if the building is too flat."""
    _filled: dict[tuple[int, int], FilledCells] = field(default_factory=dict, repr=False, compare=False)
    """What `filled` has found, by lowest and highest level."""

    @staticmethod
    def of(buildings: Buildings, cell_m: float = 4.0) -> WallIndex:
        """Index the buildings of a scene with cells of this width.

        Raises
        ------
        ValueError
            If the width is not positive.
        """
        if not cell_m > 0:
            raise ValueError(f"cell_m = {cell_m} m must be positive.")
        count = np.diff(buildings.ptr)
        ends = [buildings.ax_m, buildings.ay_m, buildings.bx_m, buildings.by_m]
        heights = [np.repeat(z, count) for z in (buildings.base_m, buildings.top_m)]
        segment = np.column_stack([*ends, *heights])
        walls = Walls(segment, buildings.ptr, buildings.base_m, buildings.top_m)
        grid = _grid_of(walls, float(cell_m))
        solid, building = _solid_cells(grid, walls)
        # Rounded inwards: slightly less is filled.
        base = np.ceil(_level(walls, walls.base_m[building]) - 1e-9)
        top = np.floor(_level(walls, walls.top_m[building]) + 1e-9)
        return WallIndex(
            grid=grid,
            walls=walls,
            solid=solid.astype(np.int32),
            base=base.astype(np.uint8),
            top=top.astype(np.uint8),
        )

    def filled(self, z_m: Float[ndarray, "n"]) -> FilledCells:
        """Grid cells that block every line between points of these heights.

        Parameters
        ----------
        z_m
            World heights of all end points, in any order.
        """
        level = _level(self.walls, np.asarray(z_m, float))
        low = int(np.floor(level.min(initial=254.0)))
        high = int(np.ceil(level.max(initial=0.0)))
        found = self._filled.get((low, high))
        if found is None:
            if len(self._filled) >= 16:
                self._filled.clear()  # another thread may ask at any time
            nx, ny = self.grid.step.shape
            is_filled = np.zeros(nx * ny, bool)
            blocks = (self.base <= low) & (self.top >= high) & (self.top > 0)
            is_filled[self.solid[blocks]] = True
            bits = np.packbits(is_filled, bitorder="little")
            found = self._filled[low, high] = FilledCells(bits, nx, ny)
        return found

    def cells(self, xyz_m: Float[ndarray, "n 3"]) -> Float[ndarray, "n 2"]:
        """Positions of points on the grid.

        Parameters
        ----------
        xyz_m
            Points in the world frame.

        Returns
        -------
        x and y from the lower corner of the grid, in widths of a cell.
        """
        return (xyz_m[:, :2] - self.grid.low) * (1.0 / self.grid.cell_m)

    def crosses_filled(
        self,
        xyz_m: Float[ndarray, "n 3"],
        a: Int[ndarray, "m"],
        b: Int[ndarray, "m"],
    ) -> Bool[ndarray, "m"]:
        """Which lines are blocked for certain, because one of a few sample points lies in a cell that a building fills.

        Parameters
        ----------
        xyz_m
            Points in the world frame.
        a, b
            Rows of the two end points of each line.

        Returns
        -------
        True where a line is blocked. Where it is false, the line may be blocked too.
        """
        out = np.empty(len(a), np.bool_)
        filled = self.filled(xyz_m[:, 2])
        kernels.probe(self.cells(xyz_m), a, b, filled, out)
        return out

    def indoors(self, xyz_m: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Which points lie inside a building.

        Parameters
        ----------
        xyz_m
            Points in the world frame; NaN as the height stands for any height.

        Returns
        -------
        True for a point within a footprint, between the base and the top of the building.
        """
        return kernels.building_at(np.ascontiguousarray(xyz_m, float), self.grid, self.walls) >= 0

    def has_los(
        self,
        xyz_m: Float[ndarray, "n 3"],
        a: Int[ndarray, "m"],
        b: Int[ndarray, "m"],
        blocked: Bool[ndarray, "m"] | None = None,
        rank: UInt64[ndarray, "n"] | None = None,
    ) -> Bool[ndarray, "m"]:
        """Which lines between points are not blocked by a building; exact.

        Parameters
        ----------
        xyz_m
            Points in the world frame [m].
        a, b
            Rows of the two end points of each line.
        blocked
            Lines that are known to be blocked (`crosses_filled`); computed by default.
        rank
            A line is followed from its end of lower rank, from `a` where they are equal; all are equal by default.

        Returns
        -------
        One boolean per line.
        """
        xyz_m = np.ascontiguousarray(xyz_m, float)
        a, b = (np.ascontiguousarray(rows, np.int32) for rows in (a, b))  # the type for which kernels are compiled
        out = np.empty(len(a), np.bool_)
        blocked = self.crosses_filled(xyz_m, a, b) if blocked is None else blocked
        rank = np.zeros(len(xyz_m), np.uint64) if rank is None else rank
        lines = xyz_m, self.indoors(xyz_m), rank, a, b, blocked

        def follow(begin: int, end: int) -> None:
            kernels.has_los(begin, end, *lines, self.grid, self.walls.segment, out)

        in_ranges(follow, kernels.n_chunks(len(a)))
        return out

    def walls_crossed(
        self,
        xyz_m: Float[ndarray, "n 3"],
        a: Int[ndarray, "m"],
        b: Int[ndarray, "m"],
    ) -> tuple[Int[ndarray, "m"], Float[ndarray, "m"]]:
        """Number of walls that each line crosses, and its length inside buildings [m].

        The result does not depend on the order of the ends, not even for a point on a wall: each line is followed from
        its western end.

        Parameters
        ----------
        xyz_m
            Points in the world frame [m].
        a, b
            Rows of the two end points of each line.

        Returns
        -------
        Number of walls and length, one row per line.

        Notes
        -----
        Deviations: a line that enters or leaves through a roof counts as inside only between walls.
        """
        xyz_m = np.ascontiguousarray(xyz_m, float)
        x, y = xyz_m[:, 0], xyz_m[:, 1]
        is_upright = x[a] == x[b]
        is_southward = is_upright & (y[a] > y[b])
        back = (x[a] > x[b]) | is_southward
        west = np.where(back, b, a)
        east = np.where(back, a, b)
        n_walls = np.zeros(len(a), np.int64)
        inside = np.zeros(len(a))
        kernels.walls_crossed(xyz_m, west, east, self.grid, self.walls.segment, n_walls, inside)
        inside += self.indoors(xyz_m)[east]
        dx, dy, _ = (xyz_m[west] - xyz_m[east]).T
        length_m = np.hypot(dx, dy)
        return n_walls, np.clip(inside, 0, 1) * length_m


def _grid_of(walls: Walls, cell_m: float) -> Grid:
    """Walls and buildings by cell, for cells of this width."""
    segment = walls.segment
    corner = segment[:, :4].reshape(-1, 2)
    low = corner.min(0) - cell_m if len(corner) else np.zeros(2)
    high = corner.max(0) + cell_m if len(corner) else np.ones(2)
    nx, ny = np.ceil((high - low) / cell_m).astype(int).tolist()
    begin, end = segment[:, :2], segment[:, 2:4]
    ptr, wall = kernels.by_cell(low, cell_m, (nx, ny), begin, end)
    empty = (np.diff(ptr) == 0).reshape(nx, ny)
    step = np.full((nx, ny), 255)
    if not empty.all():
        step = np.minimum(scipy.ndimage.distance_transform_cdt(empty, "chessboard"), 255)
    side_m = kernels.BUILDING_CELLS * cell_m
    building_ptr, building = _buildings_by_square(low, side_m, _n_squares(nx, ny), walls)
    return Grid(low, cell_m, step.astype(np.uint8), ptr, wall, building_ptr, building)


def _n_squares(nx: int, ny: int) -> tuple[int, int]:
    """Columns and rows of the squares that cover this many columns and rows of cells."""
    wide = kernels.BUILDING_CELLS
    return -(-nx // wide), -(-ny // wide)


def _solid_cells(
    grid: Grid,
    walls: Walls,
) -> tuple[Int[ndarray, "s"], Int[ndarray, "s"]]:
    """Numbers of the cells that no wall touches and whose centre is inside a building, and that building."""
    nx, ny = grid.step.shape
    wide = kernels.BUILDING_CELLS
    n_buildings = np.diff(grid.building_ptr).reshape(_n_squares(nx, ny))
    near = np.kron(n_buildings > 0, np.ones((wide, wide), bool))
    has_wall = grid.step == 0
    i, j = np.nonzero(near[:nx, :ny] & ~has_wall)
    x = grid.low[0] + (i + 0.5) * grid.cell_m
    y = grid.low[1] + (j + 0.5) * grid.cell_m
    middle = np.column_stack([x, y, np.full(len(i), np.nan)])
    building = kernels.building_at(middle, grid, walls)
    is_inside = building >= 0
    return (i * ny + j)[is_inside], building[is_inside]


def _level(walls: Walls, z_m: ndarray) -> ndarray:
    """Heights in steps of 1/254 of the range from the lowest base to the highest top."""
    zero_m = float(walls.base_m.min(initial=0.0))
    highest_m = float(walls.top_m.max(initial=1.0))
    return (z_m - zero_m) * 254 / max(highest_m - zero_m, 1.0)


def _buildings_by_square(
    low: ndarray,
    side_m: float,
    shape: tuple[int, int],
    walls: Walls,
) -> tuple[ndarray, ndarray]:
    """Buildings by the squares that their bounding box touches, compressed rows; ascending in each."""
    nx, ny = shape
    building = np.flatnonzero(np.diff(walls.ptr))
    if not len(building):
        no_rows = np.zeros(nx * ny + 1, np.int32)
        return no_rows, np.zeros(0, np.int32)
    corner, first = walls.segment[:, :2], walls.ptr[building]  # rings are closed: each corner begins a wall
    lowest = np.minimum.reduceat(corner, first)
    highest = np.maximum.reduceat(corner, first)
    i0, j0 = ((lowest - low) // side_m).astype(np.int64).T
    i1, j1 = ((highest - low) // side_m).astype(np.int64).T
    rows = j1 - j0 + 1
    count = (i1 - i0 + 1) * rows
    number, which = expand(np.zeros_like(count), count)
    i = i0[which] + number // rows[which]
    j = j0[which] + number % rows[which]
    square = i * ny + j
    ptr = offsets(np.bincount(square, minlength=nx * ny))
    order = np.argsort(square, kind="stable")
    return ptr.astype(np.int32), building[which[order]].astype(np.int32)


@dataclass(frozen=True, slots=True)
class LosOfPlaces:
    """Lines of sight between *places*, which are points rounded to a fine grid."""

    index: WallIndex
    snap_m: float = 0.5
    """Width of a place [m]; heights are rounded to the same."""

    def __post_init__(self) -> None:
        if not self.snap_m > 0:
            raise ValueError(f"snap_m = {self.snap_m} m must be positive.")

    def snap(self, xyz_m: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """Places of points.

        Parameters
        ----------
        xyz_m
            Points in the world frame.

        Returns
        -------
        The nearest point of the grid for each of them, in the world frame [m].

        Raises
        ------
        ValueError
            If a point is too far from the buildings to be rounded.
        """
        return self._cell(xyz_m) * self.snap_m + self._low

    def has_los(
        self,
        xyz_m: Float[ndarray, "n 3"],
        a: Int[ndarray, "m"],
        b: Int[ndarray, "m"],
        blocked: Bool[ndarray, "m"] | None = None,
    ) -> Bool[ndarray, "m"]:
        """`WallIndex.has_los` between the places of the end points; swapping `a` and `b` changes nothing."""
        cell = self._cell(xyz_m)
        places_m = cell * self.snap_m + self._low
        return self.index.has_los(places_m, a, b, blocked, _place(cell))

    def walls_crossed(
        self,
        xyz_m: Float[ndarray, "n 3"],
        a: Int[ndarray, "m"],
        b: Int[ndarray, "m"],
    ) -> tuple[Int[ndarray, "m"], Float[ndarray, "m"]]:
        """`WallIndex.walls_crossed` between the places of the end points."""
        return self.index.walls_crossed(self.snap(xyz_m), a, b)

    @property
    def _low(self) -> ndarray:
        return np.array([*self.index.grid.low, 0.0])

    def _cell(self, xyz_m: ndarray) -> ndarray:
        cell = np.rint((np.asarray(xyz_m, float) - self._low) / self.snap_m)
        if not np.all(np.abs(cell) < 1 << 24):
            raise ValueError(
                "an antenna is too far from the buildings for its position to be rounded. Check the coordinates."
            )
        return cell.astype(np.int64)


def _place(cell: Int[ndarray, "n 3"]) -> ndarray:
    """63-bit key of a place: 25 bits each of x and y, 13 of height."""
    of_25_bits = (1 << 25) - 1
    of_13_bits = (1 << 13) - 1
    last_bits = np.array([of_25_bits, of_25_bits, of_13_bits], np.uint64)
    x, y, z = (cell.astype(np.uint64) & last_bits).T
    return (x << np.uint64(38)) | (y << np.uint64(13)) | z


def los_between_actors(
    los: WallIndex | LosOfPlaces,
    boxes: Boxes,
    shape: UInt8[ndarray, "n"],
    a: Int[ndarray, "k"],
    b: Int[ndarray, "k"],
    above_roof_m: float = 0.23,
    bodies: bool = True,
    city: Scene | None = None,
) -> Bool[ndarray, "k"]:
    """Whether there is line of sight between points above the roofs of actors a[k] and b[k].

    Parameters
    ----------
    los
        Buildings. `LosOfPlaces` rounds the two ends to places.
    boxes, shape
        Box (world frame) and `Shape` of every actor.
    a, b
        Rows of the two actors of each line.
    above_roof_m
        Height of both ends over the centre of the roof [m].
    bodies
        Whether the bodies of third actors block too, besides the buildings.
    city
        The scene whose trees block. By default none do.

    Returns
    -------
    True where nothing blocks the line.
    """
    a, b = (np.asarray(rows, np.int64) for rows in (a, b))
    if len(a) == 0:
        return np.zeros(0, bool)
    roof_m = boxes.xyz_m[:, 2] + 0.5 * boxes.lwh_m[:, 2]
    top = boxes.xyz_m.copy()
    top[:, 2] = roof_m + above_roof_m
    clear = los.has_los(top, a, b)
    if city is not None and len(city.trees.shape):
        _block_by_trees(clear, top, a, b, city)
    if not bodies or not clear.any():
        return clear
    line = np.flatnonzero(clear)
    a, b = a[line], b[line]
    start, end = top[a], top[b]
    lowest_m = min(start[:, 2].min(), end[:, 2].min())
    tall = np.flatnonzero(roof_m > lowest_m)
    places, place = np.unique(a, return_inverse=True)
    ptr, row = neighbours(top[places], boxes.take(tall), _longest_m(start, end))
    bodies_of = prisms(shape, boxes)
    is_cut = kernels.cut_by_body(start, end, a, b, place, ptr, tall[row], bodies_of)
    clear[line] = ~is_cut
    return clear


def _longest_m(start: Float[ndarray, "k 3"], end: Float[ndarray, "k 3"]) -> float:
    """Horizontal length of the longest line; 0 without lines."""
    dx, dy, _ = (end - start).T
    return float(np.hypot(dx, dy).max(initial=0.0))


def _block_by_trees(
    clear: Bool[ndarray, "k"],
    xyz_m: Float[ndarray, "n 3"],
    a: Int[ndarray, "k"],
    b: Int[ndarray, "k"],
    city: Scene,
) -> None:
    """Mark the lines between points that a tree blocks as not clear."""
    line = np.flatnonzero(clear)
    start, end = xyz_m[a[line]], xyz_m[b[line]]
    places, place = np.unique(a[line], return_inverse=True)
    ptr, row = trees_near(xyz_m[places], city, _longest_m(start, end))
    nobody = np.full(len(line), -1)
    is_cut = kernels.cut_by_body(start, end, nobody, nobody, place, ptr, row, city.trees)
    clear[line] = ~is_cut
