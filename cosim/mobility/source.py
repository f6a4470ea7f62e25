"""What all sources of traffic have in common: what they are asked, how they answer, and how they end.

SUMO gives the centre of the *front bumper* and degrees *clockwise from north*, live and in what it writes;
everybody beyond this folder lives with box centres and radians counter-clockwise from east.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

import numpy as np
from annotated_types import Ge, Gt
from jaxtyping import Float, Int
from numba import njit
from numpy import ndarray

from cosim.roster import Roster
from cosim.world import World
from results.tables import TABLES
from sensors.boxes import Boxes
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
"""Body of each SUMO vehicle class; trains, ships, aircraft and containers are not on the road: left out."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrafficParams:
    """Whose streets, when, how long, and SUMO's own dice."""

    scenario: str = "helsinki"
    """Name of a city (`cosim nets list`); or, relative to the config file that names it, the path of a .sumocfg, of a
    folder that `cosim nets build` made, of a run to replay, or of a trace that SUMO wrote with --fcd-output."""
    trace: str | None = None
    """Replay this trace or run folder in the streets of `scenario`, instead of driving SUMO."""
    seed: Annotated[int, Ge(0)] = 1
    """Seed of SUMO."""
    scale: Annotated[float, Gt(0)] = 1.0
    """Demand, times this; below 1 SUMO leaves vehicles out, above 1 it doubles some. Traces are as they are."""
    begin_s: Annotated[float, Ge(0)] | None = None
    """Time of the scenario at which to begin, warm-up included [s]; the scenario's own when not set."""
    warmup_s: Annotated[float, Ge(0)] | None = None
    """Traffic driven before anything is sensed or recorded [s]; the shipped network's own when not set."""
    duration_s: Annotated[float, Gt(0)] = 300.0
    """Recorded time after warm-up [s]; less if the traffic ends before."""
    step_s: Annotated[float, Ge(0.1)] = 1.0
    """Length of one step of traffic [s]; when not set, that of the .sumocfg, and 1 s of a trace."""


_PER_M, _PER_RAD, _PER_MPS = (
    2.0 ** (TABLES["actors"].columns[name].bits or 0) for name in ("x_m", "yaw_rad", "speed_mps")
)
"""How finely the table `actors` keeps places, angles and speeds."""


class TrafficOver(Exception):
    """Nobody is left, and nobody will come; says why."""


class TrafficError(ValueError):
    """The user's scenario or trace turned out to be wrong while it ran: one line for the user."""


class Traffic(Protocol):
    """A source of traffic, read into arrays step by step."""

    def warm_up(self, seconds: float) -> Iterator[float]:
        """Go on unseen for `seconds`; yields the seconds done."""

    def advance(self) -> World:
        """The next step; raises TrafficOver where there is none."""

    def report(self) -> dict[str, Any]:
        """What happened, for the run's summary."""

    def close(self) -> None:
        """Let go of it."""


def world_from_bumpers(
    step: int,
    number: Int[ndarray, "n"],
    front_m: Float[ndarray, "n 3"],
    compass_deg: Float[ndarray, "n"],
    speed_mps: Float[ndarray, "n"],
    roster: Roster,
    origin_m: tuple[float, float] = (0.0, 0.0),
) -> World:
    """The world of a step from what SUMO says of each actor, in any order.

    Heights, angles and speeds pass through single precision, which is all that SUMO's Parquet traces hold of them,
    and poses are rounded to what the table `actors` keeps (1/256 m, 1/512 rad): so that a run sees the same
    world live, from a trace, or from the tables of an earlier run.
    """
    order = np.argsort(number)
    number, xyz_m, lwh_m, yaw_rad, speed = _placed(
        order, number, front_m, compass_deg, speed_mps, roster.lwh_m, *origin_m
    )
    return world_of(step, number, Boxes(xyz_m, lwh_m, yaw_rad), speed, roster)


@njit(cache=True)
def _placed(order, actor, front_m, compass_deg, speed_mps, size_m, east_m, north_m):
    """Actors, centres and sizes of boxes, yaw and speed from front bumpers on the road, in order and rounded."""
    n = len(order)
    number, xyz_m, lwh_m, yaw_rad, speed = (
        np.empty(n, np.int32), np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n)
    )  # fmt: skip
    for i in range(n):
        row = order[i]
        number[i] = actor[row]
        for axis in range(3):
            lwh_m[i, axis] = size_m[number[i], axis]
        yaw = np.deg2rad(90.0 - np.float64(np.float32(compass_deg[row])))
        yaw = np.pi - np.mod(np.pi - yaw, 2 * np.pi)  # (-pi, pi]
        back = lwh_m[i, 0] / 2
        xyz_m[i, 0] = np.rint((front_m[row, 0] - east_m - np.cos(yaw) * back) * _PER_M) / _PER_M
        xyz_m[i, 1] = np.rint((front_m[row, 1] - north_m - np.sin(yaw) * back) * _PER_M) / _PER_M
        xyz_m[i, 2] = np.rint((np.float64(np.float32(front_m[row, 2])) + lwh_m[i, 2] / 2) * _PER_M) / _PER_M
        yaw_rad[i] = np.rint(yaw * _PER_RAD) / _PER_RAD
        speed[i] = np.rint(np.float64(np.float32(speed_mps[row])) * _PER_MPS) / _PER_MPS
    return number, xyz_m, lwh_m, yaw_rad, speed


def world_of(
    step: int, number: Int[ndarray, "n"], boxes: Boxes, speed_mps: Float[ndarray, "n"], roster: Roster
) -> World:
    """The world of a step from poses as the table `actors` keeps them; `number` is sorted."""
    roster.seen(number, step)
    return World(
        step=step,
        actor=number,
        name_key=roster.name_key[number],
        shape=roster.shape[number],
        boxes=boxes,
        speed_mps=speed_mps,
        equipped=roster.equipped[number],
        behaviour=roster.behaviour[number],
    )
