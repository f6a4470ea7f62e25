"""The drivable part of an OpenStreetMap extract: every street a car can enter *and* leave."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise

import numpy as np
import shapely
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sumo_nets.osm import Box, Extract, Way, pieces


@dataclass(frozen=True, slots=True)
class DrivableStreets:
    """Input of netconvert, and the nodes where streets continue beyond the extract."""

    ways: list[Way]
    gates: frozenset[int]
    """Nodes at which traffic enters and leaves."""
    left_out: dict[str, LeftOut]
    """Streets of the wanted classes that are left out, by class."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Streets of a class that are not in the network."""

    left_m: float
    """Length left out [m]."""
    all_m: float
    """Length in the extract [m]."""

    @property
    def text(self) -> str:
        """Length and share."""
        share = self.left_m / max(self.all_m, 1e-9)
        return f"{self.left_m / 1000:,.1f} of {self.all_m / 1000:,.1f} km ({share:.0%})"


@dataclass(frozen=True, slots=True)
class _Section:
    """A street from one junction or end to the next."""

    way: Way
    run: int
    """Number of the run of nodes of which it is a part. A way has several runs if it leaves the extract and returns."""
    nodes: tuple[int, ...]


_Arcs = Sequence[tuple[int, bool]]
"""Directions in which sections may be driven: number of the section, and whether in the order of its nodes."""
_Runs = Sequence[tuple[Way, tuple[int, ...]]]
"""Ways, and runs of their nodes inside the extract."""

SMALLEST_M = 300.0
"""A component of the network that is connected with the rest only outside the extract stays if it extends at least
this far [m]."""
PIECE = 10**12
"""Between the numbers of the pieces that a way is cut into; OpenStreetMap's own are smaller."""
EARTH_RADIUS_M = 6_371_000.0


def drivable(
    extract: Extract, classes: frozenset[str], ignored_tags: frozenset[str], edge_m: float, dead_ends: bool = False
) -> DrivableStreets:
    """Surface streets of the given highway classes, without the ignored tags. Dead ends stay only with `dead_ends`.

    A street stays if a car can come from every other street that stays, drive through it and go on to every
    other, without turning round on the spot. Streets cut off by the extract, or ending within `edge_m` of its
    edge, are gates: beyond them the outside joins them all. With `dead_ends`, the largest connected component stays,
    and every other one with a gate that extends `SMALLEST_M`, such as a motorway without a ramp in the extract.

    Raises
    ------
    ValueError
        Where no street stays.
    """
    ways = [way for way in extract.ways.values() if _is_street(way, classes)]
    ways.sort(key=lambda way: way.id)
    runs = [(way, run) for way in ways for run in pieces(way, extract.place)]
    sections = _sections(runs)
    gates = _gates(extract, runs, sections, edge_m, extract.box if dead_ends else None)
    arcs: list[tuple[int, bool]] = []
    for number, section in enumerate(sections):
        forward, backward = _directions(section.way)
        arcs += [(number, True)] * forward + [(number, False)] * backward
    stays = _in_large_components(extract, sections, arcs, gates) if dead_ends else _driven(sections, arcs, gates)
    directions: dict[int, set[bool]] = defaultdict(set)  # of each section that stays
    for (number, forward), arc_stays in zip(arcs, stays, strict=True):
        if arc_stays:
            directions[number].add(forward)
    if not directions:
        raise ValueError(f"the extract has no connected network of streets of the classes {', '.join(sorted(classes))}")
    streets = _assemble(sections, directions, ignored_tags)
    return DrivableStreets(streets, gates, left_out(extract, classes, streets))


def n_clockwise(extract: Extract) -> tuple[int, int]:
    """How many roundabouts are driven clockwise, as where traffic keeps to the left, and how many there are.

    Ways of OpenStreetMap are drawn in the direction of driving. Roundabouts of several ways are left out.
    """
    n_all = n_found = 0
    for way in extract.ways.values():
        tags, nodes = way.tags, way.nodes
        if tags.get("junction") != "roundabout" or tags.get("oneway") == "-1":
            continue
        is_ring = len(nodes) > 3 and nodes[0] == nodes[-1]
        if is_ring and extract.place.keys() >= set(nodes):
            ring = shapely.linearrings([extract.place[node] for node in nodes])
            n_all += 1
            n_found += not shapely.is_ccw(ring)
    return n_found, n_all


def left_out(extract: Extract, classes: frozenset[str], kept: Sequence[Way]) -> dict[str, LeftOut]:
    """Length by class of the streets of an extract that are not among those kept; what is all kept has no entry."""
    all_m: dict[str, float] = defaultdict(float)
    for way in extract.ways.values():
        if way.tags.get("highway") in classes and way.tags.get("area") != "yes":
            length = sum(length_m(extract, run) for run in pieces(way, extract.place))
            all_m[way.tags["highway"]] += length
    kept_m: dict[str, float] = defaultdict(float)
    for way in kept:
        kept_m[way.tags["highway"]] += length_m(extract, way.nodes)
    found = {}
    for kind, length in sorted(all_m.items()):
        left_m = length - kept_m[kind]
        if left_m >= 1.0:
            found[kind] = LeftOut(left_m, length)
    return found


def length_m(extract: Extract, nodes: tuple[int, ...]) -> float:
    """Length of a chain of nodes on the sphere, small-angle."""
    lon, lat = np.radians([extract.place[node] for node in nodes]).T
    east = np.diff(lon) * np.cos(lat.mean())
    return float(EARTH_RADIUS_M * np.hypot(east, np.diff(lat)).sum())


def _is_street(way: Way, classes: frozenset[str]) -> bool:
    tags = way.tags
    if tags.get("highway") not in classes or tags.get("area") == "yes":
        return False
    if tags.get("tunnel", "no") != "no" or tags.get("layer", "0").startswith("-"):
        return False  # the network is flat: tunnels are left out
    return not {tags.get("access"), tags.get("motor_vehicle"), tags.get("vehicle")} & {"no", "private"}


def _directions(way: Way) -> tuple[bool, bool]:
    """Whether cars may drive a way in the order of its nodes, and against it."""
    oneway = way.tags.get("oneway", "yes" if way.tags.get("junction") == "roundabout" else "no")
    return oneway != "-1", oneway not in ("yes", "true", "1")


def _sections(runs: _Runs) -> list[_Section]:
    """Cut the runs at every node that occurs twice in them, and at their ends."""
    n_uses: Counter[int] = Counter()
    for _, run in runs:
        n_uses.update(run)
        n_uses.update((run[0], run[-1]))  # an end counts twice, so that there is a cut
    sections = []
    for number, (way, run) in enumerate(runs):
        cuts = [i for i, node in enumerate(run) if n_uses[node] > 1]
        for first, last in pairwise(cuts):
            sections.append(_Section(way, number, run[first : last + 1]))
    return sections


def _gates(
    extract: Extract,
    runs: _Runs,
    sections: Sequence[_Section],
    edge_m: float,
    box: Box | None,
) -> frozenset[int]:
    """Ends of a single section where its way goes on outside the extract, or which lie near the edge of the box."""
    n_ends: Counter[int] = Counter()
    for section in sections:
        n_ends.update((section.nodes[0], section.nodes[-1]))
    if box is None:
        everywhere = np.array(list(extract.place.values()))
        low, high = everywhere.min(axis=0), everywhere.max(axis=0)
    else:
        low = np.array(box[:2])
        high = np.array(box[2:])
    lon_shrinks = np.array([np.cos(np.radians(low[1])), 1.0])
    degree_m = lon_shrinks * EARTH_RADIUS_M * np.pi / 180.0  # length of one degree of longitude and of latitude
    gates = set()
    for way, run in runs:
        begin = run[0], way.nodes[0]
        end = run[-1], way.nodes[-1]
        for node, end_of_way in (begin, end):
            here = np.array(extract.place[node])
            from_edge_m = (np.minimum(here - low, high - here) * degree_m).min()
            if n_ends[node] == 1 and (node != end_of_way or from_edge_m < edge_m):
                gates.add(node)
    return frozenset(gates)


def _driven(sections: Sequence[_Section], arcs: _Arcs, gates: frozenset[int]) -> list[bool]:
    """Which arcs belong to the strongly connected network.

    The nodes of the graph are arcs, linked if a car can drive one after the other. Node 0 is the outside.
    """
    leaving: dict[int, list[int]] = defaultdict(list)  # arcs by the node where they begin
    arriving_at = []
    for i, (number, forward) in enumerate(arcs):
        nodes = sections[number].nodes
        if not forward:
            nodes = nodes[::-1]
        leaving[nodes[0]].append(i)
        arriving_at.append(nodes[-1])
    links: list[list[int]] = [[] for _ in range(len(arcs) + 1)]
    for i, node in enumerate(arriving_at):
        number, forward = arcs[i]
        turned_round = (number, not forward)
        onward = [j for j in leaving[node] if arcs[j] != turned_round]
        links[i + 1] += [j + 1 for j in onward]
        if node in gates:
            links[i + 1].append(0)
    links[0] += [j + 1 for node in sorted(gates) for j in leaving[node]]
    return _largest_component(links)[1:].tolist()


def _in_large_components(
    extract: Extract, sections: Sequence[_Section], arcs: _Arcs, gates: frozenset[int]
) -> list[bool]:
    """Which arcs belong to the largest connected component, or to one with a gate that is not too small."""
    if not arcs:
        return []
    row: dict[int, int] = {}  # of each node in the graph
    tail, head, length_of_arc_m = [], [], []
    for number, _ in arcs:
        nodes = sections[number].nodes
        tail.append(row.setdefault(nodes[0], len(row)))
        head.append(row.setdefault(nodes[-1], len(row)))
        length_of_arc_m.append(length_m(extract, nodes))
    n = len(row)
    component = connected_components(_graph(tail, head, n), directed=False)[1]
    length = np.zeros(n)
    np.add.at(length, component[tail], length_of_arc_m)
    lon, lat = np.radians([extract.place[node] for node in row]).T
    xy_m = EARTH_RADIUS_M * np.column_stack([lon * np.cos(lat.mean()), lat])
    low = np.full((n, 2), np.inf)
    high = -low
    np.minimum.at(low, component, xy_m)
    np.maximum.at(high, component, xy_m)
    stays = np.zeros(n, bool)
    stays[[component[row[node]] for node in gates if node in row]] = True
    stays &= np.hypot(*(high - low).T) >= SMALLEST_M
    stays[length.argmax()] = True
    return stays[component[tail]].tolist()


def _largest_component(links: list[list[int]]) -> ndarray:
    """Whether each node is in the largest set of nodes of which each can reach every other."""
    tail = np.repeat(np.arange(len(links)), [len(ends) for ends in links])
    head = np.fromiter(chain.from_iterable(links), np.int64)
    component = connected_components(_graph(tail, head, len(links)), connection="strong")[1]
    size = np.bincount(component)
    return component == component[size[component].argmax()]


def _graph(tail: ndarray | list[int], head: ndarray | list[int], n: int) -> coo_array:
    """Graph of `n` nodes with a link from each tail to its head."""
    return coo_array((np.ones(len(tail)), (tail, head)), shape=(n, n))


def _assemble(
    sections: Sequence[_Section], directions: Mapping[int, set[bool]], ignored_tags: frozenset[str]
) -> list[Way]:
    """The sections that stay as ways. Successive sections of a run with the same directions become one way."""
    joined: list[tuple[_Section, set[bool]]] = []
    newest = -1
    for number in sorted(directions):
        section, its = sections[number], directions[number]
        before = joined[-1] if joined and number == newest + 1 else None
        if before is not None and before[0].run == section.run and before[1] == its:
            nodes = before[0].nodes + section.nodes[1:]
            joined[-1] = replace(before[0], nodes=nodes), its
        else:
            joined.append((section, its))
        newest = number
    ways = []
    taken: set[int] = set()
    for section, its in joined:
        tags = {key: value for key, value in section.way.tags.items() if key not in ignored_tags}
        if len(its) == 1:
            tags["oneway"] = "yes" if True in its else "-1"
        name = section.way.id
        while name in taken:
            name += PIECE
        taken.add(name)
        ways.append(Way(name, section.nodes, tags))
    return ways
