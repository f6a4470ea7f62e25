"""Perception of observers with different LiDARs: vehicles, and roadside units with sensors of their own."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from numpy import ndarray

from cosim.step.perception import BoxAnswers, BoxQuestions, Observed, Perception, Seen
from cosim.step.stopwatch import Stopwatch
from cosim.traffic.roadside import RoadsideUnits
from cosim.world import World
from sensors import evidence, lidar
from sensors.boxes import Boxes
from sensors.evidence import AreaParams
from sensors.lidar import LidarParams, ProfileName, RangeImages
from sensors.pairs import Poses


@dataclass(frozen=True, slots=True)
class MixedImages:
    """Range images of observers with different LiDARs."""

    of_lidar: tuple[RangeImages, ...]
    """Of the vehicles, then of the units of each kind of LiDAR."""
    lidar: Int[ndarray, "m"]
    """LiDAR of each observer."""
    row: Int[ndarray, "m"]
    """Row of each observer among the images of its LiDAR."""

    @property
    def poses(self) -> Poses:
        """Poses of the sensors of all observers."""
        origin_m = np.empty((len(self.lidar), 3))
        yaw_rad = np.empty(len(self.lidar))
        for images, mine in self._with_observers():
            origin_m[mine] = images.poses.origin_m
            yaw_rad[mine] = images.poses.yaw_rad
        return Poses(origin_m, yaw_rad)

    def _with_observers(self) -> Iterator[tuple[RangeImages, Bool[ndarray, "m"]]]:
        """The images of each LiDAR, and which observers have it."""
        for number, images in enumerate(self.of_lidar):
            yield images, self.lidar == number

    def seen_after_s(
        self,
        o: Int[ndarray, "k"],
        xyz_m: Float[ndarray, "k 3"],
    ) -> Float[ndarray, "k"]:
        """As `RangeImages.seen_after_s`. All LiDARs turn equally fast."""
        return lidar.seen_after_s(self.poses, self.of_lidar[0].beams.s_per_rad, o, xyz_m)

    def displaced(self, error: Float[ndarray, "m 3"]) -> "MixedImages":
        """As `RangeImages.displaced`."""
        moved = (images.displaced(error[mine]) for images, mine in self._with_observers())
        return replace(self, of_lidar=tuple(moved))

    def n_returns(self) -> Int[ndarray, "m"]:
        """As `RangeImages.n_returns`."""
        n = np.zeros(len(self.lidar), np.int64)
        for images, mine in self._with_observers():
            n[mine] = images.n_returns()
        return n

    def image(self, o: int) -> tuple[RangeImages, int]:
        """The images in which that of observer o is, and its row among them."""
        number = int(self.lidar[o])
        return self.of_lidar[number], int(self.row[o])


@dataclass(frozen=True, slots=True)
class MixedPerception:
    """The perception of the vehicles, and one for each kind of LiDAR of roadside units."""

    of_lidar: tuple[Perception, ...]
    unit_key: UInt64[ndarray, "u"]
    """Keys of the names of the units, ascending."""
    lidar_of_unit: Int[ndarray, "u"]
    """LiDAR of each unit, from 1 on."""

    @staticmethod
    def of(vehicles: Perception, units: RoadsideUnits) -> "MixedPerception":
        """The perception of vehicles and units."""
        kinds = sorted(set(units.sensor))
        number = np.array([1 + kinds.index(sensor) for sensor in units.sensor])
        order = np.argsort(units.name_key)
        of_lidar = [vehicles]
        for sensor in kinds:
            of_units = Perception(
                city=vehicles.city,
                lidar=lidar_of(vehicles.lidar, sensor),
                detector=vehicles.detector,
                self_reports=vehicles.self_reports,
                seed=vehicles.seed,
                dt_s=vehicles.dt_s,
                weather=vehicles.weather,
            )
            of_lidar.append(of_units)
        return MixedPerception(
            of_lidar=tuple(of_lidar),
            unit_key=units.name_key[order],
            lidar_of_unit=number[order],
        )

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """As in `Perceives`."""
        images, seen = self.perceive(world, observers, watch)
        return self.observed(world, observers, images, seen, sort=True)

    def observed(
        self, world: World, observers: Int[ndarray, "e"], sweeps: Any, parts: Sequence[Seen], sort: bool = False
    ) -> Observed:
        """As in `Perception`."""
        return self.of_lidar[0].observed(world, observers, sweeps, parts, sort)

    def perceive(
        self,
        world: World,
        observers: Int[ndarray, "e"],
        watch: Stopwatch,
    ) -> tuple[MixedImages, list[Seen]]:
        """Images of the observers in these rows of the world, and what those of each LiDAR saw."""
        number_of = np.zeros(len(observers), np.int64)
        row = np.zeros(len(observers), np.int64)
        units = np.flatnonzero(world.is_roadside[observers])
        name_key = world.name_key[observers[units]]
        number_of[units] = self.lidar_of_unit[np.searchsorted(self.unit_key, name_key)]
        images: list[RangeImages] = []
        seen: list[Seen] = []
        for number, perception in enumerate(self.of_lidar):
            mine = np.flatnonzero(number_of == number)
            row[mine] = np.arange(len(mine))
            found, parts = perception.perceive(world, observers[mine], watch)
            images.append(found)
            seen += [part.renumbered(mine.astype(np.int32)) for part in parts]
        return MixedImages(tuple(images), number_of, row), seen

    def answers(self, sweeps: MixedImages, asked: BoxQuestions) -> BoxAnswers:
        """As in `Perceives`."""
        n_points = np.zeros(len(asked.counting), np.int32)
        plausible = np.ones(len(asked.testing), bool)
        for number, perception in enumerate(self.of_lidar):
            counting, testing, mine = asked.of_group(number, sweeps.lidar, sweeps.row)
            images = sweeps.of_lidar[number]
            n_points[counting], plausible[testing] = perception.answers(images, mine)
        return n_points, plausible

    def in_area(
        self,
        sweeps: MixedImages,
        o: Int[ndarray, "n"],
        boxes: Boxes,
        area: AreaParams,
        b: Int[ndarray, "n"],
        label: UInt8[ndarray, "boxes"],
        own: Boxes,
    ) -> Bool[ndarray, "n"]:
        """As in `Perceives`."""
        inside = np.zeros(len(o), bool)
        for number, images in enumerate(sweeps.of_lidar):
            k = np.flatnonzero(sweeps.lidar[o] == number)
            bodies = own.take(np.flatnonzero(sweeps.lidar == number))
            row = sweeps.row[o[k]]
            inside[k] = evidence.in_evaluation_area(images, row, boxes, area, b[k], label, bodies)
        return inside


def lidar_of(vehicles: LidarParams, sensor: ProfileName) -> LidarParams:
    """The LiDAR of a unit: another product on top of a mast, otherwise as on vehicles."""
    beams: dict[str, Any] = dict.fromkeys(("elevation_deg", "n_azimuths", "fov_deg"))
    return replace(vehicles, profile=sensor, mount_above_roof_m=0.0, **beams)


def check_lidars(vehicles: LidarParams, sensors: Sequence[ProfileName]) -> None:
    """Raise ValueError if a unit's LiDAR cannot be cast."""
    for sensor in sensors:
        lidar.beams(lidar_of(vehicles, sensor))
