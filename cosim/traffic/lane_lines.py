"""Centre lines of lanes, joined along routes. Each sequence of lanes is stored once."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray


@dataclass(slots=True)
class LaneLines:
    """Lines by number, in the order of first use. All vertices are in one array that grows."""

    number: dict[tuple[str, ...], int] = field(default_factory=dict)
    """Number of the line of each sequence of lanes."""
    scale: list[float] = field(default_factory=list)
    """Per line, the length of its first lane's shape divided by the length that SUMO uses for positions."""
    _ptr: list[int] = field(default_factory=lambda: [0])
    _xy_m: list[Float[ndarray, "v 2"]] = field(default_factory=list)
    _along_m: list[Float[ndarray, "v"]] = field(default_factory=list)

    def add(
        self,
        lanes: tuple[str, ...],
        shapes: list[Float[ndarray, "k 2"]],
        first_length_m: float,
    ) -> int:
        """Add the line of a new sequence of lanes.

        Parameters
        ----------
        lanes
            Ids of the lanes.
        shapes
            Vertices of each lane's centre line in the world frame [m].
        first_length_m
            Length of the first lane by which SUMO counts positions [m].

        Returns
        -------
        The number of the line.
        """
        xy = np.concatenate(shapes)
        steps = np.hypot(*np.diff(xy, axis=0).T)
        keep = np.append(True, steps > 1e-6)  # a lane begins where the one before it ends
        if keep.sum() < 2:
            keep[-1] = True
        xy = xy[keep]
        dx, dy = np.diff(xy, axis=0).T
        along = np.append(0.0, np.cumsum(np.hypot(dx, dy)))
        n_first = keep[: len(shapes[0])].sum()
        self.number[lanes] = len(self.scale)
        self.scale.append(float(along[n_first - 1]) / max(first_length_m, 1e-6))
        self._ptr.append(self._ptr[-1] + len(xy))
        self._xy_m.append(xy)
        self._along_m.append(along)
        return self.number[lanes]

    def arrays(self) -> tuple[ndarray, ndarray, ndarray]:
        """The arrays `ptr`, `xy_m` and `along_m` of `LanePaths`."""
        if len(self._xy_m) > 1:
            self._xy_m = [np.concatenate(self._xy_m)]
            self._along_m = [np.concatenate(self._along_m)]
        if not self._xy_m:
            return np.zeros(1, np.int64), np.zeros((0, 2)), np.zeros(0)
        return np.array(self._ptr, np.int64), self._xy_m[0], self._along_m[0]
