"""What an export is made from: the chosen vehicles and steps of a run, and its tables step by step.

An export plans its files from a `Selection` (`Plan`: units of files that are written together). It makes the content of
each file from the `Moment` of a step. The exporters are in `cosim.addons.export`.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import cast

import numpy as np
import pandas as pd
import pyarrow.compute as pc
from jaxtyping import Float, Float32, Int
from numpy import ndarray

from cosim.base.earth import Projection
from cosim.base.plane import turned_by
from cosim.base.ragged import differs_from_last
from results.run import Run
from results.sensing import senses

BOX = ["x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad"]
"""Columns of a box: centre, size and heading, world frame."""
UNIT_STEPS = 20
"""Steps of one unit of work: what is done again after an interruption."""

Cloud = Callable[[], Float32[ndarray, "k 3"]]
"""Makes the returns of one sweep, in the sensor's frame [m], in any thread."""

Clouds = Callable[[int, Sequence[int]], list[Cloud]]
"""Sweeps the LiDARs of some vehicles in a step again."""


@dataclass(frozen=True, slots=True)
class Visible:
    """Actors that a vehicle's LiDAR could have seen in a step, sorted by number."""

    actor: Int[ndarray, "m"]
    n_points: Int[ndarray, "m"]
    """Returns of the actor in the vehicle's sweep."""
    n_unoccluded: Int[ndarray, "m"]
    """Returns that there would be if nothing stood before the actor."""


NOTHING = Visible(*(np.zeros(0, np.int64) for _ in range(3)))


@dataclass(frozen=True, slots=True)
class File:
    """One file to write: its path below the folder, and what makes its content, in any thread."""

    path: str
    content: Callable[[], bytes]
    same_as: str = ""
    """Another file of the export with the same content: this one becomes a link to it."""


@dataclass(frozen=True, slots=True)
class Unit:
    """Files that are made together; a unit is done as a whole or again."""

    name: str
    files: Callable[[Clouds], Iterator[File]]


@dataclass(frozen=True, slots=True)
class Plan:
    """What an export will write."""

    units: tuple[Unit, ...]
    n_sweeps: int = 0
    bytes_per_point: int = 0
    text_bytes: float = 0.0
    """Estimated length of all that is no point cloud [B]."""
    remarks: tuple[str, ...] = ()
    """What the user should know of what is not written, one sentence each."""

    @staticmethod
    def of_files(files: Iterable[File]) -> "Plan":
        """A plan for a few files, which are written together."""
        listed = tuple(files)
        return Plan((Unit("files", lambda clouds: iter(listed)),))


@dataclass(frozen=True, slots=True)
class Moment:
    """All actors of one step, world frame, sorted by number; and what vehicles detected and could see."""

    step: int
    actor: Int[ndarray, "n"]
    vehicle_class: ndarray
    box: Float[ndarray, "n 7"]
    """Columns as `BOX`."""
    speed_mps: Float[ndarray, "n"]
    detections: Mapping[int, pd.DataFrame]
    """By vehicle: its list as transmitted, self report included."""
    visible: Mapping[int, Visible]
    """By vehicle."""
    pose_error: Mapping[int, Float[ndarray, "3"]] = field(default_factory=dict)
    """By vehicle: where it takes itself to be, less where it is: east, north [m] and heading [rad]. None for exact
    poses."""

    def row(self, actor: int) -> int:
        """Row of an actor that is on the road."""
        at = int(np.searchsorted(self.actor, actor))
        is_here = at < len(self.actor) and self.actor[at] == actor
        assert is_here, f"actor {actor} is not on the road"
        return at


def at_steps(steps: ndarray) -> pc.Expression:
    """Filter for the rows of these steps."""
    return pc.field("step").isin(steps.tolist())


def units_of_steps(
    blocks: Iterable[Int[ndarray, "b"]],
    files: Callable[..., Iterator[File]],
) -> list[Unit]:
    """A unit of work for each block of steps, whose files are `files(steps, clouds)`."""
    units = []
    for steps in blocks:
        name = f"steps {steps[0]} to {steps[-1]}"
        units.append(Unit(name, partial(files, steps)))
    return units


def _no_projection() -> Projection:
    raise ValueError("the run does not say where on Earth it is.")


def _no_buildings() -> Float[ndarray, "0 3 3"]:
    return np.zeros((0, 3, 3))


@dataclass(frozen=True, slots=True)
class Place:
    """What surrounds the traffic."""

    origin_m: tuple[float, float] = (0.0, 0.0)
    """The world's origin in the coordinates of the network [m]."""
    buildings: Callable[[], Float[ndarray, "t 3 3"]] = _no_buildings
    """Triangles of all buildings, world frame [m]."""


@dataclass(frozen=True)
class Selection:
    """Vehicles with a LiDAR, in the order asked for, and steps in which they sense, in ascending order."""

    run: Run
    vehicles: tuple[int, ...]
    steps: Int[ndarray, "s"]
    road_edge_m: Callable[[Float[ndarray, "n 2"]], Float[ndarray, "n"]]
    """Distance of points to the edge of the road, positive on it."""
    projection: Callable[[], Projection] = _no_projection
    """Where on Earth the world frame is; ValueError in one line where that is not known."""
    place: Place = field(default_factory=Place)
    named: bool = False
    """Whether the vehicles were named one by one, and are not simply all."""

    @cached_property
    def presence(self) -> pd.DataFrame:
        """(step, vehicle) of every chosen vehicle that senses, sorted; the frames of an export."""
        is_chosen = pc.field("actor").isin(list(self.vehicles))
        found = self.run.table("actors", ["step", "actor"], is_chosen & at_steps(self.steps))
        found = found.rename(columns={"actor": "vehicle"})
        found = found.astype({"step": np.int64, "vehicle": np.int64})
        found = found[senses(self.run, found.step.to_numpy(), found.vehicle.to_numpy())]
        return found.sort_values(["step", "vehicle"], ignore_index=True)

    @property
    def above_roof_m(self) -> float:
        """Height of the LiDAR over the roof."""
        return float(self.run.config["lidar"]["mount_above_roof_m"])

    def pose(self, moment: Moment, vehicle: int) -> Float[ndarray, "4"]:
        """Pose of a vehicle's LiDAR.

        Returns
        -------
        x, y, z [m] and yaw [rad], world frame.
        """
        return sensor_pose(moment.box[moment.row(vehicle)], self.above_roof_m)

    def believed_pose(self, moment: Moment, vehicle: int) -> Float[ndarray, "4"]:
        """Pose where a vehicle takes its LiDAR to be, as `pose` returns it.

        The boxes that it transmits are relative to this one: seen from here, they are where the LiDAR measured them.
        """
        pose = self.pose(moment, vehicle)
        error = moment.pose_error.get(vehicle)
        if error is not None:
            pose[[0, 1, 3]] += error
        return pose

    def blocks(self) -> list[Int[ndarray, "b"]]:
        """The steps with a frame, by unit of work.

        Returns
        -------
        Ascending steps, at most `UNIT_STEPS` in each array.
        """
        return _in_units(np.unique(self.presence.step))

    def spans(self) -> list[Int[ndarray, "b"]]:
        """All chosen steps, whether or not a chosen vehicle is on the road, at most `UNIT_STEPS` in each array."""
        return _in_units(self.steps)

    @cached_property
    def bodies(self) -> pd.DataFrame:
        """Class and size of every actor, by number."""
        columns = ["vehicle", "vehicle_class", "length_m", "width_m", "height_m"]
        return self.run.table("vehicles", columns).set_index("vehicle")

    def moments(self, steps: Int[ndarray, "b"]) -> Iterator[Moment]:
        """The moments of some steps, one after another. The tables of all these steps are in memory together.

        Parameters
        ----------
        steps
            Steps in any order. The moments come in ascending order; that of a step without actors is empty.
        """
        where = at_steps(steps)
        detections = self._detections(where)
        seen_by = pc.field("observer").isin(list(self.vehicles))
        visible = self.run.table("observability", where=where & seen_by)
        of_step = _by_number(detections, "step")
        visible_of_step = _visible(visible)
        errors = self._pose_errors(where)
        for moment in self.traffic(steps):
            of_vehicle = _by_number(of_step.get(moment.step, detections[:0]), "vehicle")
            yield replace(
                moment,
                detections=of_vehicle,
                visible=visible_of_step.get(moment.step, {}),
                pose_error=errors.get(moment.step, {}),
            )

    def traffic(self, steps: Int[ndarray, "b"]) -> Iterator[Moment]:
        """Like `moments`, but the actors alone: nothing is detected or visible."""
        actors = self.run.table("actors", where=at_steps(steps)).sort_values(["step", "actor"])
        actors = actors.join(self.bodies, on="actor")
        of_step = _by_number(actors, "step")
        for step in np.sort(steps).tolist():
            rows = of_step.get(step, actors[:0])
            yield Moment(
                step=step,
                actor=rows.actor.to_numpy(np.int64),
                vehicle_class=rows.vehicle_class.astype(object).to_numpy(),
                box=rows[BOX].to_numpy(float),
                speed_mps=rows.speed_mps.to_numpy(float),
                detections={},
                visible={},
            )

    def _pose_errors(self, where: pc.Expression) -> dict[int, dict[int, ndarray]]:
        """Errors of the estimated poses of the chosen vehicles, by step and vehicle; none where poses are exact."""
        if "position_errors" not in self.run.tables:
            return {}
        chosen = pc.field("vehicle").isin(list(self.vehicles))
        rows = self.run.table("position_errors", where=where & chosen)
        error = rows[["error_x_m", "error_y_m", "error_yaw_rad"]].to_numpy(float)
        found: dict[int, dict[int, ndarray]] = {}
        for step, vehicle, of_vehicle in zip(rows.step.tolist(), rows.vehicle.tolist(), error, strict=True):
            found.setdefault(step, {})[vehicle] = of_vehicle
        return found

    def _detections(self, where: pc.Expression) -> pd.DataFrame:
        """Lists of the chosen vehicles as transmitted, with the vehicle beside the pseudonym."""
        vehicle_of = self.run.subjects.vehicle  # by pseudonym
        pseudonyms = vehicle_of[vehicle_of.isin(list(self.vehicles))].index.tolist()
        columns = ["step", "observer", "detection_index", "class", *BOX, "score", "n_points", "origin", "transmitted"]
        found = self.run.table("detections", columns, where & pc.field("observer").isin(pseudonyms))
        found = found[found.transmitted]
        return found.assign(vehicle=found.observer.map(vehicle_of).astype(np.int64))


def _in_units(steps: Int[ndarray, "s"]) -> list[Int[ndarray, "b"]]:
    return [steps[i : i + UNIT_STEPS] for i in range(0, len(steps), UNIT_STEPS)]


def _by_number(rows: pd.DataFrame, column: str) -> dict[int, pd.DataFrame]:
    """Rows by the number in a column, in ascending order."""
    return {int(cast(int, number)): some for number, some in rows.groupby(column)}


def _visible(rows: pd.DataFrame) -> dict[int, dict[int, Visible]]:
    """Rows of the table `observability`, by step and vehicle."""
    rows = rows.sort_values(["step", "observer", "actor"])
    step = rows.step.to_numpy(np.int64)
    observer = rows.observer.to_numpy(np.int64)
    columns = [rows[name].to_numpy(np.int64) for name in ("actor", "n_points", "n_unoccluded")]
    begins = np.flatnonzero(differs_from_last(step) | differs_from_last(observer))
    ends = np.append(begins, len(step))[1:]  # none of an empty table, which has no `begins`
    found: dict[int, dict[int, Visible]] = {}
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        of_step = found.setdefault(int(step[begin]), {})
        seen = [column[begin:end] for column in columns]
        of_step[int(observer[begin])] = Visible(*seen)
    return found


def sensor_pose(box: Float[ndarray, "7"], above_roof_m: float) -> Float[ndarray, "4"]:
    """Pose of a vehicle's LiDAR, which stands over the middle of the roof.

    Parameters
    ----------
    box
        The vehicle's box, world frame.
    above_roof_m
        Height of the LiDAR over the roof.

    Returns
    -------
    x, y, z [m] and yaw [rad], world frame.
    """
    x, y, z, _, _, height_m, yaw = box
    return np.array([x, y, z + 0.5 * height_m + above_roof_m, yaw])


def corners_of(box: Float[ndarray, "n 7"]) -> Float[ndarray, "n 8 3"]:
    """The eight corners of each box, as data sets of OpenCOOD list them: four below, then four above."""
    around = ((0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5))
    up = np.repeat([-0.5, 0.5], 4)
    half = np.column_stack([(*around, *around), up])
    corner = half * box[:, None, 3:6]  # in the frame of each box
    corner[..., :2] = turned_by(box[:, None, 6], corner)
    return corner + box[:, None, :3]
