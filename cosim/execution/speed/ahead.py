"""What depends on the next world alone, computed in a thread of its own while the present step still sends, trusts,
fuses and records.

What vehicles perceive, how well stations hear each other and who is near whom depends on positions and on random draws
keyed by names, not on earlier steps. Where no driver commands the traffic, the next world is therefore known early. Its
radio links and near pairs are found while the present step sends and evaluates, which keeps one core busy. Its sweeps
begin as soon as the present step has read its own range images for the last time, because they share their memory.
Compiled kernels run beside Python (`nogil`).

What was computed is handed to its step as `cosim.step.precomputed.Precomputed`; a step of another world computes all
itself. Values are the same in whatever order the threads run.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from types import TracebackType

import numba
import numpy as np

from cosim.radio.csma import ChannelContext, CsmaMedium, LinkCache
from cosim.radio.message_round import Stations
from cosim.step.exchange import stations_of
from cosim.step.parts import Parts
from cosim.step.perception import Observed
from cosim.step.precomputed import Precomputed
from cosim.step.stopwatch import Stopwatch
from cosim.step.trackers.encounters import NearPairs
from cosim.world import World
from sensors.kernel import threads_may_meet


@dataclass(frozen=True, slots=True)
class _Begun:
    """What has been begun for one world, apart from its sweeps."""

    world: World
    near_pairs: Future[NearPairs]
    links: Future[LinkCache] | None
    """None where the medium does not compute links."""


class Ahead:
    """A thread that computes ahead for the steps of a run with these parts. A context manager: the thread ends with it.

    `expect` says which world comes next, and `of` gives what there is of a world to its step. Used by one thread.
    """

    def __init__(self, parts: Parts) -> None:
        self.watch = Stopwatch()
        """Seconds per stage of what was computed ahead."""
        self._parts = parts
        self._thread = ThreadPoolExecutor(1, "ahead")
        self._begun: list[_Begun] = []
        """Of the present step and of the one expected, at most."""
        self._to_sense: World | None = None
        """Expected, and its sweeps not begun."""
        self._sensing: tuple[World, Future[Observed]] | None = None
        """The one world whose sweeps have been begun, in the memory of all range images."""

    def expect(self, world: World, at_once: bool) -> None:
        """The world of the next step with messages.

        Its sweeps begin `at_once` where the step before it senses nothing, or else when that step has read its own.
        """
        if not world.equipped.any() or not threads_may_meet():
            return
        if numba.get_num_threads() > 1:  # of few vehicles they are mostly Python, which holds up the present step
            medium, links = self._parts.medium, None
            if isinstance(medium, CsmaMedium):
                links = self._thread.submit(self._links, medium, self._stations(world))
            near_pairs = self._thread.submit(self._near_pairs, world)
            self._begun = [*self._begun[-1:], _Begun(world, near_pairs, links)]
        self._to_sense = world
        if at_once:
            self._begin_sensing()

    def of(self, world: World) -> Precomputed:
        """What is known of the step of this world before it begins."""
        found = next((begun for begun in self._begun if begun.world is world), None)
        links = None if found is None else found.links
        return Precomputed(
            near_pairs=None if found is None else found.near_pairs.result,
            observed=None if self._sensing is None else partial(self._observed, world, self._sensing),
            with_links=None if links is None else partial(_with_links, links),
            sweeps_are_read=self._begin_sensing,
        )

    def _begin_sensing(self) -> None:
        """Begin the sweeps of the world that is expected, if they have not been begun."""
        if self._to_sense is not None:
            world, self._to_sense = self._to_sense, None
            self._sensing = world, self._thread.submit(self._sense, world, numba.get_num_threads())

    def _observed(self, world: World, sensing: tuple[World, Future[Observed]]) -> Observed:
        """What vehicles perceive, once the sweeps that were begun are complete; those of another world are dropped."""
        self._sensing = None
        expected, found = sensing
        observed = found.result()
        if expected is world:
            return observed
        return self._parts.perception(world, np.flatnonzero(world.equipped), self._parts.watch)

    def _stations(self, world: World) -> Stations:
        above_roof_m = self._parts.config.radio.antenna_above_roof_m
        return stations_of(world, np.flatnonzero(world.equipped), self._parts.rsus, above_roof_m)

    def _sense(self, world: World, n_threads: int) -> Observed:
        numba.set_num_threads(n_threads)  # a setting of each thread
        return self._parts.perception(world, np.flatnonzero(world.equipped), self.watch)

    def _near_pairs(self, world: World) -> NearPairs:
        numba.set_num_threads(1)  # the other core is the present step's
        with self.watch("pairs"):
            return self._parts.near_pairs(world)

    def _links(self, medium: CsmaMedium, stations: Stations) -> LinkCache:
        numba.set_num_threads(1)  # the other core is the present step's
        with self.watch("links"):
            return medium.links(stations)

    def __enter__(self) -> "Ahead":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._thread.shutdown(cancel_futures=True)


def _with_links(links: Future[LinkCache], state: ChannelContext) -> ChannelContext:
    """The medium's state with links that were found ahead."""
    return replace(state, cache=links.result())
