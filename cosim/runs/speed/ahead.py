"""Computes, in a second thread, values of the next step that depend on its world only.

Sweeps, radio links and near pairs depend on positions and on random draws with keys from names. They do not depend on
earlier steps. If no driver commands the traffic, the next world is known early. The second thread then computes the
radio links and near pairs of the next world while the present step sends, evaluates and records. Range images of many
vehicles are large. There is one memory for them, so the sweeps of the next world begin when the present step has read
its own images for the last time. Those of few vehicles begin at once. Compiled kernels run in parallel with Python code
(`nogil`).

The step gets these values as `cosim.step.precomputed.Precomputed`. A step of another world computes all of them itself.
The values do not depend on the order in which the threads run.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.base.threads import n_threads, use_threads
from cosim.radio.link_cache import LinkCache
from cosim.radio.medium import LinksAhead
from cosim.radio.message_round import Stations
from cosim.step.exchange import stations_of
from cosim.step.parts import Parts
from cosim.step.perception import Observed, Perception
from cosim.step.precomputed import Precomputed
from cosim.step.stopwatch import Stopwatch
from cosim.step.trackers.encounters import NearPairs
from cosim.world import World


@dataclass(frozen=True, slots=True)
class _Begun:
    """Computations that have begun for one world, except its sweeps."""

    world: World
    near_pairs: Future[NearPairs]
    links: Future[LinkCache] | None
    """None if the medium does not compute links."""


class Ahead:
    """A thread that computes ahead for the steps of a run. It is a context manager; the thread ends with it.

    `expect` names the next world, and `of` returns what has been computed for a world. Only one thread may use it.
    """

    def __init__(self, parts: Parts, perception: Perception) -> None:
        self.watch = Stopwatch()
        """Seconds per stage that this thread has computed ahead."""
        self._parts = parts
        self._perception = perception
        self._thread = ThreadPoolExecutor(1, "ahead")
        self._begun: list[_Begun] = []
        """For the present step and the expected one at most."""
        self._to_sense: World | None = None
        """The expected world, if its sweeps have not begun."""
        self._sensing: list[tuple[World, Future[Observed]]] = []
        """Worlds whose sweeps have begun: the present one, and the expected one."""

    def expect(self, world: World, at_once: bool) -> None:
        """Begin to compute for the world of the next step with messages.

        Parameters
        ----------
        world
            The next world with messages.
        at_once
            Begin its sweeps now, because the present step senses nothing. Otherwise they begin when the present step
            has read its own range images, unless these have a memory of their own.
        """
        if not world.equipped.any():
            return
        self._to_sense = world
        if n_threads() > 1:  # for few vehicles this is mostly Python code, which delays the present step
            medium, links = self._parts.medium, None
            self._thread.submit(use_threads, n_threads() // 2)  # the others are the step's
            if isinstance(medium, LinksAhead):
                links = self._thread.submit(self._links, medium, self._stations(world), self._senders(world))
            near_pairs = self._thread.submit(self._near_pairs, world)
            self._begun = [*self._begun[-1:], _Begun(world, near_pairs, links)]
        if at_once or (self._sensing and self._perception.keeps_last(len(self._parts.sensing(world)))):
            self._begin_sensing()

    def of(self, world: World) -> Precomputed:
        """The values that have been computed for the step of this world."""
        found = next((begun for begun in self._begun if begun.world is world), None)
        links = None if found is None else found.links
        return Precomputed(
            near_pairs=None if found is None else found.near_pairs.result,
            observed=partial(self._observed, world) if self._sensing else None,
            with_links=None if links is None else partial(_with_links, links),
            sweeps_are_read=self._begin_sensing,
        )

    def _begin_sensing(self) -> None:
        """Begin the sweeps of the expected world, if they have not begun."""
        if self._to_sense is not None:
            world, self._to_sense = self._to_sense, None
            self._sensing.append((world, self._thread.submit(self._sense, world, n_threads())))

    def _observed(self, world: World) -> Observed:
        """What vehicles perceive, when their sweeps are complete."""
        for number, (expected, observed) in enumerate(self._sensing):
            if expected is world:
                del self._sensing[: number + 1]
                return observed.result()
        for _, other in self._sensing:  # of other worlds, in the same memory
            other.result()
        self._sensing.clear()
        return self._perception(world, self._parts.sensing(world), self._parts.watch)

    def _stations(self, world: World) -> Stations:
        above_roof_m = self._parts.config.radio.antenna_above_roof_m
        return stations_of(world, np.flatnonzero(world.equipped), self._parts.rsus, above_roof_m)

    def _sense(self, world: World, n: int) -> Observed:
        use_threads(n)
        return self._perception(world, self._parts.sensing(world), self.watch)

    def _near_pairs(self, world: World) -> NearPairs:
        with self.watch("pairs"):
            return self._parts.near_pairs(world)

    def _senders(self, world: World) -> Int[ndarray, "k"]:
        """Stations that send new messages: vehicles that sense, and roadside units."""
        equipped = np.flatnonzero(world.equipped)
        n_vehicles, n_units = len(equipped), len(self._parts.rsus)
        sensing = np.searchsorted(equipped, self._parts.sensing(world))
        return np.append(sensing, n_vehicles + np.arange(n_units))

    def _links(self, medium: LinksAhead, stations: Stations, senders: Int[ndarray, "k"]) -> LinkCache:
        with self.watch("links"):
            return medium.links(stations, senders)

    def __enter__(self) -> "Ahead":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._thread.shutdown(cancel_futures=True)


def _with_links(links: Future[LinkCache], state: Any) -> Any:
    """The medium's state with links that were computed ahead."""
    return replace(state, cache=links.result())
