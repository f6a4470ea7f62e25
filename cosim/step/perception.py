"""What equipped vehicles perceive: sweeps, which actors could be seen in them, detections and self reports; and what
their sweeps say of the boxes that others report."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol, TypeVar

import numba
import numpy as np
from jaxtyping import Bool, Int, Int32, UInt16, UInt64
from numpy import ndarray

from cosim import rng
from cosim.step.stopwatch import Stopwatch
from cosim.v2x.messages import SENSED, Detections, self_reports
from cosim.world import World
from sensors import detector, evidence, lidar
from sensors.boxes import Boxes
from sensors.detector import Detector, DetectorDraws
from sensors.evidence import AreaParams
from sensors.kernel import threads_may_meet
from sensors.lidar import NO_MEMORY, SweepMemory
from sensors.neighbours import neighbours
from sensors.scene import Scene, prisms

_Rows = TypeVar("_Rows", evidence.Observability, detector.DetectedBoxes)

GROUP, FEW = 128, 64
"""Observers whose sweeps are read at once for what their rays met: at most, and at least where there are threads."""


@dataclass(frozen=True, slots=True)
class Observed:
    """What all equipped vehicles perceived in one step; `e` counts them."""

    sweeps: lidar.RangeImages
    """Valid until the next step, which uses their memory again."""
    observability: evidence.Observability
    detections: Detections
    """Self reports and what the detector reports."""
    is_real: Bool[ndarray, "s"]
    """Truth of the detector's reports, in order: whether there is such an actor."""
    actor_row: Int[ndarray, "s"]
    """Truth: its row of the world."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What some observers sensed; observers are counted among them."""

    observability: evidence.Observability
    reports: detector.DetectedBoxes

    def behind(self, n: int) -> "Seen":
        """The same, counted from `n`."""
        here, found = self.observability, self.reports
        return Seen(
            replace(here, observer=here.observer + np.int32(n)), replace(found, observer=found.observer + np.int32(n))
        )


@dataclass(frozen=True, slots=True)
class BoxQuestions:
    """What vehicles ask their own sweeps: rows of the sweeps, ascending, and rows of the boxes."""

    boxes: Boxes
    area: AreaParams
    counting: Int[ndarray, "p"]
    counted: Int[ndarray, "p"]
    """Returns inside are counted."""
    testing: Int[ndarray, "t"]
    tested: Int[ndarray, "t"]
    """Whether free space allows that something stands there."""


BoxAnswers = tuple[Int32[ndarray, "p"], Bool[ndarray, "t"]]
"""Returns inside, and whether it can be there."""


class Perceives(Protocol):
    """The part of a step that senses, and that keeps range images until the next step."""

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """What these rows of the world perceive."""
        ...

    def answers(self, sweeps: lidar.RangeImages, asked: BoxQuestions) -> BoxAnswers:
        """What the sweeps of the last step say of boxes; `sweeps` as observed, or where vehicles take them to be."""
        ...


@dataclass(slots=True)
class Perception:
    """LiDAR, evidence and detector of all equipped vehicles.

    Threads take groups of observers in turn, so that none waits for another one between two kernels.
    """

    city: Scene
    lidar: lidar.LidarParams
    detector: Detector
    self_reports: bool
    """Whether every vehicle also reports itself."""
    seed: int
    dt_s: float
    _range_steps: UInt16[ndarray, "n a e"] | None = field(default=None, repr=False)
    """Memory of the last range images, written over by the next."""
    _groups: list[SweepMemory] = field(default_factory=list, repr=False)
    """The same of all else in the sweeps of a group of observers, for each thread."""

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """What these rows of the world perceive."""
        rays = lidar.n_rays(self.lidar)
        range_steps = self._range_steps = lidar.buffer((len(observers), *rays), np.uint16, self._range_steps)
        with watch("sweep"):
            origin_m = lidar.mount(world.boxes, observers, self.lidar).origin_m
            near = neighbours(origin_m, world.boxes, self.lidar.max_range_m)
            bodies = prisms(world.shape, world.boxes)
        n_threads = min(numba.get_num_threads(), len(observers) // FEW + 1) if threads_may_meet() else 1
        n_groups = max(1, -(-len(observers) // (GROUP * n_threads))) * n_threads
        begins = np.linspace(0, len(observers), n_groups + 1).astype(int)

        def sense(first: int, last: int) -> tuple[Seen, Stopwatch]:
            if n_threads > 1:
                numba.set_num_threads(1)  # a setting of each thread
            kept, own = self._groups.pop() if self._groups else NO_MEMORY, watch.of_thread() if n_threads > 1 else watch
            part = near.part(first, last)
            memory = kept._replace(range_steps=range_steps[first:last], near=part, bodies=bodies)
            sweeps, here = self.sense(world, observers[first:last], own, memory)
            self._groups.append(SweepMemory(None, sweeps.hit, sweeps.thinned))
            return here.behind(first), own

        if n_threads == 1:
            found = list(map(sense, begins[:-1], begins[1:]))
        else:
            with ThreadPoolExecutor(n_threads, "sensing") as threads:
                found = list(threads.map(sense, begins[:-1], begins[1:]))
            for _, own in found:
                watch.add(own, n_threads)
        seen = [here for here, _ in found]
        with watch("detect"):
            images = lidar.range_images(world.boxes, observers, self.lidar, range_steps)
            return self.observed(world, observers, images, seen)

    def sense(
        self,
        world: World,
        observers: Int[ndarray, "e"],
        watch: Stopwatch,
        memory: SweepMemory = NO_MEMORY,
    ) -> tuple[lidar.Sweeps, Seen]:
        """The sweeps of these rows of the world, and what is seen in them."""
        with watch("sweep"):
            sweeps = self.sweep(world, observers, memory)
        with watch("detect"):
            here = evidence.observability(sweeps, world.boxes, world.shape, memory.near, memory.bodies)
            draws = self.draws(world, observers)
            reports = detector.detect(self.detector, sweeps, here, world.boxes, world.label, draws)
        return sweeps, Seen(here, reports)

    def answers(self, sweeps: lidar.RangeImages, asked: BoxQuestions) -> BoxAnswers:
        """As `Perceives`."""
        return (
            evidence.points_in_boxes(sweeps, asked.counting, asked.boxes, asked.counted),
            evidence.plausible(sweeps, asked.testing, asked.boxes, asked.tested, asked.area),
        )

    def sweep(self, world: World, observers: Int[ndarray, "e"], memory: SweepMemory = NO_MEMORY) -> lidar.Sweeps:
        """Sweeps of these rows of the world, with what each ray met; in memory of their own if none is given."""
        keys = sweep_keys(self.seed, world, observers)
        return lidar.scan(world.boxes, world.shape, observers, self.city, self.lidar, keys, memory)

    def observed(
        self, world: World, observers: Int[ndarray, "e"], sweeps: lidar.RangeImages, parts: Sequence[Seen]
    ) -> Observed:
        """What all observers see, from what each part of them does; the truth's name is dropped here."""
        seen, found = _concat([part.observability for part in parts]), _concat([part.reports for part in parts])
        n = len(found.observer)
        sensed = Detections.perceived(
            observer=observers[found.observer],
            detection_index=1 + np.arange(n) - np.searchsorted(found.observer, found.observer),
            label=found.label,
            boxes=found.boxes,
            score=found.score,
            n_points=found.n_points,
            origin=np.full(n, SENSED, np.uint8),
        )
        listed = [self_reports(world, observers), sensed] if self.self_reports else [sensed]
        return Observed(sweeps, seen, Detections.concat(listed), ~found.is_false_positive, found.actor)

    def draws(self, world: World, observers: Int[ndarray, "e"]) -> DetectorDraws:
        """Keys of the detector's randomness in these rows of the world."""
        names, step, site = world.name_key, world.step, rng.key(self.seed, rng.Stream.CLUTTER_MEMORY)
        return DetectorDraws(
            time_s=step * self.dt_s,
            actor=names,
            observer_step=rng.keys(rng.key(self.seed, rng.Stream.DETECTION, step), names[observers]),
            observer=rng.keys(rng.key(self.seed, rng.Stream.DETECTION_MEMORY), names[observers]),
            site=site,
            site_step=rng.keys(rng.key(self.seed, rng.Stream.CLUTTER, step), names[observers]),
            site_observer=rng.keys(site, names[observers]),
        )


def _concat(parts: list[_Rows]) -> _Rows:
    """The rows of all parts, in order."""
    joined: dict[str, Any] = {}
    for column in fields(parts[0]):
        values = [getattr(part, column.name) for part in parts]
        joined[column.name] = Boxes.concat(values) if isinstance(values[0], Boxes) else np.concatenate(values)
    return replace(parts[0], **joined)


def sweep_keys(seed: int, world: World, observers: Int[ndarray, "e"]) -> UInt64[ndarray, "e"]:
    """Keys of the LiDARs' randomness in these rows of the world."""
    return rng.keys(rng.key(seed, rng.Stream.SWEEP, world.step), world.name_key[observers])
