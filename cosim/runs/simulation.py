"""For notebooks and scripts: simulate step by step in memory, or run a whole experiment into a folder.

from cosim import Simulation

with Simulation({"traffic": {"duration_s": 20}}) as simulation:
    for result in simulation:
        print(result.time_s, len(result.world), len(result.detections))
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.codes import Role, labels
from cosim.config.config import Config, load, resolve_data, with_defaults
from cosim.door.kinds import SECTIONS
from cosim.runs import recording
from cosim.runs import run as running
from cosim.runs.check import check, notes_on
from cosim.runs.drive import warm_up
from cosim.runs.rows import Columns
from cosim.step.cycle import step
from cosim.step.fuse import boxes_of
from cosim.step.mixed_perception import MixedImages
from cosim.step.parts import Parts
from cosim.step.result import StepResult
from cosim.step.state import State
from cosim.traffic.scenario import Scenario, find
from cosim.traffic.source import TrafficEnded, TrafficSource
from cosim.world import World
from results.archive import OpenRun, open_run
from results.columns import WHOLE, Column
from results.tables import TABLES
from sensors.boxes import Boxes
from sensors.lidar import RangeImages

AnyConfig = Config | Mapping[str, Any] | str | Path | None
"""A `Config`, a dictionary with the content of a config file, the path of a TOML file, or None for the default city."""


def run(config: AnyConfig = None, out: str | Path | None = None, **parts: type | str) -> OpenRun:
    """Run one experiment into a folder, as the command `cosim run` does, and open it.

    Parameters
    ----------
    config
        As `Simulation`.
    out
        Folder to write. The default is the next free `runs/<city>-N`.
    parts
        As in `Simulation`.

    Returns
    -------
    The run, with its tables and metrics.

    Raises
    ------
    ValueError
        In one line, if the config cannot run.
    """
    resolved = _resolved(config, parts)
    _warn(resolved, find(resolved.traffic.scenario, resolved.traffic.trace))
    return open_run(running.run(resolved, None if out is None else Path(out), lambda *_: None))


class Simulation:
    """A simulation in memory. Iterate over it to get the result of every step. It writes no files.

    Use it as a context manager, which ends SUMO. It can be iterated over once; entering it again begins with step 0.
    Simulations may exist beside each other, because each has SUMO in a process of its own; the same config always has
    the same traffic.

    Parameters
    ----------
    config
        A `Config`, a dictionary with the content of a config file, the path of a TOML file, or None for the default
        city.
    parts
        Classes that replace those of the config, by section: `detector`, `radio`, `pseudonyms`, `trust`, `driver`.
        Each is a class that is defined at the top level of a module or notebook, or a name as in a config. Name
        attacks in the config's `attacks`.

    Raises
    ------
    ValueError
        In one line, if the config cannot run.
    """

    def __init__(self, config: AnyConfig = None, **parts: type | str) -> None:
        self.config = _resolved(config, parts)
        self._scenario = check(self.config)
        _warn(self.config, self._scenario)
        self._parts: Parts | None = None
        self._traffic: TrafficSource | None = None
        self._state: State | None = None
        self._variants: tuple[str, ...] = ()
        self._n_steps = 0

    @property
    def n_steps(self) -> int:
        """Number of simulated steps."""
        return self._n_steps

    def __enter__(self) -> "Simulation":
        self._parts, _, self._traffic = running.load_parts(self.config, self._scenario)
        self._state = State.start(self._parts)
        self._variants = tuple(variant.name for variant in self._parts.trust.variants)
        self._n_steps = 0
        try:
            warmup_s = self._scenario.warmup_of(self.config.traffic)
            warm_up(warmup_s, self._traffic, self._parts.watch, lambda *_: None)
        except BaseException:
            self._traffic.close()
            raise
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if self._traffic is not None:
            self._traffic.close()
        self._parts = self._traffic = self._state = None

    def __iter__(self) -> Iterator["SimulatedStep"]:
        return self

    def __next__(self) -> "SimulatedStep":
        if self._parts is None or self._traffic is None or self._state is None:
            raise RuntimeError("a Simulation is entered before it is iterated over: with Simulation(...) as simulation")
        if self._n_steps >= self.config.n_steps:
            raise StopIteration
        try:
            world = self._traffic.advance()
        except TrafficEnded:
            raise StopIteration from None
        self._state, result = step(world, self._state, self._parts)
        self._traffic.command(result.commands.actor, result.commands.speed_mps)
        self._n_steps += 1
        return SimulatedStep(self, result, self._variants)


class SimulatedStep:
    """What happened in one step of a `Simulation`.

    Vehicles are named by their actor number; messages and trust by pseudonym. Tables have the columns of the tables of
    a run (`results/TABLES.md`). Their numbers are those that were computed, before they are rounded for storage.
    `results/TABLES.md` marks columns with ground truth, which no vehicle knows.
    """

    def __init__(self, simulation: Simulation, result: StepResult, variants: Sequence[str]) -> None:
        self._simulation, self._number = simulation, simulation.n_steps
        self._columns = _Columns()
        self._labels = {"variants": tuple(variants), "roles": labels(Role)}
        self.result = result
        """The results of the stages, as arrays. Their structure may change between versions."""
        self.time_s: float = result.world.step * simulation.config.traffic.step_s
        """Time since recording began [s]."""
        recording.step(self._columns, result, simulation.config.traffic.step_s)

    @property
    def step(self) -> int:
        """Number of the step, from 0."""
        return self.result.world.step

    @property
    def world(self) -> World:
        """Every actor on the road: ground truth."""
        return self.result.world

    @property
    def vehicles(self) -> Int[ndarray, "e"]:
        """Actor numbers of the equipped vehicles on the road, ascending."""
        return self.world.actor[self.world.equipped]

    @property
    def sensing(self) -> Int[ndarray, "s"]:
        """Actor numbers of the vehicles that sense in this step, ascending. They have a point cloud."""
        sensed = self.result.sensed
        return np.zeros(0, np.int64) if sensed is None else sensed.sensing.actor

    def cloud(self, vehicle: int, frame: Literal["world", "sensor"] = "world") -> Float[ndarray, "n 3"]:
        """Point cloud of one vehicle's sweep.

        Ask for it before the next step begins, because the next step overwrites its memory.

        Parameters
        ----------
        vehicle
            Actor number, one of `sensing`.
        frame
            `world`: x east, y north, z up, at the vehicle's estimated position. `sensor`: x forward, y left, z up.

        Returns
        -------
        Points [m].

        Raises
        ------
        ValueError
            If the vehicle has no sweep in this step, or if there is no such frame.
        RuntimeError
            If the next step has begun.
        """
        if frame not in ("world", "sensor"):
            raise ValueError(f"frame = {frame!r}: there is no such choice. There are world, sensor.")
        if self._simulation.n_steps != self._number:
            raise RuntimeError(f"the clouds of step {self.step} are gone: ask for them before the next step begins")
        sensed = self.result.sensed
        row = np.flatnonzero(self.sensing == vehicle)
        if sensed is None or not len(row):
            raise ValueError(
                f"vehicle {vehicle} has no sweep in step {self.step}: name one of step.sensing, where there are any."
            )
        sweeps = sensed.positioned.observed.sweeps
        images, observer = sweeps, int(row[0])
        if isinstance(sweeps, MixedImages):
            images, observer = sweeps.image(observer)
        assert isinstance(images, RangeImages), "this process holds the range images"
        xyz_m = images.xyz(observer)
        return xyz_m if frame == "sensor" else images.poses.to_world(observer, xyz_m)

    def table(self, name: str) -> pd.DataFrame:
        """Rows of this step for one table of a run; empty if the step has no rows for it.

        Raises
        ------
        ValueError
            If there is no such table, or if it is written at the end of a run.
        """
        if name not in TABLES:
            raise ValueError(f"there is no table {name!r}. The tables are {', '.join(TABLES)}.")
        if "step" not in TABLES[name].columns:
            raise ValueError(f"a step has no table {name!r}: it is of a whole run. Write one with cosim.run(...).")
        parts = [self._frame(name, columns) for columns in self._columns.of_table.get(name, [])]
        return pd.concat(parts, ignore_index=True) if parts else self._empty(TABLES[name].stored)

    @property
    def detections(self) -> pd.DataFrame:
        """Boxes in the vehicles' detection lists, attacks included: table `detections`."""
        return self.table("detections")

    @property
    def messages(self) -> pd.DataFrame:
        """Messages received, by sender and receiver, with their latency: table `receptions`."""
        return self.table("receptions")

    @property
    def evaluations(self) -> pd.DataFrame:
        """The vehicles' evaluations of detections: table `evaluations`."""
        return self.table("evaluations")

    @property
    def trust(self) -> pd.DataFrame:
        """Trust values that the server computed in this step; empty if it computed none: table `trust`."""
        return self.table("trust")

    @property
    def trust_lookups(self) -> pd.DataFrame:
        """Trust in each sender that each receiver looks up when it fuses: table `trust_lookups`."""
        return self.table("trust_lookups")

    @property
    def fused(self) -> pd.DataFrame:
        """Fused objects of each vehicle with their boxes: table `fused`."""
        if (sensed := self.result.sensed) is None:
            return self._empty(TABLES["fused"].columns)
        frame = self.table("fused")
        known, by, moved = sensed.known, sensed.known.detections.message, frame.pose.notna()
        columns = recording.detection_columns(self.result.world, known, known.pseudonym[by])
        detections = self._frame("detections", columns)
        detections = detections.assign(step=known.step[by]).set_index(["step", "observer", "detection_index"])
        pose = frame.pose.where(moved, frame.source)
        pose_index = frame.pose_index.where(moved, frame.source_index)
        named = {
            "source": pd.MultiIndex.from_frame(frame[["source_step", "source", "source_index"]]),
            "pose": pd.MultiIndex.from_arrays([frame.pose_step, pose, pose_index]),
        }
        for name, column in TABLES["fused"].columns.items():
            if column.via:
                frame[name] = detections[name].reindex(named[column.via]).array
        is_unit = self.result.world.is_roadside[sensed.sensing.row]
        boxes = []
        for found in sensed.fused():
            if found is not None:
                driven = np.flatnonzero(~is_unit[found.ego])
                boxes.append(boxes_of(found, known.objects).take(driven))
        for name, values in recording.box_columns(Boxes.concat(boxes)).items():
            frame[name] = values
        return frame[list(TABLES["fused"].columns)]

    def _empty(self, columns: Mapping[str, Column]) -> pd.DataFrame:
        """No rows, in the types that rows of other steps have: `pd.concat` of steps keeps these types."""
        made = {}
        for name, column in columns.items():
            dtype: Any = "float64"
            if column.type == "category":
                dtype = pd.CategoricalDtype(pd.Index(column.labels(self._labels)))
            elif column.type == "bool":
                dtype = "boolean" if column.null else "bool"
            elif column.type in WHOLE:
                dtype = "Int64" if column.null else "int64"
            elif column.type == "string":
                dtype = "str"
            made[name] = pd.Series(dtype=dtype)
        return pd.DataFrame(made)

    def _frame(self, table: str, columns: Mapping[str, ndarray | None]) -> pd.DataFrame:
        """Columns as a table, with labels instead of codes and nulls for absent values."""
        n = next(len(values) for values in columns.values() if values is not None)
        made: dict[str, Any] = {}
        for name, column in TABLES[table].stored.items():
            values, valid = columns.get(name), columns.get(f"{name}__valid")
            if values is None and (name == "step" or column.usual == "step"):
                values = np.full(n, self.step)
            elif values is None:
                zeros = np.zeros(n, np.int64 if column.type == "category" else np.float64)
                values, valid = zeros, np.full(n, column.usual == "zero")
            if column.type == "category" and values.dtype.kind in "iu":
                codes = (values if valid is None else np.where(valid, values, -1)).astype(np.int64)
                made[name] = pd.Categorical.from_codes(codes, pd.Index(column.labels(self._labels)))
            elif valid is None:
                made[name] = values
            else:
                nullable: Any = {"b": "boolean", "i": "Int64", "u": "Int64"}.get(values.dtype.kind, values.dtype)
                made[name] = pd.Series(values).astype(nullable).where(valid).array
        return pd.DataFrame(made)


class _Columns:
    """Keeps rows in memory by table; takes the place of a recorder."""

    tables = tuple(TABLES)

    def __init__(self) -> None:
        self.of_table: dict[str, list[Columns]] = {}

    def append(self, table: str, step: int, columns: Columns) -> None:
        """As `Recorder`."""
        if any(values is not None and len(values) for values in columns.values()):
            self.of_table.setdefault(table, []).append(columns)


def _resolved(config: AnyConfig, parts: Mapping[str, type | str]) -> Config:
    """The config, with these classes instead of those that it names."""
    named = {section: _name_of(section, part) for section, part in parts.items()}
    if config is None or isinstance(config, str | Path):
        changes = []
        for section, name in named.items():
            changes.append(f"{section}.{SECTIONS[section].key}={name}")
        return load(None if config is None else _file(config), changes)
    if not isinstance(config, Config | Mapping):
        raise ValueError(f"the config is a {type(config).__name__}. {_KINDS}")
    data = _plain(config.to_dict()) if isinstance(config, Config) else with_defaults(_plain(config))
    for section, name in named.items():
        data.setdefault(section, {})[SECTIONS[section].key] = name
    return resolve_data(data, "the config", None)


_KINDS = "Give a dictionary, the path of a TOML file, `run.config` of a run, or nothing for the default city."


def _file(config: str | Path) -> Path:
    """The path of a config file. ValueError if it is text or a folder."""
    if "\n" in str(config):
        raise ValueError("the config is a text of several lines: `tomllib.loads(text)` makes a dictionary of it.")
    if Path(config).is_dir():
        raise ValueError(f"{config} is a folder. {_KINDS}")
    return Path(config)


def _plain(value: Any) -> Any:
    """A copy of a value of a dictionary as a TOML file would hold it: no tuples, no paths, no numbers of NumPy."""
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple | ndarray):
        return [_plain(one) for one in value]
    if isinstance(value, np.generic):
        return value.item()
    return str(value) if isinstance(value, Path) else value


def _warn(config: Config, scenario: Scenario) -> None:
    """Log keys that the config sets and that change nothing, and what looks like a mistake in the scenario."""
    for note in notes_on(config, scenario):
        logging.getLogger(__name__).warning(note)


def _name_of(section: str, part: type | str) -> str:
    """The name of a class in a config."""
    known = [name for name in SECTIONS if name != "attacks"]
    if section not in known:
        raise ValueError(f"Simulation(..., {section}=...): no such part. There are {', '.join(known)}.")
    if isinstance(part, str):
        return part
    if not isinstance(part, type) or "." in part.__qualname__:
        raise ValueError(
            f"Simulation(..., {section}=...): {part!r} is no class at the top level of a module. Give the class, "
            "or its name as path.py:Name."
        )
    return f"{part.__module__}:{part.__qualname__}"
