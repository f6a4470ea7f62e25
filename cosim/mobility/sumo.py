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
from libsumo.libsumo import _libsumo
from numpy import ndarray

from cosim.mobility.source import SHAPE_OF_CLASS, TrafficError, TrafficOver, TrafficParams, world_from_bumpers
from cosim.roster import Roster
from cosim.world import World
from sumo_nets import sumocfg

__all__ = ["SumoTraffic", "TrafficParams"]

_UNKNOWN, _LEFT_OUT = -2, -1
_NOWHERE_M = -1e9
"""SUMO's coordinate of who is nowhere is far below this."""


@dataclass(slots=True)
class _Domain:
    """Vehicles or persons: libsumo's functions without their Python wrappers, and the number of each name."""

    kind: str
    number: dict[str, int] = field(default_factory=dict)
    getter: dict[str, Callable[[str], Any]] = field(init=False)

    def __post_init__(self) -> None:
        what = ("Position3D", "Angle", "Speed", "VehicleClass", "Length", "Width", "Height")
        self.getter = {name: getattr(_libsumo, f"{self.kind}_get{name}") for name in what}

    def present(self) -> tuple[str, ...] | list[str]:
        """Names of those on the road; who rides in a vehicle is not."""
        if self.kind == "vehicle":
            return _libsumo.vehicle_getIDList()
        names = _libsumo.person_getIDList()
        return [name for name, ridden in zip(names, map(_libsumo.person_getVehicle, names), strict=True) if not ridden]

    def numbers(self, names: tuple[str, ...] | list[str]) -> ndarray:
        return np.fromiter(map(self.number.get, names, repeat(_UNKNOWN)), np.int32, len(names))

    def floats(self, what: str, names: tuple[str, ...] | list[str]) -> ndarray:
        return np.fromiter(map(self.getter[what], names), float, len(names))


class SumoTraffic:
    """A running SUMO simulation, read into arrays step by step.

    Reading loops over actors in C (`map`), not in Python: libsumo answers for one actor at a time. Nothing
    is written beside the user's files: outputs that the configuration asks for are switched off, and those
    that its additional files ask for (detectors) go to a folder that is thrown away.
    """

    def __init__(
        self, params: TrafficParams, config: Path, roster: Roster, origin_m: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Load the scenario; ValueError with SUMO's own words when SUMO refuses it."""
        self._roster, self._config, self._origin_m = roster, config, origin_m
        self._domains = (_Domain("vehicle"), _Domain("person"))
        self._step = 0
        self._left_out: Counter[str] = Counter()
        self.n_teleports = 0
        """Vehicles that SUMO has lifted out of a jam since recording began."""
        self._said = tempfile.TemporaryFile("w+b")  # noqa: SIM115
        self._waste = tempfile.TemporaryDirectory(prefix="cosim.", ignore_cleanup_errors=True)
        try:
            with self._errors("refuses it"):
                libsumo.start(["sumo", *_options(params, sumocfg.read(config), Path(self._waste.name))])
        except Exception:
            self._clean()
            raise
        self._end_s = libsumo.simulation.getEndTime()
        self._dt_s = libsumo.simulation.getDeltaT()

    def warm_up(self, seconds: float) -> Iterator[float]:
        """Drive unseen for `seconds`; yields the seconds done."""
        begin = libsumo.simulation.getTime()
        while (done := libsumo.simulation.getTime() - begin) < seconds - 1e-6:
            self.move()
            yield done
        self.n_teleports = 0

    def advance(self) -> World:
        """Move everybody by one step and read them."""
        if self._step:
            self.move()
        step, self._step = self._step, self._step + 1
        present = [(domain, names, domain.numbers(names)) for domain in self._domains for names in (domain.present(),)]
        self._enrol(present, step)
        parts = [_read(domain, names, number) for domain, names, number in present]
        number, front_m, angle, speed = (np.concatenate(column) for column in zip(*parts, strict=True))
        return world_from_bumpers(step, number, front_m, angle, speed, self._roster, self._origin_m)

    def move(self) -> None:
        """One step of SUMO, read by nobody."""
        now = libsumo.simulation.getTime()
        if 0 <= self._end_s < now + self._dt_s - 1e-6:
            raise TrafficOver(f"the scenario ends at {self._end_s:g} s")
        with self._errors("gives up"):
            libsumo.simulationStep()
        self.n_teleports += libsumo.simulation.getStartingTeleportNumber()
        if libsumo.simulation.getMinExpectedNumber() <= 0:
            raise TrafficOver(f"at {libsumo.simulation.getTime():g} s everybody has left, and nobody is to come")

    @property
    def n_vehicles(self) -> int:
        """Vehicles on the road."""
        return libsumo.vehicle.getIDCount()

    def report(self) -> dict[str, Any]:
        return {
            "vehicles_waiting_to_enter_at_end": len(libsumo.simulation.getPendingVehicles()),
            "teleports": self.n_teleports,
            "actors_left_out": dict(sorted(self._left_out.items())),
            **({"sumo_complained": heard[:9]} if (heard := self._heard(0)) else {}),
        }

    def close(self) -> None:
        libsumo.close()
        self._clean()

    def _clean(self) -> None:
        self._said.close()
        self._waste.cleanup()

    def _enrol(self, present: list[tuple[_Domain, Any, ndarray]], step: int) -> None:
        """Give the strangers among those present their numbers, in place."""
        strangers = [
            (domain, [names[row] for row in rows], number, rows)
            for domain, names, number in present
            if len(rows := np.flatnonzero(number == _UNKNOWN))
        ]
        who: list[tuple[_Domain, str]] = []
        shapes, lwh_m = [], []
        for domain, names, _, _ in strangers:
            for name in names:
                vclass = domain.getter["VehicleClass"](name)
                shape = SHAPE_OF_CLASS.get(vclass)
                if shape is None:
                    domain.number[name] = _LEFT_OUT
                    self._left_out[vclass] += 1
                    continue
                who.append((domain, name))
                shapes.append(shape)
                lwh_m.append([domain.getter[what](name) for what in ("Length", "Width", "Height")])
        if who:
            newcomers = [name for _, name in who]
            new = self._roster.enrol(newcomers, np.array(shapes, np.uint8), np.array(lwh_m, float), step)
            for (domain, name), number in zip(who, new.tolist(), strict=True):
                domain.number[name] = number
        for domain, names, number, rows in strangers:
            number[rows] = domain.numbers(names)

    def _heard(self, begin: int) -> list[str]:
        """What SUMO has called an error since then, each once and in one line; it goes on after many."""
        self._said.seek(begin)
        text = self._said.read().decode(errors="replace").replace(_prefix(Path(self._waste.name)), "")
        errors = re.findall(r"^Error: (.*(?:\n .*)*)", text, re.MULTILINE)
        return list(dict.fromkeys(" ".join(error.split()) for error in errors))

    @contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        """SUMO's exceptions as one line with its reason, which its C++ writes to standard error."""
        sys.stderr.flush()
        screen, begin = os.dup(2), self._said.seek(0, os.SEEK_END)
        os.dup2(self._said.fileno(), 2)
        try:
            yield
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            reason = " ".join(self._heard(begin)) or str(error)
            raise TrafficError(f"traffic.scenario = {self._config}: SUMO {what}: {reason}") from None
        finally:
            os.dup2(screen, 2)
            os.close(screen)


def _read(domain: _Domain, names: tuple[str, ...] | list[str], number: ndarray) -> tuple[ndarray, ...]:
    if (number < 0).any():
        names, number = list(compress(names, number >= 0)), number[number >= 0]
    places = chain.from_iterable(map(domain.getter["Position3D"], names))
    front_m = np.fromiter(places, float, 3 * len(names)).reshape(-1, 3)
    read = number, front_m, domain.floats("Angle", names), domain.floats("Speed", names)
    somewhere = front_m[:, 0] > _NOWHERE_M
    return read if somewhere.all() else tuple(column[somewhere] for column in read)


def _options(params: TrafficParams, config: sumocfg.Sumocfg, waste: Path) -> list[str]:
    """SUMO's command line: the configuration as it stands, but silent, and writing nothing beside itself."""
    options = {
        "configuration-file": config.path,
        "seed": params.seed,
        "step-length": params.step_s,
        "no-step-log": "true",
        "duration-log.disable": "true",
        "duration-log.statistics": "false",
        "no-warnings": "true",
        "verbose": "false",
        # whatever the configuration says: nobody is waited for, and the same seed drives the same traffic
        "remote-port": 0,
        "random": "false",
        "threads": 1,
        "device.rerouting.threads": 0,
        "output-prefix": _prefix(waste),
        **({} if params.begin_s is None else {"begin": params.begin_s}),
        **({} if params.scale == 1 else {"scale": params.scale}),
        **dict.fromkeys(config.outputs, os.devnull),
    }
    return [word for name, value in options.items() for word in (f"--{name}", str(value))]


def _prefix(waste: Path) -> str:
    """SUMO puts it before a file's last name: from wherever that is, up to the root and down to the waste."""
    return "../" * 64 + str(waste).lstrip("/") + "/"
