"""What equipped vehicles perceive: sweeps, which actors could be seen in them, detections and self reports."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int, UInt64
from numpy import ndarray

from cosim import rng
from cosim.stopwatch import Stopwatch
from cosim.v2x.messages import SENSED, Detections, self_reports
from cosim.world import World
from sensors import detector, evidence, lidar
from sensors.detector import Detector, DetectorDraws
from sensors.scene import Scene


@dataclass(frozen=True, slots=True)
class Observed:
    """What all equipped vehicles perceived in one step; `e` counts them."""

    sweeps: lidar.Sweeps
    """Valid until the next step is perceived: its memory is used again."""
    observability: evidence.Observability
    detections: Detections
    """Self reports and what the detector reports."""
    is_real: Bool[ndarray, "s"]
    """Truth of the detector's reports, in order: whether there is such an actor."""
    actor_row: Int[ndarray, "s"]
    """Truth: its row of the world."""


@dataclass(slots=True)
class Perception:
    """LiDAR, evidence and detector of all equipped vehicles."""

    city: Scene
    lidar: lidar.LidarParams
    detector: Detector
    self_reports: bool
    """Whether every vehicle also reports itself."""
    seed: int
    dt_s: float
    _memory: lidar.Sweeps | None = field(default=None, repr=False)
    """Of the last sweeps, written over by the next."""

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """What these rows of the world perceive."""
        with watch("sweep"):
            sweeps = self.sweep(world, observers)
        with watch("detect"):
            return self.detect(world, observers, sweeps)

    def sweep(self, world: World, observers: Int[ndarray, "e"]) -> lidar.Sweeps:
        """Range images of these rows of the world."""
        keys = sweep_keys(self.seed, world, observers)
        self._memory = lidar.scan(world.boxes, world.shape, observers, self.city, self.lidar, keys, self._memory)
        return self._memory

    def detect(self, world: World, observers: Int[ndarray, "e"], sweeps: lidar.Sweeps) -> Observed:
        """Detections of these rows of the world, from their sweeps; the truth's name is dropped here."""
        seen = evidence.observability(sweeps, world.boxes, world.shape)
        draws = self.draws(world, observers)
        found = detector.detect(self.detector, sweeps, seen, world.boxes, world.label, draws)
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
        parts = [self_reports(world, observers), sensed] if self.self_reports else [sensed]
        return Observed(sweeps, seen, Detections.concat(parts), ~found.is_false_positive, found.actor)

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


def sweep_keys(seed: int, world: World, observers: Int[ndarray, "e"]) -> UInt64[ndarray, "e"]:
    """Keys of the LiDARs' randomness in these rows of the world."""
    return rng.keys(rng.key(seed, rng.Stream.SWEEP, world.step), world.name_key[observers])
