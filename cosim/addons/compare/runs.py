"""The runs behind facts, made when a fact first needs them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cosim.addons.compare.facts import RunPlan
from cosim.config.config import Config, load
from cosim.runs import run as running
from results.archive import open_run
from results.run import Run

Advance = Callable[[str, int, int], None]
"""Called with what is done, how much of it, and how much there is."""

FIRST_SEED = 7001
"""Seeds of the first replicate; no model was fitted on runs of these seeds."""


@dataclass(slots=True)
class Runs:
    """Runs in a new folder of their own, by name of their plan."""

    folder: Path
    plans: Mapping[str, RunPlan]
    is_full: bool = False
    advance: Advance = lambda *_: None
    _made: dict[str, list[Run]] = field(default_factory=dict)

    def of(self, name: str) -> list[Run]:
        """The replicates of a plan. They are made at the first call."""
        if name not in self._made:
            plan = self.plans[name]
            n, _ = plan.full if self.is_full else plan.quick
            found = []
            for replicate in range(n):
                self.advance(f"runs: {name}", replicate, n)
                found.append(self._run(plan, replicate))
            self.advance(f"runs: {name}", n, n)
            self._made[name] = found
        return self._made[name]

    def _run(self, plan: RunPlan, replicate: int) -> Run:
        path = self.folder / f"{plan.name}-{replicate + 1}"
        return open_run(running.run(config_of(plan, replicate, self.is_full), path, lambda *_: None))


def config_of(plan: RunPlan, replicate: int, is_full: bool) -> Config:
    """The config of one replicate. Replicates differ in both seeds."""
    _, duration_s = plan.full if is_full else plan.quick
    seeds = [f"seed={FIRST_SEED + replicate}", f"traffic.seed={FIRST_SEED + replicate}"]
    return load(None, ["preset=v0.2", f"traffic.duration_s={duration_s:g}", *seeds, *plan.sets])
