"""What depends on the next world alone, computed in a thread of its own while the present step still sends, trusts,
fuses and records.

What vehicles perceive, how well stations hear each other and who is near whom depends on positions and on random draws
keyed by names, not on earlier steps. Where no driver commands the traffic, the next world is therefore known early. Its
radio links and near pairs are found while the present step sends and evaluates, which keeps one core busy. Its sweeps
begin as soon as the range images of the present step have been asked for the last time, in the same memory. Compiled
kernels run beside Python (`nogil`).

Values are the same in whatever order the threads run: a step waits for what was begun for its world, and computes
itself what was begun for another.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType

import numba
import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.radio.csma import ChannelContext, CsmaMedium, LinkCache
from cosim.radio.message_round import MessageRound, Messages, RoundKind, Stations
from cosim.step import stages
from cosim.step.parts import Parts
from cosim.step.perception import BoxAnswers, BoxQuestions, Observed, Perception
from cosim.step.stopwatch import Stopwatch
from cosim.step.trackers.encounters import NearPairs
from cosim.world import World
from sensors import lidar
from sensors.kernel import threads_may_meet


class Ahead:
    """The parts of a run, with those that may be told which world comes next. A context manager: its thread ends with
    it."""

    def __init__(self, parts: Parts) -> None:
        assert isinstance(parts.perception, Perception), "the run's own perception"
        self.watch = Stopwatch()
        """Seconds per stage of what was computed ahead."""
        self._thread = ThreadPoolExecutor(1, "ahead")
        self._sensing = SensingAhead(parts.perception, self._thread, self.watch)
        self._pairs = PairsAhead(parts.near_pairs, self._thread, self.watch)
        self._links = None
        self.parts = replace(parts, perception=self._sensing, near_pairs=self._pairs)
        if isinstance(parts.medium, CsmaMedium):
            self._links = LinksAhead(parts.medium, self._thread, self.watch)
            self.parts = replace(self.parts, medium=self._links)

    def expect(self, world: World, at_once: bool) -> None:
        """The world that the next step with messages will be of: its sweeps begin `at_once` where the step before it
        senses nothing, or when the range images of that step have given their answers."""
        if world.equipped.any() and threads_may_meet():
            if numba.get_num_threads() > 1:  # of few vehicles they are mostly Python, which holds up the present step
                if self._links is not None:
                    self._links.expect(stages.stations_of(world, np.flatnonzero(world.equipped), None, self.parts))
                self._pairs.expect(world)
            self._sensing.expect(world, at_once)

    def __enter__(self) -> "Ahead":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._thread.shutdown(cancel_futures=True)


class SensingAhead:
    """In place of `cosim.step.perception.Perception`."""

    def __init__(self, own: Perception, thread: ThreadPoolExecutor, watch: Stopwatch) -> None:
        self._own, self._thread, self._watch = own, thread, watch
        self._next: World | None = None
        self._under_way: tuple[World, Future[Observed]] | None = None

    def expect(self, world: World, at_once: bool) -> None:
        """As `Ahead`."""
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
        if world is not None:
            self._under_way = world, self._thread.submit(self._sense, world, numba.get_num_threads())

    def _sense(self, world: World, n_threads: int) -> Observed:
        numba.set_num_threads(n_threads)  # a setting of each thread
        return self._own(world, np.flatnonzero(world.equipped), self._watch)


class PairsAhead:
    """In place of `cosim.step.trackers.encounters.PairSearch`."""

    def __init__(self, own: Callable[[World], NearPairs], thread: ThreadPoolExecutor, watch: Stopwatch) -> None:
        self._own, self._thread, self._watch = own, thread, watch
        self._under_way: list[tuple[World, Future[NearPairs]]] = []

    def expect(self, world: World) -> None:
        """The world of a later step; those of the present one may not have been asked for yet."""
        self._under_way = [*self._under_way[-1:], (world, self._thread.submit(self._search, world))]

    def __call__(self, world: World) -> NearPairs:
        """As `PairSearch`."""
        for expected, found in self._under_way:
            if expected is world:
                return found.result()
        return self._own(world)

    def _search(self, world: World) -> NearPairs:
        numba.set_num_threads(1)  # the other core is the present step's
        with self._watch("pairs"):
            return self._own(world)


class LinksAhead:
    """In place of `cosim.radio.csma.CsmaMedium`."""

    def __init__(self, own: CsmaMedium, thread: ThreadPoolExecutor, watch: Stopwatch) -> None:
        self._own, self._thread, self._watch = own, thread, watch
        self._under_way: list[tuple[Stations, Future[LinkCache]]] = []

    def expect(self, stations: Stations) -> None:
        """Stations of a later step."""
        self._under_way = [*self._under_way[-1:], (stations, self._thread.submit(self._links, stations))]

    def start(self) -> ChannelContext:
        """As `Medium`."""
        return self._own.start()

    def broadcast(
        self, state: ChannelContext, kind: RoundKind, step: int, begin_s: float, stations: Stations, messages: Messages
    ) -> tuple[ChannelContext, MessageRound]:
        """As `Medium`."""
        for expected, links in self._under_way:
            if expected.equals(stations):
                state = replace(state, cache=links.result())
        return self._own.broadcast(state, kind, step, begin_s, stations, messages)

    def _links(self, stations: Stations) -> LinkCache:
        numba.set_num_threads(1)  # the other core is the present step's
        with self._watch("links"):
            return self._own.links(stations)
