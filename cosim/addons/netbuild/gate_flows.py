"""Through traffic on motorways and trunk roads: flows that enter at gates, by road class and lane.

The trips of `demand` follow the density of a whole network, which gives a motorway that crosses it a small share of
what motorways carry. Here the flow at each gate of a class is brought up to a stated rate per lane.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from math import dist, inf
from typing import Any

from sumo_nets.demand import Draw, Street, gate_weight_of
from sumo_nets.density import BY_HOUR

PER_HOUR_AND_LANE = {"motorway": 830.0, "trunk": 360.0}
"""Vehicles per hour, lane and direction at the busiest hour, by road class.

From the mean daily traffic of German roads in 2017: 51,900 vehicles on motorways and 9,650 on federal roads outside of
towns (Fitschen and Nordmann, Verkehrsentwicklung auf Bundesfernstrassen 2017, BASt report V 340, 2021). The busiest
hour has 7.4 % of a day (`density.BY_HOUR`), half of it in each direction: 1,920 and 360 vehicles per hour and
direction; on 2.3 lanes of a motorway, and on one of a federal road.
"""
HEAVY_P = {"motorway": 0.15, "trunk": 0.085}
"""Share of trucks: 7,010 of 47,100 and 800 of 9,440 vehicles a day in 2012 (BASt report V 236)."""
VAN_P = 0.08
"""Share of vans."""
LARGEST_DETOUR = 1.6
"""Route over straight line above which two gates are not joined by through traffic."""


@dataclass(frozen=True, slots=True)
class GateFlow:
    """Through traffic that enters at one gate."""

    entry: Street
    per_hour: float
    exits: tuple[tuple[Street, float], ...]
    """Gates at which it leaves, with weights."""


def rates_at(hour: int) -> dict[str, float]:
    """`PER_HOUR_AND_LANE` at an hour of a working day."""
    return {kind: round(rate * BY_HOUR[hour], 1) for kind, rate in PER_HOUR_AND_LANE.items()}


def gate_flows(net: Any, streets: list[Street], wanted: dict[str, Any]) -> list[GateFlow]:
    """Through traffic of every gate of the classes in the recipe's demand, `wanted`; none where it has none.

    Its other trips that enter at the same gate are subtracted. `net` is a sumolib network.
    """
    rates = wanted.get("gates", {}).get("per_hour_and_lane", {})
    exits = [street for street in streets if street.is_exit and street.kind in rates]
    entries = [street for street in streets if street.is_entry]
    weight = {street.id: gate_weight_of(street, wanted["vehicles"]["gate_weight"]) for street in entries}
    drawn = sum(wanted[kind]["per_hour"] for kind in ("car", "van", "truck"))
    drawn *= 1.0 - (wanted["vehicles"]["from_inside"] if entries else 1.0)
    flows = []
    for entry in entries:
        if entry.kind not in rates:
            continue
        metres = _route_lengths_m(net, entry.id)
        reached = []
        for gate in exits:
            away_m = max(dist(entry.middle_m, gate.middle_m), 1.0)
            if metres.get(gate.id, inf) <= LARGEST_DETOUR * away_m:
                reached.append((gate, gate.lanes * rates[gate.kind]))
        of_others = drawn * weight[entry.id] / sum(weight.values())
        per_hour = entry.lanes * rates[entry.kind] - of_others
        if reached and per_hour > 0:
            flows.append(GateFlow(entry, per_hour, tuple(reached)))
    return flows


def gate_trips(flows: list[GateFlow], seed: int, end_s: float) -> list[str]:
    """Trips of the through traffic; departures of a gate are a Poisson process."""
    trips: list[str] = []
    for flow in flows:
        draw = Draw(seed, f"gate {flow.entry.id}")
        exits = [street for street, _ in flow.exits]
        weights = {street.id: weight for street, weight in flow.exits}
        leave = draw.chooser(exits, lambda street: weights[street.id])  # noqa: B023
        heavy_p = HEAVY_P[flow.entry.kind]
        now = 0.0
        while (now := now + draw.gap_s(flow.per_hour)) < end_s:
            share = draw.uniform()
            kind = "car"
            if share < heavy_p:
                kind = "truck"
            elif share < heavy_p + VAN_P:
                kind = "van"
            trips.append(
                f'<trip id="through{len(trips)}" type="{kind}" depart="{now:.1f}" departLane="best" departPos="base"'
                f' departSpeed="max" from="{flow.entry.id}" to="{leave().id}"/>'
            )
    return trips


def _route_lengths_m(net: Any, start: str) -> dict[str, float]:
    """Length of the fastest route from an edge to every edge that cars reach from it (Dijkstra)."""
    found: dict[str, float] = {}
    first = net.getEdge(start)
    queue = [(0.0, 0, first.getLength(), first)]
    n = 0
    while queue:
        seconds, _, metres, edge = heappop(queue)
        if edge.getID() in found:
            continue
        found[edge.getID()] = metres
        for following in edge.getAllowedOutgoing("passenger"):
            if following.getID() not in found:
                n += 1
                length_m = following.getLength()
                arrival_s = seconds + length_m / max(following.getSpeed(), 0.1)
                heappush(queue, (arrival_s, n, metres + length_m, following))
    return found
