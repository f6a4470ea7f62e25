"""Traffic by SUMO, through libsumo. A process can run one SUMO simulation at a time."""

import os
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain, compress, repeat
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.traffic.actors import ActorRegistry
from cosim.traffic.car_following import YELLOW_MPS2, calibrated
from cosim.traffic.frame import Frame, TrafficError
from cosim.traffic.lane_lines import LaneLines
from cosim.traffic.params import TrafficParams
from cosim.traffic.remarks import FlowCounts
from cosim.traffic.scratch import Scratch
from cosim.traffic.source import SHAPE_OF_CLASS, TrafficEnded, world_from_bumpers
from cosim.world import LanePaths, World
from sumo_nets import sumocfg
from sumo_nets.catalogue import bounds_m
from sumo_nets.sumocfg import first_departure_s
from sumo_nets.vtypes import check_size

_UNKNOWN, _LEFT_OUT = -2, -1
_NO_POSITION_M = -1e9
"""An actor without a position has a smaller coordinate in SUMO (-2^30)."""
_LOOK_AHEAD_M = 150.0
"""Lane paths reach this far beyond the end of a vehicle's current lane, or to the end of its route."""
_KNOWN_WAYS = 100_000
"""Number of lane paths that are kept in memory. If there are more, the memory is cleared."""
_REGARD_MAX_DECELERATION = 4
"""Bit of SUMO's speed mode that keeps the vehicle's largest deceleration."""


@dataclass(slots=True)
class _Domain:
    """Vehicles or persons: libsumo's functions for them, and the actor number of each name."""

    name: str
    number: dict[str, int] = field(default_factory=dict)
    getter: dict[str, Callable[[str], Any]] = field(init=False)

    def __post_init__(self) -> None:
        what = ("Position3D", "Angle", "Speed", "VehicleClass", "Length", "Width", "Height")
        self.getter = {name: getattr(getattr(libsumo, self.name), f"get{name}") for name in what}

    def present(self) -> tuple[str, ...] | list[str]:
        """Names of the vehicles or persons on the road. Persons inside vehicles are not included."""
        if self.name == "vehicle":
            return libsumo.vehicle.getIDList()
        names = libsumo.person.getIDList()
        vehicles = map(libsumo.person.getVehicle, names)
        return [name for name, vehicle in zip(names, vehicles, strict=True) if not vehicle]

    def numbers(self, names: tuple[str, ...] | list[str]) -> ndarray:
        return np.fromiter(map(self.number.get, names, repeat(_UNKNOWN)), np.int32, len(names))

    def floats(self, what: str, names: tuple[str, ...] | list[str]) -> ndarray:
        return np.fromiter(map(self.getter[what], names), float, len(names))


class SumoTraffic:
    """A running SUMO simulation that is read into arrays step by step.

    libsumo returns one value of one actor per call, and the calls are made by `map`. No file is written outside a
    temporary folder: outputs of the configuration are switched off, and outputs of its additional files (detectors) go
    to that folder.
    """

    def __init__(
        self,
        params: TrafficParams,
        config: Path,
        registry: ActorRegistry,
        frame: Frame | None = None,
        has_driver: bool = False,
    ) -> None:
        """Load the scenario. If SUMO refuses it, a ValueError has SUMO's message.

        With a driver, worlds have lane paths. Collisions are then counted, also at junctions, and the vehicles are not
        teleported.
        """
        self._registry, self._config = registry, config
        self._frame = frame or Frame(f"traffic.scenario = {config}", bounds_m=bounds_m(sumocfg.read(config).net))
        self._ways = _WaysAhead(self._frame) if has_driver else None
        self._commanded: dict[str, int] = {}
        """Names of commanded vehicles, and the speed mode that each had before."""
        self._collisions: set[tuple[str, ...]] = set()
        self._domains = (_Domain("vehicle"), _Domain("person"))
        self._step = 0
        self._counts = FlowCounts(params.step_s)
        self._warmup_s = 0.0
        self._left_out: Counter[str] = Counter()
        self.n_teleports = 0
        """Number of vehicles that SUMO has teleported since recording began."""
        self._stderr = tempfile.TemporaryFile("w+b")  # noqa: SIM115
        self._nothing = open(os.devnull, "wb")  # noqa: SIM115
        self._scratch = Scratch()
        try:
            with self._one_line_errors("refuses it"):
                files = sumocfg.read(config)
                if params.car_following == "calibrated":
                    files = calibrated(files, self._scratch.path)
                files = sumocfg.without_commas(files, self._scratch.path)
                options = _options(params, files, self._scratch.path, has_driver)
                libsumo.start(["sumo", *options])
        except Exception:
            self._clean()
            raise
        self._end_s = libsumo.simulation.getEndTime()
        self._dt_s = libsumo.simulation.getDeltaT()

    def warm_up(self, seconds: float) -> Iterator[float]:
        """Simulate `seconds` without reading actors. Yields the seconds that are done."""
        begin = libsumo.simulation.getTime()
        while (done := libsumo.simulation.getTime() - begin) < seconds - 1e-6:
            self.move()
            yield done
        self.n_teleports, self._warmup_s = 0, seconds
        self._collisions.clear()

    def advance(self) -> World:
        """Simulate one step and read all actors."""
        if self._step:
            self.move()
        step, self._step = self._step, self._step + 1
        present = [(domain, names, domain.numbers(names)) for domain in self._domains for names in (domain.present(),)]
        self._register(present, step)
        parts = [_read(domain, names, number) for domain, names, number in present]
        number, front_m, angle, speed = (np.concatenate(column) for column in zip(*parts, strict=True))
        world = world_from_bumpers(step, number, front_m, angle, speed, self._registry, self._frame)
        self._counts.add(world)
        if self._ways is None:
            return world
        rows = np.flatnonzero(world.equipped)
        names = list(map(self._registry.names.__getitem__, world.actor[rows].tolist()))
        return replace(world, paths=self._ways.paths(rows, names))

    def command(self, actor: Int[ndarray, "c"], speed_mps: Float[ndarray, "c"]) -> None:
        """Command speeds for the next step, within the limits of the road and of the vehicle.

        SUMO's safe speeds, junctions and red lights still apply. A vehicle that is not commanded again drives as SUMO
        decides. So does a vehicle whose commanded speed is not finite.

        Parameters
        ----------
        actor
            Actor numbers of the commanded vehicles.
        speed_mps
            Speed of each.
        """
        finite = np.isfinite(speed_mps)
        names = map(self._registry.names.__getitem__, actor[finite].tolist())
        wanted = dict(zip(names, speed_mps[finite].tolist(), strict=True))
        if not wanted and not self._commanded:
            return
        present = set(libsumo.vehicle.getIDList())
        for name in self._commanded.keys() - wanted.keys():
            if name in present:
                _give_back(name, self._commanded[name])
            del self._commanded[name]
        for name in wanted.keys() & present:
            if name not in self._commanded:
                self._commanded[name] = libsumo.vehicle.getSpeedMode(name)
            _drive_at(name, wanted[name], self._commanded[name], self._dt_s)

    def move(self) -> None:
        """Simulate one step without reading."""
        now = libsumo.simulation.getTime()
        if 0 <= self._end_s < now + self._dt_s - 1e-6:
            raise TrafficEnded(f"the scenario ends at {self._end_s:g} s")
        with self._one_line_errors("gives up"):
            libsumo.simulationStep()
        self.n_teleports += libsumo.simulation.getStartingTeleportNumber()
        if self._ways is not None:
            pairs = (sorted((found.collider, found.victim)) for found in libsumo.simulation.getCollisions())
            self._collisions.update(map(tuple, pairs))
        if libsumo.simulation.getMinExpectedNumber() <= 0:
            raise TrafficEnded(f"at {libsumo.simulation.getTime():g} s all vehicles have left, and none is to depart")

    @property
    def n_vehicles(self) -> int:
        """Number of vehicles on the road."""
        return libsumo.vehicle.getIDCount()

    def report(self) -> dict[str, Any]:
        return {
            "vehicles_waiting_to_enter_at_end": len(libsumo.simulation.getPendingVehicles()),
            "teleports": self.n_teleports,
            "actors_left_out": dict(sorted(self._left_out.items())),
            **({} if self._ways is None else {"collisions": len(self._collisions)}),
            **self._counts.report(),
            **self._first_departure(),
            **({"sumo_errors": errors[:9]} if (errors := self._errors_since(0)) else {}),
        }

    def _first_departure(self) -> dict[str, float]:
        """The first departure of the demand, if nobody was ever on the road."""
        if self._counts.n_vehicles or self._counts.n_pedestrians:
            return {}
        if (first_s := first_departure_s(sumocfg.read(self._config).routes)) is None:
            return {}
        return {"first_departure_s": first_s, "warmup_s": self._warmup_s}

    def close(self) -> None:
        try:
            self.command(np.zeros(0, np.int64), np.zeros(0))
        except (libsumo.TraCIException, libsumo.FatalTraCIError):  # SUMO has given up: no vehicle is left
            self._commanded.clear()
        with self._one_line_errors("ends with an error"):
            libsumo.close()
        self._clean()

    def _clean(self) -> None:
        self._stderr.close()
        self._nothing.close()
        self._scratch.remove()

    def _register(self, present: list[tuple[_Domain, Any, ndarray]], step: int) -> None:
        """Register the actors that have no number yet, and write their numbers into the arrays of `present`."""
        unregistered = [
            (domain, [names[row] for row in rows], number, rows)
            for domain, names, number in present
            if len(rows := np.flatnonzero(number == _UNKNOWN))
        ]
        kept: list[tuple[_Domain, str]] = []
        shapes, lwh_m = [], []
        for domain, names, _, _ in unregistered:
            for name in names:
                vclass = domain.getter["VehicleClass"](name)
                shape = SHAPE_OF_CLASS.get(vclass)
                if shape is None:
                    domain.number[name] = _LEFT_OUT
                    self._left_out[vclass] += 1
                    continue
                kept.append((domain, name))
                shapes.append(shape)
                where = f"traffic.scenario = {self._config}: {domain.name} {name!r}"
                size = {what: domain.getter[what.capitalize()](name) for what in ("length", "width", "height")}
                try:
                    lwh_m.append([check_size(where, what, value) for what, value in size.items()])
                except ValueError as error:
                    raise TrafficError(str(error)) from None
        if kept:
            new = self._registry.register(
                [name for _, name in kept], np.array(shapes, np.uint8), np.array(lwh_m, float), step
            )
            for (domain, name), number in zip(kept, new.tolist(), strict=True):
                domain.number[name] = number
        for domain, names, number, rows in unregistered:
            number[rows] = domain.numbers(names)

    def _errors_since(self, begin: int) -> list[str]:
        """SUMO's error messages after that byte of its log, each once and in one line. SUMO continues after many."""
        self._stderr.seek(begin)
        text = self._stderr.read().decode(errors="replace").replace(_prefix(self._scratch.path), "")
        errors = re.findall(r"^Error: (.*(?:\n .*)*)", text, re.MULTILINE)
        return list(dict.fromkeys(" ".join(error.split()) for error in errors))

    @contextmanager
    def _one_line_errors(self, what: str) -> Iterator[None]:
        """Turn SUMO's exceptions into one line with the reason that SUMO writes to standard error.

        What its additional files write to `stdout` or `-` is dropped: standard output belongs to the command.
        """
        sys.stdout.flush()
        sys.stderr.flush()
        output, terminal, begin = os.dup(1), os.dup(2), self._stderr.seek(0, os.SEEK_END)
        os.dup2(self._nothing.fileno(), 1)
        os.dup2(self._stderr.fileno(), 2)
        try:
            yield
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            reason = " ".join(self._errors_since(begin)) or str(error)
            raise TrafficError(f"traffic.scenario = {self._config}: SUMO {what}: {reason}") from None
        finally:
            for stream, kept in ((1, output), (2, terminal)):
                os.dup2(kept, stream)
                os.close(kept)


def _read(domain: _Domain, names: tuple[str, ...] | list[str], number: ndarray) -> tuple[ndarray, ...]:
    if (number < 0).any():
        names, number = list(compress(names, number >= 0)), number[number >= 0]
    positions = chain.from_iterable(map(domain.getter["Position3D"], names))
    front_m = np.fromiter(positions, float, 3 * len(names)).reshape(-1, 3)
    read = number, front_m, domain.floats("Angle", names), domain.floats("Speed", names)
    has_position = front_m[:, 0] > _NO_POSITION_M
    return read if has_position.all() else tuple(column[has_position] for column in read)


@dataclass(slots=True)
class _WaysAhead:
    """Lane paths of vehicles, from SUMO's routes and lanes."""

    frame: Frame
    lines: LaneLines = field(default_factory=LaneLines)
    line_of: dict[tuple[str, str, int], int] = field(default_factory=dict)
    """Number of the line by lane, route, and place on the route."""

    def paths(self, rows: Int[ndarray, "e"], names: list[str]) -> LanePaths:
        """Lane paths of these rows of the world. A vehicle on no lane, such as a teleported one, has none."""
        ask = libsumo.vehicle
        lanes = list(map(ask.getLaneID, names))
        on_lane = np.fromiter(map(bool, lanes), bool, len(lanes))
        rows, names, lanes = rows[on_lane], list(compress(names, on_lane)), list(compress(lanes, on_lane))
        keys = list(zip(lanes, map(ask.getRouteID, names), map(ask.getRouteIndex, names), strict=True))
        line = np.fromiter(map(self.line_of.get, keys, repeat(-1)), np.int64, len(keys))
        if len(self.line_of) > _KNOWN_WAYS:
            self.line_of.clear()
        for i in np.flatnonzero(line < 0).tolist():
            line[i] = self.line_of[keys[i]] = self._line(names[i], lanes[i])
        position = np.fromiter(map(ask.getLanePosition, names), float, len(names))
        ptr, xy_m, along_m = self.lines.arrays()
        return LanePaths(
            rows, line, position * np.array(self.lines.scale)[line] if len(line) else position, ptr,
            xy_m, along_m,
        )  # fmt: skip

    def _line(self, name: str, lane: str) -> int:
        lanes, ahead_m = [lane], 0.0
        for link in libsumo.vehicle.getNextLinks(name):
            inside = link[4]
            while inside:  # a way through a junction can consist of several internal lanes
                lanes.append(inside)
                ahead_m += libsumo.lane.getLength(inside)
                inside = next((onward[4] for onward in libsumo.lane.getLinks(inside)), "")
            lanes.append(link[0])
            ahead_m += libsumo.lane.getLength(link[0])
            if ahead_m > _LOOK_AHEAD_M:
                break
        key = tuple(lanes)
        number = self.lines.number.get(key)
        if number is not None:
            return number
        shapes = [np.array(libsumo.lane.getShape(part))[:, :2] - self.frame.origin_m for part in lanes]
        return self.lines.add(key, shapes, libsumo.lane.getLength(lane))


def _drive_at(name: str, speed_mps: float, mode: int, dt_s: float) -> None:
    """Command a speed. If it needs more than the vehicle's usual deceleration, that limit is lifted."""
    of = libsumo.vehicle
    now_mps = of.getSpeed(name)
    slowest_mps = now_mps - of.getEmergencyDecel(name) * dt_s
    is_emergency = speed_mps < now_mps - of.getDecel(name) * dt_s - 1e-6
    of.setSpeedMode(name, mode & ~_REGARD_MAX_DECELERATION if is_emergency else mode)
    of.setSpeed(name, max(0.0, slowest_mps, min(speed_mps, of.getAllowedSpeed(name))))


def _give_back(name: str, mode: int) -> None:
    """Let SUMO decide the vehicle's speed again."""
    libsumo.vehicle.setSpeed(name, -1)
    libsumo.vehicle.setSpeedMode(name, mode)


def _options(params: TrafficParams, config: sumocfg.Sumocfg, scratch: Path, has_driver: bool) -> list[str]:
    """SUMO's command line. It uses a copy of the configuration, which has harmless options only."""
    copy = scratch / "scenario.sumocfg"
    copy.write_text(config.text(), encoding="utf-8")
    options = {
        "configuration-file": copy,
        "seed": params.seed,
        "step-length": params.step_s,
        "no-step-log": "true",
        "duration-log.disable": "true",
        "duration-log.statistics": "false",
        "no-warnings": "true",
        "verbose": "false",
        # override the configuration, so that SUMO waits for no TraCI client, and the same seed gives the same traffic
        "remote-port": 0,
        "random": "false",
        "threads": 1,
        "device.rerouting.threads": 0,
        "output-prefix": _prefix(scratch),
        **({"collision.action": "warn", "collision.check-junctions": "true"} if has_driver else {}),
        **({"tls.yellow.min-decel": YELLOW_MPS2} if params.car_following == "calibrated" else {}),
        **({} if params.begin_s is None else {"begin": params.begin_s}),
        **({} if params.scale == 1 else {"scale": params.scale}),
    }
    return [word for name, value in options.items() for word in (f"--{name}", str(value))]


def _prefix(scratch: Path) -> str:
    """The value of `output-prefix`. SUMO puts it before file names; it leads from any folder to the temporary one."""
    return "../" * 64 + str(scratch).lstrip("/") + "/"
