"""The process in which SUMO runs, through libsumo. It answers the requests of one `cosim.traffic.sumo.SumoTraffic`.

A process can run one SUMO simulation, and SUMO that is loaded again in a process does not always repeat its traffic. So
every simulation has a process of its own, and SUMO computes the next step while cosim computes the present one.
"""

import os
import pickle
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, compress, repeat
from typing import Any, BinaryIO

import libsumo
import numpy as np
from numpy import ndarray

from cosim.traffic.lane_lines import LaneLines
from cosim.traffic.snapshot import ANSWERED, ENDED, FAILED, NewActor, Snapshot

Names = tuple[str, ...] | list[str]

_NO_POSITION_M = -1e9
"""An actor without a position has a smaller coordinate in SUMO (-2^30)."""
_LOOK_AHEAD_M = 150.0
"""Lane paths reach this far beyond the end of a vehicle's current lane, or to the end of its route."""
_KNOWN_WAYS = 100_000
"""Number of lane paths that are kept in memory. If there are more, the memory is cleared."""
_REGARD_MAX_DECELERATION = 4
"""Bit of SUMO's speed mode that keeps the vehicle's largest deceleration."""
_PART_S = 0.25
"""Wall time after which a long warm-up tells how far it is [s]."""


@dataclass(slots=True)
class _Domain:
    """Vehicles or persons: libsumo's functions for them, and the number of each name."""

    name: str
    number: dict[str, int] = field(default_factory=dict)
    getter: dict[str, Callable[[str], Any]] = field(init=False)

    def __post_init__(self) -> None:
        what = ("Position3D", "Angle", "Speed", "VehicleClass", "Length", "Width", "Height")
        self.getter = {name: getattr(getattr(libsumo, self.name), f"get{name}") for name in what}

    def present(self) -> Names:
        """Names of the vehicles or persons on the road. Persons inside vehicles are not included."""
        if self.name == "vehicle":
            return libsumo.vehicle.getIDList()
        names = libsumo.person.getIDList()
        vehicles = map(libsumo.person.getVehicle, names)
        return [name for name, vehicle in zip(names, vehicles, strict=True) if not vehicle]

    def floats(self, what: str, names: Names) -> ndarray:
        return np.fromiter(map(self.getter[what], names), float, len(names))

    def read(self, names: Names, number: ndarray) -> tuple[ndarray, ...]:
        """Number, front bumper, angle and speed of the actors of these names that have a position."""
        positions = chain.from_iterable(map(self.getter["Position3D"], names))
        front_m = np.fromiter(positions, float, 3 * len(names)).reshape(-1, 3)
        found = number, front_m, self.floats("Angle", names), self.floats("Speed", names)
        has_position = front_m[:, 0] > _NO_POSITION_M
        return found if has_position.all() else tuple(column[has_position] for column in found)


class Simulator:
    """A SUMO simulation of this process. libsumo returns one value of one actor per call; the calls are made by `map`.

    Parameters
    ----------
    options
        SUMO's command line.
    has_driver
        Whether a driver commands vehicles. Collisions are then counted, and `paths` may be asked.
    origin_m
        The world's origin in the network's coordinates [m].
    """

    def __init__(self, options: list[str], has_driver: bool, origin_m: tuple[float, float]) -> None:
        libsumo.start(["sumo", *options])
        self._has_driver = has_driver
        self._ways = _WaysAhead(origin_m)
        self._commanded: dict[str, int] = {}
        """Names of commanded vehicles, and the speed mode that each had before."""
        self._collisions: set[tuple[str, ...]] = set()
        self._domains = (_Domain("vehicle"), _Domain("person"))
        self._n_known = self._n_teleports = 0
        self._end_s, self._dt_s = libsumo.simulation.getEndTime(), libsumo.simulation.getDeltaT()
        self._warm_from_s = libsumo.simulation.getTime()
        self._has_calibrators = bool(libsumo.calibrator.getIDList())
        """Whether vehicles can come that SUMO does not expect."""

    def warm_up(self, seconds: float) -> float:
        """Simulate a part of the warm-up without reading actors. Returns how many seconds of it are done."""
        begin = time.perf_counter()
        while (done := libsumo.simulation.getTime() - self._warm_from_s) < seconds - 1e-6:
            if time.perf_counter() - begin > _PART_S:
                return done
            self.move()
        self._n_teleports = 0
        self._collisions.clear()
        return seconds

    def move(self) -> None:
        """Simulate one step without reading. Raises EOFError, which says why, if the traffic has ended."""
        now = libsumo.simulation.getTime()
        if 0 <= self._end_s < now + self._dt_s - 1e-6:
            raise EOFError(f"the scenario ends at {self._end_s:g} s")
        libsumo.simulationStep()
        self._n_teleports += libsumo.simulation.getStartingTeleportNumber()
        if self._has_driver:
            pairs = (sorted((found.collider, found.victim)) for found in libsumo.simulation.getCollisions())
            self._collisions.update(map(tuple, pairs))
        if libsumo.simulation.getMinExpectedNumber() <= 0 and not self._has_calibrators:
            raise EOFError(f"at {libsumo.simulation.getTime():g} s all vehicles have left, and none is to depart")

    def read(self) -> Snapshot:
        """All actors as they are now."""
        new: list[NewActor] = []
        parts = []
        for domain in self._domains:
            names = domain.present()
            known = map(domain.number.get, names, repeat(-1))
            number = np.fromiter(known, np.int32, len(names))
            for row in np.flatnonzero(number < 0).tolist():
                number[row] = domain.number[names[row]] = self._n_known + len(new)
                new.append(_new(domain, names[row]))
            parts.append(domain.read(names, number))
        self._n_known += len(new)
        columns = zip(*parts, strict=True)
        number, front_m, angle, speed = map(np.concatenate, columns)
        n_waiting = len(libsumo.simulation.getPendingVehicles())
        return Snapshot(new, number, front_m, angle, speed, n_waiting, self._n_teleports, len(self._collisions))

    def advance(self) -> Snapshot:
        """Simulate one step and read all actors."""
        self.move()
        return self.read()

    def paths(self, names: list[str]) -> tuple[ndarray, ...]:
        """Lane paths of vehicles; see `_WaysAhead.paths`."""
        return self._ways.paths(names)

    def command(self, wanted_mps: dict[str, float]) -> None:
        """Command speeds, by name, for the next step. Vehicles that are not commanded again are given back to SUMO."""
        present = set(libsumo.vehicle.getIDList())
        for name in self._commanded.keys() - wanted_mps.keys():
            if name in present:
                _give_back(name, self._commanded[name])
            del self._commanded[name]
        for name in wanted_mps.keys() & present:
            if name not in self._commanded:
                self._commanded[name] = libsumo.vehicle.getSpeedMode(name)
            _drive_at(name, wanted_mps[name], self._commanded[name], self._dt_s)

    def close(self) -> None:
        """End the simulation. SUMO writes the rest of its outputs."""
        libsumo.close()


def _new(domain: _Domain, name: str) -> NewActor:
    ask = domain.getter
    lwh_m = ask["Length"](name), ask["Width"](name), ask["Height"](name)
    return NewActor(domain.name, name, ask["VehicleClass"](name), lwh_m)


@dataclass(slots=True)
class _WaysAhead:
    """Lane paths of vehicles, from SUMO's routes and lanes."""

    origin_m: tuple[float, float]
    lines: LaneLines = field(default_factory=LaneLines)
    line_of: dict[tuple[str, str, int], int] = field(default_factory=dict)
    """Number of the line by lane, route, and place on the route."""

    def paths(self, names: list[str]) -> tuple[ndarray, ...]:
        """Lane paths of the vehicles of these names. A vehicle on no lane, such as a teleported one, has none.

        Returns
        -------
        The place in `names` of each vehicle with a path, then the other arrays of `cosim.world.LanePaths`.
        """
        ask = libsumo.vehicle
        lanes = list(map(ask.getLaneID, names))
        on_lane = np.fromiter(map(bool, lanes), bool, len(lanes))
        names, lanes = list(compress(names, on_lane)), list(compress(lanes, on_lane))
        routes, places = map(ask.getRouteID, names), map(ask.getRouteIndex, names)
        keys = list(zip(lanes, routes, places, strict=True))
        known = map(self.line_of.get, keys, repeat(-1))
        line = np.fromiter(known, np.int64, len(keys))
        if len(self.line_of) > _KNOWN_WAYS:
            self.line_of.clear()
        for i in np.flatnonzero(line < 0).tolist():
            number = self._line(names[i], lanes[i])
            line[i] = self.line_of[keys[i]] = number
        position = np.fromiter(map(ask.getLanePosition, names), float, len(names))
        if len(line):
            position *= np.array(self.lines.scale)[line]
        return np.flatnonzero(on_lane), line, position, *self.lines.arrays()

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
        shapes = [np.array(libsumo.lane.getShape(part)) for part in lanes]
        shapes = [shape[:, :2] - self.origin_m for shape in shapes]
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


def _answer(simulator: Simulator, request: str, arguments: tuple[Any, ...]) -> tuple[str, Any]:
    try:
        return ANSWERED, getattr(simulator, request)(*arguments)
    except EOFError as over:
        return ENDED, str(over)
    except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
        return FAILED, str(error)


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer requests until there are no more. The first one has the arguments of `Simulator`.

    With each answer goes the length of SUMO's log, which is the standard error of this process.
    """

    def tell(what: tuple[str, Any]) -> None:
        pickle.dump((*what, os.fstat(2).st_size), answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()

    try:
        simulator = Simulator(*pickle.load(requests))
    except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
        tell((FAILED, str(error)))
        return
    tell((ANSWERED, None))
    while True:
        try:
            request, *arguments = pickle.load(requests)
        except EOFError:  # the run has ended, or was killed
            return
        tell(_answer(simulator, request, tuple(arguments)))


def main() -> None:
    """Serve standard input and output. What SUMO's additional files write to standard output is dropped."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the run decides when it ends
    answers = os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    with suppress(BrokenPipeError):  # the run has ended, and wants no answer
        serve(sys.stdin.buffer, answers)


if __name__ == "__main__":
    main()
