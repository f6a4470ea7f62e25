"""Cost of reading all actors into arrays, relative to SUMO's own cost per step."""

from pathlib import Path
from time import thread_time

from cosim.traffic.actors import ActorRegistry
from cosim.traffic.fleet import FleetParams
from cosim.traffic.params import TrafficParams
from cosim.traffic.sumo import SumoTraffic
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
    registry = ActorRegistry(FleetParams(), seed=1)
    traffic = SumoTraffic(TrafficParams(scale=scale), config, registry)
    try:
        for _ in traffic.warm_up(300):
            pass
        while traffic.n_vehicles < N_VEHICLES:
            traffic.move()
        alone_s = read_s = 0.0
        n_actors = 0
        for _ in range(steps // (2 * BLOCK)):
            begin = thread_time()
            for _ in range(BLOCK):
                traffic.move()
            alone_s += thread_time() - begin
            traffic.advance()  # registers the actors that departed meanwhile
            begin = thread_time()
            for _ in range(BLOCK):
                n_actors += len(traffic.advance())
            read_s += thread_time() - begin
    finally:
        traffic.close()
    return [
        ("actors on the road", 2 * n_actors / steps, ""),
        ("SUMO alone", 1e6 * alone_s / n_actors, "µs per actor and step"),
        ("SUMO and reading every actor", 1e6 * read_s / n_actors, "µs per actor and step"),
        ("reading, over SUMO alone", read_s / alone_s, "times"),
    ]
