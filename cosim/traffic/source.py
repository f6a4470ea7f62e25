"""Interface of traffic sources, and the conversion of SUMO's coordinates.

SUMO's API and output files give the centre of the *front bumper*, and degrees *clockwise from north*. Code outside this
folder uses box centres, and radians counter-clockwise from east.
"""

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled, inlined
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.frame import Frame
from cosim.traffic.frame import TrafficError as TrafficError
from cosim.world import World
from results.tables import TABLES
from sensors.boxes import Boxes
from sensors.scene import Shape

_CLASSES_OF_SHAPE = {
    Shape.CAR: "passenger private taxi evehicle hov vip authority army custom1 custom2 ignoring",
    Shape.VAN: "delivery emergency",
    Shape.TRUCK: "truck trailer",
    Shape.BUS: "bus coach tram",
    Shape.MOTORCYCLE: "motorcycle moped",
    Shape.BICYCLE: "bicycle scooter",
    Shape.PEDESTRIAN: "pedestrian wheelchair",
}
SHAPE_OF_CLASS = {name: shape for shape, names in _CLASSES_OF_SHAPE.items() for name in names.split()}
"""Shape of each SUMO vehicle class. Trains, ships, aircraft and containers are not on the road and have no shape."""


def class_counts(shape: Int[ndarray, "n"]) -> dict[str, int]:
    """Number of actors of each class."""
    codes, n = np.unique(shape, return_counts=True)
    names = [Shape(code).name.lower() for code in codes.tolist()]
    return dict(zip(names, n.tolist(), strict=True))


PER_M, PER_RAD, PER_MPS = (
    2.0 ** (TABLES["actors"].columns[name].bits or 0) for name in ("x_m", "yaw_rad", "speed_mps")
)
"""Resolution of positions, angles and speeds in the table `actors`: steps per m, rad and m/s."""


class TrafficEnded(Exception):
    """The traffic has ended: no actor is left and none will depart, or the source ends. The message says why."""


class TrafficSource(Protocol):
    """A source of traffic that is read into arrays step by step."""

    def warm_up(self, seconds: float) -> Iterator[float]:
        """Advance by `seconds` without reading actors. Yields the seconds that are done."""

    def advance(self) -> World:
        """The world of the next step. Raises TrafficEnded if there is none."""

    def command(self, actor: Int[ndarray, "c"], speed_mps: Float[ndarray, "c"]) -> None:
        """Command the speeds of vehicles in the next step. All other vehicles drive as the traffic model says.

        Parameters
        ----------
        actor
            Actor numbers of the commanded vehicles.
        speed_mps
            Speed of each.

        Raises
        ------
        TrafficError
            This traffic cannot be commanded.
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
    """Build the world of a step from SUMO's values of each actor.

    A run gets the same world from SUMO, from a trace, or from the tables of an earlier run. For this, heights, angles
    and speeds are rounded to single precision, as in SUMO's Parquet traces, and poses to the resolution of the table
    `actors` (1/256 m, 1/512 rad).

    Parameters
    ----------
    number
        Actor numbers, in any order.
    front_m
        Centres of the front bumpers, in the source's coordinates.
    compass_deg
        Headings, clockwise from north.

    Raises
    ------
    TrafficError
        An actor is not finite or is far outside the frame's region.
    """
    order = np.argsort(number)
    number, xyz_m, yaw_rad, speed = _placed(
        order, number, front_m, compass_deg, speed_mps, registry.lwh_m, *frame.origin_m
    )
    return world_of(step, number, xyz_m, yaw_rad, speed, registry, frame)


@inlined
def _in_steps(value, per_unit):
    """A value rounded to whole steps, of which there are so many per unit."""
    return np.rint(value * per_unit) / per_unit


@compiled
def _placed(order, actor, front_m, compass_deg, speed_mps, size_m, east_m, north_m):
    """Actor numbers, box centres, yaw and speed from front bumpers on the road, in the given order, rounded."""
    n = len(order)
    number = np.empty(n, np.int32)
    xyz_m = np.empty((n, 3))
    yaw_rad = np.empty(n)
    speed = np.empty(n)
    for i in range(n):
        row = order[i]
        number[i] = actor[row]
        yaw = np.deg2rad(90.0 - np.float64(np.float32(compass_deg[row])))
        yaw = np.pi - np.mod(np.pi - yaw, 2 * np.pi)  # (-pi, pi]
        back = size_m[number[i], 0] / 2
        x = front_m[row, 0] - east_m - np.cos(yaw) * back
        y = front_m[row, 1] - north_m - np.sin(yaw) * back
        road = np.float64(np.float32(front_m[row, 2]))
        z = road + size_m[number[i], 2] / 2
        xyz_m[i, 0] = _in_steps(x, PER_M)
        xyz_m[i, 1] = _in_steps(y, PER_M)
        xyz_m[i, 2] = _in_steps(z, PER_M)
        yaw_rad[i] = _in_steps(yaw, PER_RAD)
        speed[i] = _in_steps(np.float64(np.float32(speed_mps[row])), PER_MPS)
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
    """Build the world of a step from box poses at the resolution of the table `actors`.

    Parameters
    ----------
    number
        Actor numbers, ascending.
    xyz_m, yaw_rad
        Centres and headings of the boxes, in the world frame.

    Raises
    ------
    TrafficError
        An actor is not finite or is far outside the frame's region.
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
