"""Parameters of traffic. Imports nothing heavy, because every reading of a config imports it."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Gt, Le


@dataclass(frozen=True, kw_only=True, slots=True)
class TrafficParams:
    """Network, demand, begin and duration of the traffic, and SUMO's seed."""

    scenario: str = "helsinki"
    """Name of a city (`cosim nets list`); or, relative to the config file that names it, the path of a .sumocfg, of a
    folder that `cosim nets build` made, of a run to replay, or of a trace that SUMO wrote with --fcd-output."""
    trace: str | None = None
    """Replay this trace or run folder in the network of `scenario`, instead of running SUMO."""
    seed: Annotated[int, Ge(0), Le(2**31 - 1)] = 1
    """Seed of SUMO."""
    scale: Annotated[float, Gt(0), Le(1000)] = 1.0
    """Factor on the demand; below 1 SUMO leaves vehicles out, above 1 it repeats some. Traces are not scaled."""
    begin_s: Annotated[float, Ge(0), Le(1e8)] | None = None
    """Time of the scenario at which to begin, warm-up included [s]; the scenario's own when not set."""
    warmup_s: Annotated[float, Ge(0), Le(1e7)] | None = None
    """Simulated time before anything is sensed or recorded [s]; the shipped network's own when not set."""
    duration_s: Annotated[float, Gt(0), Le(1e8)] = 300.0
    """Recorded time after warm-up [s]; less if the traffic ends before."""
    step_s: Annotated[float, Ge(0.1), Le(60)] = 1.0
    """Length of one step of traffic [s]; when not set, that of the .sumocfg, and 1 s of a trace."""


def resolved_input(name: str, folder: Path, cities: Collection[str]) -> str:
    """The absolute path of a scenario or trace, so that a config means the same in every working directory.

    `folder` is that of the config file. A file or folder beside it is preferred to a city of the same name, a city to
    a file or folder in the working directory; a name of neither is returned as it is.
    """
    if _is_input(beside := folder / name):
        return str(beside.resolve())
    if name not in cities and _is_input(Path(name)):
        return str(Path(name).resolve())
    return name


def _is_input(path: Path) -> bool:
    names = ("manifest.json", "recipe.toml")
    return path.is_file() or any((path / name).is_file() for name in names) or any(path.glob("*.sumocfg"))
