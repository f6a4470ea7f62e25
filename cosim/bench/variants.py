"""Processor time of trust variants: twenty windows on the evidence of one run, against the run with one."""

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from time import process_time

import numba
import numpy as np

from cosim.adversary.params import shares
from cosim.bench.suite import Row
from cosim.config.config import Config, load
from cosim.execution import recording
from cosim.mobility.actors import ActorRegistry
from cosim.mobility.scenario import find
from cosim.mobility.sumo import SumoTraffic
from cosim.step.cycle import step
from cosim.step.parts import Parts
from cosim.step.state import State
from cosim.world import World
from results.recorder import Recorder
from sensors.scene import Scene

STEPS = 120
ROUNDS = 3
N = 20


def bench() -> list[Row]:
    """The shipped city: TruPercept with one window of evidence and with twenty; step and recording, one thread."""
    one, many, fused = _config(1), _config(N), _config(N, fused=True)
    local, many_local = _config(1, host="local"), _config(N, host="local")
    scenario = find(one.traffic.scenario)
    registry = ActorRegistry(one.fleet, one.seed, shares(one.attacks))
    assert scenario.sumocfg is not None
    traffic = SumoTraffic(one.traffic, scenario.sumocfg, registry)
    for _ in traffic.warm_up(scenario.warmup_s):
        pass
    worlds = [traffic.advance() for _ in range(STEPS)]
    traffic.close()
    city, threads = scenario.city(), numba.get_num_threads()
    numba.set_num_threads(1)
    spent: list[list[float]] = []
    configs = (one, many, fused, local, many_local)
    for config in configs:
        _drive(config, city, worlds[:3], registry)  # compiles
    for _ in range(ROUNDS):  # in turns
        spent.append([_drive(config, city, worlds, registry) for config in configs])
    numba.set_num_threads(threads)
    rows = np.array(spent)
    return [
        ("equipped vehicles, mean", float(np.mean([world.equipped.sum() for world in worlds])), ""),
        ("step and recording, one trust variant", 1e3 * median(rows[:, 0]) / STEPS, "ms of processor time per step"),
        (f"{N} trust variants", median(rows[:, 1] / rows[:, 0]), "times that"),
        (f"{N} trust variants, all with fused objects", median(rows[:, 2] / rows[:, 0]), "times that"),
        (f"{N} trust variants, kept by every vehicle", median(rows[:, 4] / rows[:, 3]), "times one of these"),
    ]


def _config(n: int, fused: bool = False, host: str = "central") -> Config:
    """The shipped city with `n` windows of 5 s and more."""
    windows_s = np.linspace(5.0, 100.0, N).tolist()
    sections = [
        f"{{ name = 'window {s:g} s', freshness_s = {s}, fused = {str(fused).lower()} }}" for s in windows_s[1:n]
    ]
    return load(None, [
        f"trust.host={host}", f"trust.freshness_s={windows_s[0]}", f"trust_variant=[{', '.join(sections)}]",
        "attacks.0.start_s=10", "attacks.1.start_s=10",
    ])  # fmt: skip


def _drive(config: Config, city: Scene, worlds: Sequence[World], registry: ActorRegistry) -> float:
    """Processor time of stepping through these worlds and recording all tables [s]."""
    parts = Parts.of(config, city)
    names = [variant.name for variant in parts.trust.variants]
    folder = Path(tempfile.mkdtemp(prefix="cosim-bench-"))
    try:
        recorder = Recorder(folder, config.record.level, config.record.block_steps, variants=names)
        state = State.start(parts)
        begin = process_time()
        for world in worlds:
            state, result = step(world, state, parts)
            recording.step(recorder, result, config.traffic.step_s)
            recorder.reach(world.step)
        recorder.close(recording.open_rows(state, parts, registry, len(worlds)))
        return process_time() - begin
    finally:
        shutil.rmtree(folder)
