"""What a run costs, before it begins: vehicles, sweeps, processor time, time, memory and disk space.

The costs were measured in Helsinki, Adlershof, Braunschweig and Königs Wusterhausen, with all presets, 5 to 100 %
equipped vehicles and up to five sweeps per second, on one machine. `speed.json` in the user's cache says how much
faster or slower this machine is.
"""

import math
from dataclasses import dataclass, replace

from cosim.config.config import Config
from cosim.studies.density import HELSINKI, equipped_on_road, scenario_of, vehicles_on_road
from cosim.studies.speed import MachineSpeed, speed_here
from sensors import lidar

START_S = 3.4
"""Start of a process, including imports and loading of compiled kernels [s]."""
SUMO_S = 0.0008
"""A step of SUMO with 200 vehicles [s]."""
READ_S = 0.0010
"""Reading the actors of such a step, where it is recorded [s]."""
STEP_S = 0.0231
"""A recorded step in which vehicles sense, without what grows with their number [s]."""
IDLE_STEP_S = 0.0023
"""A recorded step in which none senses: encounters and tables [s]."""
RAY_S = 9.0e-9
"""Per ray of a sweep: to cast it, to detect objects, and the messages about them, with radio, matching, evaluation,
trust and fusion at those who receive them [s]. A sensor with fewer rays reports less. With up to 70 equipped vehicles
in range, no growth with their number was found."""
VARIANT_S = 0.0004
"""Trust of one more variant, per step, at the 60 equipped vehicles of central Helsinki [s]."""
METRICS_S = 0.5
"""Metrics of one point [s]."""
BYTES = 890
"""Per sweep that sees all around, at record.level = "standard"."""
RECEIVED_BYTES = 0.123
"""At the same level, per sweep, equipped vehicle in range, and vehicle per square kilometre: evaluations and fused
objects, which are as many as the objects in the messages that were received."""
ACTOR_BYTES = 13.2
"""Per actor and step, at the same level."""
STEP_BYTES = 1100
"""Per step in which vehicles sense: the tables on the radio, servers and stations."""
MEMORY_BYTES = 480e6
"""Memory of a process: libraries, kernels and a small city."""
VEHICLE_BYTES = 0.29e6
"""Memory per equipped vehicle: range images, detections, evidence."""
HELSINKI_KM2 = 1.73
LONG_S = 600.0
"""A run that takes longer gets a hint how to halve it [s]."""


@dataclass(frozen=True, slots=True)
class Cost:
    """What follows from a config."""

    n_vehicles: float
    """Mean number of vehicles on the road."""
    n_equipped: float
    sweeps_per_s: float
    """Sweeps per simulated second; each is followed by two messages."""
    rays: int
    """Rays of one sweep."""
    cpu_s: float
    """Processor time [s]."""
    step_cpu_s: float
    """Processor time of one recorded step [s]."""
    wall_s: float
    """Time by the clock [s]."""
    memory_bytes: float
    disk_bytes: float
    basis: str
    """Where the speed of this machine is from."""
    cheaper: str = ""
    """The cheapest change that halves the time; empty if the run is short."""


def cost_of(config: Config, speed: MachineSpeed | None = None) -> Cost:
    """Estimate what a run costs on this machine; `speed` takes the place of what the user's cache says."""
    speed = speed or speed_here()
    n_vehicles, n_sweeps = vehicles_on_road(config), n_sweeps_of(config)
    cpu_s = run_s(config) + traffic_s(config)
    steps_s = cpu_s - START_S - METRICS_S - warmup_s(config)
    equipped = equipped_on_road(config) if config.sensing else 0.0
    found = Cost(
        n_vehicles=n_vehicles,
        n_equipped=equipped,
        sweeps_per_s=n_sweeps / config.traffic.duration_s,
        rays=rays_of(config),
        cpu_s=cpu_s * speed.cpu,
        step_cpu_s=steps_s * speed.cpu / config.n_steps,
        wall_s=cpu_s * speed.cpu * speed.wall_per_cpu,
        memory_bytes=memory_bytes(config),
        disk_bytes=disk_bytes(config),
        basis=speed.basis,
    )
    if found.wall_s <= LONG_S:
        return found
    return replace(found, cheaper=_cheaper(config, found.wall_s, speed))


def _cheaper(config: Config, wall_s: float, speed: MachineSpeed) -> str:
    """The first of these changes with which the run takes at most half of the time, as keys of the command line."""
    step_s, traffic = config.traffic.step_s, config.traffic
    half_s = max(step_s, math.floor(traffic.duration_s / 2 / step_s) * step_s)
    sweeps_s = n_sweeps_of(config) * _sweep_s(config) * speed.cpu * speed.wall_per_cpu
    if sweeps_s > 0.5 * wall_s and wall_s > 0:
        kept = max(0.0, 1 - 0.5 * wall_s / sweeps_s)  # share of the sweeps with which half of the time is left
        p = math.floor(100 * config.fleet.penetration_p * kept) / 100
        if p >= 0.05:
            return f"--set fleet.penetration_p={p:g}, or --set traffic.duration_s={half_s:g}"
    return f"--set traffic.duration_s={half_s:g}"


def warmup_s(config: Config) -> float:
    """Processor time of the traffic before the first recorded step [s]."""
    traffic = config.traffic
    lasts_s = scenario_of(traffic.scenario, traffic.trace).warmup_of(traffic)
    return lasts_s / traffic.step_s * SUMO_S * vehicles_on_road(config) / HELSINKI


def traffic_s(config: Config) -> float:
    """Processor time of the traffic of a run, with its warm-up [s]."""
    n_steps = config.traffic.duration_s / config.traffic.step_s
    return warmup_s(config) + n_steps * (SUMO_S + READ_S) * vehicles_on_road(config) / HELSINKI


def run_s(config: Config) -> float:
    """Processor time of a run without its traffic [s]."""
    n_active = n_active_steps(config)
    steps_s = n_active * STEP_S + (config.n_steps - n_active) * IDLE_STEP_S
    return START_S + METRICS_S + steps_s + n_sweeps_of(config) * _sweep_s(config)


def _sweep_s(config: Config) -> float:
    return rays_of(config) * RAY_S


def rays_of(config: Config) -> int:
    """Number of rays of a sweep."""
    grid = lidar.beams(config.lidar)
    return len(grid.azimuth_rad) * len(grid.elevation_rad)


def memory_bytes(config: Config) -> float:
    """Largest resident memory of a run."""
    equipped = equipped_on_road(config) if config.sensing else 0.0
    return MEMORY_BYTES + equipped * VEHICLE_BYTES


def disk_bytes(config: Config) -> float:
    """Disk space of a run."""
    n_vehicles = vehicles_on_road(config)
    per_km2 = n_vehicles / area_km2(config)
    in_range_km2 = math.pi * (config.radio.range_m / 1000) ** 2
    in_range_p = min(1.0, in_range_km2 / area_km2(config))
    in_range = equipped_on_road(config) * in_range_p
    sweep_bytes = around_p(config) * (BYTES + RECEIVED_BYTES * per_km2 * in_range)
    return (
        ACTOR_BYTES * n_vehicles * config.n_steps
        + n_active_steps(config) * STEP_BYTES
        + n_sweeps_of(config) * sweep_bytes
    )


def area_km2(config: Config) -> float:
    """Area of the network of a config; that of central Helsinki if there is no network."""
    bounds = scenario_of(config.traffic.scenario, config.traffic.trace).bounds_m
    if bounds is None:
        return HELSINKI_KM2
    x0, y0, x1, y1 = bounds
    return max((x1 - x0) * (y1 - y0) / 1e6, 0.01)


def n_active_steps(config: Config) -> int:
    """Number of recorded steps in which vehicles sense."""
    return config.n_steps // config.schedule.exchange_every_steps if config.sensing else 0


def around_p(config: Config) -> float:
    """Share of all directions that a sweep sees."""
    return lidar.beams(config.lidar).fov_rad / (2 * math.pi)


def n_sweeps_of(config: Config) -> float:
    """Sweeps, each of which is followed by two messages."""
    if not config.sensing:
        return 0.0
    return equipped_on_road(config) * config.traffic.duration_s * config.schedule.sweeps_per_s
