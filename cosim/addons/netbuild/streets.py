"""The drivable part of an OpenStreetMap extract: every street a car can enter *and* leave."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise

import numpy as np
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sumo_nets.osm import Extract, Way, pieces


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
        return f"{self.left_m / 1000:,.1f} of {self.all_m / 1000:,.1f} km ({self.left_m / max(self.all_m, 1e-9):.0%})"


SMALLEST_M = 300.0
"""A piece of the network that hangs together only with the outside stays if it extends at least this far [m]."""


def drivable(
    extract: Extract, classes: frozenset[str], ignored_tags: frozenset[str], edge_m: float, dead_ends: bool = False
) -> DrivableStreets:
    """Surface streets of the given highway classes, without the ignored tags, and unless `dead_ends` without those.

    A street stays if a car can come from every other street that stays, drive through it and go on to every
    other, without turning round on the spot. Streets cut off by the extract, or ending within `edge_m` of its
    edge, are gates: beyond them the outside joins them all. With `dead_ends`, the largest connected piece stays, and
    every other one with a gate that extends `SMALLEST_M`, such as a motorway without a ramp in the extract.

    Raises
    ------
    ValueError
        Where no street stays.
    """
    ways = [way for way in extract.ways.values() if _is_street(way, classes)]
    runs = [(way, run) for way in sorted(ways, key=lambda way: way.id) for run in pieces(way, extract.place)]
    use: dict[int, int] = defaultdict(int)
    for _, run in runs:
        for node in run:
            use[node] += 1
        use[run[0]] += 1
        use[run[-1]] += 1
    stubs = [(index, a, b) for index, (_, run) in enumerate(runs) for a, b in _split(run, use)]
    gates = _gates(extract, runs, stubs, edge_m, extract.box if dead_ends else None)
    arcs = []  # (run, first, last, forward)
    for index, a, b in stubs:
        way, run = runs[index]
        forward, backward = _directions(way)
        arcs += [(index, a, b, True)] * forward + [(index, a, b, False)] * backward
    alive = _joined_outside(extract, runs, arcs, gates) if dead_ends else _driven(runs, arcs, gates)
    kept: dict[int, list[tuple[int, int, bool, bool]]] = defaultdict(list)
    both: dict[tuple[int, int, int], list[bool]] = defaultdict(list)
    for (index, a, b, forward), is_alive in zip(arcs, alive, strict=True):
        if is_alive:
            both[index, a, b].append(forward)
    for (index, a, b), ways_round in sorted(both.items()):
        kept[index].append((a, b, True in ways_round, False in ways_round))
    if not kept:
        raise ValueError(f"the extract has no connected network of streets of the classes {', '.join(sorted(classes))}")
    streets = _assemble(extract, runs, kept, gates, ignored_tags)
    return replace(streets, left_out=left_out(extract, classes, streets.ways))


def left_out(extract: Extract, classes: frozenset[str], kept: Sequence[Way]) -> dict[str, LeftOut]:
    """Length by class of the streets of an extract that are not among those kept; what is all kept has no entry."""
    all_m: dict[str, float] = defaultdict(float)
    for way in extract.ways.values():
        if way.tags.get("highway") in classes and way.tags.get("area") != "yes":
            all_m[way.tags["highway"]] += sum(length_m(extract, run) for run in pieces(way, extract.place))
    kept_m: dict[str, float] = defaultdict(float)
    for way in kept:
        kept_m[way.tags["highway"]] += length_m(extract, way.nodes)
    found = {kind: LeftOut(length - kept_m[kind], length) for kind, length in sorted(all_m.items())}
    return {kind: of for kind, of in found.items() if of.left_m >= 1.0}


def length_m(extract: Extract, nodes: tuple[int, ...]) -> float:
    """Length of a chain of nodes on the sphere, small-angle."""
    lon, lat = np.radians(np.array([extract.place[node] for node in nodes])).T
    steps = np.hypot(np.diff(lon) * np.cos(lat.mean()), np.diff(lat))
    return float(6_371_000.0 * steps.sum())


def _is_street(way: Way, classes: frozenset[str]) -> bool:
    tags = way.tags
    if tags.get("highway") not in classes or tags.get("area") == "yes":
        return False
    if tags.get("tunnel", "no") != "no" or tags.get("layer", "0").startswith("-"):
        return False  # the network is flat: tunnels are left out
    return not {tags.get("access"), tags.get("motor_vehicle"), tags.get("vehicle")} & {"no", "private"}


def _directions(way: Way) -> tuple[bool, bool]:
    oneway = way.tags.get("oneway", "yes" if way.tags.get("junction") == "roundabout" else "no")
    return oneway != "-1", oneway not in ("yes", "true", "1")


def _split(run: tuple[int, ...], use: dict[int, int]) -> list[tuple[int, int]]:
    cuts = [i for i, node in enumerate(run) if use[node] > 1]
    return list(pairwise(cuts))


def _gates(
    extract: Extract, runs, stubs, edge_m: float, box: tuple[float, float, float, float] | None
) -> frozenset[int]:
    ends: dict[int, int] = defaultdict(int)
    for index, a, b in stubs:
        ends[runs[index][1][a]] += 1
        ends[runs[index][1][b]] += 1
    everywhere = np.array(list(extract.place.values()))
    low, high = everywhere.min(axis=0), everywhere.max(axis=0)
    if box is not None:
        low, high = np.array(box[:2]), np.array(box[2:])
    metres = np.array([np.cos(np.radians(low[1])), 1.0]) * 6_371_000.0 * np.pi / 180.0
    gates = set()
    for way, run in runs:
        for node, cut in ((run[0], run[0] != way.nodes[0]), (run[-1], run[-1] != way.nodes[-1])):
            here = np.array(extract.place[node])
            near = (np.minimum(here - low, high - here) * metres).min() < edge_m
            if ends[node] == 1 and (cut or near):
                gates.add(node)
    return frozenset(gates)


def _driven(runs, arcs, gates: frozenset[int]) -> list[bool]:
    """Which arcs belong to the strongly connected network; node 0 of the graph is the outside."""
    tail, head = [], []
    for index, a, b, forward in arcs:
        run = runs[index][1]
        first, last = (run[a], run[b]) if forward else (run[b], run[a])
        tail.append(first)
        head.append(last)
    leaving: dict[int, list[int]] = defaultdict(list)
    for i, node in enumerate(tail):
        leaving[node].append(i)
    links: list[list[int]] = [[] for _ in range(len(arcs) + 1)]
    for i, node in enumerate(head):
        back = (*arcs[i][:3], not arcs[i][3])
        links[i + 1] += [j + 1 for j in leaving[node] if arcs[j] != back]
        if node in gates:
            links[i + 1].append(0)
    links[0] += [j + 1 for node in sorted(gates) for j in leaving[node]]
    return _largest_component(links)[1:].tolist()


def _joined_outside(extract: Extract, runs, arcs, gates: frozenset[int]) -> list[bool]:
    """Which arcs belong to the largest connected piece, or to one with a gate that is not too small."""
    if not arcs:
        return []
    row: dict[int, int] = {}
    ends = []
    for index, a, b, _ in arcs:
        run = runs[index][1]
        ends.append([row.setdefault(node, len(row)) for node in (run[a], run[b])])
    tail, head = np.array(ends).reshape(-1, 2).T
    graph = coo_array((np.ones(len(tail)), (tail, head)), shape=(len(row), len(row)))
    piece = connected_components(graph, directed=False)[1]
    length = np.zeros(len(row))
    np.add.at(length, piece[tail], [length_m(extract, runs[index][1][a : b + 1]) for index, a, b, _ in arcs])
    lon, lat = np.radians([extract.place[node] for node in row]).T
    xy_m = 6_371_000.0 * np.column_stack([lon * np.cos(lat.mean()), lat])
    low, high = np.full((len(row), 2), np.inf), np.full((len(row), 2), -np.inf)
    np.minimum.at(low, piece, xy_m)
    np.maximum.at(high, piece, xy_m)
    kept = np.zeros(len(row), bool)
    kept[[piece[row[node]] for node in gates if node in row]] = True
    kept &= np.hypot(*(high - low).T) >= SMALLEST_M
    kept[length.argmax()] = True
    return kept[piece[tail]].tolist()


def _largest_component(links: list[list[int]]) -> ndarray:
    """Whether each node is in the largest set of nodes of which each can reach every other."""
    tail = np.repeat(np.arange(len(links)), [len(ends) for ends in links])
    head = np.fromiter(chain.from_iterable(links), np.int64)
    graph = coo_array((np.ones(len(tail)), (tail, head)), shape=(len(links), len(links)))
    label = connected_components(graph, connection="strong")[1]
    return label == label[np.bincount(label)[label].argmax()]


def _assemble(extract: Extract, runs, kept, gates: frozenset[int], ignored_tags: frozenset[str]) -> DrivableStreets:
    ways = []
    taken: set[int] = set()
    for index, stubs_kept in sorted(kept.items()):
        way, run = runs[index]
        joined: list[list] = []  # consecutive stubs with the same directions
        for a, b, forward, backward in stubs_kept:
            if joined and joined[-1][1] == a and joined[-1][2:] == [forward, backward]:
                joined[-1][1] = b
            else:
                joined.append([a, b, forward, backward])
        for a, b, forward, backward in joined:
            tags = {key: value for key, value in way.tags.items() if key not in ignored_tags}
            if not (forward and backward):
                tags["oneway"] = "yes" if forward else "-1"
            name = way.id
            while name in taken:
                name += 10**12
            taken.add(name)
            ways.append(Way(name, run[a : b + 1], tags))
    return DrivableStreets(ways, gates, {})
