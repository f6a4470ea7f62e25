"""Estimates how long a plan takes and how much time sharing saves, before anything has run."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from cosim.config.config import Config
from cosim.studies.density import HELSINKI, vehicles_on_road
from cosim.studies.plan import StudyPlan
from cosim.studies.points import Point, scenario_of
from sensors import lidar

START_S = 4.5
"""Start of a process, including imports and loading of compiled kernels [s]."""
SUMO_S = 0.004
"""SUMO and reading its actors, per step of the traffic of central Helsinki [s]."""
STEP_S = 0.02
"""A step in which vehicles sense, without what grows with their number [s]."""
IDLE_STEP_S = 0.004
"""A step in which none senses: encounters and tables [s]."""
RAY_S = 10e-9
"""Per ray of a sweep: to cast it, and to detect objects [s]."""
MESSAGES_S = 1.2e-3
"""The two messages of a sweep that sees all around, at those who receive them: radio, matching, evaluation, trust,
fusion [s]. A sensor that sees less reports less."""
VARIANT_S = 0.0004
"""Trust of one more variant, per step, at the 60 equipped vehicles of central Helsinki [s]."""
METRICS_S = 0.5
"""Metrics of one point [s]."""
BYTES = 880
"""Per sweep that sees all around, at record.level = "standard"."""
ACTOR_BYTES = 14
"""Per actor and step, at the same level."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Rough estimates of processor time [s] on an idle core, and of disk space."""

    separate_s: float
    """Time if every missing point were a separate run."""
    planned_s: float
    """Time of the plan, summed over all workers."""
    merged_saves_s: float
    """Time saved by trust variants."""
    traffic_saves_s: float
    """Time saved by replaying traffic."""
    bytes: float
    is_measured: bool
    """Whether the estimate uses the measured time of finished runs of this study."""


def estimate(points: Sequence[Point], made: StudyPlan, stored: Collection[str], run_s: float | None) -> Estimate:
    """Estimate the time of a plan and that of one run per point; `run_s` is the measured time of a run, if known."""
    separate = sum(_run_s(point.config) + _traffic_s(point.config) for point in points)
    merged = sum(
        _run_s(run.config)
        + _traffic_s(run.config)
        + (len(run.members) - 1) * (run.config.n_steps * VARIANT_S + METRICS_S)
        for run in made.runs
    )
    replayed = sum(_traffic_s(run.config) for run in made.runs if run.traffic)
    driven = sum(_traffic_s(config) + START_S for name, config in made.traffic.items() if name not in stored)
    size = sum(map(_bytes, (run.config for run in made.runs)))
    planned = merged - replayed + driven
    scale = 1.0
    if run_s is not None and made.runs:
        scale = run_s * len(made.runs) / planned
    return Estimate(
        separate * scale, planned * scale, (separate - merged) * scale, (replayed - driven) * scale, size,
        run_s is not None,
    )  # fmt: skip


def _traffic_s(config: Config) -> float:
    warmup_s = config.traffic.warmup_s
    if warmup_s is None:
        warmup_s = scenario_of(config.traffic.scenario, config.traffic.trace).warmup_s
    n_steps = (warmup_s + config.traffic.duration_s) / config.traffic.step_s
    return n_steps * SUMO_S * vehicles_on_road(config) / HELSINKI


def _run_s(config: Config) -> float:
    """Processor time of a run without its traffic.

    The costs were measured in central Helsinki and Adlershof with the presets v0.2 and modern and 5 to 60 % equipped
    vehicles. Estimated times of these studies, and of three others with another LiDAR, other radios, Braunschweig and
    no sensing, were 0.8 to 1.4 times the measured ones.
    """
    n_active = config.n_steps // config.schedule.exchange_every_steps if config.sensing else 0
    steps_s = n_active * STEP_S + (config.n_steps - n_active) * IDLE_STEP_S
    grid = lidar.beams(config.lidar)
    n_rays = len(grid.azimuth_rad) * len(grid.elevation_rad)
    sweep_s = n_rays * RAY_S + _around_p(config) * MESSAGES_S
    return START_S + METRICS_S + steps_s + _n_sweeps(config) * sweep_s


def _bytes(config: Config) -> float:
    """Disk space of a run."""
    actors = ACTOR_BYTES * vehicles_on_road(config) * config.n_steps
    return actors + BYTES * _n_sweeps(config) * _around_p(config)


def _around_p(config: Config) -> float:
    """Share of all directions that a sweep sees."""
    return lidar.beams(config.lidar).fov_rad / (2 * math.pi)


def _n_sweeps(config: Config) -> float:
    """Sweeps, each of which is followed by two messages."""
    if not config.sensing:
        return 0.0
    equipped = vehicles_on_road(config) * config.fleet.penetration_p
    return equipped * config.traffic.duration_s / config.sensing_interval_s
