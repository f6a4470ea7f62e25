"""Estimates how long a plan takes and how much time sharing saves, before anything has run."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from cosim.studies.density import HELSINKI, vehicles_on_road
from cosim.studies.plan import Plan
from cosim.studies.points import Point, scenario_of

START_S = 4.0
"""Start of a process, including imports and loading of compiled kernels [s]."""
SUMO_S = 0.004
"""SUMO and reading its actors, per simulated second of central Helsinki [s]."""
STEP_S = 0.018
"""A step with sensing but without equipped vehicles [s]."""
VEHICLE_S = 0.35e-3
"""Per equipped vehicle and step, on one core [s]."""
VARIANT_S = 0.0004
"""Trust of one more variant, per step, at the 60 equipped vehicles of central Helsinki [s]."""
METRICS_S = 0.1
"""Metrics of one point [s]."""
BYTES = 500
"""Per equipped vehicle and second at record.level = "standard"."""


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


def estimate(points: Sequence[Point], made: Plan, stored: Collection[str], run_s: float | None) -> Estimate:
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
    size = sum(BYTES * _equipped(run.config) * run.config.traffic.duration_s for run in made.runs)
    planned = merged - replayed + driven
    scale = 1.0
    if run_s is not None and made.runs:
        scale = run_s * len(made.runs) / planned
    return Estimate(
        separate * scale, planned * scale, (separate - merged) * scale, (replayed - driven) * scale, size,
        run_s is not None,
    )  # fmt: skip


def _traffic_s(config) -> float:
    warmup_s = config.traffic.warmup_s
    if warmup_s is None:
        warmup_s = scenario_of(config.traffic.scenario, config.traffic.trace).warmup_s
    return (warmup_s + config.traffic.duration_s) * SUMO_S * vehicles_on_road(config) / HELSINKI


def _run_s(config) -> float:
    sensing = config.traffic.duration_s / config.sensing_interval_s
    return START_S + METRICS_S + sensing * (STEP_S + VEHICLE_S * _equipped(config))


def _equipped(config) -> float:
    return vehicles_on_road(config) * config.fleet.penetration_p
