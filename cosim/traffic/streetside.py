"""What stands along streets: parked cars and trees, placed by chance at a rate per length of kerb, or from a map.

Chance belongs to the edge and to the place along it. A higher rate adds cars and trees and moves none.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import shapely
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.bounds import Positive100, Share
from cosim.base.codes import PARKED
from cosim.base.plane import turned_by
from cosim.base.rng import Stream, key, name_key, uniforms
from cosim.traffic.objects import TYPICAL_M, ObjectParams
from sensors.scene import Scene
from sensors.trees import tree_prisms
from sumo_nets.ground import StreetHeights
from sumo_nets.network import lanes
from sumo_nets.streetside import Kerb, read_trees, street_space

PLACE_M = {"parked": 6.0, "trees": 5.0}
"""Length of kerb of one place [m]: a car of 4.5 m or a van of 5.3 m with gaps; two trunks are not nearer."""

GAP_M = 0.3
"""Between the outermost lane and what stands beside it [m]."""
ENDS_M = 8.0
"""No place is nearer to the end of an edge, where junctions and crossings are [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ParkedParams:
    """Cars and vans that are parked along streets, beside the outermost lane, for the whole run.

    They are actors like those of `[[objects]]`: sensors see them, they hide others, and detectors report them. They
    count as real objects in every metric, as in KITTI, nuScenes and Waymo, which label parked cars. Their names in
    the table `vehicles` begin with `parked/`.
    """

    per_100_m: Annotated[float, Ge(0), Le(16)] = 0.0
    """Parked cars per 100 m of kerb, where there is parking. 0: none."""
    streets_p: Share = 1.0
    """Share of the edges that have parking on their outer side: the right one, or with left-hand traffic the left one.
    Where the network has OpenStreetMap's tags of parking, these decide."""
    vans_p: Share = 0.1
    """Share of vans among them."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TreeParams:
    """Trees along streets: a trunk and a crown each, which block LiDARs and lines of sight, not radio."""

    per_100_m: Annotated[float, Ge(0), Le(20)] = 0.0
    """Trees per 100 m of kerb, where there are trees. 0: none."""
    streets_p: Share = 1.0
    """Share of the edges that have trees on their outer side."""
    from_map: bool = False
    """Whether trees and rows of trees in the scenario's polygon files stand there too."""
    trunk_m: Annotated[float, Gt(0), Le(5)] = 0.35
    """Width of a trunk [m]."""
    crown_base_m: Annotated[float, Gt(0), Le(50)] = 3.0
    """Height of the underside of a crown above the street [m]."""
    crown_m: Annotated[float, Gt(0), Le(50)] = 5.0
    """Width of a crown [m]."""
    height_m: Positive100 = 10.0
    """Height of a tree [m]."""

    def __post_init__(self) -> None:
        if self.height_m <= self.crown_base_m:
            raise ValueError(
                f"trees.height_m = {self.height_m:g} m is not above trees.crown_base_m = {self.crown_base_m:g} m. Set "
                "it higher."
            )


NO_PARKED, NO_TREES = ParkedParams(), TreeParams()


def check_streets(net: Path | None, section: str) -> Path:
    """The network. A ValueError of one line is raised if there is none, along which this section places anything."""
    if net is None:
        raise ValueError(
            f"[{section}]: a trace without streets has no kerbs. Leave the section out, or name the city in "
            "traffic.scenario and the trace in traffic.trace."
        )
    return net


class _Places(NamedTuple):
    """Places along kerbs; network coordinates."""

    name: list[str]
    xyz_m: Float[ndarray, "p 3"]
    """Ground on the outer edge of the outermost lane."""
    yaw_rad: Float[ndarray, "p"]
    """Driving direction."""
    side: Float[ndarray, "p"]
    """1 to the right of the driving direction, -1 to its left."""
    rank: Float[ndarray, "p"]
    """The uniform draw that took the place: at a lower rate, places of smaller ranks are taken."""
    draw: Float[ndarray, "p"]
    """A uniform draw of each place, for its kind of vehicle."""


@dataclass(frozen=True, slots=True)
class Streetside:
    """The space beside the streets of a network."""

    kerbs: list[Kerb]
    areas: ndarray
    """Shapely polygons of lanes and junctions, network coordinates."""
    origin_m: tuple[float, float]
    """The world's origin in these coordinates [m]."""
    seed: int

    @staticmethod
    def of(net: Path | None, origin_m: tuple[float, float], seed: int, section: str) -> "Streetside":
        """Read a network. Without one, a ValueError names the section of the config that needs it."""
        return Streetside(*street_space(check_streets(net, section)), origin_m, seed)

    def planted(self, city: Scene, params: TreeParams) -> Float[ndarray, "t 3"]:
        """Feet of the trees, world frame. No trunk stands in a building, on a lane or in a junction."""
        found = self._places("trees", Stream.TREES, params.per_100_m, params.streets_p, tags=False)
        foot = self._beside(found, params.trunk_m / 2)
        trunk = _squares(foot[:, 0], foot[:, 1], params.trunk_m / 2)
        return foot[self._is_free(trunk, city, np.zeros(0, object))]

    def parked(self, city: Scene, params: ParkedParams) -> dict[str, ObjectParams]:
        """Parked cars by name. None stands in a building, on a lane, in a junction or on a tree."""
        found = self._places("parked", Stream.PARKED, params.per_100_m, params.streets_p, tags=True)
        kind = np.where(found.draw < params.vans_p, "van", "car")
        size = np.array([TYPICAL_M[one] for one in kind.tolist()]).reshape(-1, 3)
        at = self._beside(found, size[:, 1] / 2)
        body = _footprints(at, size, found.yaw_rad)
        trees, first = city.trees, city.trees.ptr[:-1]
        trunks = _squares(trees.x_m[first], trees.y_m[first], trees.half_l_m[first])
        free = np.flatnonzero(self._is_free(body, city, trunks))
        free = free[np.argsort(found.rank[free], kind="stable")]
        free = np.sort(free[_first_of_overlapping(body[free])])
        parked = {}
        for i in free.tolist():
            x, y, ground_m = at[i].tolist()
            parked[PARKED + found.name[i]] = ObjectParams(
                vehicle_class=str(kind[i]),  # type: ignore[arg-type]
                at_m=(x, y),
                ground_m=ground_m,
                yaw_deg=float(np.degrees(found.yaw_rad[i])),
            )
        return parked

    def _places(self, section: str, stream: Stream, per_100_m: float, streets_p: float, tags: bool) -> _Places:
        """The places that are taken, of all places along the kerbs."""
        share = per_100_m * PLACE_M[section] / 100
        names: list[str] = []
        where = [np.zeros((0, 5))]
        draws = [np.zeros((0, 2))]
        for kerb in self.kerbs if share > 0 else ():
            prefix = key(self.seed, stream)
            edge = np.array([name_key(kerb.edge)], np.uint64)
            has_it = uniforms(prefix, edge)[0, 0] < streets_p
            if tags and kerb.parking is not None:
                has_it = kerb.parking
            if not has_it:
                continue
            number, place = _along(kerb, PLACE_M[section])
            draw = uniforms(prefix, np.repeat(edge, len(number)), number + 1, n=2)
            taken = draw[:, 0] < share
            names += [f"{kerb.edge}/{n}" for n in number[taken].tolist()]
            where.append(place[taken])
            draws.append(draw[taken])
        at = np.concatenate(where)
        yaw_rad, side = at[:, 3:].T
        return _Places(names, at[:, :3], yaw_rad, side, *np.concatenate(draws).T)

    def _beside(self, places: _Places, half_m: Float[ndarray, "p"] | float) -> Float[ndarray, "p 3"]:
        """Middles of what stands at places, half as wide as given; world frame."""
        at = places.xyz_m - np.array([*self.origin_m, 0.0])
        away = places.side * (GAP_M + half_m)
        at[:, 0] += away * np.sin(places.yaw_rad)
        at[:, 1] -= away * np.cos(places.yaw_rad)
        return at

    def _is_free(self, body: ndarray, city: Scene, others: ndarray) -> ndarray:
        """Which polygons (world frame) touch no lane, junction, building or other polygon."""
        moved = shapely.transform(self.areas, lambda xy: xy - np.array(self.origin_m))
        free = np.ones(len(body), bool)
        for taken in (moved, city.footprints, others):
            meets, _ = shapely.STRtree(taken).query(body, predicate="intersects")
            free[meets] = False
        return free


def _squares(
    x: Float[ndarray, "n"],
    y: Float[ndarray, "n"],
    half: Float[ndarray, "n"] | float,
) -> ndarray:
    """Shapely polygons of upright squares, from their middles and half their widths."""
    return shapely.box(x - half, y - half, x + half, y + half)


_CORNERS = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
"""Of a rectangle, counter-clockwise, in halves of its length and width."""


def _footprints(
    at_m: Float[ndarray, "n 3"],
    lwh_m: Float[ndarray, "n 3"],
    yaw_rad: Float[ndarray, "n"],
) -> ndarray:
    """Shapely polygons of boxes seen from above."""
    from_centre = _CORNERS * lwh_m[:, None, :2] / 2
    corners = turned_by(yaw_rad[:, None], from_centre) + at_m[:, None, :2]
    return shapely.polygons(corners)


def _first_of_overlapping(body: ndarray) -> Bool[ndarray, "n"]:
    """Which polygons meet none before them that stays."""
    stays = np.ones(len(body), bool)
    one, other = shapely.STRtree(body).query(body, predicate="intersects")
    pairs = np.column_stack([one, other])[one > other]
    for later, earlier in sorted(pairs.tolist()):
        stays[later] &= not stays[earlier]
    return stays


def _along(
    kerb: Kerb,
    place_m: float,
) -> tuple[Int[ndarray, "p"], Float[ndarray, "p 5"]]:
    """Numbers of the places along a kerb, and of each x, y, z on the outer edge of the lane, heading and side."""
    step = np.diff(kerb.line_m[:, :2], axis=0)
    length = np.hypot(*step.T)
    end = np.concatenate([[0.0], np.cumsum(length)])
    n = int((end[-1] - 2 * ENDS_M) / place_m)
    number = np.arange(max(0, n))
    at = ENDS_M + (number + 0.5) * place_m
    part = np.clip(np.searchsorted(end, at, "right") - 1, 0, len(step) - 1)
    x, y, z = (np.interp(at, end, coordinate) for coordinate in kerb.line_m.T)
    yaw = np.arctan2(step[part, 1], step[part, 0])
    side = np.full(len(number), -1.0 if kerb.is_left else 1.0)
    away = side * kerb.half_width_m
    edge_x = x + away * np.sin(yaw)
    edge_y = y - away * np.cos(yaw)
    return number, np.column_stack([edge_x, edge_y, z, yaw, side])


def with_trees(city: Scene, beside: Streetside, net: Path, files: Sequence[Path], params: TreeParams) -> Scene:
    """A city with the trees of a config; those of a map (`from_map`) are in the polygon files."""
    feet = beside.planted(city, params)
    if params.from_map:
        of_files = [read_trees(path) for path in files]
        known = np.concatenate([np.zeros((0, 2)), *of_files])
        ground_m = np.zeros(0)
        if len(known):
            ground_m = StreetHeights(lanes(net)).ground_m(shapely.points(known))
        xy_m = known - np.array(beside.origin_m)
        feet = np.concatenate([feet, np.column_stack([xy_m, ground_m])])
    trees = tree_prisms(feet, params.trunk_m, params.crown_base_m, params.crown_m, params.height_m)
    return replace(city, trees=trees)
