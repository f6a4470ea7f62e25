"""What it costs to read everybody into arrays, over what it costs SUMO to move them."""

from pathlib import Path
from time import thread_time

from cosim.mobility.source import TrafficParams
from cosim.mobility.sumo import SumoTraffic
from cosim.roster import FleetParams, Roster
from sumo_nets import catalogue

CITY = "adlershof"
N_VEHICLES = 1000
STEPS = 400


def bench(config: Path | None = None, scale: float = 3.0, steps: int = STEPS) -> list[tuple[str, float, str]]:
    """SUMO alone, and SUMO with every actor read, step by step in turn on the same traffic.

    Counts the processor's time, so that what else runs on the machine matters less.

    Parameters
    ----------
    config
        A .sumocfg; by default one of the cities in SUMO's package, with demand for about a thousand vehicles.
    scale
        Of its demand.
    """
    config = config or catalogue.find(CITY).sumocfg_path
    roster = Roster(FleetParams(), seed=1)
    traffic = SumoTraffic(TrafficParams(scale=scale), config, roster)
    try:
        for _ in traffic.warm_up(300):
            pass
        while traffic.n_vehicles < N_VEHICLES:
            traffic.move()
        traffic.advance()
        alone_s = read_s = 0.0
        n_actors = 0
        for step in range(steps):
            begin = thread_time()
            if step % 2:
                traffic.move()
                alone_s += thread_time() - begin
                continue
            world = traffic.advance()
            read_s += thread_time() - begin
            n_actors += len(world)
    finally:
        traffic.close()
    return [
        ("actors on the road", 2 * n_actors / steps, ""),
        ("SUMO alone", 1e6 * alone_s / n_actors, "µs per actor and step"),
        ("SUMO and reading every actor", 1e6 * read_s / n_actors, "µs per actor and step"),
        ("reading, over SUMO alone", read_s / alone_s, "times"),
    ]
