"""The perception of a run whose vehicles sense in cells."""

from dataclasses import dataclass, field, replace
from time import perf_counter, process_time
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.execution.cells.border import cells_of, within_reach
from cosim.execution.cells.crew import CellCost, Crew
from cosim.execution.cells.worker import AreaQuestions, peak_bytes
from cosim.step.mixed_perception import MixedPerception
from cosim.step.perception import BoxAnswers, BoxQuestions, Observed, Perception, Seen
from cosim.step.stopwatch import Stopwatch
from cosim.world import World
from sensors.boxes import Boxes
from sensors.evidence import AreaParams
from sensors.lidar import Poses


@dataclass(frozen=True, slots=True)
class CellImages:
    """Range images of M observers, which the workers of the cells hold."""

    poses: Poses
    observers: tuple[Int[ndarray, "k"], ...]
    """Observers of each cell, ascending."""
    cell: UInt8[ndarray, "m"]
    row: Int[ndarray, "m"]
    """Row of each observer within its cell."""
    error: Float[ndarray, "m 3"] | None = None
    """Errors of the poses, as in `displaced`; None if they are exact."""

    def displaced(self, error: Float[ndarray, "m 3"]) -> "CellImages":
        """As `RangeImages.displaced`."""
        return replace(self, poses=self.poses.displaced(error), error=error)

    def by_cell(self, observer: Int[ndarray, "n"]) -> list[Int[ndarray, "k"]]:
        """Of questions to these observers, those of each cell, in their order."""
        cell = self.cell[observer]
        order = np.argsort(cell, kind="stable")  # of bytes: a radix sort, whose cost does not grow with the cells
        n_asked = np.bincount(cell, minlength=len(self.observers))
        return np.split(order, np.cumsum(n_asked)[:-1])

    def error_in(self, cell: int) -> Float[ndarray, "k 3"] | None:
        """Errors of the poses of a cell's observers."""
        return None if self.error is None else self.error[self.observers[cell]]


_UNCOUNTED = 2
"""Steps that load kernels."""


@dataclass(frozen=True, slots=True)
class _Mark:
    """What a run took until the cells had answered all questions of a step."""

    n_steps: int
    run_cpu_s: float
    at_s: float
    cost: CellCost


def _per_step(first: _Mark, last: _Mark) -> dict[str, Any]:
    """Means per step between two marks."""
    n, a, b = last.n_steps - first.n_steps, first.cost, last.cost
    cells_s = (b.cpu_s - a.cpu_s) / n
    means = {
        "wall_s": (last.at_s - first.at_s) / n,
        "run_cpu_s": (last.run_cpu_s - first.run_cpu_s) / n,
        "cells_cpu_s": float(cells_s.sum()),
        "busiest_sense_s": (b.busiest_sense_s - a.busiest_sense_s) / n,
        "busiest_answer_s": (b.busiest_answer_s - a.busiest_answer_s) / n,
        "wait_s": (b.wait_s - a.wait_s) / n,
        "imbalance": (b.busiest_sense_s - a.busiest_sense_s + b.busiest_answer_s - a.busiest_answer_s)
        / max((b.cpu_s - a.cpu_s).mean(), 1e-9),
    }
    rounded = {name: round(value, 4) for name, value in means.items()}
    return {"steps": n, **rounded, "bytes": (b.n_bytes - a.n_bytes) // n, "cell_cpu_s": cells_s.round(4).tolist()}


@dataclass(slots=True)
class CellPerception:
    """Perception of which every cell computes that of its own vehicles.

    A cell gets the actors within the reach of its vehicles' sensors. What one vehicle perceives does not depend on who
    else is computed with it, so the results equal those of one process in every bit.
    """

    inside: Perception | MixedPerception
    crew: Crew
    reach_m: float
    """Range of the sensors."""
    n_steps: int = 0
    n_observers: int = 0
    """Vehicles that have sensed, summed over the steps."""
    n_beyond: int = 0
    """Actors that cells got besides their own vehicles, summed over cells and steps."""
    _marks: list["_Mark"] = field(default_factory=list)

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """As in `Perceives`."""
        with watch("wait for cells"):
            images, seen = self._perceive(world, observers)
        with watch("detect"):
            return self.inside.observed(world, observers, images, seen, sort=True)

    def _perceive(self, world: World, observers: Int[ndarray, "e"]) -> tuple[CellImages, list[Seen]]:
        n, xy_m = self.crew.n_cells, world.boxes.xyz_m[:, :2]
        cell = cells_of(xy_m[observers], np.ones(len(observers)), n)
        mine = tuple(np.flatnonzero(cell == number) for number in range(n))
        radius_m = world.boxes.circumradius_m
        largest = int(np.argmax(radius_m))  # each cell gets it, because it says how far neighbours are looked for
        rows = [
            np.union1d(within_reach(xy_m, observers[own], self.reach_m + radius_m[largest]), largest)
            if len(own) else own for own in mine
        ]  # fmt: skip
        self.n_steps += 1
        self.n_observers += len(observers)
        self.n_beyond += sum(map(len, rows)) - len(observers)
        found = self.crew.ask("perceive", [
            (world.take(there), np.searchsorted(there, observers[own])) if len(own) else None
            for there, own in zip(rows, mine, strict=True)
        ], keeps=True)  # fmt: skip
        row, seen = np.zeros(len(observers), np.int64), []
        poses = Poses(np.zeros((len(observers), 3)), np.zeros(len(observers)))
        for there, own, result in zip(rows, mine, found, strict=True):
            if result is None:
                continue
            of_cell, here = result
            row[own] = np.arange(len(own))
            poses.origin_m[own], poses.yaw_rad[own] = of_cell.origin_m, of_cell.yaw_rad
            seen.append(here.of_actors(there.astype(np.int32)).renumbered(own.astype(np.int32)))
        return CellImages(poses, mine, cell.astype(np.uint8), row), seen

    def report(self) -> dict[str, Any]:
        """Figures of the cells for the manifest. Costs are means per step, from the third step with messages on."""
        crew, n_observers = self.crew, max(self.n_observers, 1)
        found: dict[str, Any] = {
            "cells": crew.n_cells,
            "replaced": crew.n_replaced,
            "vehicles": round(self.n_observers / max(self.n_steps, 1), 1),
            "actors_beyond_per_vehicle": round(self.n_beyond / n_observers, 4),
            "stages_s": {stage: round(s, 3) for stage, s in crew.stages_s.items()},
            "peak_mb": {"run": round(peak_bytes() / 1e6), "cell": round(crew.peak_bytes / 1e6)},
        }
        if len(self._marks) == 2:
            found["per_step"] = _per_step(*self._marks)
        return found

    def _mark(self) -> None:
        """Note what the steps so far took, at the same point of each step, and keep the first and the last note.

        The first steps load kernels, so they do not count.
        """
        if self.n_steps > _UNCOUNTED:
            mark = _Mark(self.n_steps, process_time(), perf_counter(), self.crew.cost)
            self._marks = [*self._marks[:1], mark]

    def answers(self, sweeps: CellImages, asked: BoxQuestions) -> BoxAnswers:
        """As in `Perceives`."""
        n_points, plausible = np.zeros(len(asked.counting), np.int32), np.ones(len(asked.testing), bool)
        parts: list[tuple[Any, ...]] = []
        of_cells = zip(sweeps.by_cell(asked.counting), sweeps.by_cell(asked.testing), strict=True)
        for number, (p, t) in enumerate(of_cells):
            rows, (counted, tested) = _only(asked.boxes, asked.counted[p], asked.tested[t])
            counting, testing = (sweeps.row[by].astype(np.int32) for by in (asked.counting[p], asked.testing[t]))
            mine = BoxQuestions(asked.boxes.take(rows), asked.area, counting, counted, testing, tested)
            parts.append((p, t, (sweeps.error_in(number), mine)))
        found = self.crew.ask("answers", [given if len(p) + len(t) else None for p, t, given in parts])
        for (p, t, _), result in zip(parts, found, strict=True):
            if result is not None:
                n_points[p], plausible[t] = result
        self._mark()
        return n_points, plausible

    def in_area(
        self, sweeps: CellImages, o: Int[ndarray, "n"], boxes: Boxes, area: AreaParams, b: Int[ndarray, "n"],
        label: UInt8[ndarray, "boxes"], own: Boxes,
    ) -> Bool[ndarray, "n"]:  # fmt: skip
        """As in `Perceives`."""
        inside = np.zeros(len(o), bool)
        parts: list[tuple[Any, ...]] = []
        for number, (observers, k) in enumerate(zip(sweeps.observers, sweeps.by_cell(o), strict=True)):
            rows, (about,) = _only(boxes, b[k])
            asked = AreaQuestions(sweeps.row[o[k]], boxes.take(rows), area, about, label[rows], own.take(observers))
            parts.append((k, (sweeps.error_in(number), asked)))
        found = self.crew.ask("in_area", [given if len(k) else None for k, given in parts])
        for (k, _), result in zip(parts, found, strict=True):
            if result is not None:
                inside[k] = result
        return inside


def _only(boxes: Boxes, *of: Int[ndarray, "_"]) -> tuple[Int[ndarray, "k"], list[Int[ndarray, "_"]]]:
    """Rows of the boxes that occur in some arrays, ascending, and the arrays with rows of these."""
    occurs = np.zeros(len(boxes), bool)
    for rows in of:
        occurs[rows] = True
    number = np.cumsum(occurs, dtype=np.int32) - 1
    return np.flatnonzero(occurs), [number[rows].astype(rows.dtype) for rows in of]
