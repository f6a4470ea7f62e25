"""Traffic by SUMO, through libsumo, which holds one simulation per process."""

import os
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain, compress, repeat
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
from numpy import ndarray

from cosim.actors import ActorRegistry
from cosim.mobility.frame import Frame, TrafficError
from cosim.mobility.params import TrafficParams
from cosim.mobility.remarks import FlowCounts
from cosim.mobility.source import SHAPE_OF_CLASS, TrafficEnded, world_from_bumpers
from cosim.world import World
from sumo_nets import sumocfg
from sumo_nets.catalogue import bounds_m
from sumo_nets.sumocfg import first_departure_s
from sumo_nets.vtypes import check_size

_UNKNOWN, _LEFT_OUT = -2, -1
_NO_POSITION_M = -1e9
"""SUMO's coordinate of an actor without a position (-2^30) is below this."""


@dataclass(slots=True)
class _Domain:
    """Vehicles or persons: libsumo's functions for them, and the number of each name."""

    name: str
    number: dict[str, int] = field(default_factory=dict)
    getter: dict[str, Callable[[str], Any]] = field(init=False)

    def __post_init__(self) -> None:
        what = ("Position3D", "Angle", "Speed", "VehicleClass", "Length", "Width", "Height")
        self.getter = {name: getattr(getattr(libsumo, self.name), f"get{name}") for name in what}

    def present(self) -> tuple[str, ...] | list[str]:
        """Names of those on the road, without persons inside vehicles."""
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
    """A running SUMO simulation, read into arrays step by step.

    libsumo returns one value of one actor per call; the calls are made by `map`. No file is written outside of a
    temporary folder: outputs of the configuration are switched off, and those of its additional files (detectors)
    go to that folder.
    """

    def __init__(
        self, params: TrafficParams, config: Path, registry: ActorRegistry, frame: Frame | None = None
    ) -> None:
        """Load the scenario; ValueError with SUMO's message when SUMO refuses it."""
        self._registry, self._config = registry, config
        self._frame = frame or Frame(f"traffic.scenario = {config}", bounds_m=bounds_m(sumocfg.read(config).net))
        self._domains = (_Domain("vehicle"), _Domain("person"))
        self._step = 0
        self._counts = FlowCounts()
        self._warmup_s = 0.0
        self._left_out: Counter[str] = Counter()
        self.n_teleports = 0
        """Vehicles that SUMO has teleported since recording began."""
        self._stderr = tempfile.TemporaryFile("w+b")  # noqa: SIM115
        self._scratch = tempfile.TemporaryDirectory(prefix="cosim.", ignore_cleanup_errors=True)
        try:
            with self._one_line_errors("refuses it"):
                libsumo.start(["sumo", *_options(params, sumocfg.read(config), Path(self._scratch.name))])
        except Exception:
            self._clean()
            raise
        self._end_s = libsumo.simulation.getEndTime()
        self._dt_s = libsumo.simulation.getDeltaT()

    def warm_up(self, seconds: float) -> Iterator[float]:
        """Simulate `seconds` without reading; yields the seconds done."""
        begin = libsumo.simulation.getTime()
        while (done := libsumo.simulation.getTime() - begin) < seconds - 1e-6:
            self.move()
            yield done
        self.n_teleports, self._warmup_s = 0, seconds

    def advance(self) -> World:
        """Simulate one step and read all actors."""
        if self._step:
            self.move()
        step, self._step = self._step, self._step + 1
        present = [(domain, names, domain.numbers(names)) for domain in self._domains for names in (domain.present(),)]
        self._register(present, step)
        parts = [_read(domain, names, number) for domain, names, number in present]
        number, front_m, angle, speed = (np.concatenate(column) for column in zip(*parts, strict=True))
        return self._counts.add(world_from_bumpers(step, number, front_m, angle, speed, self._registry, self._frame))

    def move(self) -> None:
        """Simulate one step without reading."""
        now = libsumo.simulation.getTime()
        if 0 <= self._end_s < now + self._dt_s - 1e-6:
            raise TrafficEnded(f"the scenario ends at {self._end_s:g} s")
        with self._one_line_errors("gives up"):
            libsumo.simulationStep()
        self.n_teleports += libsumo.simulation.getStartingTeleportNumber()
        if libsumo.simulation.getMinExpectedNumber() <= 0:
            raise TrafficEnded(f"at {libsumo.simulation.getTime():g} s all vehicles have left, and none is to depart")

    @property
    def n_vehicles(self) -> int:
        """Vehicles on the road."""
        return libsumo.vehicle.getIDCount()

    def report(self) -> dict[str, Any]:
        return {
            "vehicles_waiting_to_enter_at_end": len(libsumo.simulation.getPendingVehicles()),
            "teleports": self.n_teleports,
            "actors_left_out": dict(sorted(self._left_out.items())),
            **self._counts.report(),
            **self._first_departure(),
            **({"sumo_errors": errors[:9]} if (errors := self._errors_since(0)) else {}),
        }

    def _first_departure(self) -> dict[str, float]:
        """The first departure of the demand, where no vehicle was ever on the road."""
        if self._counts.n_vehicles or (first_s := first_departure_s(sumocfg.read(self._config).routes)) is None:
            return {}
        return {"first_departure_s": first_s, "warmup_s": self._warmup_s}

    def close(self) -> None:
        libsumo.close()
        self._clean()

    def _clean(self) -> None:
        self._stderr.close()
        self._scratch.cleanup()

    def _register(self, present: list[tuple[_Domain, Any, ndarray]], step: int) -> None:
        """Register the actors that have no number yet; fills their numbers in place."""
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
                lwh_m.append(
                    [
                        check_size(where, what.lower(), domain.getter[what](name))
                        for what in ("Length", "Width", "Height")
                    ]
                )
        if kept:
            new = self._registry.register(
                [name for _, name in kept], np.array(shapes, np.uint8), np.array(lwh_m, float), step
            )
            for (domain, name), number in zip(kept, new.tolist(), strict=True):
                domain.number[name] = number
        for domain, names, number, rows in unregistered:
            number[rows] = domain.numbers(names)

    def _errors_since(self, begin: int) -> list[str]:
        """SUMO's error messages since that byte of its log, each once and in one line; SUMO continues after many."""
        self._stderr.seek(begin)
        text = self._stderr.read().decode(errors="replace").replace(_prefix(Path(self._scratch.name)), "")
        errors = re.findall(r"^Error: (.*(?:\n .*)*)", text, re.MULTILINE)
        return list(dict.fromkeys(" ".join(error.split()) for error in errors))

    @contextmanager
    def _one_line_errors(self, what: str) -> Iterator[None]:
        """SUMO's exceptions as one line with the reason that its C++ writes to standard error."""
        sys.stderr.flush()
        terminal, begin = os.dup(2), self._stderr.seek(0, os.SEEK_END)
        os.dup2(self._stderr.fileno(), 2)
        try:
            yield
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            reason = " ".join(self._errors_since(begin)) or str(error)
            raise TrafficError(f"traffic.scenario = {self._config}: SUMO {what}: {reason}") from None
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)


def _read(domain: _Domain, names: tuple[str, ...] | list[str], number: ndarray) -> tuple[ndarray, ...]:
    if (number < 0).any():
        names, number = list(compress(names, number >= 0)), number[number >= 0]
    positions = chain.from_iterable(map(domain.getter["Position3D"], names))
    front_m = np.fromiter(positions, float, 3 * len(names)).reshape(-1, 3)
    read = number, front_m, domain.floats("Angle", names), domain.floats("Speed", names)
    has_position = front_m[:, 0] > _NO_POSITION_M
    return read if has_position.all() else tuple(column[has_position] for column in read)


def _options(params: TrafficParams, config: sumocfg.Sumocfg, scratch: Path) -> list[str]:
    """SUMO's command line: a copy of the configuration with harmless options only, written to the temporary folder."""
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
        # overrides the configuration: no TraCI client is waited for, and the same seed gives the same traffic
        "remote-port": 0,
        "random": "false",
        "threads": 1,
        "device.rerouting.threads": 0,
        "output-prefix": _prefix(scratch),
        **({} if params.begin_s is None else {"begin": params.begin_s}),
        **({} if params.scale == 1 else {"scale": params.scale}),
    }
    return [word for name, value in options.items() for word in (f"--{name}", str(value))]


def _prefix(scratch: Path) -> str:
    """SUMO puts it before a file's base name: from any folder up to the root and down to the temporary folder."""
    return "../" * 64 + str(scratch).lstrip("/") + "/"
