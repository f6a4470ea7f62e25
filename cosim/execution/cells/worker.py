"""The processes of cells: `python -m cosim.execution.cells FD FD FD`.

The first process imports the program and gets the perception of the run. It forks a worker for every cell, and another
one when a worker has died. So workers share the memory of the program and of the city, and begin at once. A worker
keeps the range images of its vehicles until the next step, and nothing else.
"""

import os
import resource
import signal
import socket
import sys
import traceback
from dataclasses import dataclass, replace
from time import process_time
from typing import Any

from jaxtyping import Bool, Float, Int, Int32, UInt8
from numpy import ndarray

from cosim.door.load import load_own
from cosim.execution.cells.channel import Channel
from cosim.step.mixed_perception import MixedPerception
from cosim.step.perception import BoxAnswers, BoxQuestions, Perception, Seen
from cosim.step.stopwatch import Stopwatch
from cosim.world import World
from sensors.boxes import Boxes
from sensors.evidence import AreaParams
from sensors.lidar import Poses


@dataclass(frozen=True, slots=True)
class Reply:
    """What a worker answers."""

    result: Any
    """An exception if the work failed."""
    cpu_s: float
    """Processor time since the reply before."""
    stages_s: dict[str, float]
    """Seconds per stage of this request."""
    peak_bytes: int
    """Largest memory of the worker so far."""


@dataclass(frozen=True, slots=True)
class AreaQuestions:
    """Which boxes lie in the area that a vehicle of the cell evaluates; arguments as of `Perceives.in_area`."""

    o: Int[ndarray, "n"]
    boxes: Boxes
    area: AreaParams
    b: Int32[ndarray, "n"]
    label: UInt8[ndarray, "boxes"]
    own: Boxes


class Worker:
    """The services of a worker. Observers are numbered within the cell."""

    def __init__(self, perception: Perception | MixedPerception) -> None:
        self.perception, self.watch = perception, Stopwatch()
        self._images: Any = None

    def pid(self) -> int:
        """This process."""
        return os.getpid()

    def perceive(self, world: World, observers: Int[ndarray, "e"]) -> tuple[Poses, Seen]:
        """Poses of the sensors, and what they see; `world` is the cell and what is within reach of it."""
        images, seen = self.perception.perceive(world, observers.copy(), self.watch)
        self._images = images
        return images.poses, Seen.joined(seen)

    def in_area(self, error: Float[ndarray, "e 3"] | None, asked: AreaQuestions) -> Bool[ndarray, "n"]:
        """As in `Perceives`, with the errors of the vehicles' positions."""
        with self.watch("match"):
            return self.perception.in_area(
                self._at(error), asked.o, asked.boxes, asked.area, asked.b, asked.label, asked.own
            )

    def answers(self, error: Float[ndarray, "e 3"] | None, asked: BoxQuestions) -> BoxAnswers:
        """As in `Perceives`, with the errors of the vehicles' positions."""
        with self.watch("evaluate"):
            return self.perception.answers(self._at(error), asked)

    def _at(self, error: Float[ndarray, "e 3"] | None) -> Any:
        return self._images if error is None else self._images.displaced(error)


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
        now_s = process_time()
        reply, before_s = Reply(result, now_s - before_s, worker.watch.seconds, peak_bytes()), now_s
        try:
            channel.send(reply)
        except OSError:
            return
        except Exception as error:  # the exception of a user's own class may hold anything
            channel.send(replace(reply, result=RuntimeError(f"{type(result).__name__}: {result} ({error})")))


def peak_bytes() -> int:
    """Largest memory of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def main() -> None:
    """Fork a worker for every three files that arrive, until the run has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which then ends its workers
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    files = [int(word) for word in sys.argv[1:]]
    control = socket.socket(fileno=os.dup(files[0]))
    channel = Channel(files)
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
                serve(Channel(fds), Worker(perception))
                os._exit(0)
            for fd in fds:
                os.close(fd)
    except (EOFError, OSError):
        return  # the run has ended
