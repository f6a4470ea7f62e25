"""One long run on several workers: sweeps, detections and the evidence in range images are theirs.

The recorded traffic is cut into shards (`cosim.studies.shard_worker`), which workers sense ahead of the step that needs
them; their range images stay where they were made, and are asked there what they say of the boxes that vehicles
received. All else, everything that has a state, is computed by one process, step by step, as in a run without workers:
the tables are the same, value for value. A shard that is lost with its worker is sensed again by another.
"""

import json
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from cosim.config.config import Config
from cosim.execution import run as running
from cosim.execution.check import check
from cosim.execution.drive import Advance
from cosim.execution.folder import check as check_folder
from cosim.mobility.scenario import find
from cosim.step.perception import BoxAnswers, BoxQuestions, Observed, Perceives, Perception
from cosim.step.stopwatch import Stopwatch
from cosim.studies.engine import Client, Future, connected, gathered
from cosim.studies.plan import TRAFFIC_VERSION
from cosim.studies.points import traffic_identity
from cosim.studies.shard_worker import Shard, answers_of, problem_of, seen_of, sense
from cosim.studies.stages import Cache, default_folder
from cosim.world import World
from sensors.lidar import Scanners, n_rays, scanners

SHARD_BYTES = 32_000_000
"""Range images of a shard at most; of one observer at least."""
_AHEAD = 3
"""Shards for each worker that are sensed, or being sensed, before the step that needs them."""
_STEPS_PER_COUNT = 50
"""Steps after which workers are counted again."""
_SOON = 10
"""Priority of what the present step waits for, before what is sensed ahead."""


def run(config: Config, out: Path | None, advance: Advance, scheduler: str | None = None, workers: int = 1) -> Path:
    """As `cosim.execution.run.run`, with the help of workers; the folder that it wrote."""
    check_folder(out)
    check(config)
    _check(config)
    traffic = _recorded(config, advance)
    with _helped(config, traffic, scheduler, workers) as perceive:
        return running.run(config, out, advance, traffic, perceive)


def resume(
    path: Path, advance: Advance, scheduler: str | None = None, workers: int = 1, trust_code: bool = False
) -> Path:
    """As `cosim.execution.run.resume`, with the help of workers."""
    config = running.resumable(path, trust_code)
    _check(config)
    traffic = _recorded(config, advance)
    with _helped(config, traffic, scheduler, workers) as perceive:
        return running.resume(path, advance, traffic, perceive, trust_code)


def _check(config: Config) -> None:
    """ValueError where the traffic cannot be recorded before the run."""
    if config.driver.model != "none":
        raise ValueError(
            f'driver.model = "{config.driver.model}": what vehicles believe drives them, so that nothing can be sensed '
            'ahead. Leave --workers and --scheduler out, or set driver.model to "none".'
        )


def _recorded(config: Config, advance: Advance) -> Path | None:
    """The traffic of a config, driven once and kept in the cache; None where it replays a trace or a run itself."""
    if find(config.traffic.scenario, config.traffic.trace).trace is not None:
        return None
    cache, name = Cache(default_folder()), traffic_identity(config, TRAFFIC_VERSION)
    cache.make_traffic(name, config, advance)
    return cache.find("traffic", name)


@contextmanager
def _helped(
    config: Config, traffic: Path | None, scheduler: str | None, workers: int
) -> Iterator[Callable[[Perception], Perceives]]:
    """What makes the workers' perception out of a run's own; ValueError where a worker cannot do it."""
    text = json.dumps(config.to_dict(), default=str)
    with connected(scheduler, workers, traffic, processes=True) as client:
        for worker, problem in client.run(problem_of, text).items():
            if problem:
                raise ValueError(f"worker {worker}: {problem}")
        with closing(running.worlds_of(config, traffic)) as worlds:
            yield lambda own: ShardedPerception(own, client, text, config.sense_every_steps, worlds)


@dataclass(frozen=True, slots=True)
class _Piece:
    """Some observers of a step, and the shard that they are sensed in."""

    sensed: Future
    seen: Future
    number: int
    """Which step of the shard."""
    first: int
    """The first of these observers among those of the step."""
    end: int


class ShardedPerception:
    """Perception by the workers of a Dask cluster, ahead of time; in place of `cosim.step.perception.Perception`.

    Parameters
    ----------
    own
        The run's own perception, for all that needs no sweeps.
    config
        The run's, its plain data as JSON.
    worlds
        Those that the run will ask about, in order, and those between them.
    shard_bytes
        As `SHARD_BYTES`.
    """

    def __init__(
        self, own: Perception, client: Client, config: str, every_steps: int, worlds: Iterator[World],
        shard_bytes: int = SHARD_BYTES,
    ) -> None:  # fmt: skip
        self._own, self._client, self._config, self._every_steps = own, client, config, every_steps
        self._worlds = worlds
        self._ahead: deque[tuple[World, list[_Piece]]] = deque()
        self._now: list[_Piece] = []
        rays = n_rays(own.lidar)
        self._most = max(1, shard_bytes // (np.dtype(np.uint16).itemsize * rays[0] * rays[1]))
        self._n_asked, self._n_workers = 0, 1

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """As `Perceives`."""
        with watch("sweep"):
            self._now = []
            self._look_ahead(world.step)
            ahead, self._now = self._ahead.popleft()
            assert ahead.step == world.step and np.array_equal(ahead.actor, world.actor), "the traffic is the same"
            found = gathered(self._client, [piece.seen for piece in self._now])
        with watch("detect"):
            seen = [steps[piece.number].behind(piece.first) for steps, piece in zip(found, self._now, strict=True)]
            return self._own.observed(world, observers, scanners(world.boxes, observers, self._own.lidar), seen)

    def answers(self, sweeps: Scanners, asked: BoxQuestions) -> BoxAnswers:
        """As `Perceives`."""
        origin_m = sweeps.poses.origin_m
        found = gathered(self._client, [
            self._client.submit(
                answers_of, piece.sensed, piece.number, origin_m[piece.first : piece.end],
                _of_observers(asked, piece.first, piece.end), priority=_SOON, pure=False,
            )
            for piece in self._now
        ])  # fmt: skip
        self._now = []
        return np.concatenate([n_points for n_points, _ in found]), np.concatenate([possible for _, possible in found])

    def _look_ahead(self, step: int) -> None:
        """Hand out shards until every worker has some to do; worlds before `step` are passed over."""
        if self._n_asked % _STEPS_PER_COUNT == 0:  # it is a question to the scheduler
            self._n_workers = max(1, len(self._client.nthreads()))
        self._n_asked += 1
        wanted = _AHEAD * self._n_workers * self._most
        n = sum(pieces[-1].end for _, pieces in self._ahead)
        while n < wanted or not self._ahead:
            if not (worlds := self._next(step)):
                break
            self._hand_out(worlds)
            n += sum(int(world.equipped.sum()) for world in worlds)

    def _next(self, step: int) -> list[World]:
        """The worlds whose sweeps fill a shard, or one that fills several; none at the end."""
        found: list[World] = []
        n = 0
        for world in self._worlds:
            n_here = int(world.equipped.sum())
            if world.step >= step and world.step % self._every_steps == 0 and n_here:
                found.append(world)
                n += n_here
                if n + n_here > self._most:
                    break
        return found

    def _hand_out(self, worlds: list[World]) -> None:
        """Have these worlds sensed: together, or one in parts."""
        observers = [np.flatnonzero(world.equipped) for world in worlds]
        if len(worlds) > 1:
            shard = self._submit(Shard(tuple(worlds), tuple(observers)))
            for number, (world, rows) in enumerate(zip(worlds, observers, strict=True)):
                self._ahead.append((world, [_Piece(*shard, number, 0, len(rows))]))
            return
        rows = observers[0]
        ends = [*range(self._most, len(rows), self._most), len(rows)]
        self._ahead.append((worlds[0], [
            _Piece(*self._submit(Shard((worlds[0],), (rows[first:end],))), 0, first, end)
            for first, end in zip([0, *ends], ends, strict=False)
        ]))  # fmt: skip

    def _submit(self, shard: Shard) -> tuple[Future, Future]:
        sensed = self._client.submit(sense, self._config, shard, pure=False)
        return sensed, self._client.submit(seen_of, sensed, priority=_SOON, pure=False)


def _of_observers(asked: BoxQuestions, first: int, end: int) -> BoxQuestions:
    """What the observers from `first` to `end` ask, counted from the first, with the boxes that they ask about."""
    counted, tested = (slice(*np.searchsorted(o, [first, end])) for o in (asked.counting, asked.testing))
    rows, at = np.unique(np.concatenate([asked.counted[counted], asked.tested[tested]]), return_inverse=True)
    n = counted.stop - counted.start
    return replace(
        asked, boxes=asked.boxes.take(rows), counting=asked.counting[counted] - first, counted=at[:n],
        testing=asked.testing[tested] - first, tested=at[n:],
    )  # fmt: skip
