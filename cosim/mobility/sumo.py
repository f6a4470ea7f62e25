"""Traffic by SUMO, through libsumo: the only file that knows SUMO's conventions.

SUMO gives the centre of the *front bumper* and degrees *clockwise from north*; everybody else here lives
with box centres and radians counter-clockwise from east. libsumo holds one simulation per process.
"""

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TextIO

import libsumo
import numpy as np
from annotated_types import Ge, Gt
from jaxtyping import Float
from numpy import ndarray

from cosim.roster import Roster
from cosim.world import World
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


@contextmanager
def _what_sumo_says() -> Iterator[TextIO]:
    """Catch what SUMO's C++ writes to standard error, which is where its reasons for an error go."""
    sys.stderr.flush()
    screen = os.dup(2)
    with tempfile.TemporaryFile("w+", errors="replace") as said:
        os.dup2(said.fileno(), 2)
        try:
            yield said
        finally:
            os.dup2(screen, 2)
            os.close(screen)


@dataclass(frozen=True, kw_only=True, slots=True)
class TrafficParams:
    """Whose streets, how long, and SUMO's own dice."""

    scenario: str = "helsinki"
    """Name of a shipped network, or the path of a .sumocfg (relative to the config file that names it)."""
    seed: Annotated[int, Ge(0)] = 1
    """Seed of SUMO."""
    warmup_s: Annotated[float, Ge(0)] | None = None
    """Traffic driven before anything is sensed or recorded [s]; the shipped network's own when not set."""
    duration_s: Annotated[float, Gt(0)] = 300.0
    """Recorded time after warm-up [s]."""
    step_s: Annotated[float, Ge(0.1)] = 1.0
    """Length of one step of traffic [s]."""


def centre_from_bumper(
    front_m: Float[ndarray, "n 3"], compass_deg: Float[ndarray, "n"], lwh_m: Float[ndarray, "n 3"]
) -> Boxes:
    """Boxes of actors from SUMO's pose: centre of the front bumper on the road, degrees clockwise from north."""
    yaw = np.deg2rad(90.0 - compass_deg)
    yaw = np.pi - np.mod(np.pi - yaw, 2 * np.pi)  # (-pi, pi]
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    centre = front_m - heading * (lwh_m[:, :1] / 2)
    centre[:, 2] += lwh_m[:, 2] / 2
    return Boxes(centre, lwh_m, yaw)


class SumoTraffic:
    """A running SUMO simulation, read into arrays step by step.

    `advance` loops over actors in Python: libsumo answers for one vehicle at a time (0.7 µs each for
    position, angle and speed, against 2-7 µs that SUMO itself takes to move it).
    """

    def __init__(self, params: TrafficParams, config: Path, roster: Roster) -> None:
        """Load the scenario; ValueError with SUMO's own words when SUMO refuses it."""
        self._roster = roster
        self._number: dict[str, int] = {}
        self._step = 0
        self._left_out: set[str] = set()
        self.n_teleports = 0
        """Vehicles that SUMO has lifted out of a jam since recording began."""
        with _what_sumo_says() as said:
            try:
                libsumo.start([
                    "sumo", "-c", str(config), "--seed", str(params.seed), "--step-length", str(params.step_s),
                    "--no-step-log", "true", "--duration-log.disable", "true", "--duration-log.statistics", "false",
                    "--no-warnings", "true",
                ])  # fmt: skip
            except libsumo.TraCIException as error:
                said.seek(0)
                reason = " ".join(said.read().split()).removeprefix("Error: ") or str(error)
                raise ValueError(f"traffic.scenario = {config}: SUMO refuses it: {reason}") from None

    def warm_up(self, seconds: float) -> Iterator[float]:
        """Drive unseen for `seconds`; yields the seconds done."""
        begin = libsumo.simulation.getTime()
        while (done := libsumo.simulation.getTime() - begin) < seconds - 1e-6:
            libsumo.simulationStep()
            yield done

    def advance(self) -> World:
        """Move everybody by one step and read them."""
        if self._step:
            self.move()
        step, self._step = self._step, self._step + 1
        groups = [
            ("vehicle/", libsumo.vehicle, libsumo.vehicle.getIDList()),
            ("person/", libsumo.person, self._on_foot()),
        ]
        numbers, fronts, angles, speeds = [], [], [], []
        for namespace, domain, names in groups:
            self._enrol_newcomers(namespace, domain, names, step)
            names = [n for n in names if namespace + n in self._number]
            numbers += [self._number[namespace + n] for n in names]
            fronts += [domain.getPosition3D(n) for n in names]
            angles += [domain.getAngle(n) for n in names]
            speeds += [domain.getSpeed(n) for n in names]
        number = np.array(numbers, np.int32)
        order = np.argsort(number)
        number = number[order]
        roster = self._roster
        roster.seen(number, step)
        front_m = np.array(fronts, float).reshape(-1, 3)[order]
        return World(
            step=step,
            actor=number,
            name_key=roster.name_key[number],
            shape=roster.shape[number],
            boxes=centre_from_bumper(front_m, np.array(angles, float)[order], roster.lwh_m[number]),
            speed_mps=np.array(speeds, float)[order],
            equipped=roster.equipped[number],
            behaviour=roster.behaviour[number],
        )

    def move(self) -> None:
        """One step of SUMO, read by nobody."""
        libsumo.simulationStep()
        self.n_teleports += libsumo.simulation.getStartingTeleportNumber()

    def _on_foot(self) -> list[str]:
        person = libsumo.person
        return [p for p in person.getIDList() if not person.getVehicle(p)]

    def _enrol_newcomers(self, namespace: str, domain, names, step: int) -> None:
        new = [n for n in names if namespace + n not in self._number and namespace + n not in self._left_out]
        if not new:
            return
        shapes = [SHAPE_OF_CLASS.get(domain.getVehicleClass(n)) for n in new]
        self._left_out.update(namespace + n for n, s in zip(new, shapes, strict=True) if s is None)
        new = [n for n, s in zip(new, shapes, strict=True) if s is not None]
        lwh_m = [(domain.getLength(n), domain.getWidth(n), domain.getHeight(n)) for n in new]
        shape = np.array([s for s in shapes if s is not None], np.uint8)
        numbers = self._roster.enrol(new, namespace, shape, np.array(lwh_m, float).reshape(-1, 3), step)
        self._number.update((namespace + n, int(i)) for n, i in zip(new, numbers, strict=True))

    @property
    def n_waiting(self) -> int:
        """Vehicles that have not found room to enter."""
        return len(libsumo.simulation.getPendingVehicles())

    def close(self) -> None:
        libsumo.close()
