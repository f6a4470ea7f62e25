"""Replayed traffic: a trace that SUMO wrote, or the tables of an earlier run."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.mobility.actors import ActorRegistry
from cosim.mobility.fcd import Timestep, timesteps
from cosim.mobility.frame import Frame, TrafficError
from cosim.mobility.interpolation import LONGEST_S, interpolated
from cosim.mobility.objects import PREFIX
from cosim.mobility.params import TrafficParams
from cosim.mobility.remarks import FlowCounts
from cosim.mobility.source import SHAPE_OF_CLASS, TrafficEnded, world_from_bumpers, world_of
from cosim.mobility.streetside import PARKED
from cosim.world import World
from results.archive import open_run
from results.run import Run
from sensors.scene import Shape
from sumo_nets import vtypes
from sumo_nets.vtypes import check_size

_UNKNOWN, _LEFT_OUT = -2, -1
_TOLERANCE_S = 1e-4
_N_PROBED = 10
"""Timesteps from which the interval of a trace is measured."""


class _Replay:
    """What the replays of a trace and of a run have in common."""

    def __init__(self, source: Path, registry: ActorRegistry, dt_s: float, frame: Frame) -> None:
        self._source, self._registry, self._dt_s, self._frame = source, registry, dt_s, frame
        self._n_skipped = self._step = 0
        self._counts = FlowCounts(dt_s)

    def warm_up(self, seconds: float) -> Iterator[float]:
        """Skip the first `seconds`; yields the seconds done."""
        self._n_skipped = round(seconds / self._dt_s)
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
    `begin + warm-up + (s - 1) * step_s`, because SUMO labels a step with the time at which it began.

    If the trace's timesteps are longer than `step_s`, actors are interpolated between them (`interpolation`).

    Sizes and classes come from the vehicle types that `files` define. For other types they are guessed from the name.
    """

    def __init__(
        self,
        params: TrafficParams,
        path: Path,
        registry: ActorRegistry,
        files: tuple[Path, ...] = (),
        frame: Frame | None = None,
    ) -> None:
        super().__init__(path, registry, params.step_s, frame or Frame(str(path)))
        self._types = types_of(files)
        self._shape_of = cache(partial(_shape_of, self._types))
        self._number: dict[tuple[str, bool], int] = {}
        self._left_out: dict[str, str] = {}
        self._rows_of: tuple[list[str], Int[ndarray, "m"], Int[ndarray, "m"]] | tuple[None, None, None] = (
            None,
            None,
            None,
        )
        self._timesteps = timesteps(path)
        self._ahead = [timestep for _, timestep in zip(range(_N_PROBED), self._timesteps, strict=False)]
        if not any(timestep.names for timestep in self._ahead) and len(self._ahead) < _N_PROBED:
            raise TrafficError(f"{path}: an empty trace: no actor is ever on the road.")
        self._frame = self._frame.around(np.concatenate([timestep.front_m for timestep in self._ahead]))
        times_s = np.array([timestep.time_s for timestep in self._ahead])
        every_s = np.diff(times_s).min() if len(times_s) > 1 else self._dt_s
        steps = self._dt_s / every_s
        if steps > 1 - 1e-3:
            fits, self._interpolated_s = abs(steps - round(steps)) < 1e-3, None
        else:
            fits = abs(1 / steps - round(1 / steps)) < 1e-3 and every_s < LONGEST_S + 1e-3
            self._interpolated_s = float(every_s)
        if not fits:
            raise TrafficError(
                f"{path} has a timestep every {every_s:g} s, and traffic.step_s = {self._dt_s:g} s is no multiple of "
                f"it, and no fraction of it either{'' if every_s < LONGEST_S + 1e-3 else ' that is interpolated'}. Set "
                "traffic.step_s to a multiple, or record the trace with shorter timesteps."
            )
        if self._interpolated_s is not None:
            self._timesteps = interpolated(chain(self._ahead, self._timesteps), every_s, round(1 / steps))
            self._ahead = []
        self._begin_s = float(times_s[0]) if params.begin_s is None else params.begin_s
        self._last_s = self._begin_s

    def advance(self) -> World:
        """The world of the next step."""
        step, self._step = self._step, self._step + 1
        timestep = self._at(self._begin_s + (self._n_skipped + step - 1) * self._dt_s)
        self._frame = self._frame.around(timestep.front_m)
        if timestep.names is not self._rows_of[0]:  # between two timesteps of the trace, the actors are the same
            self._rows_of = timestep.names, *self._on_road(timestep, step)
        _, rows, number = self._rows_of
        world = world_from_bumpers(
            step, number, timestep.front_m[rows], timestep.compass_deg[rows], timestep.speed_mps[rows],
            self._registry, self._frame,
        )  # fmt: skip
        return self._counts.add(world)

    def report(self) -> dict[str, Any]:
        report: dict[str, Any] = {"actors_left_out": dict(sorted(Counter(self._left_out.values()).items()))}
        report |= self._counts.report()
        if self._interpolated_s is not None:
            report["trace_interpolated_s"] = self._interpolated_s
        return report | ({"origin_m": list(self._frame.origin_m)} if self._frame.is_around else {})

    def close(self) -> None:
        self._timesteps.close()  # type: ignore[attr-defined]

    def _at(self, time_s: float) -> Timestep:
        while True:
            if not self._ahead and (timestep := next(self._timesteps, None)) is not None:
                self._ahead.append(timestep)
            if not self._ahead:
                raise TrafficEnded(f"{self._source} ends at {self._last_s:g} s")
            first = self._ahead[0]
            if first.time_s > time_s + _TOLERANCE_S:  # the road was empty, and a timestep without actors has no row
                return Timestep(time_s, [], [], np.zeros((0, 3)), np.zeros(0), np.zeros(0))
            self._ahead.pop(0)
            self._last_s = first.time_s
            if first.time_s > time_s - _TOLERANCE_S:
                return first

    def _on_road(self, timestep: Timestep, step: int) -> tuple[Int[ndarray, "m"], Int[ndarray, "m"]]:
        """Rows of the timestep that are on the road, and their actor numbers. New actors are registered."""
        shape = np.fromiter(map(self._shape_of, timestep.types), np.int16, len(timestep.types))
        for row in np.flatnonzero(shape == _LEFT_OUT).tolist():
            self._left_out.setdefault(timestep.names[row], self._types(timestep.types[row]).vclass)
        rows = np.flatnonzero((shape != _LEFT_OUT) & ~_inside_vehicle(timestep, shape))
        is_person = (shape == Shape.PEDESTRIAN)[rows].tolist()
        keys = list(zip([timestep.names[row] for row in rows.tolist()], is_person, strict=True))
        number = self._numbers(keys)
        if (new := np.flatnonzero(number == _UNKNOWN)).size:
            self._register(timestep, rows[new], shape, step)
            number = self._numbers(keys)
        values, n = np.unique(number, return_counts=True)
        if len(values) < len(number):
            name = keys[int(np.flatnonzero(number == values[n > 1][0])[0])][0]
            raise TrafficError(f"{self._source}: {name!r} occurs twice at {timestep.time_s:g} s. Remove the copies.")
        return rows, number

    def _numbers(self, keys: list[tuple[str, bool]]) -> Int[ndarray, "n"]:
        return np.fromiter(map(self._number.get, keys, repeat(_UNKNOWN)), np.int32, len(keys))

    def _register(self, timestep: Timestep, rows: Int[ndarray, "k"], shape: Int[ndarray, "n"], step: int) -> None:
        names = {(timestep.names[row], bool(shape[row] == Shape.PEDESTRIAN)): row for row in rows.tolist()}
        lwh_m = np.array([self._types(timestep.types[row]).lwh_m for row in names.values()], float).reshape(-1, 3)
        shapes = shape[list(names.values())].astype(np.uint8)
        numbers = self._registry.register([name for name, _ in names], shapes, lwh_m, step)
        self._number.update(zip(names, numbers.tolist(), strict=True))


def _shape_of(types: Callable[[str], vtypes.VehicleType], name: str) -> int:
    """The shape code of a vehicle type, or `_LEFT_OUT` if its vehicles are not on the road."""
    shape = SHAPE_OF_CLASS.get(types(name).vclass)
    return _LEFT_OUT if shape is None else int(shape)


def _inside_vehicle(timestep: Timestep, shape: Int[ndarray, "n"]) -> Bool[ndarray, "n"]:
    """Persons at the exact position of a vehicle. They ride in it, and a run with SUMO does not contain them."""
    is_person = shape == Shape.PEDESTRIAN
    if not is_person.any():
        return is_person
    position = timestep.front_m[:, 0] + 1j * timestep.front_m[:, 1]
    return is_person & np.isin(position, position[~is_person])


class RunReplay(_Replay):
    """Replays the tables `actors` and `vehicles` of an earlier run. The worlds are the same, bit for bit."""

    def __init__(
        self,
        params: TrafficParams,
        folder: Path,
        registry: ActorRegistry,
        frame: Frame | None = None,
        inputs_changed: Sequence[str] = (),
    ) -> None:
        """Open the run. `inputs_changed` are files of the scenario that have changed since it was recorded."""
        run = open_run(folder)
        super().__init__(run.path, registry, params.step_s, frame or Frame(f"traffic.trace = {folder}"))
        self._inputs_changed = list(inputs_changed)
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
        placed = [f"{PREFIX}{i}" for i in range(len(run.manifest["config"].get("objects", ())))]
        self._is_traffic = ~vehicles.sumo_id.isin(placed).to_numpy(bool)  # the new config has its own objects
        if run.manifest["config"].get("parked", {}).get("per_100_m"):
            self._is_traffic &= ~vehicles.sumo_id.str.startswith(PARKED).to_numpy(bool)
        self._shape = np.array([Shape[k.upper()] for k in vehicles.vehicle_class], np.uint8)
        self._lwh_m = vehicles[["length_m", "width_m", "height_m"]].to_numpy(float)
        for name, sizes in zip(self._names, self._lwh_m.tolist(), strict=True):
            for what, size in zip(("length", "width", "height"), sizes, strict=True):
                check_size(f"{folder}: vehicle {name!r}", what, size)
        self._number = np.full(len(vehicles), _UNKNOWN, np.int32)
        self._run = run
        self._every = round(every)
        self._steps = _steps_of(run)
        self._ahead: tuple[int, dict[str, ndarray]] | None = None

    def advance(self) -> World:
        """The world of the next step."""
        step, self._step = self._step, self._step + 1
        wanted = (self._n_skipped + step) * self._every
        if wanted >= self._run.manifest["steps"]:
            raise TrafficEnded(f"{self._source} ends after {self._run.manifest['steps'] * self._run.dt_s:g} s")
        rows = self._at(wanted)
        actor = rows["actor"]
        if not self._is_traffic.all():
            rows = {name: column[self._is_traffic[actor]] for name, column in rows.items()}
            actor = rows["actor"]
        new = actor[self._number[actor] == _UNKNOWN]
        if len(new):
            names = [self._names[i] for i in new.tolist()]
            self._number[new] = self._registry.register(names, self._shape[new], self._lwh_m[new], step)
        number = self._number[actor]
        order = np.argsort(number)
        number = number[order]
        xyz_m, yaw_rad, speed = (rows[name][order] for name in ("xyz_m", "yaw_rad", "speed_mps"))
        return self._counts.add(world_of(step, number, xyz_m, yaw_rad, speed, self._registry, self._frame))

    def report(self) -> dict[str, Any]:
        """Counts of the run that is replayed."""
        summary = self._run.manifest.get("summary", {})
        report: dict[str, Any] = {n: summary[n] for n in ("teleports", "actors_left_out") if n in summary}
        report |= self._counts.report()
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


def _steps_of(run: Run) -> Iterator[tuple[int, dict[str, ndarray]]]:
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
            yield int(step[begin]), {name: column[begin:end] for name, column in columns.items()}


def types_of(files: tuple[Path, ...]):
    """A function that finds vehicle types by name. It reads the next file only if a type is not known yet."""
    known: dict[str, vtypes.VehicleType] = {}
    left = list(files)

    @cache
    def look_up(name: str) -> vtypes.VehicleType:
        while name not in known and left:
            known.update(vtypes.read([left.pop(0)]))
        return known.get(name) or vtypes.guess(name)

    return look_up
