"""What a worker computes of one long run: the sweeps of a shard, and what they say of boxes.

A shard is a piece of the recorded traffic: some steps, or some of the observers of one. All chance is keyed by who,
whom, when and what for, so that it does not matter which worker computes a shard, when, or how often.
"""

import json
from dataclasses import dataclass, replace
from functools import cache

import numba
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.config.config import resolve_data
from cosim.offline.replay_lidar import city_of
from cosim.step.parts import perception_of
from cosim.step.perception import BoxAnswers, BoxQuestions, Perception, Seen, answers
from cosim.step.stopwatch import Stopwatch
from cosim.world import World
from sensors.lidar import RangeImages, with_ranges


@dataclass(frozen=True, slots=True)
class Shard:
    """Worlds of the recorded traffic, in order of time, and whose sweeps are wanted in each (rows of the world)."""

    worlds: tuple[World, ...]
    observers: tuple[Int[ndarray, "e"], ...]


@dataclass(frozen=True, slots=True)
class SensedShard:
    """A shard once it is sensed; its range images stay with the worker that made them."""

    images: tuple[RangeImages, ...]
    seen: tuple[Seen, ...]

    def __sizeof__(self) -> int:
        """Bytes, by which Dask knows what it would cost to move them."""
        return sum(images.range_steps.nbytes for images in self.images)


def sense(config: str, shard: Shard) -> SensedShard:
    """Sweeps and detections of a shard. `config`: the run's, its plain data as JSON."""
    numba.set_num_threads(1)
    perception, images, seen = perception_for(config), [], []
    for world, observers in zip(shard.worlds, shard.observers, strict=True):
        sweeps, found = perception.sense(world, observers, Stopwatch())
        images.append(with_ranges(sweeps, sweeps.range_steps, sweeps.step_m))
        seen.append(found)
    return SensedShard(tuple(images), tuple(seen))


def seen_of(sensed: SensedShard) -> tuple[Seen, ...]:
    """What is seen in each step of a shard, without range images."""
    return sensed.seen


def answers_of(sensed: SensedShard, number: int, origin_m: Float[ndarray, "e 3"], asked: BoxQuestions) -> BoxAnswers:
    """What the sweeps of the shard's step `number` say of boxes, from where the vehicles take their sensors to be."""
    numba.set_num_threads(1)
    images = sensed.images[number]
    return answers(replace(images, poses=replace(images.poses, origin_m=origin_m)), asked)


@cache
def perception_for(config: str) -> Perception:
    """LiDAR and detector of a config, made once in a process."""
    experiment = resolve_data(json.loads(config), "the config of the run", None)
    return perception_of(experiment, city_of(experiment))


def problem_of(config: str) -> str:
    """Why this process cannot sense for a config; empty where it can."""
    try:
        perception_for(config)
    except (ValueError, OSError) as error:
        return " ".join(str(error).split())
    return ""
