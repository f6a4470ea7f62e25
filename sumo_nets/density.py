"""How much traffic a network gets: vehicles per km of street and the daily profile, as trips per hour."""

from __future__ import annotations

from dataclasses import dataclass
from math import dist, hypot
from typing import Annotated

from annotated_types import Ge, Gt, Le

from sumo_nets.demand import Draw, NoTraffic, Street

BY_HOUR = (
    0.12,
    0.07,
    0.05,
    0.06,
    0.12,
    0.35,
    0.70,
    0.98,
    0.92,
    0.75,
    0.70,
    0.74,
    0.76,
    0.78,
    0.82,
    0.93,
    1.00,
    0.99,
    0.82,
    0.60,
    0.44,
    0.35,
    0.28,
    0.20,
)
"""Traffic of each hour of a working day, as a share of the busiest; the usual shape of urban traffic counts."""
SHARES = {"car": 0.80, "van": 0.08, "truck": 0.03, "bicycle": 0.09}
"""Vehicle classes, as shares of the departures."""
WALKS = 0.4
"""Departing pedestrians per departing vehicle."""
DETOUR = 1.35
"""Length of a trip over the straight-line distance, as a guess."""
DRIVE_MPS = 9.0
"""Mean speed of an urban trip, stops included, as a guess."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Density:
    """Amount of traffic."""

    per_km: Annotated[float, Gt(0)] = 2.0
    """Vehicles on the road at the busiest hour, per km of street and direction."""
    hour: Annotated[int, Ge(0), Le(23)] = 16
    """Hour of a working day."""
    seed: Annotated[int, Ge(0)] = 1
    """Seed of the trips."""


def trips_per_hour(streets: list[Street], density: Density, trip_s: float | None = None) -> dict[str, float]:
    """Trips per hour of each vehicle class, and their least length, for a density of vehicles (Little's law).

    `trip_s` is the mean duration of a trip [s]; left out, it is guessed from the distances of streets.
    """
    if not streets:
        raise NoTraffic("no street that a car can enter and leave remains")
    km = sum(street.length_m for street in streets) / 1000.0
    xs, ys = zip(*(street.middle_m for street in streets), strict=True)
    across_m = hypot(max(xs) - min(xs), max(ys) - min(ys))
    at_least_m = round(min(600.0, 0.2 * across_m), -1)
    if trip_s is None:
        trip_s = _guessed_trip_s(streets, at_least_m, density.seed)
    per_hour = BY_HOUR[density.hour] * density.per_km * km * 3600.0 / trip_s
    trips = {"at_least": at_least_m}
    for kind, share in (SHARES | {"pedestrian": WALKS}).items():
        trips[kind] = float(max(1, round(per_hour * share)))
    return trips


def _guessed_trip_s(streets: list[Street], at_least_m: float, seed: int) -> float:
    """Mean duration of trips between streets drawn by their length."""
    draw = Draw(seed, "lengths")
    where = draw.chooser(streets, lambda street: street.length_m)
    far_m = []
    for _ in range(2000):
        origin, target = where(), where()
        away_m = dist(origin.middle_m, target.middle_m)
        if origin.piece == target.piece and away_m >= at_least_m:
            far_m.append(away_m)
    if not sum(far_m):
        raise NoTraffic(f"no two streets are {at_least_m:g} m apart, the least for a trip")
    return DETOUR * sum(far_m) / len(far_m) / DRIVE_MPS
