"""The drivable part of an OpenStreetMap extract: every street a car can enter *and* leave."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import chain, pairwise

import numpy as np
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sumo_nets.osm import Extract, Way, pieces


@dataclass(frozen=True, slots=True)
class Streets:
    """Input of netconvert, and the nodes where streets continue beyond the extract."""

    ways: list[Way]
    gates: frozenset[int]
    """Nodes at which traffic enters and leaves."""
    dropped_m: float
    """Length of street left out because a car could not leave (or reach) it [m]."""


def drivable(
    extract: Extract, classes: frozenset[str], ignored_tags: frozenset[str], edge_m: float, dead_ends: bool = False
) -> Streets:
    """Surface streets of the given highway classes, without the ignored tags, and unless `dead_ends` without those.

    A street stays if a car can come from every other street that stays, drive through it and go on to every
    other, without turning round on the spot. Streets cut off by the extract, or ending within `edge_m` of its
    edge, are gates: beyond them the outside joins them all.

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
    alive = [True] * len(arcs) if dead_ends else _driven(runs, arcs, gates)
    kept: dict[int, list[tuple[int, int, bool, bool]]] = defaultdict(list)
    both: dict[tuple[int, int, int], list[bool]] = defaultdict(list)
    for (index, a, b, forward), is_alive in zip(arcs, alive, strict=True):
        if is_alive:
            both[index, a, b].append(forward)
    for (index, a, b), ways_round in sorted(both.items()):
        kept[index].append((a, b, True in ways_round, False in ways_round))
    if not kept:
        raise ValueError(f"the extract has no connected network of streets of the classes {', '.join(sorted(classes))}")
    return _assemble(extract, runs, stubs, kept, gates, ignored_tags)


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


def _largest_component(links: list[list[int]]) -> ndarray:
    """Whether each node is in the largest set of nodes of which each can reach every other."""
    tail = np.repeat(np.arange(len(links)), [len(ends) for ends in links])
    head = np.fromiter(chain.from_iterable(links), np.int64)
    graph = coo_array((np.ones(len(tail)), (tail, head)), shape=(len(links), len(links)))
    label = connected_components(graph, connection="strong")[1]
    return label == label[np.bincount(label)[label].argmax()]


def _assemble(extract: Extract, runs, stubs, kept, gates: frozenset[int], ignored_tags: frozenset[str]) -> Streets:
    ways, dropped = [], 0.0
    for index, a, b in stubs:
        if not any(stub[:2] == (a, b) for stub in kept.get(index, ())):
            dropped += length_m(extract, runs[index][1][a : b + 1])
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
    return Streets(ways, gates, dropped)
