"""Perception of the next step in a thread of its own, while the present one still sends, trusts, fuses and records.

What vehicles perceive depends on the world and on random draws keyed by names, not on earlier steps. Where no driver
commands the traffic, the next world is therefore known early. Its sweeps begin as soon as the range images of
the present step have been asked for the last time, in the same memory; compiled kernels run beside Python (`nogil`).
"""

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

import numba
import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.perception import BoxAnswers, BoxQuestions, Observed, Perception
from cosim.stopwatch import Stopwatch
from cosim.world import World
from sensors import lidar


class SensingAhead:
    """Perception that may be told which world comes next; in place of `cosim.perception.Perception`.

    Values are the same in whatever order the threads run: each step's sweeps are complete before it goes on with them,
    and nothing reads range images while they are written. A context manager: its thread ends with it.
    """

    def __init__(self, own: Perception) -> None:
        self._own = own
        self._thread = ThreadPoolExecutor(1, "sensing ahead")
        self._next: World | None = None
        self._under_way: tuple[World, Future[Observed]] | None = None
        self.watch = Stopwatch()
        """Seconds per stage of what was sensed ahead."""

    def __enter__(self) -> "SensingAhead":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._thread.shutdown(cancel_futures=True)

    def expect(self, world: World, at_once: bool) -> None:
        """The world that will be asked about next: `at_once` where the step before it senses nothing, or when the range
        images of that step have given their answers."""
        self._next = world
        if at_once:
            self._begin()

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """As `Perceives`."""
        if self._under_way is not None:
            ahead, found = self._under_way
            self._under_way = None
            with watch("wait for sensing"):
                observed = found.result()
            if ahead is world:
                return observed
        return self._own(world, observers, watch)

    def answers(self, sweeps: lidar.Scanners, asked: BoxQuestions) -> BoxAnswers:
        """As `Perceives`."""
        found = self._own.answers(sweeps, asked)
        self._begin()
        return found

    def _begin(self) -> None:
        world, self._next = self._next, None
        if world is None or not world.equipped.any() or not _threads_may_meet():
            return
        self._under_way = world, self._thread.submit(self._sense, world, numba.get_num_threads())

    def _sense(self, world: World, n_threads: int) -> Observed:
        numba.set_num_threads(n_threads)  # a setting of each thread
        return self._own(world, np.flatnonzero(world.equipped), self.watch)


def _threads_may_meet() -> bool:
    """Whether two threads may run parallel kernels at once: with Numba's layers omp and tbb, and not with workqueue."""
    try:
        return numba.threading_layer() != "workqueue"
    except ValueError:  # no parallel kernel has run yet
        return False
