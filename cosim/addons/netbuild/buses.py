"""Bus lines and their stops, from OpenStreetMap's route relations."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import dist, inf
from typing import Any
from xml.sax.saxutils import quoteattr

from cosim.addons.netbuild.streets import PIECE, length_m
from sumo_nets.demand import Draw, Point
from sumo_nets.osm import Extract, Relation, pieces

STOP_M = 22.0
"""Length of a stop, and of the lane that a line begins on: an articulated bus and room to pull out [m]."""
NEAR_M = 16.0
"""Farthest from its lane that a stop's sign may stand [m]."""
APART_M = 100.0
"""Signs that are nearer to each other along a lane are one stop [m]."""
FARTHEST_M = 1500.0
"""Longest drive over streets that the relation does not name: termini and joined junctions [m]."""
DETOUR = 1.6
"""A matched line may be at most this much longer than the streets that the relation names."""
LEFT_OUT = 1.5
"""A metre of a way that is left out costs as much as driving this many metres. So a bus takes no shortcut, but does not
drive into a dead end and back either."""
_ROLES = ("backward", "forward")

Project = Callable[[list[int]], dict[int, Point]]
"""Gives nodes their place in the network."""
Chain = list[Any]
"""Edges of a way that follow each other."""
Drives = dict[Any, tuple[float, list[str]]]
"""Cost and edges of the best drive to each edge at which a way may be left."""
NO_DRIVE: tuple[float, list[str]] = (inf, [])
Calls = tuple[str, set[int]]
"""Number of a line, and the signs at which it calls."""


@dataclass(frozen=True, slots=True)
class Line:
    """One direction of a line (or of several that run alike) through the extract."""

    refs: tuple[str, ...]
    edges: tuple[str, ...]
    stops: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class BusStop:
    """A stop beside the kerb lane."""

    id: str
    name: str
    lane: str
    start_m: float
    end_m: float


def lines_of(
    extract: Extract,
    net: Any,
    project: Project,
    recipe: dict[str, Any],
) -> tuple[list[Line], list[BusStop]]:
    """Daytime bus lines that run at least `at_least_m` through the network, and the stops they call at.

    `net` is a sumolib network with original ids; `project` gives nodes their place in it. `recipe` is that of buses:
    without `whole_ways`, a line is the shortest drive that touches one edge of every way.
    """
    edges_of_way = defaultdict(list)
    for edge in sorted(net.getEdges(), key=lambda edge: edge.getID()):
        if edge.allows("bus"):
            ids = " ".join(lane.getParam("origId", "") for lane in edge.getLanes()).split()
            for way in sorted({int(way_id.lstrip("-")) for way_id in ids}):
                edges_of_way[way % PIECE].append(edge)
    relations = [relation for _, relation in sorted(extract.relations.items()) if _is_daytime_bus(relation)]
    named_members = {member[:2] for relation in relations for member in relation.members}
    signs = {ref for kind, ref in named_members if kind == "n" and ref in extract.place}
    runs = {}
    for kind, way in named_members:
        if kind == "w" and way in edges_of_way:
            nodes = extract.ways[way].nodes
            runs[way] = [node for node in nodes if node in extract.place]
    ends = {run[end] for run in runs.values() for end in (0, -1)}
    place = project(sorted(signs | ends))

    def chains_of(way: int, role: str) -> list[Chain]:
        if not recipe.get("whole_ways"):
            return [[edge] for edge in edges_of_way[way]]
        run = runs[way]
        first, last = place[run[0]], place[run[-1]]
        return _towards(role, _chains(edges_of_way[way]), first, last)

    alike: dict[tuple[str, ...], list[Calls]] = defaultdict(list)
    drives = []
    for relation in relations:
        named = _ways(relation, edges_of_way)
        drives += [(relation, ways) for ways in _drives(relation, relations, named, runs, recipe)]
    for relation, ways in drives:
        if ways and ways[0][1] not in _ROLES:
            first_two = [runs[way] for way, _ in ways[:2]]
            ways[0] = ways[0][0], _away(*first_two)
        matched = _matched(net, [chains_of(*way) for way in ways]) if ways else []
        while matched and net.getEdge(matched[0]).getLength() < STOP_M:
            matched.pop(0)  # a bus begins on a lane that is long enough for it
        driven_m = sum(net.getEdge(edge).getLength() for edge in matched)
        drawn: list[tuple[int, ...]] = []
        for way, _ in ways:
            drawn += pieces(extract.ways[way], extract.place)
        named_m = sum(length_m(extract, run) for run in drawn)
        if recipe["at_least_m"] <= driven_m <= DETOUR * named_m:
            members = {ref for kind, ref, _ in relation.members if kind == "n"}
            alike[tuple(matched)].append((relation.tags["ref"], members & signs))
    stops: dict[str, BusStop] = {}
    lines = []
    for edges, drives_alike in sorted(alike.items()):
        refs = tuple(sorted({ref for ref, _ in drives_alike}))
        called = set()
        for sign in sorted(set().union(*(calls for _, calls in drives_alike))):
            name = extract.node_tags.get(sign, {}).get("name", "")
            stop = _beside(net, edges, sign, name, place[sign])
            if stop is not None:
                stop = _kept(stops, stop)
                edge, _, _ = stop.lane.rpartition("_")
                called.add((edges.index(edge), stop.end_m, stop.id))
        in_order = [stop_id for _, _, stop_id in sorted(called)]
        lines.append(Line(refs, edges, tuple(in_order)))
    return lines, sorted(stops.values(), key=lambda stop: stop.id)


def stops_xml(stops: list[BusStop]) -> str:
    """SUMO's additional file for the stops."""
    rows = (
        f'    <busStop id="{stop.id}" name={quoteattr(stop.name)} lane="{stop.lane}"'
        f' startPos="{stop.start_m:.2f}" endPos="{stop.end_m:.2f}" friendlyPos="true"/>\n'
        for stop in stops
    )
    return '<?xml version="1.0" encoding="UTF-8"?>\n<additional>\n' + "".join(rows) + "</additional>\n"


def departures(
    lines: list[Line],
    recipe: dict[str, Any],
    seed: int,
    end_s: float,
) -> list[str]:
    """Buses by timetable: each line at its headway from a phase of its own, dwelling at every stop."""
    draw = Draw(seed, "bus")
    trips: list[str] = []
    for n, line in enumerate(lines):
        headway_s = 3600.0 / recipe["per_hour_and_line"] / min(len(line.refs), recipe["most_lines_alike"])
        now = draw.uniform() * headway_s
        n_buses = 0
        while now < end_s:
            dwell = "".join(
                f'<stop busStop="{stop}" duration="{recipe["dwell_s"] * (0.5 + draw.uniform()):.0f}"/>'
                for stop in line.stops
            )
            trips.append(
                f'<vehicle id="bus{n}.{n_buses}" type="bus" line={quoteattr(line.refs[0])}'
                f' depart="{now:.1f}" departLane="best" departSpeed="max">'
                f'<route edges="{" ".join(line.edges)}"/>{dwell}</vehicle>'
            )
            n_buses += 1
            now += headway_s * (0.8 + 0.4 * draw.uniform())
    return trips


def _is_daytime_bus(relation: Relation) -> bool:
    """Whether a relation is a bus line with a number that is not that of a night line, such as 7N or N7."""
    ref = relation.tags.get("ref", "")
    return relation.tags.get("route") == "bus" and ref != "" and not re.fullmatch(r"N ?\d.*|.*N", ref)


def _ways(
    relation: Relation,
    edges_of_way: dict[int, list[Any]],
) -> list[tuple[int, str]]:
    """The relation's ways inside the network and their roles; gaps (termini, joined junctions) are bridged later."""
    return [
        (ref, role)
        for kind, ref, role in relation.members
        if kind == "w" and ref in edges_of_way and "platform" not in role and "stop" not in role
    ]


def _drives(
    relation: Relation,
    relations: list[Relation],
    ways: list[tuple[int, str]],
    runs: dict[int, list[int]],
    recipe: dict[str, Any],
) -> list[list[tuple[int, str]]]:
    """The ways of a relation, and those of the way back if it stands for both directions of a line.

    It does if it is the only one of its number, says nothing else, and does not lead in a circle. The way back leaves
    out ways with a direction.
    """
    n_alike = sum(other.tags["ref"] == relation.tags["ref"] for other in relations)
    version, circle = (relation.tags.get(key) for key in ("public_transport:version", "roundtrip"))
    if not recipe.get("whole_ways") or n_alike > 1 or version == "2" or circle == "yes" or not ways:
        return [ways]
    (first, _), (last, _) = ways[0], ways[-1]
    is_circle = not set(runs[first]).isdisjoint(runs[last])
    if len(ways) > 2 and is_circle:
        return [ways]
    return [ways, [way for way in reversed(ways) if way[1] not in _ROLES]]


def _away(nodes: list[int], onward: list[int] | None = None) -> str:
    """Role of the first way of a line: to the node that it shares with the next; as it is drawn, if there is none."""
    if onward is None:
        return "forward"
    shared = nodes[0] in onward, nodes[-1] in onward
    return "" if shared[0] == shared[1] else _ROLES[shared[1]]


def _chains(edges: list[Any]) -> list[Chain]:
    """The edges of a way from end to end, in each direction; those of a ring one by one."""
    after = {}
    for edge in edges:
        for onward in edge.getAllowedOutgoing("bus"):
            turns_back = onward.getToNode() is edge.getFromNode()
            if onward in edges and not turns_back:
                after[edge] = onward
    chains = []
    for edge in edges:
        if edge not in after.values():
            chains.append([edge])
            while (onward := after.get(edge)) and onward not in chains[-1]:
                chains[-1].append(onward)
                edge = onward
    driven = {edge for chain in chains for edge in chain}
    return chains + [[edge] for edge in edges if edge not in driven]


def _towards(role: str, chains: list[Chain], first: Point, last: Point) -> list[Chain]:
    """The chains in the direction of a role, for a way from `first` to `last`; all where there is none, or no role."""

    def role_of(chain: Chain) -> str:
        begin = chain[0].getShape()[0][:2]
        end = chain[-1].getShape()[-1][:2]
        along_m = dist(begin, first) + dist(end, last)
        against_m = dist(begin, last) + dist(end, first)
        return _ROLES[along_m < against_m]

    return [chain for chain in chains if role_of(chain) == role] or chains


def _matched(net: Any, ways: list[list[Chain]]) -> list[str]:
    """The shortest drive along one chain of every way, in their order, where metres left out count `LEFT_OUT` times."""
    drives: Drives = {}
    for n, chains in enumerate(ways):
        onward: Drives = {}
        for chain in chains:
            whole_m = sum(edge.getLength() for edge in chain)
            for first, edge in enumerate(chain):
                metres, steps = edge.getLength(), [edge.getID()]
                if n > 0:
                    metres, steps = _entered(net, edge, drives)
                cost = metres + LEFT_OUT * (whole_m - edge.getLength())
                for last in chain[first:]:
                    if last is not edge:
                        cost += (1 - LEFT_OUT) * last.getLength()
                        steps = [*steps, last.getID()]
                    if cost < onward.get(last, NO_DRIVE)[0]:
                        onward[last] = cost, steps
        if not onward:
            return []
        drives = onward
    end = min(drives, key=lambda edge: (drives[edge][0], edge.getID()))
    _, steps = drives[end]
    return steps if len(set(steps)) == len(steps) else []


def _entered(net: Any, edge: Any, drives: Drives) -> tuple[float, list[str]]:
    """Cost and drive up to the end of an edge, from where it is cheapest to come."""
    best = NO_DRIVE
    for before, (cost, steps) in drives.items():
        path: tuple[Any, ...] | None = (edge,)
        metres = edge.getLength()
        if before is not edge:
            path, metres = net.getShortestPath(before, edge, vClass="bus", maxCost=FARTHEST_M)
        total = cost + metres - before.getLength()
        if path is not None and total < best[0]:
            best = total, steps + [leg.getID() for leg in path[1:]]
    return best


def _kept(stops: dict[str, BusStop], stop: BusStop) -> BusStop:
    """The stop that is there already; otherwise this one, which joins the others under an id of its own."""
    for known in stops.values():
        if known.lane == stop.lane and abs(known.end_m - stop.end_m) < APART_M:
            return known
    if stop.id in stops:  # one sign, for both directions
        stop = replace(stop, id=f"{stop.id}.{len(stops)}")
    stops[stop.id] = stop
    return stop


def _beside(net: Any, edges: tuple[str, ...], sign: int, name: str, at: Point) -> BusStop | None:
    """The stop on the line's kerb lane nearest to a sign, if one is near enough and long enough."""
    from sumolib.geomhelper import polygonOffsetAndDistanceToPoint

    nearest = inf
    stop = None
    for edge_id in edges:
        edge = net.getEdge(edge_id)
        kerb = next(lane for lane in edge.getLanes() if lane.allows("bus"))
        offset, away = polygonOffsetAndDistanceToPoint(at, kerb.getShape(), perpendicular=False)
        if away < min(nearest, NEAR_M) and edge.getLength() >= STOP_M + 20.0:
            nearest = away
            last = edge.getLength() - 12.0  # room for a queue of two between stop and stop line
            ends = min(max(offset + STOP_M / 2, STOP_M + 1.0), last)
            stop = BusStop(f"stop{sign}", name, kerb.getID(), ends - STOP_M, ends)
    return stop
