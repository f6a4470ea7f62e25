"""Speed, room by room, on this machine and now: what every claim of speed rests on."""

import os
import platform
from importlib import import_module
from time import perf_counter

import numba
import numpy as np

from cosim.config import Config, load
from cosim.cycle import State, Turn, turn
from cosim.manifest import Stopwatch
from cosim.mobility.sumo import SumoTraffic
from cosim.roster import Roster
from cosim.scenario import find
from cosim.v2x.messages import FABRICATED, SELF
from sensors.boxes import overlapping_pairs
from trust.evaluation import evaluate
from trust.matching import match
from trust.tables import Detections as Claims

Row = tuple[str, float, str]
"""What was measured, the figure, its unit."""

STEPS = 60


def bench() -> list[Row]:
    """The shipped city, everybody equipped: the stages of the cycle."""
    config = load(None, ["fleet.penetration_p=1", "adversary.start_s=0"])
    scenario = find(config.traffic.scenario)
    roster = Roster(config.fleet, config.seed)
    assert scenario.sumocfg is not None
    traffic = SumoTraffic(config.traffic, scenario.sumocfg, roster)
    for _ in traffic.warm_up(scenario.warmup_s):
        pass
    city = scenario.city()
    state, watch = State.start(config, city), Stopwatch()
    for world in (traffic.advance(), traffic.advance()):  # compiles, and fills memories
        turn(world, city, state, config, watch)
    read_s, watch, n_equipped = 0.0, Stopwatch(), 0
    for _ in range(STEPS):
        begin = perf_counter()
        world = traffic.advance()
        read_s += perf_counter() - begin
        happened = turn(world, city, state, config, watch)
        n_equipped += int(world.equipped.sum())
    traffic.close()
    rate = _verdicts_per_s(happened, config)
    return [
        ("equipped vehicles, mean", n_equipped / STEPS, ""),
        ("cycle, all stages", 1e6 * sum(watch.seconds.values()) / n_equipped, "µs per equipped vehicle and turn"),
        *((f"cycle, {stage}", 1e6 * s / n_equipped, "µs per equipped vehicle and turn")
          for stage, s in watch.seconds.items()),
        ("verdicts on one core: IoU, matching, evaluation", 1e-6 * rate, "million verdicts/s"),
        ("faster than real time at that size", STEPS / (sum(watch.seconds.values()) + read_s), "times"),
    ]  # fmt: skip


def _verdicts_per_s(happened: Turn, config: Config) -> float:
    """Verdicts per second and core, from boxes and points per box, best of several rounds."""
    said, views = happened.said, happened.views
    sender = np.searchsorted(happened.observers, said.observer)
    claims = Claims(sender, said.k, said.label, said.score, said.origin == SELF, said.origin == FABRICATED)
    threads, best = numba.get_num_threads(), np.inf
    numba.set_num_threads(1)
    for _ in range(7):
        begin = perf_counter()
        pairs = overlapping_pairs(said.boxes, said.label, said.observer)
        groups = match(views, claims, pairs, config.trust)
        evaluate(views, groups, claims, happened.n_points, happened.plausible, config.trust)
        best = min(best, perf_counter() - begin)
    numba.set_num_threads(threads)
    return len(views.member) / best


BENCHES: dict[str, str] = {
    "sensors": "sensors.bench",
    "trust": "trust.bench",
    "radio": "cosim.radio.bench",
    "mobility": "cosim.mobility.bench",
    "results": "results.bench",
    "cycle": "cosim.bench",
}
"""Modules whose `bench()` measures a room."""


def run(name: str) -> list[Row]:
    """The figures of one benchmark."""
    return import_module(BENCHES[name]).bench()


def machine() -> str:
    """What this machine is, for the record."""
    return (
        f"{platform.machine()}, {os.cpu_count()} cores, {numba.get_num_threads()} threads, "
        f"Python {platform.python_version()}, NumPy {np.__version__}, Numba {numba.__version__}"
    )
