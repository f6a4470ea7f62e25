"""The runs in which facts are measured: made when a fact first needs them, or given by the user."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.addons.compare.facts import RunPlan
from cosim.config.changes import as_toml
from cosim.config.config import Config, load
from cosim.runs import run as running
from cosim.runs.drive import Advance
from results.archive import open_run
from results.run import Run

DEFAULT_WORLD = "preset=modern"
"""The world in which facts are measured unless their conditions change it."""
SCENES = Path(__file__).with_name("scenes")
FIRST_SEED = 7001
"""Seeds of the first replicate; no model was fitted on runs of these seeds."""


@dataclass(slots=True)
class PlannedRuns:
    """Runs in a new folder of their own, by name of their plan."""

    folder: Path
    plans: Mapping[str, RunPlan]
    is_full: bool = False
    advance: Advance = lambda *_: None
    _made: dict[str, list[Run]] = field(default_factory=dict)

    @property
    def what(self) -> str:
        """The kind of runs, in words."""
        return "long runs" if self.is_full else "short runs"

    def of(self, name: str) -> Sequence[Run]:
        """The replicates of a plan. They are made at the first call."""
        if name not in self._made:
            plan = self.plans[name]
            n, _ = plan.length(self.is_full)
            found: list[Run] = []
            for replicate in range(n):
                self.advance(f"runs: {name}", replicate, n, "")
                path = self.folder / f"{name}-{replicate + 1}"
                made = running.run(config_of(plan, replicate, self.is_full), path, lambda *_: None)
                found.append(open_run(made))
            self.advance(f"runs: {name}", n, n, "")
            self._made[name] = found
        return self._made[name]

    def unlike(self, name: str) -> list[str]:
        """Nothing: these runs have the keys of their plan."""
        return []


@dataclass(frozen=True, slots=True)
class GivenRuns:
    """Runs of the user in place of all plans."""

    runs: Sequence[Run]
    plans: Mapping[str, RunPlan]

    @staticmethod
    def opened(folders: Sequence[Path], plans: Mapping[str, RunPlan]) -> "GivenRuns":
        """Open run folders. ValueError, in one line, if two of them have the same traffic: they are no replicates."""
        runs = [open_run(folder) for folder in folders]
        first: dict[str, Run] = {}
        for run in runs:
            traffic = [run.manifest.get("net"), *(_at(run.config, key) for key in _TRAFFIC)]
            same = first.setdefault(json.dumps(traffic), run)
            if same is not run:
                raise ValueError(
                    f"--run {run.path} has the traffic and the seeds of {same.path}: it is no replicate of it, and an "
                    "interval over both would say nothing. Leave it out."
                )
        return GivenRuns(runs, plans)

    @property
    def what(self) -> str:
        """The runs, in words."""
        return ", ".join(run.name for run in self.runs)

    def of(self, name: str) -> Sequence[Run]:
        """The runs, whatever the plan."""
        return self.runs

    def unlike(self, name: str) -> list[str]:
        """Keys of a plan that the runs set otherwise, with both values."""
        plan = self.plans[name]
        planned = config_of(plan, 0, is_full=False).to_dict()
        found: dict[str, None] = {}
        for key in (text.partition("=")[0] for text in plan.sets):
            wanted = as_toml(_at(planned, key))
            given = {as_toml(_at(run.config, key)) for run in self.runs}
            for other in sorted(given - {wanted}):
                if key not in _THRIFT:
                    found[f"{key} = {other}, not {wanted}"] = None
        return list(found)


_TRAFFIC = ("traffic.seed", "traffic.begin_s", "seed")
"""Keys of which replicates differ in one at least, or in the files of their traffic."""
_THRIFT = ("sensing", "attacks", "trust_variant", "encounters", "trust.host")
"""Keys that plans set to save time, not as a condition."""


def _at(config: Mapping[str, Any], key: str) -> Any:
    """The value of a key such as `traffic.step_s`; None where the config has none."""
    value: Any = config
    for name in key.split("."):
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def config_of(plan: RunPlan, replicate: int, is_full: bool) -> Config:
    """The config of one replicate. Replicates differ in both seeds."""
    _, duration_s = plan.length(is_full)
    seeds = [f"seed={FIRST_SEED + replicate}", f"traffic.seed={FIRST_SEED + replicate}"]
    start = [] if plan.scene else [DEFAULT_WORLD]
    scene = SCENES / plan.scene if plan.scene else None
    return load(scene, [*start, f"traffic.duration_s={duration_s:g}", *seeds, *plan.sets])
