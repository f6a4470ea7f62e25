"""Form of the streets around places of a network: junctions, lights, lengths between junctions, speed limits."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import hypot
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from sumo_nets.network import admits_motors
from sumo_nets.xml import Attributes, stream

_SPACING_M = 20.0
"""Distance of the points on a street by which the nearest street is found."""
_LIGHTS = frozenset(("traffic_light", "traffic_light_unregulated", "traffic_light_right_on_red"))


@dataclass(frozen=True, slots=True)
class Streets:
    """J junctions and E streets for motor vehicles; network coordinates. A street is one direction of a road."""

    junction_m: Float[ndarray, "j 2"]
    has_lights: Bool[ndarray, "j"]
    length_m: Float[ndarray, "e"]
    """Length of each street, from junction to junction."""
    speed_mps: Float[ndarray, "e"]
    """Speed limit of each street."""
    n_lanes: Int[ndarray, "e"]
    point_m: Float[ndarray, "p 2"]
    """Points on the streets."""
    point_street: Int[ndarray, "p"]
    """The street of each point."""


@dataclass(frozen=True, slots=True)
class Morphology:
    """Form of the streets around N places."""

    junctions_per_km2: Float[ndarray, "n"]
    lights_share: Float[ndarray, "n"]
    """Share of the junctions within the radius that have traffic lights; 0 without junctions."""
    street_length_m: Float[ndarray, "n"]
    """Length between junctions of the nearest street."""
    speed_limit_mps: Float[ndarray, "n"]
    """Speed limit of the nearest street."""
    lanes: Float[ndarray, "n"]
    """Lanes of the nearest street, in its direction."""


class _Edge(NamedTuple):
    """An edge of the network for motor vehicles, in one direction."""

    begin: str
    """Name of the node where it begins."""
    end: str
    length_m: float
    speed_mps: float
    n_lanes: int
    line_m: list[tuple[float, float]]


class _Node(NamedTuple):
    xy_m: tuple[float, float]
    has_lights: bool


def read(net_path: Path | str) -> Streets:
    """The junctions of a network where roads for motor vehicles branch or cross, and the streets between them.

    A node with two neighbours is no junction: there a road only bends, or changes its lanes. Edges that follow each
    other across such nodes are one street.

    Raises
    ------
    ValueError
        In one line: the file is damaged, or has no street for motor vehicles.
    """
    edges, nodes = _elements(net_path)
    if not edges:
        raise ValueError(f"{net_path}: no street for motor vehicles.")
    neighbours: dict[str, set[str]] = {}
    for edge in edges:
        neighbours.setdefault(edge.begin, set()).add(edge.end)
        neighbours.setdefault(edge.end, set()).add(edge.begin)
    junctions = {name for name, others in neighbours.items() if len(others) > 2}
    street = _joined(edges, junctions)
    n = max(street) + 1
    length_m = np.bincount(street, [edge.length_m for edge in edges], n)
    n_lanes = np.zeros(n, np.int64)
    np.maximum.at(n_lanes, street, [edge.n_lanes for edge in edges])
    lines = [_along(edge.line_m) for edge in edges]
    known = [nodes[name] for name in sorted(junctions) if name in nodes]
    return Streets(
        junction_m=np.array([node.xy_m for node in known], float).reshape(-1, 2),
        has_lights=np.array([node.has_lights for node in known], bool),
        length_m=length_m,
        speed_mps=np.bincount(street, [edge.speed_mps * edge.length_m for edge in edges], n) / length_m,
        n_lanes=n_lanes,
        point_m=np.concatenate([np.array(line) for line in lines]),
        point_street=np.repeat(street, [len(line) for line in lines]),
    )


def _elements(net_path: Path | str) -> tuple[list[_Edge], dict[str, _Node]]:
    """Edges for motor vehicles, and all nodes by name."""
    nodes: dict[str, _Node] = {}
    edges: list[_Edge] = []
    ends: tuple[str, str] | None = None
    lanes: list[Attributes] = []

    def start(name: str, attributes: Attributes) -> None:
        nonlocal ends
        if name == "edge":
            is_street = attributes.get("function", "normal") == "normal"
            ends = (attributes["from"], attributes["to"]) if is_street else None
            lanes.clear()
        elif name == "lane" and ends is not None and admits_motors(attributes):
            lanes.append(attributes)
        elif name == "junction" and attributes.get("type") != "internal":
            xy_m = (float(attributes["x"]), float(attributes["y"]))
            nodes[attributes["id"]] = _Node(xy_m, attributes.get("type") in _LIGHTS)

    def end(name: str) -> None:
        if name == "edge" and ends is not None and lanes:
            first = lanes[0]
            points = [point.split(",") for point in first["shape"].split()]
            line_m = [(float(point[0]), float(point[1])) for point in points]
            edges.append(_Edge(*ends, float(first["length"]), float(first["speed"]), len(lanes), line_m))

    stream(net_path, start, end)
    return edges, nodes


def _joined(edges: list[_Edge], junctions: set[str]) -> list[int]:
    """Number of the street of each edge."""
    onward: dict[str, list[int]] = {}
    for number, edge in enumerate(edges):
        onward.setdefault(edge.begin, []).append(number)
    follower = [-1] * len(edges)
    for number, edge in enumerate(edges):
        further = [other for other in onward.get(edge.end, ()) if edges[other].end != edge.begin]
        if edge.end not in junctions and len(further) == 1:
            follower[number] = further[0]
    street = [-1] * len(edges)
    count = 0
    followers = set(follower)
    heads = [number for number in range(len(edges)) if number not in followers]
    for number in [*heads, *range(len(edges))]:  # the second part is of streets that run in a ring
        at = number
        while at >= 0 and street[at] < 0:
            street[at] = count
            at = follower[at]
        count = max(street) + 1
    return street


def _along(line_m: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points on a line, at most 20 m apart, its ends included."""
    found = [line_m[0]]
    for (x0, y0), (x1, y1) in pairwise(line_m):
        n = max(1, int(np.ceil(hypot(x1 - x0, y1 - y0) / _SPACING_M)))
        found += [(x0 + (x1 - x0) * k / n, y0 + (y1 - y0) * k / n) for k in range(1, n + 1)]
    return found


def around(streets: Streets, xy_m: Float[ndarray, "n 2"], radius_m: float = 250.0) -> Morphology:
    """Form of the streets around places.

    Parameters
    ----------
    xy_m
        Places, network coordinates.
    radius_m
        Radius of the disc in which junctions are counted.
    """
    area_km2 = np.pi * radius_m**2 / 1e6
    count = np.zeros(len(xy_m))
    lit = np.zeros(len(xy_m))
    if len(streets.junction_m) and len(xy_m):
        tree = cKDTree(streets.junction_m)
        count = np.asarray(tree.query_ball_point(xy_m, radius_m, return_length=True), float)
        if streets.has_lights.any():
            lights = cKDTree(streets.junction_m[streets.has_lights])
            lit = np.asarray(lights.query_ball_point(xy_m, radius_m, return_length=True), float)
    nearest = streets.point_street[cKDTree(streets.point_m).query(xy_m)[1]] if len(xy_m) else np.zeros(0, np.int64)
    return Morphology(
        count / area_km2, lit / np.maximum(count, 1), streets.length_m[nearest], streets.speed_mps[nearest],
        streets.n_lanes[nearest].astype(float),
    )  # fmt: skip
