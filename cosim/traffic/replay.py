"""Replayed traffic: a trace that SUMO wrote, or the tables of an earlier run."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.codes import OBJECT, PARKED
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.fcd import Timestep, is_observed, projection_of, timesteps
from cosim.traffic.frame import Frame, TrafficError
from cosim.traffic.georeference import Conversion, LaneCheck, NetLocation, TravelCheck, conversion
from cosim.traffic.identity import LEFT_OUT, UNKNOWN, Identities, TypeTable
from cosim.traffic.interpolation import LONGEST_S, Timeline, interval_s
from cosim.traffic.params import TrafficParams
from cosim.traffic.remarks import FlowCounts
from cosim.traffic.source import TrafficEnded, world_from_bumpers, world_of
from cosim.world import World
from sensors.scene import Shape
from sumo_nets import vtypes
from sumo_nets.vtypes import LARGEST_M, SMALLEST_M, check_size

if TYPE_CHECKING:
    from results.run import Run

_N_PROBED = 10
"""Timesteps from which the interval of a trace is measured."""


def opened(
    path: Path,
    net: NetLocation | None,
) -> tuple[list[Timestep], Iterator[Timestep], Conversion | None, str]:
    """The first timesteps of a trace, those behind them, and how its positions become those of the network, in words.

    A TrafficError is raised if nobody is ever on the road, or if the positions are known to be elsewhere.
    """
    read = timesteps(path)
    ahead = list(islice(read, _N_PROBED))
    if not any(timestep.names for timestep in ahead) and len(ahead) < _N_PROBED:
        raise TrafficError(f"{path}: an empty trace: no actor is ever on the road.")
    return ahead, read, *conversion(str(path), ahead, net, projection_of(path))


class _Replay:
    """What the replays of a trace and of a run have in common."""

    def __init__(self, source: Path, registry: ActorRegistry, dt_s: float, frame: Frame) -> None:
        self._source, self._registry, self._dt_s, self._frame = source, registry, dt_s, frame
        self._n_skipped = self._step = 0
        self._counts = FlowCounts(dt_s)

    def warm_up(self, seconds: float) -> Iterator[float]:
        """Skip the first `seconds`; yields the seconds done."""
        self._n_skipped = ceil(seconds / self._dt_s - 1e-6)  # as SUMO warms up
        yield seconds

    def command(self, actor: Int[ndarray, "c"], speed_mps: Float[ndarray, "c"]) -> None:
        """Refused: replayed traffic cannot be commanded. Raises a TrafficError if there is a command."""
        if len(actor):
            raise TrafficError(
                f"{self._source} is replayed: nothing can brake in it. Run SUMO by removing traffic.trace, or choose a "
                "driver that commands no speeds."
            )


class TraceReplay(_Replay):
    """Replays a trace that SUMO wrote with `--fcd-output`.

    Step 0 is the world before the trace's first timestep, as in a run with SUMO. Step s is the timestep at
    `begin + warm-up + (s - 1) * step_s`, because SUMO labels a step with the time at which it began. Recorded
    positions (`fcd.OBSERVED`) begin in traffic: their first timestep is step 0, unless `begin_s` is set.

    Between two timesteps of the trace, actors are interpolated (`interpolation`).

    Sizes and classes are those that the trace states, or those of the vehicle types that `files` define. For other
    types they are guessed from the name. Positions in degrees, and those of the map before the network's offset, become
    the network's (`georeference`).

    A name is one actor until it comes back as another type after an absence, or farther away than it can have driven.
    """

    def __init__(
        self,
        params: TrafficParams,
        path: Path,
        registry: ActorRegistry,
        files: tuple[Path, ...] = (),
        frame: Frame | None = None,
        net: NetLocation | None = None,
    ) -> None:
        super().__init__(path, registry, params.step_s, frame or Frame(str(path)))
        self._types = TypeTable(files)
        self._identities = Identities(params.step_s)
        self._left_out: dict[str, str] = {}
        self._untyped: set[str] = set()
        self._listed: list[str] | None = None
        """List of names of the timestep of which the rows and the numbers are."""
        self._rows = self._number = np.zeros(0, np.int64)
        ahead, self._read, self._convert, self._placed = opened(path, net)
        self._lanes = LaneCheck(net)
        self._travel = TravelCheck(str(path))  # before the interval is judged, whose unit may be wrong
        placed = list(self._placed_of(ahead))
        self._frame = self._frame.around(np.concatenate([timestep.front_m for timestep in placed]))
        every_s = interval_s(np.array([timestep.time_s for timestep in ahead])) or self._dt_s
        if every_s > max(LONGEST_S, self._dt_s) * (1 + 1e-3):
            raise TrafficError(
                f"{path} has a timestep every {every_s:g} s, and traffic.step_s = {self._dt_s:g} s is shorter. At most "
                f"{LONGEST_S:g} s are interpolated. Set traffic.step_s to a multiple of {every_s:g}, or record the "
                "trace with shorter timesteps."
            )
        self._travel = TravelCheck(str(path))
        read = self._placed_of(chain(ahead, self._read))
        was_observed = is_observed(path)
        self._timeline = Timeline(str(path), read, every_s, self._dt_s, was_observed)
        self._first_s = ahead[0].time_s
        self._begin_s = self._first_s + self._dt_s if was_observed else self._first_s
        if params.begin_s is not None:
            self._begin_s = params.begin_s
        self._asked_begin = params.begin_s is not None
        self._n_at_begin = 0  # actors at the first timestep, where step 0 lies before it

    def advance(self) -> World:
        """The world of the next step."""
        step, self._step = self._step, self._step + 1
        time_s = self._begin_s + (self._n_skipped + step - 1) * self._dt_s
        timestep = self._timeline.at(time_s)
        if timestep is None:
            raise TrafficEnded(self._end())
        self._frame = self._frame.around(timestep.front_m)
        if timestep.names is not self._listed:  # between two timesteps of the trace, the actors are the same
            self._rows, self._number = self._on_road(timestep, step)
            self._listed = timestep.names
        rows = self._rows
        world = world_from_bumpers(
            step,
            self._number,
            timestep.front_m[rows],
            timestep.compass_deg[rows],
            timestep.speed_mps[rows],
            self._registry,
            self._frame,
        )
        if step == 1 and time_s <= self._first_s:
            self._n_at_begin = len(world)
        self._counts.add(world)
        return world

    def skip_gap(self, most: float) -> int:
        """Pass the steps of an empty road between two timesteps, at most so many. Returns their number."""
        time_s = self._begin_s + (self._n_skipped + self._step - 2) * self._dt_s
        n = int(max(0, min(most, self._timeline.n_empty(time_s, self._dt_s))))
        self._step += n
        self._counts.n_steps += n
        return n

    def report(self) -> dict[str, Any]:
        n_left_out = Counter(self._left_out.values())
        report: dict[str, Any] = {"actors_left_out": dict(sorted(n_left_out.items()))}
        report |= self._counts.report() | self._timeline.report() | self._identities.report()
        if not (self._counts.n_vehicles or self._counts.n_pedestrians) and self._begin_s < self._first_s:
            report |= {"first_departure_s": self._first_s, "warmup_s": self._n_skipped * self._dt_s}
        if self._n_at_begin:
            report |= {"actors_at_trace_begin": self._n_at_begin, "trace_begin_s": self._first_s + self._dt_s}
        if self._types.guessed:
            report["types_guessed"] = dict(sorted(self._types.guessed.items()))
        if self._untyped:
            report["vehicles_without_type"] = len(self._untyped)
        if self._placed:
            report["trace_placed"] = self._placed
        ratio = self._travel.odd_ratio
        if ratio is not None:
            report["trace_travel_ratio"] = round(ratio, 4)
        aside_p = self._travel.aside_p
        if aside_p is not None:
            report["trace_aside_p"] = round(aside_p, 3)
        report |= self._lanes.report()
        return report | ({"origin_m": list(self._frame.origin_m)} if self._frame.is_around else {})

    def close(self) -> None:
        self._read.close()  # type: ignore[attr-defined]

    def _placed_of(self, read: Iterable[Timestep]) -> Iterator[Timestep]:
        """Timesteps with positions of the network."""
        for timestep in read:
            placed = timestep if self._convert is None or not timestep.names else self._convert(timestep)
            self._travel.add(placed)
            yield placed

    def _end(self) -> str:
        """Why the traffic ends, with what was skipped of it."""
        said = f"{self._source} goes from {self._first_s:g} s to {self._timeline.last_s:g} s"
        skipped_s = self._n_skipped * self._dt_s
        if self._asked_begin and self._begin_s > self._first_s:
            said += f", and traffic.begin_s = {self._begin_s:g} s"
        if skipped_s > self._dt_s:
            said += (
                f", and the warm-up skips {skipped_s:g} s of it. Set traffic.warmup_s = 0 to replay the trace from its "
                "begin"
            )
        return said

    def _on_road(
        self,
        timestep: Timestep,
        step: int,
    ) -> tuple[Int[ndarray, "m"], Int[ndarray, "m"]]:
        """Rows of the timestep that are on the road, and their actor numbers. New actors are registered."""
        shape = self._types.shapes(timestep.types, timestep.is_person, timestep.vclasses)
        for row in np.flatnonzero(shape == LEFT_OUT).tolist():
            self._left_out.setdefault(timestep.names[row], self._type_of(timestep, row).vclass)
        rows = np.flatnonzero((shape != LEFT_OUT) & ~_inside_vehicle(timestep, shape))
        names = [timestep.names[row] for row in rows.tolist()]
        types = [timestep.types[row] for row in rows.tolist()]
        keys = list(zip(names, (shape == Shape.PEDESTRIAN)[rows].tolist(), strict=True))
        if len(set(keys)) < len(keys):
            name = Counter(keys).most_common(1)[0][0][0]
            hint = "" if any(types) else " A vehicle and a person of one name need the column type."
            raise TrafficError(
                f"{self._source}: {name!r} occurs twice at {timestep.time_s:g} s. Remove the copies.{hint}"
            )
        front_m = timestep.front_m[rows]
        self._check_frame(step, names, front_m)
        xy_m = front_m[:, :2]
        number = self._identities.numbers(keys, types, xy_m, step)
        new = np.flatnonzero(number == UNKNOWN)
        if new.size:
            new_rows = rows[new]
            number[new] = self._register(timestep, new_rows, shape[new_rows], step)
        return rows, number

    def _check_frame(self, step: int, names: list[str], front_m: Float[ndarray, "n 3"]) -> None:
        """Refuse positions far outside before they could be those of another actor of the name."""
        zero = np.zeros(len(names))
        xyz_m = front_m - np.array([*self._frame.origin_m, 0.0])
        self._frame.check(step, names, np.arange(len(names)), xyz_m, zero, zero)

    def _register(
        self, timestep: Timestep, rows: Int[ndarray, "k"], shape: Int[ndarray, "k"], step: int
    ) -> Int[ndarray, "k"]:
        names = [timestep.names[row] for row in rows.tolist()]
        types = [timestep.types[row] for row in rows.tolist()]
        of_types_m = [self._type_of(timestep, row).lwh_m for row in rows.tolist()]
        keys = list(zip(names, (shape == Shape.PEDESTRIAN).tolist(), strict=True))
        lwh_m = np.array(of_types_m, float).reshape(-1, 3)
        if timestep.lwh_m is not None:
            own_m = timestep.lwh_m[rows]
            large = np.argwhere(own_m > tuple(LARGEST_M.values()))
            if large.size:
                row, axis = large[0].tolist()
                what = tuple(LARGEST_M)[axis]
                found_m = own_m[row, axis]
                raise TrafficError(
                    f"{self._source}: {names[row]!r} has {what} = {found_m:g} m; at most "
                    f"{LARGEST_M[what]:g} m are possible. Correct the trace."
                )
            lwh_m = np.where(own_m >= SMALLEST_M, own_m, lwh_m)
        is_motorised = np.isin(shape, (Shape.CAR, Shape.TRUCK))
        self._lanes.add(timestep.front_m[rows[is_motorised]])
        for row, (name, is_person), of in zip(rows.tolist(), keys, types, strict=True):
            if not (of or is_person or (timestep.vclasses and timestep.vclasses[row])):
                self._untyped.add(name)
        shown = self._identities.names(keys)
        number = self._registry.register(shown, shape.astype(np.uint8), lwh_m, step)
        self._identities.add(keys, types, timestep.front_m[rows, :2], number, step)
        return number

    def _type_of(self, timestep: Timestep, row: int) -> vtypes.VehicleType:
        vclass = "" if timestep.vclasses is None else timestep.vclasses[row]
        return self._types(timestep.types[row], bool(timestep.is_person[row]), vclass)


def _inside_vehicle(timestep: Timestep, shape: Int[ndarray, "n"]) -> Bool[ndarray, "n"]:
    """Persons at the exact position of a vehicle. They ride in it, and a run with SUMO does not contain them."""
    is_person = shape == Shape.PEDESTRIAN
    if not is_person.any():
        return is_person
    position = timestep.front_m[:, 0] + 1j * timestep.front_m[:, 1]
    return is_person & np.isin(position, position[~is_person])


_OF_RECORDED = (
    "vehicles_waiting_to_enter_at_end",
    "teleports",
    "actors_left_out",
    "origin_m",
    "sumo_errors",
    "sumo_warnings",
)
"""What a replay's summary has of the run that is replayed."""


class RunReplay(_Replay):
    """Replays the tables `actors` and `vehicles` of an earlier run. The worlds are the same, bit for bit."""

    def __init__(
        self,
        params: TrafficParams,
        folder: Path,
        registry: ActorRegistry,
        frame: Frame | None = None,
        inputs_changed: Sequence[str] = (),
        net: NetLocation | None = None,
    ) -> None:
        """Open the run. `inputs_changed` are files of the scenario that have changed since it was recorded."""
        from results.archive import open_run  # imported here because pandas takes its time

        run = open_run(folder)
        super().__init__(run.path, registry, params.step_s, frame or Frame(f"traffic.trace = {folder}"))
        self._inputs_changed = list(inputs_changed)
        self._lanes = LaneCheck(net)
        run.require("actors", "vehicles")
        every = params.step_s / run.dt_s
        if abs(every - round(every)) > 1e-9 or every < 1 - 1e-9:
            raise ValueError(
                f"{folder} was recorded every {run.dt_s:g} s, and traffic.step_s = {params.step_s:g} s is no multiple "
                "of it. Set traffic.step_s to a multiple."
            )
        if params.begin_s is not None:
            raise ValueError(
                "traffic.begin_s cannot be set if a run is replayed, because the replay begins where the run began. "
                "Set traffic.warmup_s to skip its first seconds."
            )
        vehicles = run.table("vehicles").sort_values("vehicle")
        self._names = vehicles.sumo_id.tolist()
        n_objects = len(run.manifest["config"].get("objects", ()))
        placed = [f"{OBJECT}{i}" for i in range(n_objects)]
        self._is_traffic = ~vehicles.sumo_id.isin(placed).to_numpy(bool)  # the new config has its own objects
        if run.manifest["config"].get("parked", {}).get("per_100_m"):
            self._is_traffic &= ~vehicles.sumo_id.str.startswith(PARKED).to_numpy(bool)
        shapes = [Shape[name.upper()] for name in vehicles.vehicle_class]
        self._shape = np.array(shapes, np.uint8)
        self._lwh_m = vehicles[["length_m", "width_m", "height_m"]].to_numpy(float)
        for name, sizes in zip(self._names, self._lwh_m.tolist(), strict=True):
            for what, size in zip(("length", "width", "height"), sizes, strict=True):
                check_size(f"{folder}: vehicle {name!r}", what, size)
        self._number = np.full(len(vehicles), UNKNOWN, np.int32)
        self._run = run
        self._every = round(every)
        self._steps = _steps_of(run)
        self._ahead: tuple[int, dict[str, ndarray]] | None = None

    def advance(self) -> World:
        """The world of the next step."""
        step, self._step = self._step, self._step + 1
        wanted = (self._n_skipped + step) * self._every
        n_steps = self._run.manifest["steps"]
        if wanted >= n_steps:
            raise TrafficEnded(f"{self._source} ends after {n_steps * self._run.dt_s:g} s")
        rows = self._at(wanted)
        is_traffic = self._is_traffic[rows["actor"]]
        rows = {name: column[is_traffic] for name, column in rows.items()}
        actor = rows["actor"]
        new = actor[self._number[actor] == UNKNOWN]
        if len(new):
            names = [self._names[i] for i in new.tolist()]
            numbers = self._registry.register(names, self._shape[new], self._lwh_m[new], step)
            self._number[new] = numbers
            is_car = np.isin(self._shape[actor], (Shape.CAR, Shape.TRUCK))
            xyz_m = rows["xyz_m"][is_car & np.isin(actor, new)]
            self._lanes.add(xyz_m + [*self._frame.origin_m, 0.0])
        number = self._number[actor]
        order = np.argsort(number)
        number = number[order]
        xyz_m, yaw_rad, speed = (rows[name][order] for name in ("xyz_m", "yaw_rad", "speed_mps"))
        world = world_of(step, number, xyz_m, yaw_rad, speed, self._registry, self._frame)
        self._counts.add(world)
        return world

    def report(self) -> dict[str, Any]:
        """Counts of the run that is replayed."""
        summary = self._run.manifest.get("summary", {})
        known = [name for name in _OF_RECORDED if name in summary]
        report: dict[str, Any] = {name: summary[name] for name in known}
        report |= self._counts.report() | self._lanes.report()
        return report | ({"inputs_changed": self._inputs_changed} if self._inputs_changed else {})

    def close(self) -> None:
        self._steps.close()  # type: ignore[attr-defined]

    def _at(self, step: int) -> dict[str, ndarray]:
        while self._ahead is None or self._ahead[0] < step:
            self._ahead = next(self._steps, None)
            if self._ahead is None:
                break
        if self._ahead is None or self._ahead[0] > step:  # the road was empty
            none = np.zeros(0)
            return {"actor": none.astype(np.int32), "xyz_m": none.reshape(0, 3), "yaw_rad": none, "speed_mps": none}
        return self._ahead[1]


def _steps_of(run: "Run") -> Iterator[tuple[int, dict[str, ndarray]]]:
    """Read the table `actors` step by step. One block of the table is in memory at a time."""
    for part in run.parts("actors"):
        step = part.step.to_numpy()
        columns = {
            "actor": part.actor.to_numpy(),
            "xyz_m": part[["x_m", "y_m", "z_m"]].to_numpy(float),
            "yaw_rad": part.yaw_rad.to_numpy(float),
            "speed_mps": part.speed_mps.to_numpy(float),
        }
        cuts = np.flatnonzero(np.diff(step)) + 1
        begins, ends = np.append(0, cuts), np.append(cuts, len(step))
        for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
            of_step = {name: column[begin:end] for name, column in columns.items()}
            yield int(step[begin]), of_step
