"""What equipped vehicles perceive: sweeps, observability, detections and self-reports.

It also answers what a sweep says about boxes that other vehicles report.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, UInt8, UInt16, UInt64
from numpy import ndarray

from cosim.base import rng
from cosim.base.ragged import place_in_group
from cosim.base.threads import in_parts, n_threads
from cosim.messages.content import SENSED, Detections, self_reports
from cosim.step.stopwatch import Stopwatch
from cosim.world import World
from sensors import detector, evidence, lidar
from sensors.boxes import Boxes
from sensors.detector import Detector, DetectorDraws
from sensors.evidence import AreaParams
from sensors.lidar import NO_MEMORY, SweepMemory
from sensors.neighbours import neighbours
from sensors.scene import Scene, prisms
from sensors.weather import CLEAR, WeatherParams, weaken

GROUP, FEW = 64, 64
"""Largest number of observers in a group, and smallest number of observers per thread. Each thread keeps what every ray
of a group met: 230 kB per observer with 115,200 rays."""


@dataclass(frozen=True, slots=True)
class Observed:
    """What all equipped vehicles perceived in one step; `e` is their number."""

    sweeps: Any
    """`RangeImages`, or `cosim.step.mixed_perception.MixedImages` where LiDARs differ. Valid until the next step, which
    overwrites their memory."""
    observability: evidence.Observability
    detections: Detections
    """Self-reports and the detector's reports."""
    is_real: Bool[ndarray, "s"]
    """Ground truth of the detector's reports, in order: whether the actor exists."""
    actor_row: Int[ndarray, "s"]
    """Ground truth: row of the actor in the world."""
    caused_by: Int[ndarray, "s"] | None = None
    """Ground truth: row of the attacker whose object caused a phantom, -1 for other reports; None without phantoms."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What a group of observers sensed; observers are numbered within the group."""

    observability: evidence.Observability
    reports: detector.DetectedBoxes

    def behind(self, n: int) -> "Seen":
        """What they sensed, with observers numbered from `n`."""
        first = np.int32(n)
        here, found = self.observability, self.reports
        here = replace(here, observer=here.observer + first)
        return Seen(here, replace(found, observer=found.observer + first))

    def renumbered(self, number: Int32[ndarray, "e"]) -> "Seen":
        """What they sensed, with these numbers of the observers."""
        here, found = self.observability, self.reports
        here = replace(here, observer=number[here.observer])
        return Seen(here, replace(found, observer=number[found.observer]))

    def of_actors(self, row: Int32[ndarray, "n"]) -> "Seen":
        """What they sensed, with these rows of the actors."""
        here, found = self.observability, self.reports
        actor = found.actor.copy()
        actor[~found.is_false_positive] = row[found.actor[~found.is_false_positive]]
        return Seen(replace(here, actor=row[here.actor]), replace(found, actor=actor))

    @staticmethod
    def joined(parts: Sequence["Seen"]) -> "Seen":
        """What all groups saw, in order."""
        seen, reports = ([getattr(part, name) for part in parts] for name in ("observability", "reports"))
        return Seen(type(seen[0]).concat(seen), type(reports[0]).concat(reports))


@dataclass(frozen=True, slots=True)
class BoxQuestions:
    """Questions of vehicles to their own sweeps: rows of the sweeps, ascending, and rows of the boxes."""

    boxes: Boxes
    velocity_mps: Float[ndarray, "boxes 2"]
    """Of the boxes: a sensor that turns sees them where they are when it looks there."""
    area: AreaParams
    counting: Int[ndarray, "p"]
    counted: Int[ndarray, "p"]
    """Boxes whose returns are counted by the sweeps of `counting`."""
    testing: Int[ndarray, "t"]
    tested: Int[ndarray, "t"]
    """Boxes that the sweeps of `testing` test: can an object stand there, or did rays pass through?"""

    def of_group(
        self, number: int, group: Int[ndarray, "m"], row: Int[ndarray, "m"]
    ) -> tuple[Int[ndarray, "k"], Int[ndarray, "l"], "BoxQuestions"]:
        """The questions of one group of sweeps, whose rows within the group are `row`.

        Returns
        -------
        Which of the counting and of the testing questions they are, and the questions.
        """
        p = np.flatnonzero(group[self.counting] == number)
        t = np.flatnonzero(group[self.testing] == number)
        counting = row[self.counting[p]].astype(np.int32)
        testing = row[self.testing[t]].astype(np.int32)
        counts = replace(self, counting=counting, counted=self.counted[p])
        return p, t, replace(counts, testing=testing, tested=self.tested[t])


BoxAnswers = tuple[Int32[ndarray, "p"], Bool[ndarray, "t"]]
"""Number of returns inside each counted box, and whether each tested box is plausible."""


class Perceives(Protocol):
    """The component of a step that senses. It keeps range images until the next step, and answers questions to them."""

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """What the vehicles in these rows of the world perceive."""
        ...

    def answers(self, sweeps: Any, asked: BoxQuestions) -> BoxAnswers:
        """Answers of this step's sweeps about boxes; `sweeps` at their true or estimated positions."""
        ...

    def in_area(
        self,
        sweeps: Any,
        o: Int[ndarray, "n"],
        boxes: Boxes,
        area: AreaParams,
        b: Int[ndarray, "n"],
        label: UInt8[ndarray, "boxes"],
        own: Boxes,
    ) -> Bool[ndarray, "n"]:
        """As `sensors.evidence.in_evaluation_area`."""
        ...


RangeSteps = UInt16[ndarray, "n a e"] | None
_SMALL_BYTES = 64 << 20
"""Range images of up to this size leave those of the step before as they are."""


@dataclass(slots=True)
class Perception:
    """LiDAR, evidence and detector of all equipped vehicles.

    Each thread takes the next group of observers when it has finished one, so threads do not wait for each other
    between two kernels.
    """

    city: Scene
    lidar: lidar.LidarParams
    detector: Detector
    self_reports: bool
    """Whether every vehicle also reports itself."""
    seed: int
    dt_s: float
    weather: WeatherParams = CLEAR
    _range_steps: tuple[RangeSteps, RangeSteps] = field(default=(None, None), repr=False)
    """Memory of the range images: of the step before the last one, and of the last one."""
    _groups: list[SweepMemory] = field(default_factory=list, repr=False)
    """Memory of the other arrays in the sweeps of a group of observers, one item per thread."""

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """What the vehicles in these rows of the world perceive."""
        images, seen = self.perceive(world, observers, watch)
        with watch("detect"):
            return self.observed(world, observers, images, seen)

    def perceive(
        self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch
    ) -> tuple[lidar.RangeImages, list[Seen]]:
        """Range images of the vehicles in these rows of the world, and what groups of them saw."""
        before, last = self._range_steps
        keeps_last = self.keeps_last(len(observers))
        size = self._size(len(observers))
        range_steps = lidar.buffer(size, np.uint16, before if keeps_last else last)
        self._range_steps = (last if keeps_last else None), range_steps
        with watch("sweep"):
            poses = lidar.mount(world.boxes, observers, self.lidar)
            near = neighbours(poses.origin_m, world.boxes, self.lidar.max_range_m)
            bodies = prisms(world.shape, world.boxes, world.speed_mps)
        most = len(observers) // FEW + 1
        n = min(n_threads(), most)
        n_groups = max(1, -(-len(observers) // (GROUP * n))) * n
        bounds = np.linspace(0, len(observers), n_groups + 1).astype(int).tolist()

        def sense(first: int, last: int) -> tuple[Seen, Stopwatch]:
            own = watch.of_thread() if n > 1 else watch
            some, part = observers[first:last], near.part(first, last)
            kept = self._groups.pop() if self._groups else NO_MEMORY
            memory = kept._replace(range_steps=range_steps[first:last], near=part, bodies=bodies)
            draws = detector_draws(self.seed, self.dt_s, world.step, world.name_key, world.name_key[some])
            with own("sweep"):
                sweeps = swept(world, some, self.city, self.lidar, self.weather, self.seed, memory)
            with own("detect"):
                here = evidence.observability(sweeps, world.boxes, world.shape, part, bodies)
                reports = detector.detect(self.detector, sweeps, here, world.boxes, world.label, draws)
            self._groups.append(SweepMemory(None, sweeps.hit))
            return Seen(here, reports).behind(first), own

        found = in_parts(sense, bounds, most)
        if n > 1:
            for _, own in found:
                watch.add(own, n)
        images = lidar.RangeImages(
            poses=poses,
            observers=observers,
            ground_m=lidar.height_of_road_m(world.boxes, observers),
            beams=lidar.beams(self.lidar),
            max_range_m=self.lidar.max_range_m,
            range_steps=range_steps,
            step_m=lidar.step_of(self.lidar),
        )
        return images, [here for here, _ in found]

    def _size(self, n_observers: int) -> tuple[int, int, int]:
        """Shape of the range images of so many observers."""
        beams = lidar.beams(self.lidar)
        return n_observers, len(beams.azimuth_rad), len(beams.elevation_rad)

    def keeps_last(self, n_observers: int) -> bool:
        """Whether sweeps of so many observers leave the range images of the step before as they are.

        Those of a large fleet are written over them, because they are large.
        """
        return 2 * math.prod(self._size(n_observers)) <= _SMALL_BYTES

    def answers(self, sweeps: lidar.RangeImages, asked: BoxQuestions) -> BoxAnswers:
        """As in `Perceives`."""
        return (
            evidence.points_in_boxes(sweeps, asked.counting, asked.boxes, asked.counted, asked.velocity_mps),
            evidence.plausible(
                sweeps, asked.testing, asked.boxes, asked.tested, asked.area, velocity_mps=asked.velocity_mps
            ),
        )

    def in_area(
        self,
        sweeps: lidar.RangeImages,
        o: Int[ndarray, "n"],
        boxes: Boxes,
        area: AreaParams,
        b: Int[ndarray, "n"],
        label: UInt8[ndarray, "boxes"],
        own: Boxes,
    ) -> Bool[ndarray, "n"]:
        """As in `Perceives`."""
        return evidence.in_evaluation_area(sweeps, o, boxes, area, b, label, own)

    def observed(
        self, world: World, observers: Int[ndarray, "e"], sweeps: Any, parts: Sequence[Seen], sort: bool = False
    ) -> Observed:
        """Join the groups of observers. Detections do not contain the true actor; it is kept separately.

        Parameters
        ----------
        observers
            Rows of the world of all observers.
        sweeps
            Range images of all observers.
        parts
            What the groups saw, in the order of `observers`. Observers are numbered as rows of `observers`.
        sort
            Whether the groups are not in this order.
        """
        joined = Seen.joined(parts)
        seen, found = joined.observability, joined.reports
        if sort:
            seen = seen.take(np.argsort(seen.observer, kind="stable"))
            found = found.take(np.argsort(found.observer, kind="stable"))
        n = len(found.observer)
        sensed = Detections.perceived(
            observer=observers[found.observer],
            detection_index=1 + place_in_group(found.observer),
            label=found.label,
            boxes=found.boxes,
            score=found.score,
            n_points=found.n_points,
            origin=np.full(n, SENSED, np.uint8),
        )
        vehicles = observers[~world.is_roadside[observers]]
        listed = [self_reports(world, vehicles), sensed] if self.self_reports else [sensed]
        return Observed(sweeps, seen, Detections.by_key(listed), ~found.is_false_positive, found.actor)


def detector_draws(
    seed: int, dt_s: float, step: int, names: UInt64[ndarray, "n"], own: UInt64[ndarray, "e"]
) -> DetectorDraws:
    """Random keys of the detector in a step; `names` are the keys of all actors, `own` those of the observers."""
    site = rng.key(seed, rng.Stream.CLUTTER_MEMORY)
    return DetectorDraws(
        time_s=step * dt_s,
        actor=names,
        observer_step=rng.keys(rng.key(seed, rng.Stream.DETECTION, step), own),
        observer=rng.keys(rng.key(seed, rng.Stream.DETECTION_MEMORY), own),
        site=site,
        site_step=rng.keys(rng.key(seed, rng.Stream.CLUTTER, step), own),
        site_observer=rng.keys(site, own),
    )


def swept(
    world: World,
    observers: Int[ndarray, "e"],
    city: Scene,
    params: lidar.LidarParams,
    weather: WeatherParams,
    seed: int,
    memory: SweepMemory = NO_MEMORY,
) -> lidar.Sweeps:
    """Sweeps of the vehicles in these rows of the world, in this weather."""
    of_step = rng.key(seed, rng.Stream.SWEEP, world.step)
    keys = rng.keys(of_step, world.name_key[observers])
    if memory.bodies is None:
        memory = memory._replace(bodies=prisms(world.shape, world.boxes, world.speed_mps))
    sweeps = lidar.scan(world.boxes, world.shape, observers, city, params, keys, memory)
    if not weather.is_clear:
        reflectivity = rng.key(seed, rng.Stream.REFLECTIVITY)
        dirt = rng.key(seed, rng.Stream.DIRT)
        weaken(sweeps, weather, keys, world.name_key, reflectivity, dirt)
    return sweeps
