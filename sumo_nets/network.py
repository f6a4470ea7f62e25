"""What a file must be before SUMO is started on it: a network that a car can drive on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sumo_nets.xml import Attributes, Enough, stream

LANE_M = 3.2
"""Width of a lane that does not say [m]; SUMO's own default."""


def check_for_cars(net_path: Path | str) -> None:
    """Refuse a file that is not a SUMO network, or a network without any lane for passenger cars.

    Raises
    ------
    ValueError
        One line: the file, and why no car can drive there.
    """
    elements = 0
    lanes = 0
    inside = False

    def start(name: str, attributes: Attributes) -> None:
        nonlocal elements, lanes, inside
        elements += 1
        if elements == 1 and name != "net":
            raise ValueError(f"{net_path}: not a SUMO network: it starts with <{name}>, a network starts with <net>")
        if name == "edge":
            inside = attributes.get("function", "normal") not in ("normal", "connector")
        elif name == "lane" and not inside:
            lanes += 1
            if _admits_cars(attributes):
                raise Enough

    def end(name: str) -> None:
        if name == "net":
            what = f"none of its {lanes} lanes lets passenger cars in" if lanes else "it has no lane at all"
            raise ValueError(
                f"{net_path}: no car can drive on this network: {what}. "
                "Was it built for rail or pedestrians only? Rebuild it with netconvert and its streets kept."
            )

    stream(net_path, start, end)


def lanes(net_path: Path | str) -> tuple[list[Float[ndarray, "k 2"]], list[float]]:
    """Middle line and width [m] of every lane outside junctions, in network coordinates."""
    lines: list[Float[ndarray, "k 2"]] = []
    widths: list[float] = []
    inside = False

    def start(name: str, attributes: Attributes) -> None:
        nonlocal inside
        if name == "edge":
            inside = attributes.get("function", "normal") != "normal"
        elif name == "lane" and not inside:
            points = [point.split(",")[:2] for point in attributes["shape"].split()]
            lines.append(np.array(points, float))
            widths.append(float(attributes.get("width", LANE_M)))

    stream(net_path, start)
    return lines, widths


def _admits_cars(lane: Attributes) -> bool:
    if "allow" in lane:
        return bool({"passenger", "all"} & set(lane["allow"].split()))
    return not {"passenger", "all"} & set(lane.get("disallow", "").split())
