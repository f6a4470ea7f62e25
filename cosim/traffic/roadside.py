"""Roadside units with a LiDAR: stations that stand still, sense, send, receive and evaluate, and are no traffic.

They are not the antennas of `[rsu]`, which are the trust server's radio links: those have no sensor, no identity and no
message of their own. Who wants both at one place gives both sections.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Bool, Float, UInt64
from numpy import ndarray

from cosim.base.bounds import Positive100
from cosim.base.plane import wrapped
from cosim.base.rng import Stream, key, name_key, uniforms
from cosim.traffic.actors import actor_key
from sensors.lidar import ProfileName
from sumo_nets.network import Junction, Streets

PREFIX = "roadside/"
"""Prefix of their names; east and north in the network follow, so that a unit has one name wherever it is listed."""
MAST_M = 0.1
"""Length and width of a unit's box. It serves for reports only: the body of a unit meets no ray."""
APART_M = 100.0
"""Least distance between two units that are placed at junctions [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RoadsideParams:
    """A `[[roadside]]` section: a unit with a LiDAR and a radio at the side of the road, or several at junctions.

    It detects with the detector of the vehicles, sends its detections, and evaluates those of others. It does not
    report itself, keeps its pseudonym, and has no position error.
    """

    at: tuple[float, float] | None = None
    """East and north in the network [m]."""
    junction: str | None = None
    """In place of `at`: the SUMO id of a junction."""
    junctions: Annotated[int, Ge(0), Le(10_000)] | None = None
    """In place of `at`: so many units, one at each of the junctions that `choose` takes."""
    choose: Literal["busiest", "random", "listed"] = "busiest"
    """With `junctions`: those with the most incoming lanes that are at least 100 m from each other; those that are
    drawn from their names by `seed`, where more units only add to fewer; or the first ones of `listed`."""
    listed: tuple[str, ...] = ()
    """SUMO ids of junctions, the best one first, such as `cosim place roadside` prints."""
    heading_deg: Annotated[float, Ge(-360), Le(360)] = 0.0
    """Direction in which the sensor looks, counter-clockwise from east [deg]. It matters for a field of view below 360
    degrees."""
    height_m: Positive100 = 6.0
    """Height of the sensor above the street [m]."""
    sensor: ProfileName = "os1_128"
    """Product whose beams are used. Everything else is as in [lidar]. The sensor is level: its lowest beams meet the
    street at height_m / tan(elevation)."""
    trusted: bool = True
    """Whether others know by the class of its certificate that it belongs to a road authority. If so, whoever looks up
    trust in it finds 1, and the trust server drops evaluations of it. Where it could see a detection (visibility above
    0), the server drops what all others say about this detection in the same step. If not, it is a sender like any
    other."""

    def __post_init__(self) -> None:
        given = [name for name in ("at", "junction", "junctions") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"roadside: {' and '.join(given) or 'no place'} given. Say where the unit stands by one of at = "
                '[east, north], junction = "id", junctions = 3.'
            )
        if self.choose == "listed" and not (self.listed and self.junctions is not None):
            raise ValueError(
                'roadside: choose = "listed" takes the first of the junctions in listed = ["id", ...]. Set listed and '
                "junctions, such as `cosim place roadside` prints them."
            )


@dataclass(frozen=True, slots=True)
class RoadsideUnits:
    """U roadside units, in the order of the config; world frame."""

    names: tuple[str, ...]
    ground_m: Float[ndarray, "u 3"]
    """Point of the street below each sensor."""
    height_m: Float[ndarray, "u"]
    yaw_rad: Float[ndarray, "u"]
    sensor: tuple[ProfileName, ...]
    trusted: Bool[ndarray, "u"]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def name_key(self) -> UInt64[ndarray, "u"]:
        """The key of each unit in random draws."""
        return np.array([actor_key(name, False) for name in self.names], np.uint64)


NO_UNITS = RoadsideUnits(
    names=(),
    ground_m=np.zeros((0, 3)),
    height_m=np.zeros(0),
    yaw_rad=np.zeros(0),
    sensor=(),
    trusted=np.zeros(0, bool),
)


def place(
    sections: Sequence[RoadsideParams], streets: Streets, origin_m: tuple[float, float], seed: int
) -> RoadsideUnits:
    """The units of these sections.

    Parameters
    ----------
    sections
        The `[[roadside]]` sections.
    streets
        The network.
    origin_m
        The world's origin in the network's coordinates.
    seed
        Decides what `choose = "random"` draws.

    Raises
    ------
    ValueError
        In one line, if a place does not fit.
    """
    sites: list[tuple[RoadsideParams, tuple[float, float, float]]] = []
    for i, section in enumerate(sections):
        if section.at is not None:
            streets.check_inside(*section.at, f"roadside.{i}.at")
            sites.append((section, (*section.at, streets.street_m(*section.at))))
        else:
            sites += [(section, junction.xyz_m) for junction in _chosen(section, f"roadside.{i}", streets, seed)]
    names: list[str] = []
    for _, (x, y, _) in sites:
        place = f"{x:.2f}/{y:.2f}"
        if PREFIX + place in names:
            raise ValueError(f"two [[roadside]] units stand at {place} m. Leave one of them out.")
        names.append(PREFIX + place)
    yaw = np.radians([section.heading_deg for section, _ in sites])
    ground_m = np.array([site for _, site in sites]).reshape(-1, 3)
    return RoadsideUnits(
        tuple(names),
        ground_m - [*origin_m, 0.0],
        np.array([section.height_m for section, _ in sites], float),
        wrapped(yaw),
        tuple(section.sensor for section, _ in sites),
        np.array([section.trusted for section, _ in sites], bool),
    )


def drawn(streets: Streets, seed: int) -> list[Junction]:
    """All junctions in a random order, which depends on their names and the seed."""
    junctions = sorted(streets.junctions, key=lambda junction: junction.name)
    names = np.array([name_key("junction/" + junction.name) for junction in junctions], np.uint64)
    draw = uniforms(key(seed, Stream.PLACEMENT), names)[:, 0]
    return [junctions[i] for i in np.argsort(draw, kind="stable").tolist()]


def _chosen(section: RoadsideParams, where: str, streets: Streets, seed: int) -> list[Junction]:
    """The junctions of a section."""
    names = section.listed if section.junction is None else (section.junction,)
    by_name = {junction.name: junction for junction in streets.junctions}
    if unknown := next((name for name in names if name not in by_name), None):
        raise ValueError(
            f'{where}: the network has no junction "{unknown}" that vehicles drive into. Take an id from its '
            ".net.xml, or give at = [east, north]."
        )
    if section.junctions is None:
        return [by_name[name] for name in names]
    if section.choose == "busiest":
        found, why = streets.busiest(section.junctions, APART_M), f" that are {APART_M:g} m from each other"
    elif section.choose == "random":
        found, why = drawn(streets, seed)[: section.junctions], ""
    else:
        found = [by_name[name] for name in names[: section.junctions]]
        why = f" in {where}.listed"
    if len(found) < section.junctions:
        raise ValueError(
            f"{where}.junctions = {section.junctions}: there are only {len(found)} junctions{why}. Set it lower."
        )
    return found
