"""Estimates how long a plan takes and how much time sharing saves, before anything has run."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from cosim.studies.cost import METRICS_S, START_S, VARIANT_S, disk_bytes, memory_bytes, run_s, traffic_s
from cosim.studies.plan import StudyPlan
from cosim.studies.points import Point
from cosim.studies.speed import MachineSpeed

SAME = MachineSpeed()
"""The machine on which the costs were measured."""


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
    memory_bytes: float = 0.0
    """Memory of the largest run."""


def estimate(
    points: Sequence[Point],
    made: StudyPlan,
    stored: Collection[str],
    measured_s: float | None,
    speed: MachineSpeed = SAME,
) -> Estimate:
    """Estimate the time of a plan and that of one run per point.

    `measured_s` is the measured time of a run of this study, if known; else `speed` is that of this machine.
    """
    separate = sum(run_s(point.config) + traffic_s(point.config) for point in points)
    merged = sum(
        run_s(run.config)
        + traffic_s(run.config)
        + (len(run.members) - 1) * (run.config.n_steps * VARIANT_S + METRICS_S)
        for run in made.runs
    )
    replayed = sum(traffic_s(run.config) for run in made.runs if run.traffic)
    missing = [config for name, config in made.traffic.items() if name not in stored]
    driven = sum(traffic_s(config) + START_S for config in missing)
    size = sum(disk_bytes(run.config) for run in made.runs)
    planned = merged - replayed + driven
    scale = speed.cpu
    if measured_s is not None and made.runs:
        scale = measured_s * len(made.runs) / planned
    return Estimate(
        separate_s=separate * scale,
        planned_s=planned * scale,
        merged_saves_s=(separate - merged) * scale,
        traffic_saves_s=(replayed - driven) * scale,
        bytes=size,
        is_measured=measured_s is not None,
        memory_bytes=_memory_bytes(made),
    )


def _memory_bytes(made: StudyPlan) -> float:
    """Memory of the largest run of a plan."""
    return max((memory_bytes(run.config) for run in made.runs), default=0.0)
