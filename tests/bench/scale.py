"""Measures how the cost of each stage grows with the number of vehicles, on crops of a city at constant density."""

import resource
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time, thread_time

import numpy as np
from jaxtyping import Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.addons.export.live import SUFFIXES, Live
from cosim.attacks.params import shares
from cosim.base.threads import n_threads, use_threads
from cosim.config.config import Config, load
from cosim.runs import recording
from cosim.step.cycle import step
from cosim.step.parts import Parts
from cosim.step.result import StepResult
from cosim.step.state import State
from cosim.traffic.actors import ActorRegistry
from cosim.traffic.scenario import Scenario, find
from cosim.traffic.source import TrafficEnded
from cosim.world import World
from results.recorder import Recorder
from sensors.scene import Scene

Row = tuple[str, float, str]
"""A description, the figure and its unit."""

VEHICLES = (250, 500, 1000, 2000, 5000)
WARM_UP_S = 3.0
"""Simulated time before the measurement [s]. It compiles kernels and fills caches and buffers."""
_NEAR_M = 100.0
_N_CENTRES, _N_INSTANTS = 100, 4
"""Number of candidate centres of a crop, and number of times at which its neighbours are counted."""
_N_SHOWN = 10
"""Number of times that a step is shown to a viewer."""


class CpuStopwatch:
    """Wall and processor seconds per stage; takes the place of `cosim.step.stopwatch.Stopwatch`."""

    def __init__(self, processor_time: Callable[[], float] = process_time) -> None:
        self.wall_s: dict[str, float] = {}
        self.processor_s: dict[str, float] = {}
        self._stage, self._begin, self._processor_time = "", (0.0, 0.0), processor_time

    def __call__(self, stage: str) -> "CpuStopwatch":
        self._stage, self._begin = stage, (perf_counter(), self._processor_time())
        return self

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None:
        spent = perf_counter() - self._begin[0], self._processor_time() - self._begin[1]
        for seconds, more in zip((self.wall_s, self.processor_s), spent, strict=True):
            seconds[self._stage] = seconds.get(self._stage, 0.0) + more

    def of_thread(self) -> "CpuStopwatch":
        """As `Stopwatch`."""
        return CpuStopwatch(thread_time)

    def add(self, other: "CpuStopwatch", n_threads: int) -> None:
        """As `Stopwatch`."""
        for stage, seconds in other.wall_s.items():
            self.wall_s[stage] = self.wall_s.get(stage, 0.0) + seconds / n_threads
            self.processor_s[stage] = self.processor_s.get(stage, 0.0) + other.processor_s[stage]


def bench(
    scenario: str = "helsinki",
    trace: str | None = None,
    vehicles: tuple[int, ...] = VEHICLES,
    seconds: int = 5,
    overrides: tuple[str, ...] = (),
) -> Iterator[Row]:
    """Measure each size in the default world, with all vehicles equipped, with 1, 2, 4, ... and all threads.

    Parameters
    ----------
    scenario, trace
        As `traffic.scenario` and `traffic.trace`.
    vehicles
        Numbers of actors to crop to. If one is larger than the traffic, or if there is none, all of it is measured.
    seconds
        Simulated time to measure for each size and number of threads.
    overrides
        Further keys of the config, as for `cosim run --set`.
    """
    config = load(None, [
        f"traffic.scenario={scenario}", *([f"traffic.trace={trace}"] if trace else []), "fleet.penetration_p=1",
        'fleet.equipped_kinds=["car","van","truck","bus","motorcycle"]', "trust_variant=[]",
        *overrides,
    ])  # fmt: skip
    found = find(config.traffic.scenario, config.traffic.trace)
    n_warm, n_measured = (round(time_s / config.traffic.step_s) for time_s in (WARM_UP_S, seconds))
    worlds, registry = _worlds(config, found, n_warm, n_measured)
    parts = Parts.of(config, found.city(), limits=found.limits())
    some = worlds[:: -max(1, (len(worlds) - 1) // _N_INSTANTS)]
    whole = float(np.mean([_neighbours(world, np.arange(len(world))) for world in some]))
    warm = False
    threads = n_threads()
    sizes = [n for n in sorted(vehicles) if n < len(worlds[-1])]
    yield "actors of the whole traffic", len(worlds[-1]), ""
    yield f"neighbours within {_NEAR_M:g} m, of the whole traffic", whole, "actors"
    for size in [*sizes, len(worlds[-1])] if len(sizes) < len(vehicles) or not vehicles else sizes:
        actor, neighbours = piece(some, size, whole)
        yield f"{size} actors: neighbours within {_NEAR_M:g} m", neighbours, "actors"
        cropped = [_taken(world, np.flatnonzero(np.isin(world.actor, actor))) for world in worlds]
        if not warm:
            # some kernels are first called after many steps
            warm = bool(list(_measured("", cropped, n_warm, parts, registry)))
        for n in sorted({1, threads, *(2**k for k in range(1, threads.bit_length()))}):
            use_threads(n)
            yield from _measured(f"{size} actors, {n} thread{'s' * (n > 1)}", cropped, n_warm, parts, registry)
    use_threads(threads)
    yield "peak memory of this process", _peak_bytes() / 1e9, "GB"


def _measured(name: str, worlds: list[World], n_warm: int, parts: Parts, registry: ActorRegistry) -> Iterator[Row]:
    """Figures for one size and the present number of threads."""
    watch = CpuStopwatch()
    with TemporaryDirectory() as folder:
        config = parts.config
        variants = [variant.name for variant in parts.trust.variants]
        recorder = Recorder(Path(folder), config.record.level, len(worlds), variants=variants)
        parts = parts.under(config)
        state, n_equipped, begin = State.start(parts), 0, (0.0, 0.0)
        for number, world in enumerate(worlds):
            if number == n_warm:
                parts, begin = replace(parts, watch=watch), (perf_counter(), process_time())  # type: ignore[arg-type]
            state, result = step(world, state, parts)
            if result.sensed is not None:
                with watch("fuse"):
                    result.sensed.fused()
            with watch("record"):
                recording.step(recorder, result, config.traffic.step_s)
                recorder.reach(world.step)
            if number < n_warm:
                watch.wall_s.clear()
                watch.processor_s.clear()
            else:
                n_equipped += int(world.equipped.sum())
            if number + 1 < len(worlds):
                del result  # as in a run
        with watch("record"):
            recorder.flush(recording.open_rows(state, parts, registry, worlds[-1].step + 1))
        wall_s, processor_s = perf_counter() - begin[0], process_time() - begin[1]
        shown = dict(_shown(parts.config, parts.city, result, Path(folder)))
        n_bytes = sum(path.stat().st_size for path in Path(folder).rglob("*.parquet"))
        n_sensed = sum(int(world.equipped.sum()) for world in worlds)
    n = len(worlds) - n_warm
    simulated_s = n * config.traffic.step_s
    yield f"{name}: equipped vehicles, mean", n_equipped / n, ""
    yield f"{name}: times real time", simulated_s / wall_s, "times"
    yield f"{name}: processor time", 1e6 * processor_s / n_equipped, "µs per equipped vehicle and step"
    yield f"{name}: wall time", 1e6 * wall_s / n_equipped, "µs per equipped vehicle and step"
    yield f"{name}: processor time, all vehicles", processor_s / simulated_s, "s per simulated second"
    serial = {stage: _serial_s(watch.wall_s[stage], of_all) for stage, of_all in watch.processor_s.items()}
    if n_threads() > 1:
        yield f"{name}: serial, of the processor time", sum(serial.values()) / processor_s, ""
    for stage, seconds in sorted(watch.processor_s.items(), key=lambda item: -item[1]):
        yield f"{name}: {stage}, wall time", 1e3 * watch.wall_s[stage] / simulated_s, "ms per simulated second"
        yield f"{name}: {stage}, processor time", 1e6 * seconds / n_equipped, "µs per equipped vehicle and step"
        if n_threads() > 1:
            yield f"{name}: {stage}, serial, of the processor time", serial[stage] / processor_s, ""
    for suffix, shown_s in shown.items():
        figure = 1e6 * shown_s * n / n_equipped
        yield f"{name}: watched as {suffix}, processor time", figure, "µs per equipped vehicle and step"
    yield f"{name}: tables", n_bytes / (n_sensed * config.traffic.step_s), "bytes per vehicle-second"


def _serial_s(wall_s: float, processor_s: float) -> float:
    """Time of one thread alone, if the rest is divided evenly: wall = serial + (processor - serial) / threads."""
    n = n_threads()
    if n == 1:
        return wall_s
    serial_s = (n * wall_s - processor_s) / (n - 1)
    return min(max(serial_s, 0.0), wall_s)


def _shown(config: Config, city: Scene, result: StepResult, folder: Path) -> Iterator[tuple[str, float]]:
    """Processor time of all threads that showing a step takes, by the kind of file [s]; the city was shown before."""
    scenario = find(config.traffic.scenario, config.traffic.trace)
    for suffix in SUFFIXES:
        with Live(config, str(folder / f"live{suffix}")) as live:
            live(result, scenario, city)
            live.flush()
            begin = process_time()
            for _ in range(_N_SHOWN):
                live(result, scenario, city)
            live.flush()
            yield suffix, (process_time() - begin) / _N_SHOWN


def _worlds(config: Config, scenario: Scenario, n_warm: int, n_measured: int) -> tuple[list[World], ActorRegistry]:
    """The first steps from the first one with an equipped vehicle, and all actors."""
    registry = ActorRegistry(config.fleet, config.seed, shares(config.attacks))
    traffic = scenario.traffic(config.traffic, registry, config.driver.model != "none")
    worlds: list[World] = []
    try:
        for _ in traffic.warm_up(scenario.warmup_s):
            pass
        while len(worlds) < n_warm + n_measured:
            world = traffic.advance()
            if worlds or world.equipped.any():
                worlds.append(replace(world, step=len(worlds)))
    except TrafficEnded as over:
        if len(worlds) <= n_warm:
            raise ValueError(f"{scenario.name}: the traffic is too short to measure: {over}.") from None
    finally:
        traffic.close()
    return worlds, registry


def piece(worlds: Sequence[World], n: int, wanted: float) -> tuple[Int[ndarray, "n"], float]:
    """A crop of n actors with about as many neighbours per actor as the whole traffic has.

    The crop holds the n actors of the first world that are nearest to a centre. Actors at the rim have fewer
    neighbours, so a small crop lies where the traffic is a little denser.

    Parameters
    ----------
    worlds
        Worlds over which neighbours are averaged.
    n
        Number of actors.
    wanted
        Mean number of neighbours of the whole traffic.

    Returns
    -------
    Actor numbers of the crop, and their mean number of neighbours.
    """
    world = worlds[0]
    xy = world.boxes.xyz_m[:, :2]
    centres = np.unique(np.linspace(0, len(world) - 1, _N_CENTRES).astype(int))
    pieces = world.actor[np.sort(cKDTree(xy).query(xy[centres], n)[1].reshape(len(centres), n))]
    neighbours = np.array([
        np.mean([_neighbours(one, np.flatnonzero(np.isin(one.actor, actor))) for one in worlds]) for actor in pieces
    ])  # fmt: skip
    best = int(np.argmin(np.abs(neighbours - wanted)))
    return pieces[best], float(neighbours[best])


def _neighbours(world: World, rows: Int[ndarray, "n"]) -> float:
    """Mean number of other actors among these rows within `_NEAR_M`."""
    if not len(rows):
        return 0.0
    tree = cKDTree(world.boxes.xyz_m[rows, :2])
    return float(tree.count_neighbors(tree, _NEAR_M) / len(rows) - 1.0)


def _taken(world: World, rows: Int[ndarray, "n"]) -> World:
    """The actors in these rows, ascending, with the lanes ahead of them."""
    taken, paths = world.take(rows), world.paths
    if paths is None:
        return taken
    kept = np.isin(paths.row, rows)
    row = np.searchsorted(rows, paths.row[kept])
    return replace(taken, paths=replace(paths, row=row, line=paths.line[kept], front_m=paths.front_m[kept]))


def _peak_bytes() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
