"""The speed of this machine, measured in the runs that were made on it, and kept in the user's cache."""

import json
import os
import statistics
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, process_time
from typing import Any

FEWEST_S = 5.0
"""Shortest processor time that is taken for a measurement [s]."""
KEPT = 7
"""Number of measurements that are kept."""
MOST_SCENARIOS = 100
"""Number of scenarios whose vehicles are kept."""
_LIMITS = (0.02, 50.0)
"""Ratios beyond these are no measurements."""

Advance = Callable[[str, int, int, str], None]


@dataclass(frozen=True, slots=True)
class MachineSpeed:
    """How this machine compares with the one on which the costs were measured."""

    cpu: float = 1.0
    """Measured divided by predicted processor time of steps."""
    wall_per_cpu: float = 0.85
    """Time by the clock divided by processor time, if cores are free. A second thread computes in advance, so it may be
    below 1. The smallest measured value holds, and at most 1: the others were measured beside other work."""
    n_runs: int = 0
    """Number of runs that were measured."""

    @property
    def basis(self) -> str:
        """Where it is from, in words."""
        if not self.n_runs:
            return "rough: no run on this machine has been measured yet"
        return f"on free cores, by {self.n_runs} run{'s' if self.n_runs > 1 else ''} on this machine"


def place() -> Path:
    """The file: in COSIM_CACHE, or in the user's cache folder."""
    if named := os.environ.get("COSIM_CACHE"):
        return Path(named) / "speed.json"
    of_user = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(of_user) / "cosim" / "speed.json"


def speed_here() -> MachineSpeed:
    """The speed of this machine; that of the machine of the costs if nothing was measured."""
    found = _kept()
    if not found:
        return MachineSpeed()
    cpu, wall = zip(*found, strict=True)
    return MachineSpeed(statistics.median(cpu), min(1.0, *wall), len(found))


def remembered(scenario: str) -> float | None:
    """Vehicles on the road in the last run of a scenario and half hour, at traffic.scale = 1; None if none is known."""
    found = _content().get("vehicles", {})
    value = found.get(scenario) if isinstance(found, dict) else None
    return float(value) if isinstance(value, int | float) and 0 <= value < 1e7 else None


def remember(scenario: str, n_vehicles: float) -> None:
    """Keep the mean number of vehicles on the road in a run of a scenario and half hour, at traffic.scale = 1."""
    known = _content().get("vehicles", {})
    last = list(known.items())[1 - MOST_SCENARIOS :] if isinstance(known, dict) else []
    _write({"vehicles": dict(last) | {scenario: round(n_vehicles, 1)}})


def _kept() -> list[tuple[float, float]]:
    low, high = _LIMITS
    with suppress(ValueError, TypeError):
        kept = []
        for cpu, wall in _content().get("cpu_and_wall_per_cpu", []):
            pair = float(cpu), float(wall)
            if all(low < value < high for value in pair):
                kept.append(pair)
        return kept[-KEPT:]
    return []


def _content() -> dict[str, Any]:
    with suppress(OSError, ValueError, RecursionError):
        found = json.loads(place().read_text(encoding="utf-8"))
        return found if isinstance(found, dict) else {}
    return {}


def _write(changes: dict[str, Any]) -> None:
    with suppress(OSError):  # without a cache, the next estimate is as rough as this one
        place().parent.mkdir(parents=True, exist_ok=True)
        partial = place().with_name(f"speed-{os.getpid()}.partial")
        partial.write_text(json.dumps(_content() | changes), encoding="utf-8")
        partial.replace(place())


class Pace:
    """Progress of a run, from which the speed of the second half of its steps is measured and kept.

    Kernels are compiled in the first half, and nothing can be said of a run that is shorter than `FEWEST_S`.
    """

    def __init__(self, step_cpu_s: float, advance: Advance) -> None:
        self._step_cpu_s, self._advance = step_cpu_s, advance
        self._half: tuple[int, float, float] | None = None

    def __call__(self, phase: str, done: int, total: int, note: str) -> None:
        """Pass progress on; at half of the steps the clock starts, and after the last one it stops."""
        self._advance(phase, done, total, note)
        if phase != "run":
            return
        if self._half is None and 2 * done >= total:
            self._half = done, process_time(), monotonic()
        elif self._half is not None and done == total:
            first, cpu_s, wall_s = self._half
            predicted_s = (done - first) * self._step_cpu_s
            self._keep(predicted_s, process_time() - cpu_s, monotonic() - wall_s)

    @staticmethod
    def _keep(predicted_s: float, cpu_s: float, wall_s: float) -> None:
        if cpu_s < FEWEST_S or predicted_s <= 0:
            return
        ratios = cpu_s / predicted_s, wall_s / cpu_s
        kept = [*_kept(), ratios]
        _write({"cpu_and_wall_per_cpu": kept[-KEPT:]})
