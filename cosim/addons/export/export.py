"""Exports of a run: the choice of vehicles and steps, repeated sweeps, and files that are written in parallel."""

import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import shapely
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.export.folder import Folder
from cosim.base.earth import Projection
from cosim.config.config import Config
from cosim.config.single import from_command_line
from cosim.door import blame
from cosim.door.guard import make
from cosim.door.load import Choice
from cosim.runs.replay_lidar import city_of, config_of, sweep, worlds
from cosim.traffic.scenario import Scenario, find
from cosim.world import World
from results.moments import Cloud, Place, Plan, Selection
from results.run import Run
from results.sensing import sensing_steps
from sensors.raycast.mesh import city_triangles
from sensors.scene import Scene
from sumo_nets import network

Progress = Callable[[str, int, int], None]
"""Callback for progress. Its arguments are the phase, the work done and the total."""

IN_FLIGHT = 64
"""Largest number of files that are encoded and written at the same time."""

SAMPLE = 16
"""Number of sweeps from which the mean number of returns is estimated."""


class Exporter(Protocol):
    """Writes a run in another tool's layout."""

    @property
    def TABLES(self) -> tuple[str, ...]:
        """Tables that the run must hold; a class attribute will do."""
        ...

    def plan(self, selection: Selection) -> Plan:
        """The files to write for some vehicles and steps of a run.

        Raises
        ------
        ValueError
            In one line, where these vehicles and steps will not do.
        """
        ...


@dataclass(slots=True)
class Sweeper:
    """Computes sweeps of a run again. Worlds are read in blocks of steps, so ask for steps in ascending order."""

    run: Run
    config: Config
    city: Scene
    steps: Int[ndarray, "s"]
    """All steps that will be asked for."""
    _block: dict[int, World] = field(default_factory=dict)

    def __call__(self, step: int, vehicles: Sequence[int]) -> list[Cloud]:
        """Per vehicle, a function that computes the returns of its LiDAR in its sensor frame."""
        if not vehicles:
            return []
        if step not in self._block:
            at = int(np.searchsorted(self.steps, step))
            block = self.steps[at : at + self.config.record.block_steps]
            self._block = {world.step: world for world in worlds(self.run, block)}
        world = self._block[step]
        row = np.searchsorted(world.actor, np.asarray(vehicles))
        sweeps = sweep(self.config, self.city, world, row)
        return [partial(sweeps.cloud, i) for i in range(len(vehicles))]


def export(
    run: Run,
    form: str,
    out: Path,
    vehicles: str | None = None,
    steps: str | None = None,
    sets: Sequence[str] = (),
    progress: Progress = lambda what, done, total: None,
) -> dict[str, Any]:
    """Write a run, or some vehicles and steps of it, in another tool's layout.

    Parameters
    ----------
    form
        Name of an included exporter, or one of the user's own as `path.py:Name`.
    vehicles, steps
        Numbers and spans of them, such as `3,17,20-25`. None: all.
    sets
        Parameters of the exporter, as `key=value`.

    Returns
    -------
    What was written: frames or files, bytes, what was estimated before, and remarks on what is not written.

    Raises
    ------
    ValueError
        In one line: there is no such exporter, the run lacks a table or did not sense, a vehicle was never on the road,
        the folder has other content, or the disk is full.
    ExtensionError
        In one line, if the user's own exporter fails.
    """
    choice, params = from_command_line("exporter", form, sets)
    with blame.in_use(choice.source.file, f"exporter {choice.of.__name__}"):
        return _exported(run, choice, make(choice, *params), out, (vehicles, steps, sets), progress)


def _exported(
    run: Run,
    choice: Choice,
    fmt: Exporter,
    out: Path,
    wanted: tuple[str | None, str | None, Sequence[str]],
    progress: Progress,
) -> dict[str, Any]:
    vehicles, steps, sets = wanted
    run.require(*fmt.TABLES)
    if vehicles is not None and getattr(fmt, "ALL_VEHICLES", False):
        raise ValueError(f"--vehicles {vehicles}: {choice.source.name} always has all vehicles. Leave it out.")
    config, of_traffic = config_of(run), getattr(fmt, "ALL_STEPS", False)
    if "detections" in fmt.TABLES and not config.sensing:  # the table would be empty
        raise run.lacks("sweeps, detections or messages", "")
    chosen = Selection(
        run,
        _vehicles(run, vehicles),
        _steps(run, steps, of_traffic),
        _road_edge_m(config),
        partial(_projection, config),
        _place(run, config),
        vehicles is not None,
    )
    if chosen.presence.empty and not of_traffic:
        if not chosen.vehicles:
            raise ValueError(f"{run.path}: no vehicle carries a LiDAR. Raise fleet.penetration_p, and run again.")
        raise ValueError("none of these vehicles is on the road in any of these steps. Choose others.")
    about = {
        "format": choice.source.name,
        "run": str(run.path.resolve()),
        "vehicles": list(chosen.vehicles),
        "steps": steps or _span(chosen.steps),
        "parameters": list(sets),
        "created": run.manifest.get("created"),
        "schema_version": run.manifest["schema_version"],
    }
    if choice.is_own:
        about["sha256"] = choice.source.sha256
    plan = fmt.plan(chosen)
    folder = Folder.open(out, about)
    return _write(plan, chosen, folder, Sweeper(run, config, _city(fmt, config), chosen.steps), progress)


def _write(plan: Plan, chosen: Selection, folder: Folder, sweeper: Sweeper, progress: Progress) -> dict[str, Any]:
    n_bytes = _estimate(plan, chosen, sweeper)
    left = [unit for unit in plan.units if unit.name not in folder.done]
    folder.check_room(n_bytes * len(left) / max(1, len(plan.units)))
    folder.note()
    n_files = written = 0
    note = f"about {_size(n_bytes)}"
    with ThreadPoolExecutor(max_workers=os.cpu_count() or 1) as pool:
        n_units = len(plan.units)
        for n_done, unit in enumerate(left, n_units - len(left)):
            progress(note, n_done, n_units)
            ahead: deque[Future[int]] = deque()
            for file in unit.files(sweeper):
                if file.same_as:
                    written += folder.write(file)
                else:
                    ahead.append(pool.submit(folder.write, file))
                n_files += 1
                while len(ahead) > IN_FLIGHT:
                    written += ahead.popleft().result()
            written += sum(one.result() for one in ahead)
            folder.finish(unit.name)
    progress(note, len(plan.units), len(plan.units))
    return {
        "out": str(folder.path),
        "files": n_files,
        "bytes": written,
        "sweeps": plan.n_sweeps,
        "estimated_bytes": round(n_bytes),
        "resumed": len(left) < len(plan.units),
        "remarks": list(plan.remarks),
    }


def _estimate(plan: Plan, chosen: Selection, sweeper: Sweeper) -> float:
    """Bytes that a plan will write, from a few of its sweeps."""
    if not plan.n_sweeps:
        return plan.text_bytes
    steps, vehicles = chosen.presence.step, chosen.presence.vehicle
    step = steps.iloc[0]
    some = vehicles[steps == step].tolist()[:SAMPLE]
    points = np.mean([len(cloud()) for cloud in sweeper(int(step), some)])
    return plan.n_sweeps * plan.bytes_per_point * float(points) + plan.text_bytes


def _city(fmt: Exporter, config: Config) -> Scene:
    """The buildings; an empty scene if the exporter makes no point clouds."""
    return city_of(config) if "observability" in fmt.TABLES else Scene.empty()


def _vehicles(run: Run, text: str | None) -> tuple[int, ...]:
    """Vehicles from a text such as `3,17,20-25`. None: all vehicles with a LiDAR."""
    known = run.table("vehicles", ["vehicle", "equipped"]).set_index("vehicle").equipped
    if text is None:
        return tuple(known.index[known].tolist())
    chosen: dict[int, None] = {}
    for first, last in _ranges(text, "--vehicles", "3,17,20-25"):
        chosen |= dict.fromkeys(range(first, last + 1))
    for number in chosen:
        if number not in known.index:
            raise ValueError(
                f"--vehicles {number}: there was never such a vehicle in {run.path}; 0 to {known.index[-1]}."
            )
        if not known[number]:
            some = ", ".join(map(str, known.index[known][:8]))
            raise ValueError(f"--vehicles {number} carries no LiDAR. These do: {some}, ...")
    return tuple(chosen)


def _steps(run: Run, text: str | None, of_traffic: bool) -> Int[ndarray, "s"]:
    """Steps in which vehicles sense, or all steps `of_traffic`, from a text such as `0-59`. None: all such steps."""
    every = np.arange(int(run.manifest["steps"])) if of_traffic else sensing_steps(run)
    if text is None:
        return every
    keep = np.zeros(len(every), bool)
    for a, b in _ranges(text, "--steps", "0-59"):
        keep |= (every >= a) & (every <= b)
    if not keep.any():
        why = "the run is over by then" if of_traffic else "no vehicle senses then"
        last = int(run.manifest["steps"]) - 1
        raise ValueError(f"--steps {text}: {why}. {run.path} has the steps 0 to {last}.")
    return every[keep]


def _ranges(text: str, flag: str, example: str) -> list[tuple[int, int]]:
    """First and last number of each span in the text. A single number is a span too."""
    found = []
    for part in text.split(","):
        ends = part.strip().split("-")
        if (
            not 1 <= len(ends) <= 2
            or not all(e.isdecimal() and len(e) < 10 for e in ends)
            or int(ends[0]) > int(ends[-1])
        ):
            raise ValueError(f"{flag} {text}: numbers and spans of them are wanted, as in {flag} {example}")
        found.append((int(ends[0]), int(ends[-1])))
    return found


def _span(steps: Int[ndarray, "s"]) -> str:
    return f"{steps[0]} to {steps[-1]}, {len(steps)} of them"


def _size(n_bytes: float) -> str:
    return f"{n_bytes / 1e9:.1f} GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.1f} MB"


def scenario_of(config: Config) -> Scenario:
    """The scenario of a run's traffic."""
    return find(config.traffic.scenario, config.traffic.trace)


def _road_edge_m(
    config: Config,
) -> Callable[[Float[ndarray, "n 2"]], Float[ndarray, "n"]]:
    """A function for the distance of points to the edge of the lanes for motor vehicles [m]; positive on the lanes."""
    scenario = scenario_of(config)

    @cache
    def road() -> tuple[shapely.Geometry, shapely.STRtree]:
        lanes = () if scenario.net is None else network.lanes(scenario.net)
        strips = []
        for lane in lanes:
            if lane.for_cars:
                line = shapely.LineString(lane.line_m[:, :2] - scenario.origin_m)
                strips.append(shapely.buffer(line, 0.5 * lane.width_m, quad_segs=4))
        whole = shapely.union_all(strips)
        if whole.is_empty:
            raise ValueError(
                "the run's traffic has no network: the distance to the edge of the road is not known. Set "
                "traffic.scenario to a city and traffic.trace to the trace, and run again."
            )
        shapely.prepare(whole)
        xy, ring = shapely.get_coordinates(shapely.get_rings(shapely.get_parts(whole)), return_index=True)
        inside = np.flatnonzero(ring[1:] == ring[:-1])
        sides = np.stack([xy[inside], xy[inside + 1]], axis=1)
        return whole, shapely.STRtree(shapely.linestrings(sides))

    def distance_m(xy_m: Float[ndarray, "n 2"]) -> Float[ndarray, "n"]:
        if not len(xy_m):
            return np.zeros(0)
        whole, edge = road()
        points = shapely.points(xy_m)
        _, away = edge.query_nearest(points, return_distance=True, all_matches=False)
        return np.where(shapely.contains(whole, points), away, -away)

    return distance_m


def _place(run: Run, config: Config) -> Place:
    """The surroundings of the run's traffic."""
    scenario = scenario_of(config)
    east_m, north_m = run.manifest["summary"].get("origin_m", scenario.origin_m)
    return Place((east_m, north_m), lambda: city_triangles(city_of(config)))


def _projection(config: Config) -> Projection:
    """Where on Earth the run's world frame is."""
    scenario = scenario_of(config)
    if scenario.net is None:
        raise ValueError("the run's traffic has no network: it is not known where on Earth it is.")
    text, offset_m = network.projection(scenario.net)
    (x_m, y_m), (offset_x_m, offset_y_m) = scenario.origin_m, offset_m
    return Projection.of(text, x_m - offset_x_m, y_m - offset_y_m)
