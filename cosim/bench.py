"""Speed, room by room, on this machine and now: what every claim of speed rests on."""

import os
import platform
from importlib import import_module
from time import perf_counter

import numba
import numpy as np

from cosim.config import load
from cosim.cycle import State, turn
from cosim.manifest import Stopwatch
from cosim.mobility.sumo import SumoTraffic
from cosim.roster import Roster
from cosim.scenario import find

Row = tuple[str, float, str]
"""What was measured, the figure, its unit."""

STEPS = 120


def bench() -> list[Row]:
    """The shipped city, everybody equipped: SUMO alone, SUMO read into arrays, and the stages of the cycle."""
    config = load(None, ["fleet.penetration_p=1", "adversary.start_s=0"])
    scenario = find(config.traffic.scenario)
    roster = Roster(config.fleet, config.seed)
    traffic = SumoTraffic(config.traffic, scenario.sumocfg, roster)
    for _ in traffic.warm_up(scenario.warmup_s):
        pass
    city = scenario.city()
    state, watch = State.start(config, city), Stopwatch()
    for world in (traffic.advance(), traffic.advance()):  # compiles, and fills memories
        turn(world, city, state, config, watch)
    alone_s = read_s = 0.0
    watch, n_actors, n_equipped = Stopwatch(), 0, 0
    for step in range(STEPS):
        begin = perf_counter()
        if step % 2:  # in turn, so that both meet the same traffic
            traffic.move()
            alone_s += perf_counter() - begin
            continue
        world = traffic.advance()
        read_s += perf_counter() - begin
        turn(world, city, state, config, watch)
        n_actors += len(world)
        n_equipped += int(world.equipped.sum())
    traffic.close()
    turns = STEPS / 2
    return [
        ("SUMO alone", 1e6 * alone_s / n_actors, "µs per actor and step"),
        ("SUMO and reading every actor", 1e6 * read_s / n_actors, "µs per actor and step"),
        ("reading, over SUMO alone", read_s / alone_s, "times"),
        ("equipped vehicles, mean", n_equipped / turns, ""),
        ("cycle, all stages", 1e6 * sum(watch.seconds.values()) / n_equipped, "µs per equipped vehicle and turn"),
        *((f"cycle, {stage}", 1e6 * s / n_equipped, "µs per equipped vehicle and turn")
          for stage, s in watch.seconds.items()),
        ("faster than real time at that size", turns / (sum(watch.seconds.values()) + read_s), "times"),
    ]  # fmt: skip


BENCHES: dict[str, str] = {
    "sensors": "sensors.bench",
    "trust": "trust.bench",
    "v2x": "cosim.v2x.bench",
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
