"""What the numbers of a trace mean: metres of the network, metres of its map, degrees, or something else."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Bool, Float
from numpy import ndarray

from cosim.base.earth import Projection
from cosim.traffic.fcd import Timestep
from cosim.traffic.frame import Bounds, TrafficError
from cosim.traffic.interpolation import rows_in_both
from sumo_nets.levels import LEVEL_M
from sumo_nets.network import lanes

Conversion = Callable[[Timestep], Timestep]

_MARGIN_M = 500.0
"""Actors may be this far outside the bounds of the network."""
_MOST_P, _HALF_P = 0.9, 0.5
"""Shares of positions within the network that speak for a meaning, and against another one."""
_MOVING_MPS = 0.5
_FEWEST, _ENOUGH = 3, 200
"""Moves of actors that are compared with their speeds."""
_DEGREES_RATIO = 1e-4
"""If all moves are shorter than this part of what the speeds say, coordinates are degrees."""
FAR_M, _FAR_P = 10.0, 1 / 3
"""Vehicles of a trace are elsewhere if more than this share is farther than this from all lanes. In their own network,
none of those of four cities is, and 3 % with errors of 5 m; in that of another city, 76 % and more are."""
_POSSIBLE, _ODD = (0.02, 50.0), (0.6, 1.7)
"""Ways over what the speeds say: outside the first they are refused, and outside the second they are noted. The second
leaves out knots (0.51) and miles per hour (0.45)."""
_ODD_OF_LEAPS = 0.4
"""The smaller one where most moves are none, as in mesoscopic traffic: the mean of its first 200 may be 0.67."""
_ASIDE_DEG, _ASIDE_P = 45.0, 1 / 3
"""Angles are noted if more than this share of moves is farther than this from them."""


@dataclass(frozen=True, slots=True)
class NetLocation:
    """Where a network is: its bounds, and how it was projected."""

    bounds_m: Bounds
    """In its own coordinates."""
    projection: Projection | None = None
    """From degrees to its own coordinates. None without a projection, or one that is not read."""
    offset_m: tuple[float, float] = (0.0, 0.0)
    """What was added to projected coordinates."""
    path: Path | None = None
    """File of the network."""

    def has(self, xy_m: Float[ndarray, "n 2"]) -> Bool[ndarray, "n"]:
        """Whether each position is within the bounds."""
        west, south, east, north = self.bounds_m
        low = np.array([west, south]) - _MARGIN_M
        high = np.array([east, north]) + _MARGIN_M
        is_within = (low <= xy_m) & (xy_m <= high)
        return is_within[:, 0] & is_within[:, 1]

    def holds(self, xy_m: Float[ndarray, "n 2"]) -> float:
        """Share of positions within the bounds."""
        return float(self.has(xy_m).mean())


def conversion(
    source: str, timesteps: Sequence[Timestep], net: NetLocation | None, own: Projection | None
) -> tuple[Conversion | None, str]:
    """How the positions of a trace become those of the network, and a word about it; None if they are already.

    Parameters
    ----------
    source
        Name of the trace for error messages.
    timesteps
        Timesteps with the first actors.
    net
        The network, if there is one.
    own
        The projection around their middle of positions that were given in degrees to `cosim trace`.

    Raises
    ------
    TrafficError
        The positions are known to be elsewhere, and no projection of the network is read.
    """
    fronts = [timestep.front_m[:, :2] for timestep in timesteps if len(timestep.names)]
    if net is None or not fronts:
        return None, ""
    xy = np.concatenate(fronts)
    if own is not None:
        if net.projection is None:
            raise TrafficError(
                f"{source}: its degrees were projected around their own middle, {own.latitude_deg:.4f} degrees north, "
                f"{own.longitude_deg:.4f} degrees east, and the network has no projection that is read: transverse "
                "Mercator of WGS84, such as UTM. Give the trace in metres of the network."
            )
        return _moved(own, net.projection), "longitudes and latitudes, placed by the projection of the network"
    to_net = net.projection
    x, y = xy.T
    is_degrees = _in_degrees(xy)
    if to_net is not None and is_degrees and net.holds(to_net.to_world(y, x)) > _MOST_P:

        def placed(timestep: Timestep) -> Timestep:
            if not _in_degrees(timestep.front_m[:, :2]):
                raise TrafficError(
                    f"{source}: at {timestep.time_s:g} s, x and y are no longer degrees. Record it again."
                )
            there = to_net.to_world(timestep.front_m[:, 1], timestep.front_m[:, 0])
            return replace(timestep, front_m=np.column_stack([there, timestep.front_m[:, 2]]))

        return placed, "longitudes and latitudes, placed by the projection of the network"
    offset_m = np.array([*net.offset_m, 0.0])
    is_person = np.concatenate([timestep.is_person for timestep in timesteps])
    xy = xy if is_person.all() else xy[~is_person]
    is_elsewhere = offset_m.any() and net.holds(xy) < _HALF_P
    if is_elsewhere and net.holds(xy + offset_m[:2]) > _MOST_P:

        def shifted(timestep: Timestep) -> Timestep:
            # SUMO 1.28 writes vehicles in coordinates of the map, persons and containers in those of the network.
            is_there = timestep.is_person & net.has(timestep.front_m[:, :2])
            front_m = timestep.front_m + np.where(is_there[:, None], 0.0, offset_m)
            return replace(timestep, front_m=np.round(front_m, 6))  # who rides is at the exact place of the vehicle

        said = "coordinates of the map before the network's offset (SUMO's --fcd-output.utm); the offset is added"
        return shifted, said
    return None, ""


def _in_degrees(xy: Float[ndarray, "n 2"]) -> bool:
    return bool((np.abs(xy) <= (180.0, 90.0)).all())


def _moved(own: Projection, to_net: Projection) -> Conversion:
    """From one map to another one, headings included."""

    def moved(timestep: Timestep) -> Timestep:
        here = own.of_world(timestep.front_m[:, :2])
        there_m = to_net.to_world(here.latitude_deg, here.longitude_deg)
        turned_deg = np.degrees(here.turn_rad - to_net.of_world(there_m).turn_rad)
        return replace(
            timestep,
            front_m=np.column_stack([there_m, timestep.front_m[:, 2]]),
            compass_deg=(timestep.compass_deg + turned_deg) % 360.0,
        )

    return moved


def refuse_degrees(name: str, at: Sequence[float], net: NetLocation, origin_m: Sequence[float] = (0.0, 0.0)) -> None:
    """Raise TrafficError if a position in metres is rather the longitude and latitude of a place in the network.

    Parameters
    ----------
    name
        The key that has the position.
    origin_m
        Its origin in the network's coordinates.
    """
    if net.projection is None:
        return
    for latitude, longitude in (at, at[::-1]):
        if abs(latitude) > 90 or abs(longitude) > 180:
            continue
        there_m = net.projection.to_world(np.array([latitude]), np.array([longitude]))
        if net.has(there_m)[0]:
            east_m, north_m = (there_m[0] - origin_m).tolist()
            raise TrafficError(
                f"{name} = {list(at)} are degrees of a place in the network, and metres are needed. Set it to "
                f"[{east_m:.1f}, {north_m:.1f}]."
            )


class LaneCheck:
    """Counts the vehicles that come on the road far from all lanes for cars, as those of another place do, and those
    above or below them."""

    def __init__(self, net: NetLocation | None) -> None:
        self._path = None if net is None else net.path
        self._tree: shapely.STRtree | None = None
        self._n = self._n_far = self._n_off_level = 0

    def add(self, xyz_m: Float[ndarray, "n 3"]) -> None:
        """Look at cars and trucks that are new: places on the road, in coordinates of the network."""
        if self._path is None:
            return
        if self._tree is None:
            lines = [lane.line_m for lane in lanes(self._path) if lane.for_cars]
            self._tree = shapely.STRtree([shapely.LineString(line) for line in lines])
        points = shapely.points(xyz_m[:, :2])
        near, lane = self._tree.query(points, predicate="dwithin", distance=FAR_M)
        lines = self._tree.geometries[lane]
        along_m = shapely.line_locate_point(lines, points[near])
        road_m = shapely.get_z(shapely.line_interpolate_point(lines, along_m))
        is_level = np.abs(road_m - xyz_m[near, 2]) < LEVEL_M
        n_near = len(np.unique(near))
        self._n += len(xyz_m)
        self._n_far += len(xyz_m) - n_near
        self._n_off_level += n_near - len(np.unique(near[is_level]))

    def report(self) -> dict[str, float]:
        """For the summary: shares of these vehicles, where they are large."""
        counts = {"trace_far_from_lanes_p": self._n_far, "trace_off_level_p": self._n_off_level}
        fewest = max(_FEWEST, _FAR_P * self._n)
        many = {name: n for name, n in counts.items() if n >= fewest}
        return {name: round(n / self._n, 3) for name, n in many.items()}


class TravelCheck:
    """Compares ways between timesteps with speeds and angles, until enough actors have moved."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._before: Timestep | None = None
        self._ratios: list[float] = []
        """Way over what the speeds say, of each actor that moves between two timesteps."""
        self._n_aside = 0
        """Those that do not move to where they look."""

    def add(self, timestep: Timestep) -> None:
        """Look at the next timestep. A TrafficError is raised if positions or times cannot be metres and seconds."""
        if len(self._ratios) > _ENOUGH:
            return
        before, self._before = self._before, timestep
        if before is None:
            return
        rows, after = rows_in_both(before.names, timestep.names)
        was_mps, is_mps = before.speed_mps[rows], timestep.speed_mps[after]
        slower_mps = np.minimum(np.abs(was_mps), np.abs(is_mps))
        fast: Bool[ndarray, "n"] = (slower_mps > _MOVING_MPS) & (was_mps * is_mps > 0)
        rows, after = rows[fast], after[fast]
        took_s = timestep.time_s - before.time_s
        mean_mps = (was_mps[fast] + is_mps[fast]) / 2
        asked_m = np.abs(mean_mps) * took_s
        dx_m, dy_m, _ = (timestep.front_m[after] - before.front_m[rows]).T
        gone_m = np.hypot(dx_m, dy_m)
        self._ratios += (gone_m / asked_m).tolist()
        angles_deg = before.compass_deg[rows], timestep.compass_deg[after]
        ahead = np.exp(1j * np.deg2rad(angles_deg)).sum(axis=0)
        forward = ahead * np.sign(mean_mps)  # who reverses moves backwards
        turned_rad = np.angle(dy_m + 1j * dx_m) - np.angle(forward)
        is_aside = np.cos(turned_rad) < np.cos(np.deg2rad(_ASIDE_DEG))
        self._n_aside += int((is_aside & (gone_m > 0)).sum())
        if self._ratios:
            self._judge(timestep)

    @property
    def odd_ratio(self) -> float | None:
        """Ways over what the speeds say, if both the median and the mean are far from 1 on the same side.

        The median is deaf to a few vehicles that are put elsewhere, and the mean to mesoscopic traffic, whose vehicles
        stand and then leap.
        """
        if len(self._ratios) < _FEWEST:
            return None
        both = np.median(self._ratios), np.mean(self._ratios)
        low, high = float(min(both)), float(max(both))
        if high < (_ODD[0] if low > 0 else _ODD_OF_LEAPS):
            return high
        return low if low > _ODD[1] else None

    @property
    def aside_p(self) -> float | None:
        """Share of moves that do not go to where their vehicles look, if it is large."""
        if self._n_aside < max(_FEWEST, _ASIDE_P * len(self._ratios)):
            return None
        return self._n_aside / len(self._ratios)

    def _judge(self, timestep: Timestep) -> None:
        moves = [ratio for ratio in self._ratios if ratio > 0]
        if moves and max(moves) < _DEGREES_RATIO and _in_degrees(timestep.front_m[:, :2]):
            raise TrafficError(
                f"{self._source}: vehicles move {max(moves):.2g} times as far as their speeds say, so x and y look "
                "like degrees. Record the trace without --fcd-output.geo, or name the city that it comes from, if its "
                "network has a transverse Mercator projection of WGS84, such as UTM. No other one is read."
            )
        ratio = self.odd_ratio
        if not moves or ratio is None or _POSSIBLE[0] <= ratio <= _POSSIBLE[1]:
            return
        looks = ("milliseconds", "kilometres") if ratio < 1 else ("minutes", "millimetres")
        raise TrafficError(
            f"{self._source}: vehicles move {ratio:.3g} times as far as their speeds say, so its times look like "
            f"{looks[0]}, or x and y like {looks[1]}. Write seconds and metres."
        )
