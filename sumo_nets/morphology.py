"""Form of the streets around places of a network: junctions, traffic lights, lengths between junctions, speed limits."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from pathlib import Path

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


def read(net_path: Path | str) -> Streets:
    """The junctions where streets for motor vehicles branch or cross, and these streets.

    Junctions are those at which vehicles from one street can go on into more than one other, or that more than one
    street leads into; where a road only bends or changes its lanes, there is none. Streets that meet at such a place
    are joined.
    """
    kinds: dict[str, tuple[float, float, bool]] = {}
    edges: list[tuple[str, str, float, float, int, list[tuple[float, float]]]] = []
    state: dict[str, object] = {}

    def start(name: str, attributes: Attributes) -> None:
        if name == "edge":
            state.clear()
            if attributes.get("function", "normal") == "normal":
                state.update(begin=attributes["from"], end=attributes["to"], lanes=[])
        elif name == "lane" and state and admits_motors(attributes):
            shape = [tuple(map(float, p.split(",")[:2])) for p in attributes["shape"].split()]
            lanes = state["lanes"]
            assert isinstance(lanes, list)
            lanes.append((float(attributes["length"]), float(attributes["speed"]), shape))
        elif name == "junction" and attributes.get("type") != "internal":
            lights = attributes.get("type") in _LIGHTS
            kinds[attributes["id"]] = (float(attributes["x"]), float(attributes["y"]), lights)

    def end(name: str) -> None:
        if name == "edge" and state.get("lanes"):
            lanes = state["lanes"]
            assert isinstance(lanes, list)
            length, speed, shape = lanes[0]
            edges.append((str(state["begin"]), str(state["end"]), length, speed, len(lanes), shape))
            state.clear()

    stream(net_path, start, end)
    if not edges:
        raise ValueError(f"{net_path}: no street for motor vehicles.")
    neighbours: dict[str, set[str]] = {}
    for begin, finish, *_ in edges:
        neighbours.setdefault(begin, set()).add(finish)
        neighbours.setdefault(finish, set()).add(begin)
    crossing = {name for name, others in neighbours.items() if len(others) > 2}
    street = _joined(edges, crossing)
    n = max(street) + 1
    length = np.bincount(street, [edge[2] for edge in edges], n)
    speed = np.bincount(street, [edge[3] * edge[2] for edge in edges], n) / length
    n_lanes = np.zeros(n, np.int64)
    np.maximum.at(n_lanes, street, [edge[4] for edge in edges])
    points, of = [], []
    for number, edge in zip(street, edges, strict=True):
        on = _along(edge[5])
        points += on
        of += [number] * len(on)
    known = [name for name in sorted(crossing) if name in kinds]
    return Streets(
        np.array([kinds[name][:2] for name in known], float).reshape(-1, 2),
        np.array([kinds[name][2] for name in known], bool), length, speed, n_lanes, np.array(points), np.array(of),
    )  # fmt: skip


def _joined(edges: list, crossing: set[str]) -> list[int]:
    """Number of the street of each edge: edges that follow each other without a crossing are one street."""
    onward: dict[str, list[int]] = {}
    for number, edge in enumerate(edges):
        onward.setdefault(edge[0], []).append(number)
    street = [-1] * len(edges)
    entered = {edge[1]: [] for edge in edges}
    for number, edge in enumerate(edges):
        entered[edge[1]].append(number)
    next_of = [-1] * len(edges)
    for number, edge in enumerate(edges):
        if edge[1] not in crossing:
            further = [other for other in onward.get(edge[1], ()) if edges[other][1] != edge[0]]
            if len(further) == 1:
                next_of[number] = further[0]
    follows = {other for other in next_of if other >= 0}
    count = 0
    order = [number for number in range(len(edges)) if number not in follows] + list(range(len(edges)))
    for number in order:
        if street[number] >= 0:
            continue
        at = number
        while at >= 0 and street[at] < 0:
            street[at] = count
            at = next_of[at]
        count += 1
    return street


def _along(shape: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points on a line, at most 20 m apart, its ends included."""
    found = [shape[0]]
    for (x0, y0), (x1, y1) in zip(shape[:-1], shape[1:], strict=True):
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
