"""What it costs to read everybody into arrays, over what it costs SUMO to move them."""

from pathlib import Path
from time import thread_time

from cosim.mobility.source import TrafficParams
from cosim.mobility.sumo import SumoTraffic
from cosim.roster import FleetParams, Roster
from sumo_nets import catalogue

CITIES = ("adlershof", "koenigs-wusterhausen")
"""Where a vehicle costs SUMO most, since it finds new ways as it goes, and where it costs least, on a motorway."""
N_VEHICLES = 1000
STEPS = 400
BLOCK = 10
"""Steps of each in turn: the step after a reading is dearer for SUMO, since reading has cooled its caches."""


def bench() -> list[tuple[str, float, str]]:
    """Both cities with demand for a thousand vehicles and more."""
    return [
        (f"{city}: {what}", value, unit)
        for city in CITIES
        for what, value, unit in bench_city(catalogue.find(city).sumocfg_path, scale=3.0)
    ]


def bench_city(config: Path, scale: float = 1.0, steps: int = STEPS) -> list[tuple[str, float, str]]:
    """SUMO alone, and SUMO with every actor read, ten steps of each in turn on the same traffic.

    Counts the processor's time, so that what else runs on the machine matters less.

    Parameters
    ----------
    config
        A .sumocfg with demand for at least a thousand vehicles at once.
    scale
        Of its demand.
    """
    roster = Roster(FleetParams(), seed=1)
    traffic = SumoTraffic(TrafficParams(scale=scale), config, roster)
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
            traffic.advance()  # numbers those who came meanwhile
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
