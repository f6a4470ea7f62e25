"""What stands still and is not part of the SUMO simulation: parked vehicles, obstacles, dummies, roadside units."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.base.codes import OBJECT
from cosim.base.plane import wrapped
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.fleet import ActorClass
from cosim.traffic.frame import NETWORK_MARGIN_M, Frame, TrafficError
from cosim.traffic.roadside import MAST_M, NO_UNITS, RoadsideUnits
from cosim.traffic.source import PER_M, PER_RAD, TrafficSource, world_of
from cosim.world import World
from sensors.boxes import Boxes
from sensors.scene import Shape

TYPICAL_M = {
    "car": (4.5, 1.85, 1.5),
    "van": (5.3, 1.95, 2.0),
    "truck": (8.0, 2.4, 3.3),
    "bus": (12.0, 2.55, 3.2),
    "motorcycle": (2.2, 0.9, 1.5),
    "bicycle": (1.8, 0.65, 1.75),
    "pedestrian": (0.5, 0.5, 1.75),
}
"""Default length, width and height of each class, those of the shipped vehicle types."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectParams:
    """An `[[objects]]` section: one real object that stands still.

    Sensors see it, it occludes other objects, and it appears in the tables like any other actor. It is never equipped.
    Traffic does not react to it: SUMO's vehicles drive through an object on their lane.
    """

    vehicle_class: ActorClass = "car"
    """Class of the object in the tables, which also sets its default size. A dummy of a person is a `pedestrian`."""
    at_m: tuple[float, float] | None = None
    """Centre of its box in the world frame, which is that of the tables: east, north [m]. Required."""
    ground_m: Annotated[float, Ge(-1000), Le(10_000)] = 0.0
    """Height of the ground under it [m]."""
    yaw_deg: Annotated[float, Ge(-360), Le(360)] = 0.0
    """Heading, counter-clockwise from east [deg]."""
    length_m: Annotated[float, Ge(0.001), Le(100)] | None = None
    """Extent along its heading [m]. If it is not set, the default of its class is used."""
    width_m: Annotated[float, Ge(0.001), Le(100)] | None = None
    """Extent across its heading [m]. If it is not set, the default of its class is used."""
    height_m: Annotated[float, Ge(0.001), Le(100)] | None = None
    """Vertical extent [m]. If it is not set, the default of its class is used."""
    from_s: Annotated[float, Ge(0), Le(1e8)] = 0.0
    """Recorded time at which it appears [s]."""
    to_s: Annotated[float, Gt(0), Le(1e8)] = 1e8
    """Recorded time at which it disappears [s]."""

    def __post_init__(self) -> None:
        if self.at_m is None:
            raise ValueError("objects: at_m is not given. Set its position: at_m = [east, north], in metres.")
        if self.to_s <= self.from_s:
            raise ValueError(f"objects: to_s = {self.to_s:g} s is not after from_s = {self.from_s:g} s. Set it later.")

    @property
    def lwh_m(self) -> tuple[float, float, float]:
        """Length, width, height."""
        length, width, height = TYPICAL_M[self.vehicle_class]
        return self.length_m or length, self.width_m or width, self.height_m or height


@dataclass(frozen=True, slots=True)
class Placed:
    """Objects and roadside units as arrays, in the world frame, rounded to the resolution of the table `actors`."""

    names: list[str]
    shape: UInt8[ndarray, "o"]
    boxes: Boxes
    from_step: Float[ndarray, "o"]
    to_step: Float[ndarray, "o"]
    """One past the last step."""
    is_unit: Bool[ndarray, "o"]
    """Whether it is a roadside unit. Units are equipped."""

    @staticmethod
    def of(
        objects: Sequence[ObjectParams],
        frame: Frame,
        step_s: float,
        parked: Mapping[str, ObjectParams] | None = None,
        units: RoadsideUnits = NO_UNITS,
    ) -> "Placed":
        """Convert the objects, parked cars by name, and units to arrays.

        Raises
        ------
        TrafficError
            One of them is far outside the network.
        """
        n_units, parked = len(units), parked or {}
        names = [f"{OBJECT}{i}" for i in range(len(objects))]
        names += [*parked, *units.names]
        objects = [*objects, *parked.values()]
        kinds = [Shape[o.vehicle_class.upper()] for o in objects]
        kinds += [Shape.ROADSIDE_UNIT] * n_units
        shape = np.array(kinds, np.uint8)
        masts_m = np.column_stack([np.full((n_units, 2), MAST_M), units.height_m])
        objects_m = np.array([o.lwh_m for o in objects]).reshape(-1, 3)
        lwh_m = np.concatenate([objects_m, masts_m])
        lwh_m = lwh_m.astype(np.float32).astype(float)
        ground_m = [(*(o.at_m or ()), o.ground_m) for o in objects]
        xyz_m = np.concatenate([np.array(ground_m).reshape(-1, 3), units.ground_m])
        xyz_m[:, 2] += lwh_m[:, 2] / 2
        yaw = np.concatenate([np.radians([o.yaw_deg for o in objects]), units.yaw_rad])
        xyz_m = np.rint(xyz_m * PER_M) / PER_M
        yaw_rad = np.rint(wrapped(yaw) * PER_RAD) / PER_RAD
        boxes = Boxes(xyz_m, lwh_m, yaw_rad)
        times_s = [(o.from_s, o.to_s) for o in objects]
        times_s += [(0.0, np.inf)] * n_units
        times = np.array(times_s).reshape(-1, 2) / step_s
        from_step, to_step = np.ceil(times - 1e-9).T
        placed = Placed(names, shape, boxes, from_step, to_step, shape == Shape.ROADSIDE_UNIT)
        if frame.bounds_m is not None:  # that of a trace without a network is known once the trace is read
            placed.check(frame)
        return placed

    def check(self, frame: Frame) -> None:
        """Raise TrafficError if one of them is far outside the network."""
        n = len(self.names)
        numbers, zero = np.arange(n), np.zeros(n)
        frame = replace(frame, source="roadside.at" if self.is_unit.all() else "objects.at_m")
        frame.check(0, self.names, numbers, self.boxes.xyz_m, self.boxes.yaw_rad, zero)


class WithObjects:
    """A `TrafficSource` that adds objects and roadside units to the worlds of another traffic source."""

    def __init__(self, traffic: TrafficSource, placed: Placed, registry: ActorRegistry, frame: Frame) -> None:
        self._traffic, self._placed, self._registry, self._frame = traffic, placed, registry, frame
        self._number = np.full(len(placed.names), -1, np.int32)
        self._is_checked = False

    def warm_up(self, seconds: float) -> Iterator[float]:
        return self._traffic.warm_up(seconds)

    def advance(self) -> World:
        """The world of the next step, with the objects that are present in it."""
        world, p = self._traffic.advance(), self._placed
        if not self._is_checked:
            _check_place(p, self._traffic.report().get("origin_m", (0.0, 0.0)))
            p.check(self._frame)
            self._is_checked = True
        here = np.flatnonzero((p.from_step <= world.step) & (world.step < p.to_step))
        if not len(here):
            return world
        new = here[self._number[here] < 0]
        if len(new):
            self._register(new[~p.is_unit[new]], world.step, equipped=False)
            self._register(new[p.is_unit[new]], world.step, equipped=True)
        here = here[np.argsort(self._number[here])]
        boxes = p.boxes.take(here)
        speed = np.zeros(len(here))
        objects = world_of(
            world.step, self._number[here], boxes.xyz_m, boxes.yaw_rad, speed, self._registry, self._frame
        )
        return _joined(world, objects)

    def _register(self, rows: Int[ndarray, "k"], step: int, equipped: bool) -> None:
        """Give numbers to objects that appear."""
        names = [self._placed.names[i] for i in rows.tolist()]
        shape = self._placed.shape[rows]
        lwh_m = self._placed.boxes.lwh_m[rows]
        self._number[rows] = self._registry.register(names, shape, lwh_m, step, equipped=equipped)

    def command(self, actor: Int[ndarray, "c"], speed_mps: Float[ndarray, "c"]) -> None:
        """As in `TrafficSource`."""
        self._traffic.command(actor, speed_mps)

    def report(self) -> dict[str, Any]:
        """Counts of the traffic source, the number of objects that were present, and the roadside units."""
        p, present = self._placed, self._number >= 0
        report = self._traffic.report() | {"objects": int((present & ~p.is_unit).sum())}
        units = [p.names[i] for i in np.flatnonzero(p.is_unit).tolist()]
        return report | ({"roadside": units} if units else {})

    def close(self) -> None:
        self._traffic.close()


def _check_place(placed: Placed, origin_m: Sequence[float]) -> None:
    """Raise TrafficError if an object is at the coordinates of a trace whose world has an origin of its own."""
    if not any(origin_m):
        return
    at_m = placed.boxes.xyz_m[:, :2]
    here_m = at_m - origin_m  # the first actors are within a kilometre of the world's origin
    is_there = np.hypot(*here_m.T) < NETWORK_MARGIN_M
    if is_there.any():
        row = int(np.argmax(is_there))
        places = at_m[row], origin_m, here_m[row]
        given, origin, here = ("[{:.10g}, {:.10g}]".format(*xy) for xy in places)
        raise TrafficError(
            f"{placed.names[row]}: at_m = {given} is in the trace's coordinates, of which the world's origin is at "
            f"{origin}. Set at_m = {here}."
        )


def _joined(world: World, objects: World) -> World:
    """Merge two worlds into one, sorted by actor."""
    order = np.argsort(np.concatenate([world.actor, objects.actor]), kind="stable")
    row = np.empty(len(order), np.int64)
    row[order] = np.arange(len(order))
    columns = {
        name: np.concatenate([getattr(world, name), getattr(objects, name)])[order]
        for name in ("actor", "name_key", "shape", "speed_mps", "equipped", "attack")
    }
    boxes = Boxes.concat([world.boxes, objects.boxes]).take(order)
    paths = None if world.paths is None else replace(world.paths, row=row[world.paths.row])
    return World(step=world.step, boxes=boxes, paths=paths, **columns)
