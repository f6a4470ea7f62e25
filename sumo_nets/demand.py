"""Trips of vehicles and pedestrians: departure times, origins and destinations.

Trips are drawn here; SUMO's `duarouter` turns them into routes. Draws come from one `random.Random`
per vehicle class, of which only `random()` is used, so that a rebuild gives the same trips on every machine.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from math import dist, inf, log
from pathlib import Path
from random import Random
from typing import Any

Point = tuple[float, float]

KINDS = ("car", "van", "truck", "bicycle")
"""Vehicle classes whose trips are drawn; buses follow a timetable."""
ENTRY_M = 12.0
"""Shortest lane on which a vehicle can be inserted without overlapping another [m]."""
MOST_TRIES = 10_000
"""Draws of origin and destination before a recipe is refused."""


class NoTraffic(ValueError):
    """The network has no streets for the traffic that is wanted. The message is one line."""


@dataclass(frozen=True, slots=True)
class Street:
    """Properties of one directed edge of the network that the demand needs."""

    id: str
    start: str
    end: str
    kind: str
    length_m: float
    middle_m: Point
    lanes: int
    is_entry: bool
    is_exit: bool
    walkable: bool
    cyclable: bool
    piece: int = 0
    """Number of the connected piece of the network that it belongs to."""


class Draw:
    """Draws with given weights from a fixed sequence of uniform numbers."""

    def __init__(self, seed: int, what: str) -> None:
        self._random = Random(f"{seed} {what}")

    def uniform(self) -> float:
        return self._random.random()

    def gap_s(self, per_hour: float) -> float:
        return -log(1.0 - self.uniform()) * 3600.0 / per_hour

    def chooser(
        self,
        streets: Sequence[Street],
        weight: Callable[[Street], float],
    ) -> Callable[[], Street]:
        chosen = [street for street in streets if weight(street) > 0.0]
        sums = list(accumulate(weight(street) for street in chosen))

        def choose() -> Street:
            if not chosen:
                raise NoTraffic("the network has no street at which this traffic could start or end")
            at = bisect_right(sums, self.uniform() * sums[-1])
            return chosen[min(at, len(chosen) - 1)]

        return choose


def streets_of(net: Any, gates: frozenset[str], is_one_piece: bool = False) -> list[Street]:
    """The edges of a sumolib network that a car may use, sorted by id; `is_one_piece`: as if all were connected."""
    streets = []
    piece = {} if is_one_piece else _pieces(net)
    for edge in sorted(net.getEdges(), key=lambda edge: edge.getID()):
        if not edge.allows("passenger"):
            continue
        start, end = edge.getFromNode(), edge.getToNode()
        line = edge.getShape()
        x0, y0 = line[0][:2]
        x1, y1 = line[-1][:2]
        length_m = edge.getLength()
        is_entry = start.getID() in gates and _turns_only(edge.getIncoming(), end) and length_m >= ENTRY_M
        is_exit = end.getID() in gates and _turns_only(edge.getOutgoing(), start)
        streets.append(
            Street(
                edge.getID(),
                start.getID(),
                end.getID(),
                edge.getType().removeprefix("highway."),
                length_m,
                ((x0 + x1) / 2, (y0 + y1) / 2),
                sum(lane.allows("passenger") for lane in edge.getLanes()),
                is_entry,
                is_exit,
                edge.allows("pedestrian"),
                edge.allows("bicycle"),
                piece.get(edge.getID(), 0),
            )
        )
    return streets


def _pieces(net: Any) -> dict[str, int]:
    """Number of the connected piece of each edge."""
    found: dict[str, int] = {}
    for n, first in enumerate(net.getEdges()):
        left = [first]
        while left:
            edge = left.pop()
            if edge.getID() not in found:
                found[edge.getID()] = n
                left += [*edge.getOutgoing(), *edge.getIncoming()]
    return found


def _turns_only(neighbours: Any, other_end: Any) -> bool:
    """Whether an edge is connected, at this end, only to its opposite direction."""
    return all(other_end in (edge.getFromNode(), edge.getToNode()) for edge in neighbours)


def gate_weight_of(street: Street, weights: dict[str, float]) -> float:
    """Share of a gate in the trips that enter or leave, relative to other gates."""
    return weights.get(street.id, weights.get(street.kind, 1.0) * street.lanes)


def _is_a_trip(origin: Street, target: Street, recipe: dict[str, Any]) -> bool:
    """Whether a way leads from one street to another, and they are as far apart as a recipe asks for."""
    away_m = dist(origin.middle_m, target.middle_m)
    is_far = recipe["at_least_m"] <= away_m <= recipe.get("at_most_m", inf)
    return is_far and origin.piece == target.piece


def vehicle_trips(
    streets: list[Street],
    kind: str,
    recipe: dict[str, Any],
    seed: int,
    end_s: float,
) -> list[str]:
    """Trips of one vehicle class, sorted by departure."""
    draw = Draw(seed, kind)
    through = [street for street in streets if kind != "bicycle" or street.cyclable]

    def at_gate(street: Street) -> float:
        return gate_weight_of(street, recipe["gate_weight"])

    inside = [street for street in through if not street.is_entry and not street.is_exit]
    entries = [street for street in through if street.is_entry]
    exits = [street for street in through if street.is_exit]
    from_inside = recipe["from_inside"] if entries else 1.0  # a network without gates
    to_inside = recipe["to_inside"] if exits else 1.0
    enter, leave = draw.chooser(entries, at_gate), draw.chooser(exits, at_gate)
    kerb = draw.chooser(inside, lambda street: street.length_m if street.length_m > 40.0 else 0.0)
    trips: list[str] = []
    now = 0.0
    while (now := now + draw.gap_s(recipe["per_hour"])) < end_s:
        for _ in range(MOST_TRIES):
            starts_inside, ends_inside = draw.uniform() < from_inside, draw.uniform() < to_inside
            origin = kerb() if starts_inside else enter()
            target = kerb() if ends_inside else leave()
            if _is_a_trip(origin, target, recipe):
                break
        else:
            raise NoTraffic(f"no two streets are {recipe['at_least_m']:g} m apart, the least for a trip ({kind})")
        place = 'departPos="random_free" departSpeed="0"' if starts_inside else 'departPos="base" departSpeed="max"'
        goal = ' arrivalPos="random"' if ends_inside else ""
        trips.append(
            f'<trip id="{kind}{len(trips)}" type="{kind}" depart="{now:.1f}"'
            f' departLane="best" {place}{goal} from="{origin.id}" to="{target.id}"/>'
        )
    return trips


def walks(
    streets: list[Street],
    recipe: dict[str, Any],
    seed: int,
    end_s: float,
) -> list[str]:
    """Walks of pedestrians along pavements, sorted by departure."""
    draw = Draw(seed, "pedestrian")
    pavements = [street for street in streets if street.walkable and street.length_m > 15.0]
    door = draw.chooser(pavements, lambda street: street.length_m)
    lines: list[str] = []
    now = 0.0
    while (now := now + draw.gap_s(recipe["per_hour"])) < end_s:
        for _ in range(MOST_TRIES):
            origin, target = door(), door()
            if _is_a_trip(origin, target, recipe):
                break
        else:
            least, most = recipe["at_least_m"], recipe["at_most_m"]
            raise NoTraffic(f"no two pavements are {least:g} to {most:g} m apart, as far as people walk")
        lines.append(
            f'<person id="pedestrian{len(lines)}" type="pedestrian" depart="{now:.1f}" departPos="random">'
            f'<personTrip from="{origin.id}" to="{target.id}" arrivalPos="random"/></person>'
        )
    return lines


def write_trips(path: Path, trips: list[str]) -> None:
    """Write trips, walks and vehicles in the order of their departures."""
    text = "\n".join(["<routes>", *sorted(trips, key=_departure), "</routes>", ""])
    path.write_text(text, encoding="utf-8", newline="\n")


def _departure(trip: str) -> tuple[float, str]:
    _, _, rest = trip.partition('depart="')
    time_s, _, _ = rest.partition('"')
    return float(time_s), trip
