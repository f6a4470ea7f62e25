"""Estimates how many vehicles a config has on the road, before anything is simulated."""

from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np

from cosim.config.config import Config
from cosim.studies.speed import remember, remembered
from cosim.traffic.fcd import timesteps
from cosim.traffic.fleet import FleetParams
from cosim.traffic.identity import LEFT_OUT, TypeTable
from cosim.traffic.scenario import Scenario, find
from results.manifest import read_manifest
from sensors.scene import Shape
from sumo_nets import catalogue, sumocfg
from sumo_nets.xml import Attributes, Enough, stream

HELSINKI = 200
"""Number of vehicles on the road in central Helsinki."""
COUNTED = {"helsinki": 200, "adlershof": 156, "braunschweig": 32, "koenigs-wusterhausen": 145}
"""Mean number of vehicles on the road in the cities by name, in the minute after their warm-up."""
OF_CLASS = {"car": 152, "van": 15, "truck": 3, "bus": 7, "motorcycle": 0, "bicycle": 17}
"""Mean number of vehicles of each class on the road in central Helsinki."""
SHORTEST_S = 30.0
"""Shortest run of which the number of vehicles is kept [s]."""
_LEG_S = 4.6
"""Time that a vehicle is on the road, for the square root of each metre of a city's diagonal [s]. 200 vehicles at 2,820
departures per hour are on the road for 255 s in central Helsinki (2.0 km); it is 234 s in Bologna (2.9 km)."""
_HALF_HOUR_S = 1800.0
_PROBED = 300
"""Number of timesteps of a trace that are counted."""
_MOST = 1_000_000


def vehicles_on_road(config: Config) -> float:
    """Mean number of vehicles on the road: for a city from demand and size, for a trace or run from its content."""
    traffic = config.traffic
    scenario = scenario_of(traffic.scenario, traffic.trace)
    if scenario.trace is not None:
        return _recorded(scenario.trace)
    return traffic.scale * _demanded(traffic.scenario, scenario, traffic.begin_s, _middle_s(config, scenario))


def equipped_on_road(config: Config) -> float:
    """Mean number of equipped vehicles on the road, if vehicles of each class are as frequent as in central Helsinki.

    All vehicles count as those of the classes that are equipped by default.
    """
    usual, fleet = FleetParams().equipped_kinds, config.fleet
    n_usual = sum(OF_CLASS[kind] for kind in usual)
    n_can_be = sum(OF_CLASS[kind] for kind in fleet.equipped_kinds)
    return vehicles_on_road(config) * min(1.0, fleet.penetration_p * n_can_be / n_usual)


def note_density(config: Config, run: Path) -> None:
    """Keep the mean number of vehicles of a finished run for the next estimate, unless it is known or replayed."""
    traffic = config.traffic
    scenario = scenario_of(traffic.scenario, traffic.trace)
    if traffic.scenario in COUNTED or scenario.trace is not None:
        return
    if traffic.duration_s < SHORTEST_S or traffic.scale <= 0:
        return
    summary = read_manifest(run).get("summary", {})
    found = summary.get("vehicles_on_road_mean")
    if isinstance(found, int | float) and "vehicles_on_road_first" not in summary:  # where streets were filling
        note_vehicles(scenario, found / traffic.scale, traffic.begin_s, _middle_s(config, scenario))


def note_vehicles(scenario: Scenario, n_vehicles: float, begin_s: float | None, after_s: float) -> None:
    """Keep the mean number of vehicles on the road at a scenario's own demand, some time after the begin.

    It serves the estimates of runs of that half hour.
    """
    remember(_place_of(scenario, begin_s, after_s), n_vehicles)


def _middle_s(config: Config, scenario: Scenario) -> float:
    """Time from the begin of the traffic to the middle of what is recorded [s]."""
    return scenario.warmup_of(config.traffic) + config.traffic.duration_s / 2


def _place_of(scenario: Scenario, begin_s: float | None, after_s: float) -> str:
    place = (scenario.sumocfg or Path(scenario.name)).resolve()
    return f"{place}, begin {begin_s}, half hour {int(after_s // _HALF_HOUR_S)}"


@cache
def scenario_of(scenario: str, trace: str | None) -> Scenario:
    """The scenario that a config's `[traffic]` names; it is read once."""
    return find(scenario, trace)


@cache
def _recorded(trace: Path) -> float:
    if trace.is_dir():
        return float(read_manifest(trace).get("summary", {}).get("vehicles_on_road_mean", HELSINKI))
    types, n_vehicles = TypeTable(), []
    for timestep in islice(timesteps(trace), _PROBED):
        shape = types.shapes(timestep.types, timestep.is_person, timestep.vclasses)
        is_vehicle = (shape != Shape.PEDESTRIAN) & (shape != LEFT_OUT)
        n_vehicles.append(int(is_vehicle.sum()))
    return float(np.mean(n_vehicles or [HELSINKI]))


@cache
def _demanded(name: str, scenario: Scenario, begin_s: float | None, after_s: float) -> float:
    """Number of departures within the time that one vehicle is on the road, some time after the begin.

    The begin is that of the .sumocfg if it is None.
    """
    if scenario.bounds_m is None or scenario.sumocfg is None:
        return HELSINKI
    x0, y0, x1, y1 = scenario.bounds_m
    diagonal_m = np.hypot(x1 - x0, y1 - y0)
    lasts_s = _LEG_S * float(np.sqrt(diagonal_m))
    if name in COUNTED:
        return COUNTED[name]
    if (known := remembered(_place_of(scenario, begin_s, after_s))) is not None:
        return known
    if name in catalogue.names():
        return catalogue.find(name).vehicles_per_hour / 3600 * lasts_s
    config = sumocfg.read(scenario.sumocfg)
    begin_s = config.begin_s if begin_s is None else begin_s
    at_s = begin_s + after_s
    return config.scale * departures(config.demand, max(begin_s, at_s - lasts_s), at_s)


def departures(routes: tuple[Path, ...], from_s: float, to_s: float) -> float:
    """Number of vehicles in route files that depart within a time interval; flows count by their rate."""
    n = 0.0

    def start(element: str, attributes: Attributes) -> None:
        nonlocal n
        try:
            begin_s = sumocfg.seconds(attributes.get("depart", attributes.get("begin", "0")))
            if element in ("vehicle", "trip"):
                n += from_s <= begin_s < to_s
                if begin_s >= to_s or n > _MOST:  # they are sorted
                    raise Enough
            elif element == "flow":
                end_s = sumocfg.seconds(attributes.get("end", str(to_s)))
                within_s = max(0.0, min(end_s, to_s) - max(begin_s, from_s))
                n += within_s * _rate(attributes, end_s - begin_s)
        except (ValueError, ZeroDivisionError):  # a departure such as "triggered", or a period that SUMO refuses
            return

    for path in routes:
        stream(path, start)
    return n


def _rate(flow: Attributes, lasts_s: float) -> float:
    """Vehicles per second of a flow; 0 if the flow states no rate."""
    if "number" in flow:
        return float(flow["number"]) / max(lasts_s, 1.0)
    per_s = {"vehsPerHour": 1 / 3600, "probability": 1.0}
    for name, factor in per_s.items():
        if name in flow:
            return float(flow[name]) * factor
    period = flow.get("period", "inf")
    if period.startswith("exp("):  # exp(RATE): random gaps
        return float(period[4:].rstrip(") "))
    return 1 / float(period)
