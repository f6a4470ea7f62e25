"""Antennas of the trust server at the roadside: stations that receive, forward and broadcast, and have no sensors.

Roadside units that sense are those of `cosim.traffic.roadside`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Float, UInt64
from numpy import ndarray

from cosim.base import rng
from cosim.base.bounds import Positive1000


@dataclass(frozen=True, kw_only=True, slots=True)
class RsuParams:
    """Positions of the trust server's antennas. They share the vehicles' channel, power and rules of access."""

    at: tuple[tuple[float, float, float], ...] = ()
    """East and north in the network, and height of the antenna above the street, of each unit [m]."""
    n_at_junctions: Annotated[int, Ge(0), Le(10_000)] = 0
    """Further units, one at each of the junctions with the most incoming lanes."""
    apart_m: Annotated[float, Ge(0), Le(1e6)] = 100.0
    """Least distance between two units at junctions [m]."""
    height_m: Positive1000 = 6.0
    """Height of the antennas at junctions above the street [m]."""

    def __post_init__(self) -> None:
        for i, (x, y, height) in enumerate(self.at):
            if not (max(abs(x), abs(y)) <= 1e8 and 0 < height <= 1000):
                raise ValueError(
                    f"rsu.at[{i}] = [{x:g}, {y:g}, {height:g}] is no place for an antenna. "
                    "Give [east, north, height] in metres, with a height above 0 and up to 1000."
                )


@dataclass(frozen=True, slots=True)
class RsuAntennas:
    """U antennas of roadside units, in the order of the config."""

    xyz_m: Float[ndarray, "u 3"]
    key: UInt64[ndarray, "u"]
    above_street_m: Float[ndarray, "u"]
    """Height of each antenna above the street under it."""

    def __len__(self) -> int:
        return len(self.key)


NO_RSUS = RsuAntennas(
    xyz_m=np.zeros((0, 3)),
    key=np.zeros(0, np.uint64),
    above_street_m=np.zeros(0),
)
"""No roadside units."""


class StreetPlaces(Protocol):
    """The network, as far as it matters for sites of antennas (`sumo_nets.network.Streets`)."""

    def check_inside(self, x: float, y: float, key: str) -> None: ...
    def street_m(self, x: float, y: float) -> float: ...
    def busiest(self, n: int, apart_m: float) -> Sequence[Any]: ...


def place_rsus(params: RsuParams, streets: StreetPlaces) -> RsuAntennas:
    """Antennas of all roadside units.

    Parameters
    ----------
    params
        Where units stand.
    streets
        The network.

    Returns
    -------
    The units at given positions, then those at junctions.

    Raises
    ------
    ValueError
        If a unit is outside the network, if two units stand at one place, or if there are too few junctions.
    """
    if not params.at and not params.n_at_junctions:
        return NO_RSUS
    for i, (x, y, _) in enumerate(params.at):
        streets.check_inside(x, y, f"rsu.at[{i}]")
    taken = streets.busiest(params.n_at_junctions, params.apart_m)
    if len(taken) < params.n_at_junctions:
        raise ValueError(
            f"rsu.n_at_junctions = {params.n_at_junctions}: the network has no more than {len(taken)} junctions that "
            f"are rsu.apart_m = {params.apart_m:g} m from each other. Set one of the two lower."
        )
    sites = []
    for x, y, height_m in params.at:
        sites.append((x, y, streets.street_m(x, y), height_m))
    for junction in taken:
        sites.append((*junction.xyz_m, params.height_m))
    names: list[str] = []
    for x, y, _, _ in sites:
        name = f"rsu/{x:.2f}/{y:.2f}"  # a unit has the same key wherever it is listed
        if name in names:
            raise ValueError(f"two roadside units stand at [{x:.2f}, {y:.2f}] m. Leave one of them out of rsu.at.")
        names.append(name)
    x_m, y_m, street_m, above_street_m = np.array(sites).T
    keys = [rng.name_key(name) for name in names]
    return RsuAntennas(
        xyz_m=np.column_stack([x_m, y_m, street_m + above_street_m]),
        key=np.array(keys, np.uint64),
        above_street_m=above_street_m.copy(),
    )
