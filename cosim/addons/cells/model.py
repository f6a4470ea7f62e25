"""What a step in cells takes: a model that is fitted to runs, for other cities, cells and cores.

Notes
-----
With V vehicles that sense and N cells, the processor time of a step is R = r V + q N in the process of the run, and
C = c V + d N in the cells. The busiest cell takes I C / N with I = 1 + i log2(N): a share s of it to sense, and the
rest to compare and fuse. A second thread of the process of the run takes the share l of R, for radio links and near
pairs of the next step. The first thread takes M = (1 - l) R, the share a of it while cells sense for the next step. So
a step takes

    T = (1 - a) M + max(a M, s I C / N) + (1 - s) I C / N

with a core for each process and one more, and never less than (R + C) / K with K cores. If the cells are on other
machines, all that they exchange with the run passes its network port, which adds B / W for B bits and W bits per
second. r, q, c and d are 0 or more. They are fitted by least squares of the relative errors, so runs need to differ in
N.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import nnls

_AFTER = {"trust": 1.0, "radio": 0.5, "track": 1.0, "record": 1.0, "encounters": 1.0, "server": 1.0, "driver": 1.0}
"""Stages of the process of the run while the cells sense for the next step, and their share then: one of two rounds of
messages."""
_OTHER = {"radio": 0.5, "attack": 1.0, "match": 1.0, "track objects": 1.0}
"""The same for other times."""
_AHEAD = ("links", "pairs")
"""Stages of its second thread."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Means per step of a run in cells."""

    n_vehicles: float
    n_cells: int
    run_s: float
    """Processor time of the process of the run."""
    cells_s: float
    """Processor time of all cells."""
    busiest_s: float
    """Processor time of the busiest cell in each step."""
    sensing_p: float
    """Share of the cells' time that is sensing."""
    after_p: float
    """Share of the first thread's own time after the evaluation, in which cells sense for the next step."""
    ahead_p: float
    """Share of the run's own time in its second thread."""
    n_bytes: float
    wall_s: float

    @staticmethod
    def of(manifest: Mapping[str, Any]) -> "Measured":
        """From the manifest of a run.

        Raises
        ------
        ValueError
            In one line, if the run had no cells or was too short.
        """
        cells, spent_s = manifest.get("cells", {}), manifest["timings_s"]
        if not (step := cells.get("per_step")):
            raise ValueError(
                "it has no cost per step of cells: run it with --cells N, for 5 steps with messages or more."
            )
        after_s, other_s = (
            sum(share * spent_s.get(stage, 0.0) for stage, share in stages.items()) for stages in (_AFTER, _OTHER)
        )
        first_s = after_s + other_s
        ahead_s = sum(manifest.get("timings_ahead_s", {}).get(stage, 0.0) for stage in _AHEAD)
        return Measured(
            n_vehicles=cells["vehicles"], n_cells=cells["cells"], run_s=step["run_cpu_s"],
            cells_s=step["cells_cpu_s"], busiest_s=step["busiest_s"],
            sensing_p=step["sense_cpu_s"] / max(step["cells_cpu_s"], 1e-9),
            after_p=after_s / max(first_s, 1e-9), ahead_p=ahead_s / max(ahead_s + first_s, 1e-9),
            n_bytes=step["bytes"], wall_s=step["wall_s"],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Predicted:
    """A step that was not measured."""

    run_s: float
    cells_s: float
    busiest_s: float
    step_s: float
    """Time of the step."""
    n_bytes: float
    """Bytes between the process of the run and the cells."""


@dataclass(frozen=True, slots=True)
class CostModel:
    """The model of this module."""

    run_s: tuple[float, float]
    """Per vehicle and per cell."""
    cells_s: tuple[float, float]
    """Per vehicle and per cell."""
    imbalance: float
    """More work in the busiest cell, per doubling of the cells."""
    sensing_p: float
    after_p: float
    ahead_p: float
    n_bytes: float
    """Per vehicle."""

    @staticmethod
    def fit(runs: Sequence[Measured]) -> "CostModel":
        """Fit the model to runs. A ValueError of one line is raised if they have all the same number of cells."""
        n_vehicles, n_cells = (
            np.array([getattr(run, name) for run in runs], float) for name in ("n_vehicles", "n_cells")
        )
        if len(set(n_cells)) < 2:
            raise ValueError("a fit needs runs with 2 different numbers of cells or more.")
        doublings = np.log2(n_cells)
        more = np.array([run.busiest_s * run.n_cells / max(run.cells_s, 1e-9) - 1 for run in runs])
        return CostModel(
            run_s=_linear(n_vehicles, n_cells, np.array([run.run_s for run in runs])),
            cells_s=_linear(n_vehicles, n_cells, np.array([run.cells_s for run in runs])),
            imbalance=max(0.0, float((doublings * more).sum() / (doublings**2).sum())),
            sensing_p=float(np.mean([run.sensing_p for run in runs])),
            after_p=float(np.mean([run.after_p for run in runs])),
            ahead_p=float(np.mean([run.ahead_p for run in runs])),
            n_bytes=float(np.mean([run.n_bytes / run.n_vehicles for run in runs])),
        )

    def predict(self, n_vehicles: float, n_cells: int, n_cores: int, wire_bps: float = np.inf) -> Predicted:
        """A step of a city with so many vehicles that sense, in so many cells, on so many cores.

        `wire_bps` is what the network carries from and to the machine of the run [bit/s], if the cells are elsewhere.
        """
        run_s = self.run_s[0] * n_vehicles + self.run_s[1] * n_cells
        cells_s = self.cells_s[0] * n_vehicles + self.cells_s[1] * n_cells
        busiest_s = (1 + self.imbalance * float(np.log2(n_cells))) * cells_s / n_cells
        first_s = (1 - self.ahead_p) * run_s
        while_sensing_s = max(self.after_p * first_s, self.sensing_p * busiest_s)
        longest_s = (1 - self.after_p) * first_s + while_sensing_s + (1 - self.sensing_p) * busiest_s
        n_bytes = self.n_bytes * n_vehicles
        step_s = max(longest_s, (run_s + cells_s) / n_cores) + 8 * n_bytes / wire_bps
        return Predicted(run_s, cells_s, busiest_s, step_s, n_bytes)


def _linear(
    n_vehicles: Float[ndarray, "r"], n_cells: Float[ndarray, "r"], seconds: Float[ndarray, "r"]
) -> tuple[float, float]:
    """Seconds per vehicle and per cell, 0 or more, with the least relative errors."""
    found, _ = nnls(np.column_stack([n_vehicles, n_cells]) / seconds[:, None], np.ones(len(seconds)))
    return float(found[0]), float(found[1])
