"""Traffic by SUMO, which runs in a process of its own."""

import os
import pickle
import re
import subprocess
import sys
import weakref
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.traffic.actors import ActorRegistry
from cosim.traffic.car_following import YELLOW_MPS2, calibrated
from cosim.traffic.frame import Frame, TrafficError
from cosim.traffic.params import TrafficParams
from cosim.traffic.remarks import FlowCounts
from cosim.traffic.scratch import Scratch
from cosim.traffic.snapshot import ENDED, FAILED, NewActor, Snapshot
from cosim.traffic.source import SHAPE_OF_CLASS, TrafficEnded, world_from_bumpers
from cosim.world import LanePaths, World
from sensors.scene import Shape
from sumo_nets import sumocfg
from sumo_nets.catalogue import bounds_m
from sumo_nets.sumocfg import first_departure_s
from sumo_nets.vtypes import SIZES_M, check_size

_LEFT_OUT = -1
_LOST = "Warning: (?=Route file should be sorted|Removing )"
"""SUMO's warnings begin so if it leaves out a part of the demand."""
_END_S = 10.0
"""Time that SUMO's process has to end by itself [s]."""


class SumoTraffic:
    """A running SUMO simulation that is read into arrays step by step.

    Without a driver, SUMO computes the next step while the caller is busy with the present one. No file is written
    outside a temporary folder: outputs of the configuration are switched off, and outputs of its additional files
    (detectors) go to that folder.
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
        self._registry, self._config, self._has_driver = registry, config, has_driver
        self._frame = frame or Frame(f"traffic.scenario = {config}", bounds_m=bounds_m(sumocfg.read(config).net))
        self._step, self._warmup_s, self._is_commanding = 0, 0.0, False
        self._counts = FlowCounts(params.step_s)
        self._left_out: Counter[str] = Counter()
        self._number = np.zeros(0, np.int32)
        """Actor number of each `NewActor`, or `_LEFT_OUT`."""
        self._now: Snapshot | None = None
        self._is_ahead = False
        """Whether the next step has been asked for."""
        self._log_end = 0
        """Length of SUMO's log at its last answer."""
        self._scratch = Scratch()
        try:
            options = sumo_options(params, config, self._scratch.path, has_driver)
            self._process = started(self._log)
            self._kill = weakref.finalize(self, _ended, self._process)
            self._send(options, has_driver, self._frame.origin_m)
            self._receive("refuses it")
        except BaseException:
            self._clean()
            raise

    def warm_up(self, seconds: float) -> Iterator[float]:
        """Simulate `seconds` without reading actors. Yields the seconds that are done."""
        done = 0.0
        while done < seconds - 1e-6:
            yield done
            done = self._ask("warm_up", seconds)
        self._warmup_s = seconds

    def advance(self) -> World:
        """Simulate one step and read all actors."""
        if not self._is_ahead:
            self._send("advance" if self._step else "read")
        self._is_ahead = False
        now = self._now = self._receive()
        if not self._has_driver:
            self._send("advance")
            self._is_ahead = True
        step, self._step = self._step, self._step + 1
        if now.new:
            self._number = np.append(self._number, self._registered(now.new, step))
        number = self._number[now.number]
        kept = number != _LEFT_OUT
        front_m = now.front_m[kept]
        angle = now.compass_deg[kept]
        speed = now.speed_mps[kept]
        world = world_from_bumpers(step, number[kept], front_m, angle, speed, self._registry, self._frame)
        self._counts.add(world)
        return replace(world, paths=self._paths(world)) if self._has_driver else world

    def _paths(self, world: World) -> LanePaths:
        """Lane paths of the equipped vehicles."""
        rows = np.flatnonzero(world.equipped)
        names = [self._registry.names[actor] for actor in world.actor[rows].tolist()]
        at, *found = self._ask("paths", names)
        return LanePaths(rows[at], *found)

    def command(self, actor: Int[ndarray, "c"], speed_mps: Float[ndarray, "c"]) -> None:
        """Command speeds for the next step, within the limits of the road and of the vehicle.

        SUMO's safe speeds, junctions and red lights still apply. A vehicle that is not commanded again drives as SUMO
        decides. So does a vehicle whose commanded speed is not finite.

        Parameters
        ----------
        actor
            Actor numbers of the commanded vehicles. Without a driver there are none.
        speed_mps
            Speed of each.
        """
        finite = np.isfinite(speed_mps)
        names = map(self._registry.names.__getitem__, actor[finite].tolist())
        wanted = dict(zip(names, speed_mps[finite].tolist(), strict=True))
        if wanted or self._is_commanding:
            assert self._has_driver, "the next step is on its way"
            self._ask("command", wanted)
            self._is_commanding = bool(wanted)

    def report(self) -> dict[str, Any]:
        now = self._now
        return {
            "vehicles_waiting_to_enter_at_end": 0 if now is None else now.n_waiting,
            "teleports": 0 if now is None else now.n_teleports,
            "actors_left_out": dict(sorted(self._left_out.items())),
            **({"collisions": 0 if now is None else now.n_collisions} if self._has_driver else {}),
            **self._counts.report(),
            **self._first_departure(),
            **({"sumo_errors": errors[:9]} if (errors := self._errors(0)) else {}),
            **({"sumo_warnings": lost[:9]} if (lost := self._messages(_LOST, 0)) else {}),
        }

    def _first_departure(self) -> dict[str, float]:
        """The first departure of the demand, if nobody was ever on the road."""
        if self._counts.n_vehicles or self._counts.n_pedestrians:
            return {}
        if (first_s := first_departure_s(sumocfg.read(self._config).demand)) is None:
            return {}
        return {"first_departure_s": first_s, "warmup_s": self._warmup_s}

    def close(self) -> None:
        """End SUMO and its process, and remove the temporary folder."""
        try:
            if self._is_ahead:
                with suppress(TrafficError, TrafficEnded):  # of a step that nobody wants
                    self._receive()
            if self._kill.alive:
                self._send("close")
                self._receive("ends with an error")
        finally:
            self._clean()

    def _clean(self) -> None:
        self._is_ahead = False
        if kill := getattr(self, "_kill", None):
            kill()
        self._scratch.remove()

    def _registered(self, new: list[NewActor], step: int) -> Int[ndarray, "k"]:
        """Register new actors, and return their numbers."""
        new = list(map(_on_foot, new))
        has_shape = [actor.vclass in SHAPE_OF_CLASS for actor in new]
        kept = list(compress(new, has_shape))
        self._left_out.update(actor.vclass for actor in new if actor.vclass not in SHAPE_OF_CLASS)
        for actor in kept:
            where = f"traffic.scenario = {self._config}: {actor.domain} {actor.name!r}"
            try:
                for what, value in zip(("length", "width", "height"), actor.lwh_m, strict=True):
                    check_size(where, what, value)
            except ValueError as error:
                raise TrafficError(str(error)) from None
        number = np.full(len(new), _LEFT_OUT, np.int32)
        if kept:
            shapes = np.array([SHAPE_OF_CLASS[actor.vclass] for actor in kept], np.uint8)
            lwh_m = np.array([actor.lwh_m for actor in kept])
            number[has_shape] = self._registry.register([actor.name for actor in kept], shapes, lwh_m, step)
        return number

    def _ask(self, request: str, *arguments: Any) -> Any:
        self._send(request, *arguments)
        return self._receive()

    def _send(self, *request: Any) -> None:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # that the process has ended shows when its answer is read
            pickle.dump(request, self._process.stdin, pickle.HIGHEST_PROTOCOL)
            self._process.stdin.flush()

    def _receive(self, failing: str = "gives up") -> Any:
        """The result of the oldest request that is not answered yet.

        Raises
        ------
        TrafficEnded
            The traffic has ended.
        TrafficError
            SUMO has failed, in one line with the reason that SUMO writes to its log; `failing` says what it does.
        """
        assert self._process.stdout is not None
        begin, where = self._log_end, f"traffic.scenario = {self._config}"
        try:
            word, found, self._log_end = pickle.load(self._process.stdout)
        except (EOFError, pickle.UnpicklingError):
            self._kill()
            last = self._log.read_text("utf-8", "replace").split("\n")[-2:][0].strip()
            raise TrafficError(
                f"{where}: SUMO broke down ({_status(self._process.returncode)}){last and ': '}{last}."
            ) from None
        except BaseException:  # an interrupt: half an answer is no use
            self._kill()
            raise
        if word == ENDED:
            raise TrafficEnded(found)
        if word == FAILED:
            raise TrafficError(f"{where}: SUMO {failing}: {' '.join(self._errors(begin)) or found}")
        return found

    @property
    def _log(self) -> Path:
        return self._scratch.path / "sumo.log"

    def _errors(self, begin: int) -> list[str]:
        """SUMO's error messages after that byte of its log. SUMO continues after many."""
        return self._messages("Error: ", begin)

    def _messages(self, first_words: str, begin: int) -> list[str]:
        """SUMO's messages that begin so, after that byte of its log, each once and in one line."""
        text = self._log.read_bytes()[begin : self._log_end].decode(errors="replace")
        text = text.replace(_prefix(self._scratch.path), "")
        messages = re.findall(rf"^{first_words}(.*(?:\n .*)*)", text, re.MULTILINE)
        return list(dict.fromkeys(" ".join(message.split()) for message in messages))


def _on_foot(actor: NewActor) -> NewActor:
    """A person is on foot, as in a trace, also where its type has the class of a vehicle, SUMO's default."""
    if actor.domain != "person" or SHAPE_OF_CLASS.get(actor.vclass) in (None, Shape.PEDESTRIAN):
        return actor
    return actor._replace(vclass="pedestrian", lwh_m=SIZES_M["pedestrian"])


def started(log: Path) -> subprocess.Popen[bytes]:
    """SUMO's process. It finds modules where this one does, and not in the working directory.

    `tests.processes` puts a fork of a process that has loaded SUMO in its place, which spares 0.4 s of processor time.
    """
    paths = [path or os.getcwd() for path in sys.path]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    words, pipe = [sys.executable, "-P", "-m", "cosim.traffic.sumo_process"], subprocess.PIPE
    with log.open("ab") as errors:
        return subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=errors, env=environment)


def _ended(process: subprocess.Popen[bytes]) -> None:
    """End SUMO's process: it ends when its requests do."""
    for stream in (process.stdin, process.stdout):
        assert stream is not None
        with suppress(BrokenPipeError):
            stream.close()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _status(code: int) -> str:
    return f"exit status {code}" if code >= 0 else f"signal {-code}"


def sumo_options(params: TrafficParams, config: Path, scratch: Path, has_driver: bool) -> list[str]:
    """SUMO's command line. It uses a copy of the configuration, which has harmless options only."""
    files = sumocfg.read(config)
    if params.car_following == "calibrated":
        files = calibrated(files, scratch)
    files = sumocfg.without_commas(files, scratch)
    copy = scratch / "scenario.sumocfg"
    copy.write_text(files.text(), encoding="utf-8")
    options = {
        "configuration-file": copy,
        "seed": params.seed,
        "step-length": params.step_s,
        "no-step-log": "true",
        "duration-log.disable": "true",
        "duration-log.statistics": "false",
        "no-warnings": "false",
        "aggregate-warnings": 1,  # one of each kind, because a jam has thousands
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
        **({} if params.scale == 1 else {"scale": params.scale * files.scale}),
    }
    words = []
    for name, value in options.items():
        words += [f"--{name}", str(value)]
    return words


def _prefix(scratch: Path) -> str:
    """The value of `output-prefix`. SUMO puts it before file names; it leads from any folder to the temporary one."""
    return "../" * 64 + str(scratch).lstrip("/") + "/"
