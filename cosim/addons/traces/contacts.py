"""Encounters of traces from elsewhere, and of runs with other definitions: a run folder without sensing."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.addons.traces import layouts, positions, tracks
from cosim.addons.traces.layouts import PositionColumns
from cosim.addons.traces.positions import Fixes
from cosim.addons.traces.tracks import TrackParams
from cosim.base.durable import sha256
from cosim.config.config import Config, of_run_without_code
from cosim.runs import folder as run_folder
from cosim.runs.drive import Advance
from cosim.runs.manifest import versions
from cosim.runs.source import source
from cosim.step.trackers.encounters import PairSearch, update_encounters
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.fcd import is_observed, timesteps
from cosim.traffic.interpolation import interval_s
from cosim.traffic.params import TrafficParams
from cosim.traffic.replay import TraceReplay
from cosim.traffic.scenario import find
from cosim.traffic.source import TrafficEnded, TrafficError, class_counts
from cosim.world import World
from results.archive import open_run
from results.encounters import Appearance, EncounterParams, EncounterTracker, Rows, check_definitions
from results.manifest import finish
from results.recorder import Recorder
from sensors.line_of_sight import WallIndex
from sensors.scene import Shape

_BLOCK_STEPS = 600


@dataclass(frozen=True, kw_only=True, slots=True)
class ContactParams:
    """What is counted, and how positions become tracks."""

    encounters: tuple[EncounterParams, ...] = (EncounterParams(pairs="all"),)
    """Definitions, as in a config's [[encounters]]."""
    scenario: str | None = None
    """City or .sumocfg of a trace that SUMO wrote, as in traffic.scenario: sizes of vehicles, and buildings."""
    step_s: float | None = None
    """Length of a step [s]. None takes the interval of the trace."""
    max_gap_s: float = 30.0
    """Longest time between two positions of an actor across which it is followed [s]."""
    max_speed_mps: float = 70.0
    """A faster motion between two positions is a jump, at which observation ends and begins anew [m/s]."""
    appearance: Appearance | None = None
    """What an actor's first and last position mean. None: that it enters and leaves the road in a trace that SUMO
    wrote and in a run, and that observation begins and ends elsewhere, as in a trace of `cosim trace`."""
    from_s: float | None = None
    """Time of the trace at which counting begins [s]."""
    to_s: float | None = None
    """Time of the trace at which it ends [s]."""
    columns: PositionColumns | None = None
    """Columns of a table. None recognises the layout."""
    frame_hz: float | None = None
    """Video frames per second, for times that are frame numbers."""
    time_unit_s: float | None = None
    """Seconds per unit of times that are numbers. None asks the layout and the numbers."""
    length_unit_m: float | None = None
    """Metres per unit of positions. None asks the layout and the names of columns."""
    repair: bool = False
    """Whether bad rows are left out and rows are sorted, instead of refused."""
    config: Config | None = None
    """Config of the equipment: its fleet, its seed, and the height of its LiDARs, between which there is a line of
    sight or none. None: that of the run, or the default with a trace that SUMO wrote."""

    def __post_init__(self) -> None:
        check_definitions(self.encounters)
        tracks.check_options(self.step_s, self.max_gap_s, self.max_speed_mps, self.frame_hz)
        given = [s for s in (self.from_s, self.to_s) if s is not None]
        if not all(map(math.isfinite, given)) or sorted(given) != given:
            raise ValueError(f"--from {self.from_s} --to {self.to_s}: the trace is counted from a time to a later one.")


@dataclass(slots=True)
class _Counted:
    """Encounters and actors, as they are counted."""

    folder: Path
    recorder: Recorder
    trackers: tuple[EncounterTracker, ...]
    n_steps: int = 0
    n_present: int = 0
    report: dict[str, Any] = field(default_factory=dict)

    def add(self, step: int, closed: Sequence[Rows], n_present: int) -> None:
        for rows in closed:
            self.recorder.append("encounters", step, rows)
        self.recorder.reach(step)
        self.n_steps, self.n_present = step + 1, self.n_present + n_present

    def close(self, vehicles: Mapping[str, ndarray | None]) -> None:
        self.recorder.reach(self.n_steps - 1)
        rows = [tracker.close(self.n_steps) for tracker in self.trackers]
        self.recorder.close({"encounters": rows, "vehicles": [vehicles]})


def contacts(paths: Sequence[Path], params: ContactParams, out: Path | None, advance: Advance) -> Path:
    """Count the encounters of a trace, or of a run with other definitions, into a folder that reads like a run.

    Parameters
    ----------
    paths
        Files of one trace; or one run folder.
    params
        What is counted.
    out
        Folder to write; None for the next free `runs/<name>-N`.
    advance
        Called with progress.

    Returns
    -------
    The folder, with the tables `vehicles` and `encounters`.

    Raises
    ------
    ValueError
        In one line: what is wrong with the trace. Nothing is written then.
    """
    run_folder.check(out)
    if not paths:
        raise ValueError("There is no trace. Name at least one file, or a run folder.")
    for path in paths:
        if not path.exists():
            raise ValueError(f"{path}: no such file or folder. Give a trace or a run folder.")
    if paths[0].is_dir():
        _check_of_positions(params, f"{paths[0]} is a run")
        return _of_run(paths, params, out, advance)
    if params.columns is None and layouts.is_sumo(paths[0]):
        _check_of_positions(params, f"{paths[0]} is a trace that SUMO wrote")
        return _of_sumo(paths, params, out, advance)
    return _of_positions(paths, params, out, advance)


def _check_of_positions(params: ContactParams, what: str) -> None:
    """Raise ValueError if options are set that only positions from elsewhere can obey."""
    if params.columns is not None:
        raise ValueError(f"{what}: its columns are known. Leave out --id, --time, --x, --y, --lat and --lon.")
    usual = ContactParams()
    for name in ("max_gap_s", "max_speed_mps", "frame_hz", "time_unit_s", "length_unit_m", "repair"):
        if getattr(params, name) != getattr(usual, name):
            option = name.replace("unit_s", "unit").replace("unit_m", "unit").replace("_", "-")
            raise ValueError(f"--{option}: {what}, with a position in every step. Leave it out.")


def _of_run(paths: Sequence[Path], params: ContactParams, out: Path | None, advance: Advance) -> Path:
    run = open_run(paths[0])
    if len(paths) > 1:
        raise ValueError(f"{paths[1]}: contacts of one run at a time, and {paths[0]} is a run.")
    if params.from_s is not None or params.to_s is not None:
        raise ValueError("--from and --to go with a trace, and this is a run. Leave them out.")
    run.require("actors", "vehicles")
    recorded = of_run_without_code(run.manifest["config"], paths[0])
    traffic = TrafficParams(scenario=str(paths[0]), step_s=params.step_s or run.dt_s)
    return _of_traffic(paths[0], traffic, recorded, params, out, advance)


def _of_sumo(paths: Sequence[Path], params: ContactParams, out: Path | None, advance: Advance) -> Path:
    if len(paths) > 1:
        raise ValueError(f"{paths[1]}: one trace of SUMO's at a time. Count contacts of each in its own command.")
    named = str(paths[0])
    first_s, between_s = _first_and_interval_s(paths[0])
    step_s = params.step_s or between_s
    traffic = TrafficParams(scenario=params.scenario or named, trace=named, step_s=step_s, begin_s=params.from_s)
    was_observed = is_observed(paths[0])
    if was_observed and params.appearance is None:
        params = replace(params, appearance="censors")
    skipped_s = 0.0 if was_observed and params.from_s is None else step_s
    if params.from_s is None and params.to_s is not None:
        if params.to_s < first_s:
            raise TrafficError(f"{named} begins at {first_s:g} s, after --to {params.to_s:g}. Set --to later.")
        params = replace(params, from_s=first_s)
    return _of_traffic(paths[0], traffic, Config(), params, out, advance, skipped_s)


def _first_and_interval_s(path: Path) -> tuple[float, float]:
    """Time of the first timestep of a trace, and interval of the first ones."""
    read = timesteps(path)
    times_s = [timestep.time_s for timestep, _ in zip(read, range(10), strict=False)]
    read.close()  # type: ignore[attr-defined]
    return times_s[0] if times_s else 0.0, interval_s(np.array(times_s)) or 1.0


def _of_traffic(
    path: Path,
    traffic: TrafficParams,
    config: Config,
    params: ContactParams,
    out: Path | None,
    advance: Advance,
    skipped_s: float = 0.0,
) -> Path:
    """Count encounters of worlds, as a run does.

    Parameters
    ----------
    path
        The run, or the trace of SUMO.
    config
        Trees, parked cars and objects, placed by its seed; and the equipment, if `params` has none.
    skipped_s
        Length of what is skipped: the empty world before a trace.
    """
    named = str(path)
    scenario = find(named) if params.scenario is None else find(params.scenario, named)
    needs_city = any(p.pairs in ("los", "all_los") for p in params.encounters)
    if needs_city and scenario.net is None:
        raise ValueError(
            'encounters.pairs = "los" needs the buildings of a city, and a trace alone has none. Set --scenario.'
        )
    equipment = params.config or config
    registry = ActorRegistry(equipment.fleet, equipment.seed)
    city = scenario.city(config.trees, config.seed)
    parked = scenario.parked(config.parked, city, config.seed)
    replayed = scenario.traffic(traffic, registry, objects=config.objects, parked=parked)
    n_asked, appearance = _steps_asked(params, traffic.step_s), params.appearance or "ends"
    try:
        for _ in replayed.warm_up(skipped_s):
            pass
        mount_m = equipment.lidar.mount_above_roof_m
        search = PairSearch.of(params.encounters, WallIndex.of(city.buildings), mount_m, city).without(parked)
        worlds = _worlds(replayed, n_asked or math.inf)
        extent = _Extent()
        first = next(worlds, None)
        if first is None:
            raise TrafficError(f"{path}: there is nothing to count: no actor is on the road in the time given.")
        with _counting(out, scenario.name, params, traffic.step_s, appearance) as counted:
            for step, world in chain([first], worlds):
                near = search(world)
                n_present = extent.add(world, search.parked_key)
                closed, _, _ = update_encounters(counted.trackers, step, near)
                counted.add(step, closed, n_present)
                advance("contacts", step + 1, max(step + 1, n_asked), f"{len(world)}")
            is_parked = np.isin(registry.name_key, search.parked_key)
            counted.report |= replayed.report() | extent.report(registry.shape[~is_parked])
            counted.close(_vehicles(registry))
            about = {"layout": "run" if path.is_dir() else "sumo", "appearance": appearance}
            _finish(counted, scenario.name, [path], params, traffic.step_s, about, scenario.provenance())
    finally:
        replayed.close()
    return counted.folder


def _worlds(replayed: Any, most: float) -> Iterator[tuple[int, World]]:
    """The worlds to count, with their steps; in a gap of a trace, the first one without actors."""
    step = 0
    while step < most:
        try:
            world = replayed.advance()
        except TrafficEnded:
            return
        yield step, world
        step += 1
        if not len(world) and isinstance(replayed, TraceReplay):
            step += replayed.skip_gap(most - step - 1)


@dataclass(slots=True)
class _Extent:
    """Speeds of actors, and the rectangle that they are in, over the worlds of a trace."""

    low_m: ndarray = field(default_factory=lambda: np.full(2, np.inf))
    high_m: ndarray = field(default_factory=lambda: np.full(2, -np.inf))
    n_of_speed: ndarray = field(default_factory=lambda: np.zeros(1001, np.int64))
    """Actors in steps by speed, in tenths of m/s."""

    def add(self, world: World, parked_key: ndarray) -> int:
        """Add a world without the parked cars of these names. Returns the number of actors, pedestrians included."""
        moving = ~np.isin(world.name_key, parked_key)
        if moving.any():
            xy_m = world.boxes.xyz_m[moving, :2]
            self.low_m = np.minimum(self.low_m, xy_m.min(axis=0))
            self.high_m = np.maximum(self.high_m, xy_m.max(axis=0))
            tenths = np.rint(np.abs(world.speed_mps[moving]) * 10)
            code = np.clip(tenths, 0, 1000).astype(np.int64)
            self.n_of_speed += np.bincount(code, minlength=1001)
        return int(moving.sum())

    def report(self, shape: ndarray) -> dict[str, Any]:
        """For the summary of the trace, with the number of actors of each class."""
        share = np.cumsum(self.n_of_speed) / max(1, self.n_of_speed.sum())
        median, p95 = (float(np.searchsorted(share, at)) / 10 for at in (0.5, 0.95))
        extent_m = self.high_m - self.low_m if self.n_of_speed.any() else np.zeros(2)
        east_m, north_m = extent_m.tolist()
        return {
            "speed_median_mps": median,
            "speed_p95_mps": p95,
            "extent_east_m": east_m,
            "extent_north_m": north_m,
            "classes": class_counts(shape),
        }


def _steps_asked(params: ContactParams, step_s: float) -> int:
    """Steps from --from to --to; 0 if the trace decides."""
    if params.to_s is None:
        return 0
    return math.floor((params.to_s - (params.from_s or 0.0)) / step_s + 1e-6) + 1


def _of_positions(paths: Sequence[Path], params: ContactParams, out: Path | None, advance: Advance) -> Path:
    """Count encounters of positions that are interpolated to steps."""
    if params.scenario is not None:
        raise ValueError(f"--scenario goes with a trace that SUMO wrote, and {paths[0]} is none. Leave it out.")
    for p in params.encounters:
        if p.pairs != "all":
            raise ValueError(
                f'{paths[0]}: a trace of positions says nothing of equipment or buildings: pairs = "all" is counted '
                "alone. Change the definition."
            )
    read = positions.read(
        paths, params.columns, params.frame_hz, params.repair, params.time_unit_s, params.length_unit_m
    )
    (fixes, length_s), step_s = _cut(read, params, paths[0]), params.step_s
    if step_s is None:
        fixes, step_s = tracks.on_own_steps(fixes)
    track_params = TrackParams(step_s, params.max_gap_s, params.max_speed_mps, length_s)
    try:
        found = tracks.tracks(fixes, track_params)
    except ValueError as error:
        raise TrafficError(f"{fixes.source}: {error}") from None
    appearance = params.appearance or "censors"
    # Without buildings and bodies nothing is between two vehicles: what `los = "buildings"` finds in a run without a
    # city.
    params = replace(params, encounters=tuple(replace(p, los="buildings") for p in params.encounters))
    name = _plain_name(paths[0])
    number, rows = _vehicles_of(fixes, found)
    on_foot = rows["vehicle_class"] == Shape.PEDESTRIAN
    block_steps = max(_BLOCK_STEPS, found.n_steps // 200)
    with _counting(out, name, params, step_s, appearance, block_steps) as counted:
        for here in tracks.steps(fixes, found, step_s):
            closed = []
            for tracker, p in zip(counted.trackers, params.encounters, strict=True):
                vehicle = number[here.track]
                use = np.argsort(vehicle)
                if not p.pedestrians:
                    use = use[~on_foot[vehicle[use]]]
                present = vehicle[use]
                a, b, distance_m = _near(present, here.xy_m[use], p.radius_m)
                is_los = np.ones(len(a), bool)
                ended, *_ = tracker.update(here.step, a, b, distance_m, is_los, present)
                closed.append(ended)
            counted.add(here.step, closed, len(here.track))
            if here.step % 100 == 99 or here.step + 1 == found.n_steps:
                advance("contacts", here.step + 1, found.n_steps, f"{len(here.track)} vehicles")
        counted.report |= found.report | ({"repaired": fixes.repaired} if fixes.repaired else {})
        counted.report |= {"actors": len(set(found.actor.tolist())), "tracks": len(found.names)}
        counted.report |= {"read_as": list(fixes.read_as), "classes": class_counts(rows["vehicle_class"])}
        counted.close(rows)
        layout = "columns" if params.columns else layouts.layout_of(paths[0])
        about = {"layout": layout, "appearance": appearance, "begin": fixes.begin}
        checked = {f"sha256 {path.name}": sha256(path) for path in paths}
        _finish(counted, name, paths, params, step_s, about, {"name": name} | checked)
    return counted.folder


def _cut(fixes: Fixes, params: ContactParams, path: Path) -> tuple[Fixes, float]:
    """Positions in the time that is counted, and the next ones of the same actors before and after it, and how long it
    is [s]. Its begin becomes time 0."""
    if params.from_s is None and params.to_s is None:
        return fixes, math.inf
    begin = float(fixes.begin)
    from_s = 0.0 if params.from_s is None else params.from_s - begin
    to_s = math.inf if params.to_s is None else params.to_s - begin
    keep = (fixes.time_s >= from_s) & (fixes.time_s <= to_s)
    is_same = np.diff(fixes.actor) == 0
    begin_s, end_s = fixes.time_s[:-1], fixes.time_s[1:]
    reaches = is_same & (begin_s < to_s) & (end_s > from_s)
    keep[:-1] |= reaches
    keep[1:] |= reaches
    if not keep.any():
        raise TrafficError(
            f"{path}: no position in the span of --from and --to; the trace goes from {fixes.begin} to "
            f"{begin + float(fixes.time_s.max()):.10g} s."
        )
    cut = replace(
        fixes,
        actor=fixes.actor[keep],
        time_s=fixes.time_s[keep] - from_s,
        xy_m=fixes.xy_m[keep],
        begin=f"{begin + from_s:.10g}",
    )
    return cut, to_s - from_s


def _near(
    number: Int[ndarray, "n"], xy_m: ndarray, radius_m: float
) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"], ndarray]:
    """Pairs within the radius, a < b, sorted, and their distances; numbers are ascending."""
    if len(number) < 2:
        none = np.zeros(0, np.int64)
        return none, none, np.zeros(0)
    pairs = cKDTree(xy_m).query_pairs(radius_m, output_type="ndarray")
    pair = np.sort((pairs[:, 0] << 32) | pairs[:, 1])
    a, b = pair >> 32, pair & 0xFFFFFFFF
    east_m, north_m = (xy_m[a] - xy_m[b]).T
    distance_m = np.sqrt(east_m * east_m + north_m * north_m)
    return number[a], number[b], distance_m


@contextmanager
def _counting(
    out: Path | None,
    name: str,
    params: ContactParams,
    step_s: float,
    appearance: Appearance,
    block_steps: int = _BLOCK_STEPS,
) -> Iterator[_Counted]:
    """Write a folder, or nothing at all if something goes wrong."""
    trackers = tuple(EncounterTracker(p, step_s, appearance=appearance) for p in params.encounters)
    folder = run_folder.create(out, name)
    with folder.or_nothing():
        yield _Counted(folder.path, Recorder(folder.path, "summary", block_steps), trackers)
    folder.release()


def _vehicles(registry: ActorRegistry) -> dict[str, ndarray | None]:
    """Columns of the table `vehicles`."""
    return _vehicle_columns(
        registry.names,
        registry.shape,
        registry.lwh_m,
        registry.equipped,
        registry.first_step,
        registry.last_step,
        registry.n_steps,
    )


def _vehicles_of(
    fixes: Fixes,
    found: tracks.PositionTracks,
) -> tuple[Int[ndarray, "s"], dict[str, Any]]:
    """Number of the vehicle of each track, in the order of first tracks, and the same columns."""
    number_of = {name: number for number, name in enumerate(dict.fromkeys(found.names))}
    number = np.array([number_of[name] for name in found.names])
    first = np.unique(number, return_index=True)[1]
    last_step = np.zeros(len(number_of), np.int64)
    np.maximum.at(last_step, number, found.last_step)
    lasts = found.last_step - found.first_step + 1
    n_steps = np.bincount(number, lasts, len(number_of)).astype(np.int64)
    actor = found.actor[first]
    lwh_m = np.array([kind.lwh_m for kind in fixes.types])
    equipped = np.zeros(len(first), bool)
    return number, _vehicle_columns(
        list(number_of),
        fixes.shape[actor],
        lwh_m[actor],
        equipped,
        found.first_step[first],
        last_step,
        n_steps,
    )


def _vehicle_columns(
    names: Sequence[str],
    shape: ndarray,
    lwh_m: ndarray,
    equipped: Bool[ndarray, "n"],
    first_step: ndarray,
    last_step: ndarray,
    n_steps: ndarray,
) -> dict[str, ndarray | None]:
    n = len(names)
    return {
        "vehicle": np.arange(n, dtype=np.int32),
        "sumo_id": np.array(names, object),
        "vehicle_class": shape,
        "length_m": lwh_m[:, 0],
        "width_m": lwh_m[:, 1],
        "height_m": lwh_m[:, 2],
        "equipped": equipped,
        "role": np.zeros(n, np.uint8),
        "role__valid": equipped,
        "attack": None,
        "first_step": first_step,
        "last_step": last_step,
        "n_steps": n_steps,
        "attack_start_step": None,
    }


_NOTED = ("max_gap_s", "max_speed_mps", "from_s", "to_s", "time_unit_s", "length_unit_m", "repair")
"""Options of which the manifest keeps the value."""


def _finish(
    counted: _Counted,
    name: str,
    paths: Sequence[Path],
    params: ContactParams,
    step_s: float,
    about: dict[str, Any],
    net: dict[str, str],
) -> None:
    """Write the manifest."""
    given = {key: getattr(params, key) for key in _NOTED}
    given["columns"] = None if params.columns is None else asdict(params.columns)
    config = {
        "sensing": False,
        "traffic": {"scenario": name, "trace": str(paths[0]), "step_s": step_s},
        "encounters": [asdict(p) for p in params.encounters],
        "contacts": {"files": [str(path) for path in paths]} | about | given,
    }
    mean = round(counted.n_present / counted.n_steps, 3)
    manifest = {
        "dt_s": step_s,
        "steps": counted.n_steps,
        "config": config,
        "versions": versions("columnar"),
        "source": source(),
        "net": net,
        "timings_s": {},
        "summary": counted.report | {"actors_per_step_mean": mean},
    }
    finish(counted.folder, manifest)


def _plain_name(path: Path) -> str:
    """Name of a trace for its folder."""
    name = path.name.removesuffix(".gz")
    return name.rpartition(".")[0] or name
