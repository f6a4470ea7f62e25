"""Interface of traffic sources, and the conversion of SUMO's coordinates.

SUMO gives the centre of the *front bumper* and degrees *clockwise from north*, in its API and in its output files;
code outside of this folder uses box centres and radians counter-clockwise from east.
"""

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.mobility.actors import ActorRegistry
from cosim.mobility.frame import Frame
from cosim.mobility.frame import TrafficError as TrafficError
from cosim.world import World
from results.tables import TABLES
from sensors.boxes import Boxes
from sensors.kernel import compiled
from sensors.scene import Shape

SHAPE_OF_CLASS = {
    "passenger": Shape.CAR, "private": Shape.CAR, "taxi": Shape.CAR, "evehicle": Shape.CAR,
    "hov": Shape.CAR, "vip": Shape.CAR, "authority": Shape.CAR, "army": Shape.CAR, "custom1": Shape.CAR,
    "custom2": Shape.CAR, "ignoring": Shape.CAR,
    "delivery": Shape.VAN, "emergency": Shape.VAN,
    "truck": Shape.TRUCK, "trailer": Shape.TRUCK,
    "bus": Shape.BUS, "coach": Shape.BUS, "tram": Shape.BUS,
    "motorcycle": Shape.MOTORCYCLE, "moped": Shape.MOTORCYCLE,
    "bicycle": Shape.BICYCLE, "scooter": Shape.BICYCLE,
    "pedestrian": Shape.PEDESTRIAN, "wheelchair": Shape.PEDESTRIAN,
}  # fmt: skip
"""Shape of each SUMO vehicle class; trains, ships, aircraft and containers are left out: they are not on the road."""


PER_M, PER_RAD, PER_MPS = (
    2.0 ** (TABLES["actors"].columns[name].bits or 0) for name in ("x_m", "yaw_rad", "speed_mps")
)
"""Resolution at which the table `actors` keeps positions, angles and speeds."""


class TrafficEnded(Exception):
    """No actor is left and none will depart, or the source ends; says why."""


def refuse_commands(what: str, n: int) -> None:
    """TrafficError where there is any command for traffic that is replayed."""
    if n:
        raise TrafficError(
            f"{what} is replayed: nothing can brake in it. Run SUMO (no traffic.trace), or choose a driver that "
            "commands no speeds."
        )


class TrafficSource(Protocol):
    """A source of traffic, read into arrays step by step."""

    def warm_up(self, seconds: float) -> Iterator[float]:
        """Advance by `seconds` without reading; yields the seconds done."""

    def advance(self) -> World:
        """The world of the next step; raises TrafficEnded where there is none."""

    def command(self, actor: Int[ndarray, "c"], speed_mps: Float[ndarray, "c"]) -> None:
        """Speeds that vehicles drive in the next step; all others drive on their own.

        TrafficError where the traffic cannot be commanded.
        """

    def report(self) -> dict[str, Any]:
        """Counts for the run's summary."""

    def close(self) -> None:
        """Release files and processes."""


def world_from_bumpers(
    step: int,
    number: Int[ndarray, "n"],
    front_m: Float[ndarray, "n 3"],
    compass_deg: Float[ndarray, "n"],
    speed_mps: Float[ndarray, "n"],
    registry: ActorRegistry,
    frame: Frame,
) -> World:
    """The world of a step from SUMO's values of each actor, in any order.

    Heights, angles and speeds pass through single precision, which is all that SUMO's Parquet traces hold of them,
    and poses are rounded to the resolution of the table `actors` (1/256 m, 1/512 rad), so that a run gets the same
    world from SUMO, from a trace, or from the tables of an earlier run.
    """
    order = np.argsort(number)
    number, xyz_m, yaw_rad, speed = _placed(
        order, number, front_m, compass_deg, speed_mps, registry.lwh_m, *frame.origin_m
    )
    return world_of(step, number, xyz_m, yaw_rad, speed, registry, frame)


@compiled
def _placed(order, actor, front_m, compass_deg, speed_mps, size_m, east_m, north_m):
    """Actors, centres of boxes, yaw and speed from front bumpers on the road, in order and rounded."""
    n = len(order)
    number, xyz_m, yaw_rad, speed = np.empty(n, np.int32), np.empty((n, 3)), np.empty(n), np.empty(n)
    for i in range(n):
        row = order[i]
        number[i] = actor[row]
        yaw = np.deg2rad(90.0 - np.float64(np.float32(compass_deg[row])))
        yaw = np.pi - np.mod(np.pi - yaw, 2 * np.pi)  # (-pi, pi]
        back = size_m[number[i], 0] / 2
        xyz_m[i, 0] = np.rint((front_m[row, 0] - east_m - np.cos(yaw) * back) * PER_M) / PER_M
        xyz_m[i, 1] = np.rint((front_m[row, 1] - north_m - np.sin(yaw) * back) * PER_M) / PER_M
        xyz_m[i, 2] = np.rint((np.float64(np.float32(front_m[row, 2])) + size_m[number[i], 2] / 2) * PER_M) / PER_M
        yaw_rad[i] = np.rint(yaw * PER_RAD) / PER_RAD
        speed[i] = np.rint(np.float64(np.float32(speed_mps[row])) * PER_MPS) / PER_MPS
    return number, xyz_m, yaw_rad, speed


def world_of(
    step: int,
    number: Int[ndarray, "n"],
    xyz_m: Float[ndarray, "n 3"],
    yaw_rad: Float[ndarray, "n"],
    speed_mps: Float[ndarray, "n"],
    registry: ActorRegistry,
    frame: Frame,
) -> World:
    """The world of a step from poses of boxes at the resolution of the table `actors`; `number` is sorted.

    Raises
    ------
    TrafficError
        An actor is not finite or far outside of the frame's region.
    """
    frame.check(step, registry.names, number, xyz_m, yaw_rad, speed_mps)
    registry.mark_present(number, step)
    return World(
        step=step,
        actor=number,
        name_key=registry.name_key[number],
        shape=registry.shape[number],
        boxes=Boxes(xyz_m, registry.lwh_m[number], yaw_rad),
        speed_mps=speed_mps,
        equipped=registry.equipped[number],
        attack=registry.attack[number],
    )
