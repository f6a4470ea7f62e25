"""The perception of a run whose vehicles sense in cells."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter, process_time
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.addons.cells.border import cells_of, costs, within_reach
from cosim.addons.cells.crew import CellCost, Crew
from cosim.addons.cells.worker import peak_bytes
from cosim.base.ragged import offsets, ranges
from cosim.step.comparing import (
    Compared,
    FusionOf,
    Grouped,
    KnownObjects,
    PartRows,
    Recall,
    Traced,
    Used,
    numbers,
)
from cosim.step.known import Uses
from cosim.step.mixed_perception import MixedPerception
from cosim.step.perception import Observed, Perception, Seen
from cosim.step.stopwatch import Stopwatch
from cosim.world import World
from sensors.evidence import AreaParams
from sensors.lidar import Poses
from trust.fusion import Fused, SensorEvidence
from trust.params import TrustParams
from trust.tables import Evaluations, Groups, ObjectLists


@dataclass(frozen=True, slots=True)
class CellImages:
    """Range images of M observers, which the workers of the cells hold."""

    poses: Poses
    observers: tuple[Int[ndarray, "k"], ...]
    """Observers of each cell, ascending."""
    cell: UInt8[ndarray, "m"]
    crew: Crew
    error: Float[ndarray, "m 3"] | None = None
    """Errors of the poses, as in `displaced`; None if they are exact."""

    def displaced(self, error: Float[ndarray, "m 3"]) -> "CellImages":
        """As `RangeImages.displaced`."""
        return replace(self, poses=self.poses.displaced(error), error=error)

    def n_returns(self) -> Int[ndarray, "m"]:
        """As `RangeImages.n_returns`."""
        n = np.zeros(len(self.cell), np.int64)
        found = self.crew.ask("n_returns", [() if len(own) else None for own in self.observers])
        for own, of_cell in zip(self.observers, found, strict=True):
            n[own] = of_cell if len(own) else 0
        return n

    def by_cell(self, observer: Int[ndarray, "n"]) -> list[Int[ndarray, "k"]]:
        """Rows of these observers, for each cell, in their order."""
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
    busiest_s: float
    """Processor time of the busiest cell in each step, summed over the steps since the first mark."""


def _per_step(first: _Mark, last: _Mark) -> dict[str, Any]:
    """Means per step between two marks."""
    n, a, b = last.n_steps - first.n_steps, first.cost, last.cost
    cells_s = (b.cpu_s - a.cpu_s) / n
    means = {
        "wall_s": (last.at_s - first.at_s) / n,
        "run_cpu_s": (last.run_cpu_s - first.run_cpu_s) / n,
        "cells_cpu_s": float(cells_s.sum()),
        "sense_cpu_s": (b.sense_s - a.sense_s) / n,
        "busiest_s": last.busiest_s / n,
        "wait_s": (b.wait_s - a.wait_s) / n,
        "imbalance": last.busiest_s / max((b.cpu_s - a.cpu_s).mean(), 1e-9),
    }
    rounded = {name: round(value, 4) for name, value in means.items()}
    return {"steps": n, **rounded, "bytes": (b.n_bytes - a.n_bytes) // n, "cell_cpu_s": cells_s.round(4).tolist()}


@dataclass(frozen=True, slots=True)
class _Begun:
    """Sweeps that the cells make next."""

    world: World
    cell: UInt8[ndarray, "e"]
    """Of each observer."""
    observers: tuple[Int[ndarray, "k"], ...]
    """Observers of each cell, ascending."""
    rows: tuple[Int[ndarray, "h"], ...]
    """Rows of the world that each cell has got."""


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
    _begun: "_Begun | None" = None

    def begin(self, world: World, observers: Int[ndarray, "e"]) -> None:
        """Let the cells sense this world next; the next call waits for it.

        A cell begins when it has compared what it sensed before. To tell them once more changes nothing.
        """
        if self._begun is not None and self._begun.world is world:
            return
        n, xy_m = self.crew.n_cells, world.boxes.xyz_m[:, :2]
        cell = cells_of(xy_m[observers], costs(xy_m, observers, self.reach_m), n)
        mine = tuple(np.flatnonzero(cell == number) for number in range(n))
        radius_m = world.boxes.circumradius_m
        largest = int(np.argmax(radius_m))  # each cell gets it, because it says how far neighbours are looked for
        rows = tuple(
            np.union1d(within_reach(xy_m, observers[own], self.reach_m + radius_m[largest]), largest)
            if len(own) else own for own in mine
        )  # fmt: skip
        self.crew.ask("perceive", [
            (world.take(there), np.searchsorted(there, observers[own])) if len(own) else None
            for there, own in zip(rows, mine, strict=True)
        ], keeps=True)  # fmt: skip
        self._begun = _Begun(world, cell.astype(np.uint8), mine, rows)

    def __call__(self, world: World, observers: Int[ndarray, "e"], watch: Stopwatch) -> Observed:
        """As in `Perceives`."""
        with watch("wait for cells"):
            self.begin(world, observers)
            images, seen = self._perceived(observers)
        if not seen:  # nobody senses in this step
            seen = self.inside.perceive(world, observers, watch)[1]
        with watch("detect"):
            return self.inside.observed(world, observers, images, seen, sort=True)

    def _perceived(self, observers: Int[ndarray, "e"]) -> tuple[CellImages, list[Seen]]:
        assert self._begun is not None
        begun, self._begun = self._begun, None
        self.n_steps += 1
        self.n_observers += len(observers)
        self.n_beyond += sum(map(len, begun.rows)) - len(observers)
        found = self.crew.ask("perceived", [() if len(own) else None for own in begun.observers], keeps=True)
        seen = []
        poses = Poses(np.zeros((len(observers), 3)), np.zeros(len(observers)))
        for there, own, result in zip(begun.rows, begun.observers, found, strict=True):
            if result is None:
                continue
            of_cell, here = result
            poses.origin_m[own], poses.yaw_rad[own] = of_cell.origin_m, of_cell.yaw_rad
            seen.append(here.of_actors(there.astype(np.int32)).renumbered(own.astype(np.int32)))
        return CellImages(poses, begun.observers, begun.cell, self.crew), seen

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
            cost, busiest_s = self.crew.cost, 0.0
            if self._marks:
                before = self._marks[-1]
                busiest_s = before.busiest_s + float((cost.cpu_s - before.cost.cpu_s).max())
            mark = _Mark(self.n_steps, process_time(), perf_counter(), cost, busiest_s)
            self._marks = [*self._marks[:1], mark]

    def compare(
        self, _: object, sweeps: CellImages, known: KnownObjects, area: AreaParams, params: TrustParams,
        recall: Recall | None, watch: Stopwatch,
    ) -> tuple[Compared, "CellGroups"]:  # fmt: skip
        """As `cosim.step.comparing.compare`; the detector that the workers have tells its recall."""
        with watch("match"):
            parts = [
                known.part(own, received) if len(own) else None
                for own, received in zip(sweeps.observers, sweeps.by_cell(known.received.receiver), strict=True)
            ]
        with watch("evaluate"):
            found = self.crew.ask("compare", [
                None if part is None else (sweeps.error_in(cell), *part, area, params)
                for cell, part in enumerate(parts)
            ], keeps=True)  # fmt: skip
            self._mark()
            rows = [None if part is None else part[1] for part in parts]
            compared = _joined(known, sweeps.observers, rows, found)
        return compared, CellGroups(self.crew, sweeps, known, rows)


@dataclass(frozen=True, slots=True)
class CellGroups:
    """Groups of detections that the workers of the cells hold; as `Fuses`."""

    crew: Crew
    sweeps: CellImages
    known: KnownObjects
    rows: list[PartRows | None]
    """What each cell knows."""

    def fuse(self, used: Used, variants: Sequence[FusionOf]) -> list[Fused]:
        """As in `Fuses`. A trust model that scores objects keeps its state, so its objects are fused here."""
        if any(variant.scorer is not None for variant in variants):
            return self._grouped().fuse(used, variants)
        found = self.crew.ask("fuse", [
            None if rows is None else self._given(own, rows, received, used, variants)
            for own, rows, received in zip(
                self.sweeps.observers, self.rows, self.sweeps.by_cell(used.messages.receiver), strict=True
            )
        ])  # fmt: skip
        return [self._fused([None if f is None else f[number] for f in found]) for number in range(len(variants))]

    def _given(
        self, own: Int[ndarray, "k"], rows: PartRows, received: Int[ndarray, "n"], used: Used,
        variants: Sequence[FusionOf],
    ) -> tuple[Used, list[FusionOf]]:  # fmt: skip
        """What a cell needs to fuse: evaluations of its detections in the messages that it uses."""
        receiver, message = used.messages.receiver[received], used.messages.message[received]
        there = np.zeros(len(self.known.ptr) - 1, bool)
        there[message] = True
        there[self.known.own[own]] = True
        chosen = np.flatnonzero(there[used.lists.owner])
        n = np.diff(used.lists.ptr)[chosen]
        at = ranges(used.lists.ptr[chosen], n)
        member = rows.number[used.lists.member[at]]
        kept = np.flatnonzero(member >= 0)
        at = at[kept]
        own_values, reported = (
            Evaluations(values.evaluation[at], values.visibility[at]) for values in (used.own, used.reported)
        )
        of_cell = Used(
            messages=Uses(numbers(own, len(self.sweeps.cell))[receiver], message),
            in_time=used.in_time,
            lists=ObjectLists(np.searchsorted(kept, offsets(n)), member[kept], used.lists.owner[chosen]),
            own=own_values,
            reported=own_values if used.own is used.reported else reported,
            from_own_m=used.from_own_m[rows.detections],
        )
        return of_cell, [replace(variant, trust=variant.trust[received]) for variant in variants]

    def _fused(self, found: Sequence[Fused | None]) -> Fused:
        """Fused objects of all cells, by vehicle."""
        vehicles = self.sweeps.observers
        n_objects = [
            None if f is None else np.bincount(f.ego, minlength=len(own))
            for f, own in zip(found, vehicles, strict=True)
        ]
        _, places = _by_vehicle(vehicles, n_objects)
        n = sum(map(len, places))
        columns: dict[str, ndarray] = {name: np.empty(n, np.int64) for name in Fused.__dataclass_fields__}
        columns |= {"score": np.empty(n), "ego_detected": np.empty(n, bool)}
        for own, rows, place, f in zip(vehicles, self.rows, places, found, strict=True):
            if rows is not None and f is not None:
                of_all = replace(f, ego=own[f.ego], seed=rows.detections[f.seed], pose=rows.detections[f.pose])
                for name, column in columns.items():
                    column[place] = getattr(of_all, name)
        return Fused(**columns)

    def _grouped(self) -> Grouped:
        """The groups of all cells, by vehicle."""
        found = self.crew.ask("grouped", [None if rows is None else () for rows in self.rows])
        vehicles = self.sweeps.observers
        of_lists = [None if g is None else np.diff(g.lists.ptr) for g in found]
        ptr, places = _by_vehicle(vehicles, of_lists)
        seeds = [np.zeros(0, np.int64) if g is None else g.groups.seeds() for g in found]
        _, of_seed = _by_vehicle(vehicles, [
            None if g is None else np.diff(np.searchsorted(s, g.lists.ptr)) for g, s in zip(found, seeds, strict=True)
        ])  # fmt: skip
        n, n_seeds = int(ptr[-1]), sum(map(len, seeds))
        member, seed, ego_detected = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, bool)
        evidence = SensorEvidence(np.empty(n_seeds, np.int32), np.empty(n_seeds, bool), np.empty(n_seeds, bool))
        for rows, place, to, g in zip(self.rows, places, of_seed, found, strict=True):
            if rows is not None:
                member[place], seed[place] = rows.detections[g.lists.member], place[g.groups.seed]
                ego_detected[place] = g.groups.ego_detected
                for name in SensorEvidence.__dataclass_fields__:
                    getattr(evidence, name)[to] = getattr(g.of_seeds, name)
        lists = ObjectLists(ptr, member, self.known.own)
        return Grouped(lists, Groups(seed, ego_detected), self.known.detections, evidence)


def _joined(
    known: KnownObjects, vehicles: Sequence[Int[ndarray, "_"]], rows: Sequence[PartRows | None],
    found: Sequence[Compared | None],
) -> Compared:  # fmt: skip
    """What the vehicles of all cells found, by vehicle."""
    ptr, places = _by_vehicle(vehicles, [None if c is None else np.diff(c.lists.ptr) for c in found])
    n, traced = int(ptr[-1]), []
    joined = Compared(
        lists=ObjectLists(ptr, np.empty(n, np.int64), known.own),
        groups=Groups(np.empty(n, np.int64), np.empty(n, bool)),
        n_points=np.empty(n, np.int32),
        plausible=np.empty(n, bool),
        own=Evaluations(np.empty(n), np.empty(n)),
        traced=Traced(*(np.zeros(0, np.int64),) * 3),
    )
    for own, of_part, place, c in zip(vehicles, rows, places, found, strict=True):
        if of_part is None or c is None:
            continue
        joined.lists.member[place] = of_part.detections[c.lists.member]
        joined.groups.seed[place], joined.groups.ego_detected[place] = place[c.groups.seed], c.groups.ego_detected
        joined.n_points[place], joined.plausible[place] = c.n_points, c.plausible
        joined.own.evaluation[place], joined.own.visibility[place] = c.own.evaluation, c.own.visibility
        t = c.traced
        traced.append(Traced(own[t.list], of_part.detections[t.detection], of_part.detections[t.seed]))
    if traced:
        columns = [np.concatenate(column) for column in zip(*traced, strict=True)]
        order = np.argsort(columns[0], kind="stable")
        joined = replace(joined, traced=Traced(*(column[order] for column in columns)))
    return joined


def _by_vehicle(
    vehicles: Sequence[Int[ndarray, "_"]], counts: Sequence[Int[ndarray, "_"] | None]
) -> tuple[Int[ndarray, "n+1"], list[Int[ndarray, "_"]]]:
    """Where the rows of each vehicle begin if those of all cells are sorted by vehicle, and the place of each row.

    `counts` has the number of rows of each vehicle of each cell.
    """
    n = np.zeros(sum(map(len, vehicles)), np.int64)
    for own, of_cell in zip(vehicles, counts, strict=True):
        if of_cell is not None:
            n[own] = of_cell
    ptr = offsets(n)
    return ptr, [
        np.zeros(0, np.int64) if of_cell is None else ranges(ptr[own], of_cell)
        for own, of_cell in zip(vehicles, counts, strict=True)
    ]
