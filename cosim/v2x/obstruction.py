"""Line of sight by buildings: which straight lines between antennas no wall cuts, and what the others go through.

The answer for two places never changes, so it can be remembered: `Sight` keeps what it has seen in a table of
fixed size, and a forgotten answer is found again.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from scipy.ndimage import distance_transform_cdt

from cosim.v2x.march import Filled, Grid, by_cell, clear, clear_remembered, inside, probe, through


@dataclass(frozen=True, slots=True)
class Walls:
    """The buildings of a city as walls in a grid. Made by `Walls.of`."""

    grid: Grid
    walls: Float[ndarray, "w 6"]
    """x, y of both ends, base and top [m]."""
    spans: Int[ndarray, "h+1"]
    """Where each building's walls begin."""
    base_m: Float[ndarray, "h"]
    top_m: Float[ndarray, "h"]
    solid: UInt8[ndarray, "nx ny 2"]
    """Base and top of the building that fills each cell, as `_level`; base above top if none."""
    _filled: dict[tuple[int, int], Filled] = field(default_factory=dict, repr=False, compare=False)

    @staticmethod
    def of(buildings: list[tuple[ndarray, list[ndarray], float, float]], cell_m: float = 4.0) -> "Walls":
        """Index buildings given as (outer ring, holes, base z, top z); rings (k, 2), closed or not."""
        if not cell_m > 0:
            raise ValueError(f"cell_m = {cell_m} m must be positive.")
        parts: list[ndarray] = []
        sizes = np.zeros(len(buildings), np.int64)
        for h, (outer, holes, base, top) in enumerate(buildings):
            if not top > base:
                raise ValueError(f"buildings[{h}]: top_z = {top} m is not above base_z = {base} m.")
            for number, ring in enumerate((outer, *holes)):
                ring = np.asarray(ring, float)
                if ring.ndim != 2 or ring.shape[1] != 2 or len(ring) < 3 or not np.all(np.isfinite(ring)):
                    raise ValueError(f"buildings[{h}]: a ring must be (k, 2) finite numbers with k >= 3.")
                ring = _turned(ring, counter_clockwise=number == 0)  # the house is on the left of its walls
                ends = np.roll(ring, -1, axis=0)
                walls = np.column_stack([ring, ends, np.full(len(ring), base), np.full(len(ring), top)])
                walls = walls[np.any(ring != ends, axis=1)]
                parts.append(walls)
                sizes[h] += len(walls)
        walls = np.concatenate(parts) if parts else np.zeros((0, 6))
        spans = np.concatenate([[0], np.cumsum(sizes)])
        ends = walls[:, :4].reshape(-1, 2)
        low = ends.min(0) - cell_m if len(ends) else np.zeros(2)
        high = ends.max(0) + cell_m if len(ends) else np.ones(2)
        nx, ny = (int(k) for k in np.ceil((high - low) / cell_m))
        ptr, wall = by_cell(low, cell_m, (nx, ny), walls[:, :2], walls[:, 2:4])
        house_ptr, house = _houses(low, cell_m, (nx, ny), walls, spans)
        empty = (np.diff(ptr) == 0).reshape(nx, ny)
        step = np.full((nx, ny), 255)
        if not empty.all():
            step = np.minimum(distance_transform_cdt(empty, "chessboard"), 255)
        base_m, top_m = (np.array([b[k] for b in buildings], float) for k in (2, 3))
        solid = np.tile(np.array([1, 0], np.uint8), (nx, ny, 1))
        grid = Grid(low, float(cell_m), step.astype(np.uint8), ptr, wall, house_ptr, house)
        made = Walls(grid, walls, spans, base_m, top_m, solid)
        i, j = np.nonzero(empty)
        middle = np.column_stack([low[0] + (i + 0.5) * cell_m, low[1] + (j + 0.5) * cell_m, np.full(len(i), np.nan)])
        owner = inside(middle, grid, walls, spans, base_m, top_m)
        i, j, owner = i[owner >= 0], j[owner >= 0], owner[owner >= 0]
        # Rounded inwards: a bit less is filled.
        solid[i, j, 0] = np.ceil(made._level(base_m[owner]) - 1e-9)
        solid[i, j, 1] = np.floor(made._level(top_m[owner]) + 1e-9)
        return made

    def _level(self, z_m: ndarray) -> ndarray:
        """Heights in steps of which 254 make up the tallest city."""
        zero_m = float(self.base_m.min(initial=0.0))
        return (z_m - zero_m) * 254 / max(float(self.top_m.max(initial=1.0)) - zero_m, 1.0)

    def filled(self, z_m: Float[ndarray, "n"]) -> Filled:
        """Cells that no line between antennas of these heights gets through."""
        level = self._level(np.asarray(z_m, float))
        low, high = int(np.floor(level.min(initial=254.0))), int(np.ceil(level.max(initial=0.0)))
        if (low, high) not in self._filled:
            if len(self._filled) >= 16:
                self._filled.clear()
            base, top = self.solid[:, :, 0], self.solid[:, :, 1]
            bits = np.packbits((base <= low) & (top >= high) & (top > 0), bitorder="little")
            self._filled[low, high] = Filled(bits, *self.solid.shape[:2])
        return self._filled[low, high]

    def cells(self, xyz_m: Float[ndarray, "n 3"]) -> Float[ndarray, "n 2"]:
        """Where points are on the grid, in cells."""
        return (xyz_m[:, :2] - self.grid.low) * (1.0 / self.grid.cell_m)

    def _hidden(self, xyz_m: ndarray, a: ndarray, b: ndarray) -> Bool[ndarray, "m"]:
        out = np.empty(len(a), np.bool_)
        probe(self.cells(xyz_m), a, b, self.filled(xyz_m[:, 2]), out)
        return out

    def indoors(self, xyz_m: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Which points are inside a building: no line of sight leaves it."""
        xyz_m = np.ascontiguousarray(xyz_m, float)
        return inside(xyz_m, self.grid, self.walls, self.spans, self.base_m, self.top_m) >= 0

    def clear(self, xyz_m: Float[ndarray, "n 3"], a: Int[ndarray, "m"], b: Int[ndarray, "m"]) -> Bool[ndarray, "m"]:
        """Which of the lines between antennas `a` and `b` (rows) no building cuts; exact."""
        xyz_m = np.ascontiguousarray(xyz_m, float)
        out = np.empty(len(a), np.bool_)
        clear(xyz_m, self.indoors(xyz_m), a, b, self._hidden(xyz_m, a, b), self.grid, self.walls, out)
        return out

    def through(
        self, xyz_m: Float[ndarray, "n 3"], a: Int[ndarray, "m"], b: Int[ndarray, "m"]
    ) -> tuple[Int[ndarray, "m"], Float[ndarray, "m"]]:
        """How many walls the lines between antennas `a` and `b` cross, and how far they run inside houses [m].

        The same from either end, for an antenna on a wall too: lines are walked from their western end.

        Notes
        -----
        Deviations: a line that enters or leaves through a roof is inside for the part told by walls alone.
        """
        xyz_m = np.ascontiguousarray(xyz_m, float)
        x, y = xyz_m[:, 0], xyz_m[:, 1]
        back = (x[a] > x[b]) | ((x[a] == x[b]) & (y[a] > y[b]))
        a, b = np.where(back, b, a), np.where(back, a, b)
        n_walls, inside = np.zeros(len(a), np.int64), np.zeros(len(a))
        through(xyz_m, a, b, self.grid, self.walls, n_walls, inside)
        inside += self.indoors(xyz_m)[b]
        length_m = np.hypot(*(xyz_m[a, :2] - xyz_m[b, :2]).T)
        return n_walls, np.clip(inside, 0, 1) * length_m


def _turned(ring: ndarray, counter_clockwise: bool) -> ndarray:
    x, y = ring.T
    area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    return ring if (area > 0) == counter_clockwise else ring[::-1]


def _houses(
    low: ndarray, cell_m: float, shape: tuple[int, int], walls: ndarray, spans: ndarray
) -> tuple[ndarray, ndarray]:
    """Buildings by the cells that their bounding box touches."""
    cells, ids = [], []
    for h in range(len(spans) - 1):
        ends = walls[spans[h] : spans[h + 1], :4].reshape(-1, 2)
        if len(ends) == 0:
            continue
        i0, j0 = ((ends.min(0) - low) // cell_m).astype(int)
        i1, j1 = ((ends.max(0) - low) // cell_m).astype(int)
        i, j = np.meshgrid(np.arange(i0, i1 + 1), np.arange(j0, j1 + 1), indexing="ij")
        cells.append((i * shape[1] + j).ravel())
        ids.append(np.full(i.size, h))
    cell = np.concatenate([*cells, np.zeros(0, np.int64)])
    order = np.argsort(cell, kind="stable")
    ptr = np.searchsorted(cell[order], np.arange(shape[0] * shape[1] + 1))
    return ptr.astype(np.int64), np.concatenate([*ids, np.zeros(0, np.int64)])[order].astype(np.int32)


@dataclass(frozen=True, slots=True)
class Sight:
    """Walls with a memory: lines of sight between places, antennas moved to the nearest point of a fine grid.

    The answer depends on the two places only, not on what was asked before.
    """

    walls: Walls
    snap_m: float
    """Width of a place [m]; heights are rounded to the same."""
    memo: ndarray

    @staticmethod
    def of(walls: Walls, snap_m: float = 0.5, n_remembered: int = 1 << 21) -> "Sight":
        """A memory for at least `n_remembered` pairs."""
        if not snap_m > 0:
            raise ValueError(f"snap_m = {snap_m} m must be positive.")
        return Sight(walls, snap_m, np.zeros(1 << max(n_remembered - 1, 255).bit_length(), np.uint64))

    def snap(self, xyz_m: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """The places of these antennas."""
        return self._cell(xyz_m) * self.snap_m + self._low

    def clear(
        self, xyz_m: Float[ndarray, "n 3"], a: Int[ndarray, "m"], b: Int[ndarray, "m"],
        hidden: Bool[ndarray, "m"] | None = None,
    ) -> Bool[ndarray, "m"]:  # fmt: skip
        """Which of the lines between the places of antennas `a` and `b` (rows) no building cuts.

        Parameters
        ----------
        hidden
            Lines that are known to run into a building; looked for when not given.
        """
        cell = self._cell(xyz_m)
        xyz = cell * self.snap_m + self._low
        if hidden is None:
            hidden = self.walls._hidden(xyz, a, b)
        out = np.empty(len(a), np.bool_)
        clear_remembered(
            xyz, self.walls.indoors(xyz), _place(cell), a, b, hidden, self.walls.grid, self.walls.walls, self.memo, out
        )
        return out

    @property
    def _low(self) -> ndarray:
        return np.array([*self.walls.grid.low, 0.0])

    def _cell(self, xyz_m: ndarray) -> ndarray:
        cell = np.rint((np.asarray(xyz_m, float) - self._low) / self.snap_m)
        if not np.all(np.abs(cell) < 1 << 24):
            raise ValueError("an antenna lies too far from the buildings to be told apart. Check the coordinates.")
        return cell.astype(np.int64)


def _place(cell: Int[ndarray, "n 3"]) -> ndarray:
    """63-bit name of a place: 25 bits each of x and y, 13 of height."""
    x, y, z = (cell[:, k].astype(np.uint64) & np.uint64((1 << bits) - 1) for k, bits in ((0, 25), (1, 25), (2, 13)))
    return (x << np.uint64(38)) | (y << np.uint64(13)) | z
