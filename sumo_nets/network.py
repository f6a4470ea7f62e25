"""Facts read from a network file without SUMO: whether it has lanes for cars, its lanes, its junctions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sumo_nets.xml import Attributes, Enough, is_true, stream, version_of

LANE_M = 3.2
"""Default width of a lane [m]; SUMO's own."""

LARGEST_WIDTH_M = 1000.0

MOTORS = frozenset(
    (
        "passenger",
        "private",
        "emergency",
        "authority",
        "army",
        "vip",
        "hov",
        "taxi",
        "bus",
        "coach",
        "delivery",
        "truck",
        "trailer",
        "evehicle",
        "motorcycle",
        "moped",
        "custom1",
        "custom2",
    )
)
"""Vehicle classes of motor vehicles."""
OTHERS = frozenset(("bicycle", "scooter", "pedestrian", "wheelchair", "tram"))
"""Other road users' classes."""


def check_for_cars(net_path: Path | str) -> None:
    """Refuse a file that is not a SUMO network, or a network without any lane for motor vehicles.

    Raises
    ------
    ValueError
        One line: the file, and why no car can drive there.
    """
    elements = 0
    lanes = 0
    inside = False

    def start(name: str, attributes: Attributes) -> None:
        nonlocal elements, lanes, inside
        elements += 1
        if elements == 1 and name != "net":
            raise ValueError(f"{net_path}: not a SUMO network: it starts with <{name}>, a network starts with <net>")
        if name == "edge":
            inside = attributes.get("function", "normal") not in ("normal", "connector")
        elif name == "lane" and not inside:
            lanes += 1
            if _admits(attributes, MOTORS):
                raise Enough

    def end(name: str) -> None:
        if name == "net":
            what = f"none of its {lanes} lanes lets motor vehicles in" if lanes else "it has no lane at all"
            raise ValueError(
                f"{net_path}: no car can drive on this network: {what}. "
                "Was it built for rail or pedestrians only? Rebuild it with netconvert and its streets kept."
            )

    stream(net_path, start, end)


class Lane(NamedTuple):
    """A lane of a street, or across a junction."""

    line_m: Float[ndarray, "k 3"]
    """Middle line, network coordinates, read-only; z = 0 where the network has no heights."""
    width_m: float
    for_cars: bool
    across: bool
    """Within a junction."""
    edge: str
    """Id of its street."""
    ends: tuple[str, str] = ("", "")
    """Ids of the junctions at which its street begins and ends; empty within a junction."""
    limit_mps: float = math.nan
    """Speed limit."""


def lanes(net_path: Path | str) -> tuple[Lane, ...]:
    """Every lane but those of railways and waterways, and the pedestrians' within junctions.

    Only the first call reads the file, until it changes or another network is asked for.
    """
    return _lanes(Path(net_path), version_of(net_path))


def points_of(shape: str) -> Float[ndarray, "k 3"]:
    """Points of a SUMO shape, with z = 0 where it has none; empty if one is not finite."""
    triples = [(*point.split(","), "0")[:3] for point in shape.split()]
    try:
        points = np.array(triples, float)
    except ValueError:
        return np.zeros((0, 3))
    are_points = points.shape[1:] == (3,) and np.isfinite(points).all()
    return points if are_points else np.zeros((0, 3))


@lru_cache(maxsize=1)  # a city of 930 km takes 1.3 s and 15 MB
def _lanes(net_path: Path, version: tuple[int, ...]) -> tuple[Lane, ...]:
    """The lanes of this version of a file."""
    found: list[Lane] = []
    function = edge = ""
    ends = ("", "")

    def start(name: str, attributes: Attributes) -> None:
        nonlocal function, edge, ends
        if name == "edge":
            function, edge = attributes.get("function", "normal"), attributes.get("id", "")
            ends = attributes.get("from", ""), attributes.get("to", "")
        elif name == "lane" and function not in ("crossing", "walkingarea") and _admits(attributes, MOTORS | OTHERS):
            line_m = points_of(attributes["shape"])
            width_m = float(attributes.get("width", LANE_M))
            if len(line_m) < 2 or not 0 < width_m < LARGEST_WIDTH_M:
                raise ValueError(f"lane {attributes.get('id', '?')!r} has no line of finite points, or no width")
            line_m.flags.writeable = False
            limit_mps = float(attributes.get("speed", "nan"))
            found.append(
                Lane(
                    line_m=line_m,
                    width_m=width_m,
                    for_cars=_admits(attributes, MOTORS),
                    across=function == "internal",
                    edge=edge,
                    ends=ends,
                    limit_mps=limit_mps,
                )
            )
        elif name == "connection":  # a third of the elements; SUMO writes them after all lanes
            raise Enough

    stream(net_path, start)
    return tuple(found)


def lane_bounds_m(net_path: Path | str) -> tuple[float, float, float, float]:
    """Least x, least y, greatest x, greatest y of the lanes of a network."""
    lines = [lane.line_m[:, :2] for lane in lanes(net_path)]
    if not lines:
        raise ValueError(f"{net_path}: not a SUMO network: it has no lane.")
    points = np.concatenate(lines)
    west, south = points.min(axis=0).tolist()
    east, north = points.max(axis=0).tolist()
    return west, south, east, north


def original_names(net_path: Path | str) -> set[str]:
    """Ids of the ways of OpenStreetMap that the lanes of a network came from (netconvert --output.original-names)."""
    found: set[str] = set()

    def start(name: str, attributes: Attributes) -> None:
        if name == "param" and attributes.get("key") == "origId":
            found.update(attributes.get("value", "").split())

    stream(net_path, start)
    return found


def is_left_hand(net_path: Path | str) -> bool:
    """Whether traffic drives on the left."""
    found: list[str] = []

    def start(name: str, attributes: Attributes) -> None:
        found.append(attributes.get("lefthand", "false"))
        raise Enough

    stream(net_path, start)
    return is_true(found[0])


def n_jumps(net_path: Path | str) -> int:
    """Number of connections between streets that have no lane within the junction: vehicles jump across it."""
    n = 0

    def start(name: str, attributes: Attributes) -> None:
        nonlocal n
        if name == "connection" and not attributes.get("from", ":").startswith(":") and "via" not in attributes:
            n += 1

    stream(net_path, start)
    return n


@dataclass(frozen=True, slots=True)
class Junction:
    """A junction; network coordinates."""

    xyz_m: tuple[float, float, float]
    n_lanes: int
    """Lanes for vehicles that lead into it."""
    name: str = ""
    """Its id in SUMO."""


BESIDE_M = 30.0
"""A mast stands at most this far beside the outermost streets."""


class Streets(NamedTuple):
    """Junctions that vehicles drive into, in any order, and the network's bounds: west, south, east, north [m]."""

    junctions: Sequence[Junction]
    bounds_m: tuple[float, float, float, float]

    def check_inside(self, x: float, y: float, key: str) -> None:
        """Raise ValueError unless a place is within the network, or beside its outermost streets."""
        west, south, east, north = self.bounds_m
        away_m = max(west - x, x - east, south - y, y - north)
        if away_m > BESIDE_M:
            raise ValueError(
                f"{key} = [{x:g}, {y:g}] m lies outside the network, "
                f"which reaches from [{west:g}, {south:g}] to [{east:g}, {north:g}]. "
                f"Longitude and latitude, not metres? Set {key} within it."
            )

    def street_m(self, x: float, y: float) -> float:
        """Height of the nearest junction [m]."""
        if not self.junctions:
            return 0.0

        def squared_m2(junction: Junction) -> float:
            east, north, _ = junction.xyz_m
            return (east - x) ** 2 + (north - y) ** 2

        return min(self.junctions, key=squared_m2).xyz_m[2]

    def busiest(self, n: int, apart_m: float) -> list[Junction]:
        """Junctions with the most incoming lanes; fewer than `n` if no more are `apart_m` from each other.

        Of two junctions with the same number of lanes, the one farther west, then farther south, comes first.
        """
        taken: list[Junction] = []

        for site in sorted(self.junctions, key=lambda j: (-j.n_lanes, *j.xyz_m)):
            if len(taken) == n:
                break
            x, y, _ = site.xyz_m
            places = np.array([other.xyz_m for other in taken])
            east_m, north_m, _ = places.reshape(-1, 3).T
            if (np.hypot(x - east_m, y - north_m) >= apart_m).all():
                taken.append(site)
        return taken


def junctions(net_path: Path | str) -> Streets:
    """All junctions that vehicles drive into, and the network's bounds."""
    found: list[Junction] = []
    walks: set[str] = set()
    bounds: list[float] = []

    def start(name: str, attributes: Attributes) -> None:
        if name == "location":
            bounds[:] = [float(v) for v in attributes["convBoundary"].split(",")]
        elif name == "lane" and not _admits(attributes, MOTORS):
            walks.add(attributes["id"])
        elif name == "junction" and attributes.get("type") != "internal":
            incoming = attributes.get("incLanes", "").split()
            lanes = [lane for lane in incoming if lane[0] != ":" and lane not in walks]
            if lanes:
                x, y = float(attributes["x"]), float(attributes["y"])
                z = float(attributes.get("z", 0.0))
                found.append(Junction((x, y, z), len(lanes), attributes.get("id", "")))

    stream(net_path, start)
    if len(bounds) != 4:
        bounds[:] = lane_bounds_m(net_path)
    return Streets(found, (bounds[0], bounds[1], bounds[2], bounds[3]))


Location = tuple[str, tuple[float, float]]
"""A projection, and the offset of its coordinates [m]."""


def location(net_path: Path | str) -> Location:
    """The projection of a network as a text of PROJ, and what was added to projected coordinates: east, north [m].

    The text is `!` without a projection.
    """
    found: list[Location] = []

    def start(name: str, attributes: Attributes) -> None:
        if name == "location":
            x, y = (float(value) for value in attributes.get("netOffset", "0,0").split(","))
            found.append((attributes.get("projParameter", "!"), (x, y)))
        if name != "net":
            raise Enough

    stream(net_path, start)
    return found[0] if found else ("!", (0.0, 0.0))


def stretch(net_path: Path | str) -> float | None:
    """How many times as long as on Earth everything in a network is; None without a projection of degrees.

    It compares the two bounds of the network, in its coordinates and in degrees, whichever way is less. Those in
    degrees may be larger, because they hold what netconvert removed.
    """
    bounds: dict[str, list[float]] = {}

    def start(name: str, attributes: Attributes) -> None:
        if name == "location" and attributes.get("projParameter", "!") != "!":
            for key in ("convBoundary", "origBoundary"):
                bounds[key] = [float(value) for value in attributes.get(key, "").split(",") if value]
        if name != "net":
            raise Enough

    stream(net_path, start)
    here, on_earth = bounds.get("convBoundary", []), bounds.get("origBoundary", [])
    if len(here) != 4 or len(on_earth) != 4:
        return None
    west, south, east, north = on_earth
    if not (-180 <= west < east <= 180 and -90 < south < north < 90):
        return None
    degree_m = math.radians(1) * 6_371_000
    middle_rad = math.radians((south + north) / 2)
    wide_m = here[2] - here[0]
    high_m = here[3] - here[1]
    wide = wide_m / (degree_m * (east - west) * math.cos(middle_rad))
    return min(wide, high_m / (degree_m * (north - south)))


def projection(net_path: Path | str) -> Location:
    """Projection and offset of a network that must have one.

    Raises
    ------
    ValueError
        In one line: the network has no projection.
    """
    text, offset_m = location(net_path)
    if text in ("!", "-", ""):
        raise ValueError(f"{net_path} has no projection.")
    return text, offset_m


def admits_motors(lane: Attributes) -> bool:
    """Whether a lane lets any motor vehicle in."""
    return _admits(lane, MOTORS)


def _admits(lane: Attributes, classes: frozenset[str]) -> bool:
    if "allow" in lane:
        return "all" in (allowed := lane["allow"].split()) or not classes.isdisjoint(allowed)
    return "all" not in (refused := lane.get("disallow", "").split()) and not classes.issubset(refused)
