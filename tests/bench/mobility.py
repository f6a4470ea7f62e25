"""Cost of reading all actors into arrays, relative to SUMO's own cost per step."""

import tempfile
from pathlib import Path
from time import thread_time

from cosim.traffic.params import TrafficParams
from cosim.traffic.sumo import sumo_options
from cosim.traffic.sumo_process import Simulator
from sumo_nets import catalogue

CITIES = ("adlershof", "koenigs-wusterhausen")
"""The cities in which a vehicle costs SUMO most (vehicles re-route while driving) and least (a motorway)."""
N_VEHICLES = 1000
STEPS = 400
BLOCK = 10
"""Steps per block; blocks with and without reading alternate. SUMO's step after a reading is slower, because reading
evicts SUMO's data from the processor's caches."""


def bench() -> list[tuple[str, float, str]]:
    """Measure both cities with demand for more than a thousand vehicles."""
    return [
        (f"{city}: {what}", value, unit)
        for city in CITIES
        for what, value, unit in bench_city(catalogue.find(city).sumocfg_path, scale=3.0)
    ]


def bench_city(config: Path, scale: float = 1.0, steps: int = STEPS) -> list[tuple[str, float, str]]:
    """Measure SUMO alone and SUMO with reading every actor, in alternating blocks of ten steps of the same traffic.

    It measures processor time, which depends less on other load than wall time.

    Parameters
    ----------
    config
        A .sumocfg with demand for at least a thousand vehicles at once.
    scale
        Factor on its demand.
    steps
        Number of measured steps.
    """
    with tempfile.TemporaryDirectory() as scratch:
        sumo = Simulator(sumo_options(TrafficParams(scale=scale), config, Path(scratch), False), False, (0.0, 0.0))
    try:
        while sumo.warm_up(300.0) < 300.0:
            pass
        while len(sumo.read().number) < N_VEHICLES:
            sumo.move()
        alone_s = read_s = 0.0
        n_actors = 0
        for _ in range(steps // (2 * BLOCK)):
            begin = thread_time()
            for _ in range(BLOCK):
                sumo.move()
            alone_s += thread_time() - begin
            sumo.read()  # finds the actors that departed meanwhile
            begin = thread_time()
            for _ in range(BLOCK):
                n_actors += len(sumo.advance().number)
            read_s += thread_time() - begin
    finally:
        sumo.close()
    return [
        ("actors on the road", 2 * n_actors / steps, ""),
        ("SUMO alone", 1e6 * alone_s / n_actors, "µs per actor and step"),
        ("SUMO and reading every actor", 1e6 * read_s / n_actors, "µs per actor and step"),
        ("reading, over SUMO alone", read_s / alone_s, "times"),
    ]
