"""The processes of cells.

On the machine of the run, `python -m cosim.addons.cells FD FD FD` imports the program, loads its compiled functions,
and gets the perception of the run. It forks a worker for every cell, and another one when a worker has died. So workers
share the memory of the program and of the city, and begin at once. On other machines, each worker is a process
`python -m cosim.addons.cells connect HOST PORT` that reads a secret from standard input.

A worker keeps the range images of its vehicles until the next sweeps begin, the groups of the detections that they know
until it has fused them, and nothing else.
"""

import copy
import os
import resource
import signal
import socket
import sys
import threading
import traceback
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from time import thread_time
from typing import Any

from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.cells.channel import SECRET_BYTES, Channel, NetworkChannel, SharedChannel
from cosim.base.kernel import load_cached, threads_may_meet
from cosim.door.load import load_own
from cosim.step.comparing import Compared, FusionOf, Grouped, KnownObjects, PartRows, Used, compare
from cosim.step.mixed_perception import MixedPerception
from cosim.step.perception import Perception, Seen
from cosim.step.stopwatch import Stopwatch
from cosim.world import World
from sensors.evidence import AreaParams
from sensors.lidar import Poses
from trust.fusion import Fused
from trust.params import TrustParams
from trust.tables import Detections

_CONNECT_S = 30.0


@dataclass(frozen=True, slots=True)
class Reply:
    """What a worker answers."""

    result: Any
    """An exception if the work failed."""
    cpu_s: float
    """Processor time of the thread that answers since the reply before, and of the sweeps that it brings."""
    stages_s: dict[str, float]
    """Seconds per stage of this request."""
    peak_bytes: int
    """Largest memory of the worker so far."""


@dataclass(frozen=True, slots=True)
class _Sensed:
    """The sweeps of a cell's vehicles."""

    images: Any
    seen: Seen
    watch: Stopwatch
    cpu_s: float


class Worker:
    """The services of a worker. Observers are numbered within the cell.

    A second thread computes the sweeps, so that the worker can fuse meanwhile. Sweeps use the memory of those before,
    so they begin when these have been read: when the worker has answered what it has compared.
    """

    def __init__(self, perception: Perception | MixedPerception) -> None:
        self.perception, self.watch = perception, Stopwatch()
        of_vehicles = perception.of_lidar[0] if isinstance(perception, MixedPerception) else perception
        self._recall = getattr(getattr(of_vehicles, "detector", None), "recall", None)
        self._images: Any = None
        self._grouped: Any = None
        self._thread: ThreadPoolExecutor | None = None  # a thread that exists would not live through a fork
        self._to_sense: tuple[World, Int[ndarray, "e"]] | None = None
        self._perceived: Future[_Sensed] | None = None
        self._are_read = True
        self.sense_cpu_s = 0.0
        """Processor time of the sweeps that `perceived` has returned last."""

    def pid(self) -> int:
        """This process."""
        return os.getpid()

    def perceive(self, world: World, observers: Int[ndarray, "e"]) -> None:
        """Compute the sweeps of these observers next; `world` is the cell and what is within reach of it."""
        self._to_sense = copy.deepcopy((world, observers))  # the next message overwrites them
        if self._are_read:
            self.sweeps_are_read()

    def sweeps_are_read(self) -> None:
        """Begin with the next sweeps, if there are any; the last ones are not needed any more."""
        self._are_read = True
        if self._to_sense is None:
            return
        if self._perceived is not None:  # of a step that did not come
            self._perceived.exception()
        given, self._to_sense = self._to_sense, None
        if threads_may_meet():
            self._thread = self._thread or ThreadPoolExecutor(1, "sweeps")
            self._perceived = self._thread.submit(self._sense, *given)
        else:
            self._perceived = Future()
            try:
                self._perceived.set_result(self._sense(*given))
            except Exception as error:
                self._perceived.set_exception(error)

    def _sense(self, world: World, observers: Int[ndarray, "e"]) -> "_Sensed":
        watch, begin_s = Stopwatch(), thread_time()
        images, seen = self.perception.perceive(world, observers, watch)
        return _Sensed(images, Seen.joined(seen), watch, thread_time() - begin_s)

    def perceived(self) -> tuple[Poses, Seen]:
        """Poses of the sensors, and what they see, when the next sweeps are complete."""
        self.sweeps_are_read()
        assert self._perceived is not None
        self._are_read = False
        found, self._perceived = self._perceived, None
        sensed = found.result()
        self.watch.add(sensed.watch, 1)
        self._images, self.sense_cpu_s = sensed.images, sensed.cpu_s
        return sensed.images.poses, sensed.seen

    def n_returns(self) -> Int[ndarray, "e"]:
        """As `RangeImages.n_returns`."""
        return self._images.n_returns()

    def compare(
        self, error: Float[ndarray, "e 3"] | None, known: KnownObjects, rows: PartRows, area: AreaParams,
        params: TrustParams,
    ) -> Compared:  # fmt: skip
        """As `cosim.step.comparing.compare`, with the errors of the vehicles' positions."""
        images = self._images if error is None else self._images.displaced(error)
        recall = self._recall if params.denials == "recall" else None
        columns = (getattr(known.detections, column.name).copy() for column in fields(known.detections))
        known = replace(known, detections=Detections(*columns), own=known.own.copy())  # the next message overwrites it
        compared, grouped = compare(self.perception, images, known, area, params, recall, self.watch)
        self._grouped = grouped.renumbered(rows.messages)
        return compared

    def fuse(self, used: Used, variants: list[FusionOf]) -> list[Fused]:
        """As in `Fuses`."""
        with self.watch("fuse"):
            return self._grouped.fuse(used, variants)

    def grouped(self) -> Grouped:
        """What fusion needs of the comparison."""
        return self._grouped


def serve(channel: Channel, worker: Worker) -> None:
    """Answer requests until the run has ended."""
    before_s = 0.0
    while True:
        try:
            service, given = channel.receive()
        except (EOFError, OSError):
            return
        worker.watch.seconds = {}
        result: Any
        try:
            result = getattr(worker, service)(*given)
        except Exception as error:
            error.add_note(traceback.format_exc())
            result = error
        now_s, sense_s, worker.sense_cpu_s = thread_time(), worker.sense_cpu_s, 0.0
        reply, before_s = Reply(result, now_s - before_s + sense_s, worker.watch.seconds, peak_bytes()), now_s
        try:
            channel.send(reply)
        except OSError:
            return
        except Exception as error:  # the exception of a user's own class may hold anything
            channel.send(replace(reply, result=RuntimeError(f"{type(result).__name__}: {result} ({error})")))
        if service == "compare":
            worker.sweeps_are_read()


def peak_bytes() -> int:
    """Largest memory of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def connect(host: str, port: int) -> None:
    """Be the worker of a cell of a run on another machine, until the run or who has started this process has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who has started this process
    secret = os.read(0, SECRET_BYTES)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    load_cached()
    channel = NetworkChannel(socket.create_connection((host, port), timeout=_CONNECT_S))
    try:
        if not channel.knows(secret):
            sys.exit(f"{host}:{port} is not the run that asked for this worker. Nothing was read from it.")
        names = channel.receive()
        try:
            for name in names:
                load_own(name)
        except Exception as error:
            channel.send(error)
            return
        channel.send("ready")
        perception = channel.receive()
        channel.keep_last()
    except (EOFError, OSError):
        return  # the run has ended
    serve(channel, Worker(perception))
    os._exit(0)


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os._exit(3)


def main() -> None:
    """Fork a worker for every three files that arrive, until the run has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which then ends its workers
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    files = [int(word) for word in sys.argv[1:]]
    control = socket.socket(fileno=os.dup(files[0]))
    channel = SharedChannel(files)
    load_cached()
    try:
        for name in channel.receive():
            load_own(name)
        perception = channel.receive()
        channel.send("ready")
        while True:
            said, fds, *_ = socket.recv_fds(control, 1, 3)
            if not said:
                return
            if os.fork() == 0:
                control.close()
                channel.close()
                serve(SharedChannel(fds), Worker(perception))
                os._exit(0)
            for fd in fds:
                os.close(fd)
    except (EOFError, OSError):
        return  # the run has ended
