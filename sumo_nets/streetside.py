"""Space beside streets, and what OpenStreetMap says about it: kerbs, areas that others use, trees."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from numpy import ndarray

from sumo_nets.network import LANE_M, LARGEST_WIDTH_M, admits_motors, is_left_hand, points_of
from sumo_nets.xml import Attributes, is_true, stream

_PARKING = ("parking:lane:{}", "parking:lane:both", "parking:{}", "parking:both")
"""OpenStreetMap's tags of parking on the `left` or `right` of a way, in the direction in which the way is drawn."""
_NO_PARKING = frozenset(("no", "none", "no_parking", "no_stopping", "no_standing", "fire_lane", "separate"))
_ROW_M = 10.0
"""Distance between the trees of a row that OpenStreetMap has as a line [m]."""


class Kerb(NamedTuple):
    """The outer edge of a street in driving direction: on its right, or with left-hand traffic on its left.

    Network coordinates.
    """

    edge: str
    line_m: Float[ndarray, "k 3"]
    """Middle of the outermost lane."""
    half_width_m: float
    """From there to the outer edge."""
    parking: bool | None
    """What OpenStreetMap's tags say of parking on this side; None without tags."""
    is_left: bool = False
    """Whether it is on the left."""


def street_space(net_path: Path | str) -> tuple[list[Kerb], ndarray]:
    """Kerbs of the streets of a network, and the areas of its lanes and junctions.

    Returns
    -------
    One kerb per edge that motor vehicles use, and Shapely polygons, network coordinates. Tags of parking count
    if the network has them as parameters of its edges (netconvert with --osm.all-attributes).
    """
    kerbs: list[Kerb] = []
    areas: list[shapely.Geometry] = []
    edge = ""
    is_left = is_left_hand(net_path)
    tags: Attributes = {}
    lanes: list[tuple[Attributes, ndarray, float]] = []

    def start(name: str, attributes: Attributes) -> None:
        nonlocal edge, tags
        if name == "edge":
            edge, tags = "" if "function" in attributes else attributes["id"], {}
            lanes.clear()
        elif name == "lane" and edge:
            width_m = float(attributes.get("width", LANE_M))
            lanes.append((attributes, _line(attributes), min(width_m, LARGEST_WIDTH_M)))
        elif name == "param" and edge:
            tags[attributes.get("key", "")] = attributes.get("value", "")
        elif name == "junction":
            ring = points_of(attributes.get("shape", ""))
            if len(ring) > 2:
                areas.append(shapely.make_valid(shapely.Polygon(ring[:, :2])))

    def end(name: str) -> None:
        nonlocal edge
        if name == "edge" and edge and lanes:
            for _, line_m, width_m in lanes:
                areas.append(shapely.LineString(line_m[:, :2]).buffer(width_m / 2, cap_style="flat"))
            if any(admits_motors(lane) for lane, _, _ in lanes):
                _, line_m, width_m = lanes[0]  # SUMO numbers lanes from the outer side
                kerbs.append(Kerb(edge, line_m, width_m / 2, _parking(edge, tags, is_left), is_left))
            edge = ""

    stream(net_path, start, end)
    return kerbs, np.array(areas, dtype=object)


def _parking(edge: str, tags: Attributes, is_left: bool) -> bool | None:
    """Whether tags say that vehicles park on the outer side of an edge. None if they say nothing of it.

    Netconvert gives the tags of a way to the edges of both directions. The name of an edge against the direction of its
    way begins with a minus sign.
    """
    is_against = edge.rpartition(".")[2].startswith("-")  # `cosim nets tile` puts a number and a point before names
    side = "left" if is_left != is_against else "right"
    keys = [name.format(side) for name in _PARKING]
    said = [tags[key] not in _NO_PARKING for key in keys if key in tags]
    return any(said) if said else None


def read_trees(path: Path | str) -> Float[ndarray, "n 2"]:
    """Positions of the trees in a file of polygons and points of interest, as polyconvert writes it.

    A point counts if its type ends with "tree" or it has the parameter `natural=tree`; a line with the type or the
    parameter `tree_row` counts as trees 10 m apart.

    Returns
    -------
    Network coordinates. Trees without finite coordinates, or in longitude and latitude, are left out.
    """
    found: list[ndarray] = []
    here: Attributes = {}
    kind = ""

    def start(name: str, attributes: Attributes) -> None:
        nonlocal here, kind
        if name in ("poi", "poly"):
            here, kind = attributes, attributes.get("type", "")
        elif name == "param" and attributes.get("key") == "natural":
            kind = attributes.get("value", "")

    def end(name: str) -> None:
        if name == "poi" and kind.endswith("tree"):
            x, y = here.get("x", ""), here.get("y", "")
            found.append(points_of(f"{x},{y}")[:, :2])
        elif name == "poly" and kind.endswith("tree_row") and not is_true(here.get("geo", "")):
            row = points_of(here.get("shape", ""))[:, :2]
            if len(row) > 1:
                line = shapely.LineString(row)
                at = np.arange(0.0, line.length, _ROW_M)
                found.append(shapely.get_coordinates(shapely.line_interpolate_point(line, at)))

    stream(path, start, end)
    return np.concatenate([np.zeros((0, 2)), *found])


def _line(lane: Attributes) -> Float[ndarray, "k 3"]:
    points = points_of(lane.get("shape", ""))
    if len(points) < 2:
        raise ValueError(f"lane {lane.get('id', '?')!r} has no line of finite points")
    return points
