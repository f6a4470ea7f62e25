"""Parameters of traffic. Imports nothing heavy, because every reading of a config imports it."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

from cosim.base.bounds import Positive1000
from sumo_nets.sumocfg import in_folder

SHORTEST_STEP_S = 0.02
"""Shortest step of traffic that a run can have [s]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrafficParams:
    """Network, demand, start time and duration of the traffic, and SUMO's seed."""

    scenario: str = "helsinki"
    """Name of a city (`cosim nets list`), or a path. The path leads to a .sumocfg, to a folder that `cosim nets build`
    made, to a run folder to replay, or to a trace that SUMO wrote with --fcd-output. It is relative to the config
    file."""
    trace: str | None = None
    """Trace or run folder that is replayed in the network of `scenario`. If it is not set, SUMO runs."""
    seed: Annotated[int, Ge(0), Le(2**31 - 1)] = 1
    """Seed of SUMO."""
    scale: Positive1000 = 1.0
    """Factor on the demand, beside the scale of the .sumocfg. Below 1, SUMO omits some vehicles. Above 1, it repeats
    some. Traces are not scaled."""
    begin_s: Annotated[float, Ge(0), Le(1e8)] | None = None
    """Scenario time at which the simulation begins, before the warm-up [s]. If it is not set, the scenario's own begin
    time is used."""
    warmup_s: Annotated[float, Ge(0), Le(1e7)] | None = None
    """Duration that is simulated before sensing and recording begin [s]. If it is not set, a city's own value is
    used; for recorded traffic, 0."""
    duration_s: Annotated[float, Gt(0), Le(1e8)] = 120.0
    """Recorded duration after the warm-up [s]. The run is shorter if the traffic ends earlier."""
    car_following: Literal["scenario", "calibrated"] = "scenario"
    """How vehicles accelerate, follow and brake. `scenario`: as the scenario's vehicle types say. `calibrated`: by the
    Intelligent Driver Model with published parameters of city traffic, which brakes hard about as often as measured
    drivers. Sizes, speeds and routes stay. Traces are not changed."""
    step_s: Annotated[float, Ge(SHORTEST_STEP_S), Le(60)] = 1.0
    """Length of one traffic step [s]. If it is not set, the step length of the .sumocfg is used, unless the preset's is
    shorter: that of `modern` is 0.2 s, which traces have too."""


def resolved_input(name: str, folder: Path, cities: Collection[str]) -> str:
    """Resolve a scenario or trace to an absolute path, so that a config works from every working directory.

    `folder` is the folder of the config file. A file or folder in it comes first, then a city of that name, then a file
    or folder in the working directory. If none exists, the name is returned unchanged.
    """
    if _is_input(beside := folder / name):
        return str(beside.resolve())
    if name not in cities and _is_input(Path(name)):
        return str(Path(name).resolve())
    return name


def _is_input(path: Path) -> bool:
    names = ("manifest.json", "recipe.toml")
    has_file = any((path / name).is_file() for name in names)
    return path.is_file() or has_file or bool(in_folder(path))
