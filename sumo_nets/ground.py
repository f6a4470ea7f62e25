"""The ground that traffic needs: carriageways and pavements of a network, and how high they lie."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
import shapely
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.ragged import owner_of_rows
from sumo_nets.footprints import Footprint
from sumo_nets.heights import CLEARANCE_M
from sumo_nets.levels import crossings, is_bridge
from sumo_nets.network import Lane

MARGIN_M = 0.1
"""Margin added to the width of lanes [m]."""
BESIDE_M = 15.0
"""Streets at most this much farther away than the nearest one tell the height of the ground too [m]."""
AROUND_M = 300.0
"""Streets up to this distance from a building are those from which it is seen [m]."""
CAR_M = 1.5
"""Height of a car [m]."""
_CELL_M = 50.0
_MOST_CELLS = 4000
"""Cells along a side of a network; a larger network has larger cells."""
_SAMPLE_M = 5.0
_MOST_SAMPLES = 5_000_000


class Ground(NamedTuple):
    """Areas in network coordinates on which no building may stand."""

    carriageway: shapely.Geometry
    """Lanes for vehicles, those across junctions included."""
    pavement: shapely.Geometry
    """Lanes and areas for pedestrians, crossings included."""


def ground_of(net_path: Path) -> Ground:
    """Carriageways and pavements of a SUMO network."""
    import sumolib

    net = sumolib.net.readNet(str(net_path), withInternal=True, withPedestrianConnections=True)
    carriageway: list[shapely.Geometry] = []
    pavement: list[shapely.Geometry] = []
    for edge in net.getEdges(True):
        function = edge.getFunction()
        for lane in edge.getLanes():
            if function == "walkingarea":
                pavement.append(shapely.Polygon(lane.getShape()).buffer(0.0))
                continue
            line = shapely.LineString(lane.getShape())
            strip = line.buffer(lane.getWidth() / 2 + MARGIN_M, cap_style="flat")
            wheels = function != "crossing" and (lane.allows("passenger") or lane.allows("bicycle"))
            (carriageway if wheels else pavement).append(strip)
    return Ground(shapely.union_all(carriageway), shapely.union_all(pavement))


def segments(
    found: Sequence[Lane],
) -> tuple[Float[ndarray, "s 3"], Float[ndarray, "s 3"]]:
    """Begin and end of every segment of every lane, in this order."""
    lines = [lane.line_m for lane in found]
    count = [len(line) for line in lines]
    points = np.concatenate([np.zeros((0, 3)), *lines])
    ends = np.cumsum(count, dtype=int)
    is_first, is_last = np.zeros((2, len(points)), bool)
    is_first[ends - count] = True
    is_last[ends - 1] = True
    return points[~is_last], points[~is_first]


def sampled(
    begin: Float[ndarray, "s 3"], end: Float[ndarray, "s 3"], step_m: float
) -> tuple[Float[ndarray, "p 3"], Float[ndarray, "p"]]:
    """Points on segments, at most this far apart, and the length that each stands for [m].

    On segments of an impossible length, the points are farther apart, so that they fit into memory.
    """
    length_m = np.hypot(*(end - begin)[:, :2].T)
    step_m = max(step_m, float(length_m.sum()) / _MOST_SAMPLES)
    n_parts = np.maximum(np.ceil(length_m / step_m).astype(int), 1)
    row = owner_of_rows(n_parts)
    first = np.cumsum(n_parts) - n_parts
    part = np.arange(len(row)) - first[row] + 0.5
    share = (part / n_parts[row])[:, None]
    points = begin[row] + share * (end - begin)[row]
    return points, (length_m / n_parts)[row]


def covered_m(found: Sequence[Lane], standing: Sequence[Footprint], shapes: ndarray) -> tuple[float, float]:
    """Length of the lanes of motor vehicles inside buildings, whose polygons are `shapes`, and of all of them [m]."""
    xyz_m, each_m = sampled(*segments([lane for lane in found if lane.for_cars]), _SAMPLE_M)
    points = shapely.points(xyz_m[:, :2])
    at, of = shapely.STRtree(shapes).query(points, predicate="within")
    base_m = np.array([footprint.base_z_m for footprint in standing])
    top_m = np.array([footprint.top_z_m for footprint in standing])
    z_m = xyz_m[at, 2]
    is_inside = (base_m[of] < z_m + CAR_M) & (top_m[of] > z_m)
    inside = at[is_inside]
    return float(each_m[np.unique(inside)].sum()), float(each_m.sum())


class StreetHeights:
    """Heights of the ground, as the streets of a network tell them."""

    def __init__(self, found: Sequence[Lane]) -> None:
        begin, end = segments(found)
        self._begin, self._end = begin, end
        self._ends = np.concatenate([begin, end])
        self.is_flat = not self._ends[:, 2].any()
        """Whether the network has no heights."""
        if self.is_flat:
            return
        self._segments = shapely.linestrings(np.stack([begin, end], axis=1)[..., :2])
        bridge = np.concatenate(is_bridge(found, crossings(found)))
        self._grounded = np.flatnonzero(~bridge | bridge.all())  # without any other street, bridges count

    def ground_m(self, places: ndarray) -> Float[ndarray, "n"]:
        """Height of the ground at each place (Shapely geometries): that of the lowest street beside it.

        A street is beside a place if it is at most `BESIDE_M` farther away than the nearest one. Bridges do not count,
        and streets that cross the place only if no other one is beside it: they may be tunnels.
        """
        if self.is_flat:
            return np.zeros(len(places))
        tree = shapely.STRtree(self._segments[self._grounded])
        _, nearest_m = tree.query_nearest(places, return_distance=True, all_matches=False)
        place, row = tree.query(places, predicate="dwithin", distance=nearest_m + BESIDE_M)
        row = self._grounded[row]
        height_m = self._height_m(row, places[place])
        crosses = shapely.intersects(self._segments[row], places[place])
        beside_m, any_m = np.full((2, len(places)), np.inf)
        np.minimum.at(any_m, place, height_m)
        np.minimum.at(beside_m, place[~crosses], height_m[~crosses])
        return np.where(np.isfinite(beside_m), beside_m, any_m)

    def lowest_m(self, places: ndarray) -> Float[ndarray, "n"]:
        """Height of the lowest street within about `AROUND_M` of each place."""
        extent_m = float(np.ptp(self._ends[:, :2], axis=0).max())
        cell_m = max(_CELL_M, extent_m / _MOST_CELLS)
        points, _ = sampled(self._begin, self._end, cell_m / 2)
        low = points[:, :2].min(axis=0) - 2 * AROUND_M
        cell = ((points[:, :2] - low) // cell_m).astype(int)
        around = int(np.ceil(AROUND_M / cell_m))
        lowest = np.full(cell.max(axis=0) + 1 + 3 * around, np.inf)
        np.minimum.at(lowest, tuple(cell.T), points[:, 2])
        lowest = scipy.ndimage.minimum_filter(lowest, size=2 * around + 1, mode="constant", cval=np.inf)
        middle = shapely.get_coordinates(shapely.centroid(places))
        at = ((middle - low) // cell_m).astype(int)
        at = np.clip(at, 0, np.array(lowest.shape) - 1)
        return lowest[tuple(at.T)]

    def below_m(self, places: ndarray) -> Float[ndarray, "n"]:
        """Height of the lowest street that crosses each place, such as a tunnel below a building; infinite if none."""
        place, row = shapely.STRtree(self._segments).query(places, predicate="intersects")
        below_m = np.full(len(places), np.inf)
        np.minimum.at(below_m, place, self._height_m(row, places[place]))
        return below_m

    def _height_m(self, row: Int[ndarray, "p"], places: ndarray) -> Float[ndarray, "p"]:
        """Heights of segments where they are nearest to the middles of places."""
        middle = shapely.get_coordinates(shapely.centroid(places))
        begin = self._begin[row]
        along = self._end[row] - begin
        on_map = along[:, :2]
        towards = ((middle - begin[:, :2]) * on_map).sum(axis=1)
        squared_m2 = (on_map**2).sum(axis=1)
        t = np.clip(towards / np.maximum(squared_m2, 1e-12), 0.0, 1.0)
        return begin[:, 2] + t * along[:, 2]


def standing_on(footprints: list[Footprint], found: Sequence[Lane]) -> list[Footprint]:
    """Buildings raised to the ground at them, as the streets beside them tell it.

    Their tops follow that ground. The base of a building that stands on the ground reaches down to the lowest street
    around it, so that nobody sees below it from a street down the slope. A street that crosses a building far below is
    a tunnel and stays free.
    """
    if not footprints or (streets := StreetHeights(found)).is_flat:
        return footprints
    shapes = np.array([footprint.polygon for footprint in footprints])
    ground_m = streets.ground_m(shapes)
    tunnel_m = streets.below_m(shapes)
    roof_m = np.where(tunnel_m < ground_m - CLEARANCE_M, tunnel_m + CLEARANCE_M, -np.inf)
    deep_m = np.minimum(ground_m, np.maximum(streets.lowest_m(shapes), roof_m))
    raised = []
    for footprint, ground, deep in zip(footprints, ground_m.tolist(), deep_m.tolist(), strict=True):
        base_m = footprint.base_z_m + ground if footprint.base_z_m else deep
        raised.append(footprint._replace(base_z_m=base_m, top_z_m=footprint.top_z_m + ground))
    return raised
