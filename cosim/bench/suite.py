"""Speed of every component on this machine."""

import os
import platform
from dataclasses import replace
from importlib import import_module
from time import perf_counter
from typing import Any

import numba
import numpy as np

from cosim.adversary.params import shares
from cosim.config.config import load
from cosim.mobility.actors import ActorRegistry
from cosim.mobility.scenario import find
from cosim.mobility.sumo import SumoTraffic
from cosim.step.cycle import step
from cosim.step.parts import Parts
from cosim.step.result import Sensed
from cosim.step.state import State
from cosim.step.stopwatch import Stopwatch
from sensors.boxes import overlapping_pairs
from trust.evaluation import evaluate
from trust.matching import match
from trust.params import TrustParams

Row = tuple[str, float, str]
"""What was measured, the figure, its unit."""

STEPS = 60


def bench() -> list[Row]:
    """The shipped city with every vehicle equipped: the stages of the cycle."""
    config = load(None, ["fleet.penetration_p=1", "attacks.0.start_s=0", "attacks.1.start_s=0"])
    scenario = find(config.traffic.scenario)
    registry = ActorRegistry(config.fleet, config.seed, shares(config.attacks))
    assert scenario.sumocfg is not None
    traffic = SumoTraffic(config.traffic, scenario.sumocfg, registry)
    for _ in traffic.warm_up(scenario.warmup_s):
        pass
    parts = Parts.of(config, scenario.city())
    state = State.start(parts)
    for world in (traffic.advance(), traffic.advance()):  # compiles, and fills caches
        state, _ = step(world, state, parts)
    watch = Stopwatch()
    parts, read_s, n_equipped = replace(parts, watch=watch), 0.0, 0
    for _ in range(STEPS):
        begin = perf_counter()
        world = traffic.advance()
        read_s += perf_counter() - begin
        state, result = step(world, state, parts)
        n_equipped += int(world.equipped.sum())
    traffic.close()
    assert result.sensed is not None
    rate = _evaluations_per_s(result.sensed, config.trust)
    return [
        ("equipped vehicles, mean", n_equipped / STEPS, ""),
        ("cycle, all stages", 1e6 * sum(watch.seconds.values()) / n_equipped, "µs per equipped vehicle and step"),
        *((f"cycle, {stage}", 1e6 * s / n_equipped, "µs per equipped vehicle and step")
          for stage, s in watch.seconds.items()),
        ("evaluations on one core: IoU, matching, evaluation", 1e-6 * rate, "million evaluations/s"),
        ("faster than real time at that size", STEPS / (sum(watch.seconds.values()) + read_s), "times"),
    ]  # fmt: skip


def _evaluations_per_s(sensed: Sensed, params: TrustParams) -> float:
    """Evaluations per second and core, from boxes and points per box, best of several rounds."""
    listed, detections, evaluated = sensed.listed.objects, sensed.listed.detections, sensed.evaluated
    lists = evaluated.lists
    threads, best = numba.get_num_threads(), np.inf
    numba.set_num_threads(1)
    for _ in range(7):
        begin = perf_counter()
        pairs = overlapping_pairs(listed.boxes, listed.label, listed.observer)
        groups = match(lists, detections, pairs, params)
        evaluate(lists, groups, detections, evaluated.n_points, evaluated.plausible, params)
        best = min(best, perf_counter() - begin)
    numba.set_num_threads(threads)
    return len(lists.member) / best


BENCHES: dict[str, str] = {
    "sensors": "cosim.bench.sensors",
    "trust": "cosim.bench.trust",
    "radio": "cosim.bench.radio",
    "mobility": "cosim.bench.mobility",
    "results": "cosim.bench.results",
    "cycle": "cosim.bench.suite",
    "driver": "cosim.bench.driver",
    "variants": "cosim.bench.variants",
    "studies": "cosim.bench.studies",
}
"""Modules whose `bench()` measures a component."""


def run(name: str) -> list[Row]:
    """The figures of one benchmark."""
    return import_module(BENCHES[name]).bench()


def run_scale(scenario: str, trace: str | None, vehicles: str, seconds: int) -> list[dict[str, Any]]:
    """Figures of `cosim.bench.scale`; ValueError in one line for numbers that are none."""
    try:
        sizes = tuple(int(size) for size in vehicles.split(","))
    except ValueError:
        sizes = ()
    if not sizes or min(sizes) < 1:
        raise ValueError(f"--vehicles {vehicles}: whole numbers from 1, with commas between them, are wanted.")
    figures = import_module("cosim.bench.scale").bench(scenario, trace, sizes, seconds)
    return [
        {"metric": f"scale.{figure}", "group": "", "value": value, "unit": unit, "label": ""}
        for figure, value, unit in figures
    ]  # fmt: skip


def machine() -> str:
    """What this machine is, for the record."""
    return (
        f"{platform.machine()}, {os.cpu_count()} cores, {numba.get_num_threads()} threads, "
        f"Python {platform.python_version()}, NumPy {np.__version__}, Numba {numba.__version__}"
    )
