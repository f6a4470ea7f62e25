"""The ground that traffic needs: carriageways and pavements of a network."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import shapely

MARGIN_M = 0.1
"""By which lanes count as wider than drawn [m]."""


class Ground(NamedTuple):
    """Areas in network coordinates; no wall may stand on them."""

    carriageway: shapely.Geometry
    """Lanes for vehicles, those across junctions included."""
    pavement: shapely.Geometry
    """Lanes and areas for pedestrians, crossings included."""


def ground_of(net_path: Path) -> Ground:
    """Carriageways and pavements of a SUMO network."""
    import sumolib

    net = sumolib.net.readNet(str(net_path), withInternal=True, withPedestrianConnections=True)
    carriageway: list[shapely.Geometry] = []
    pavement: list[shapely.Geometry] = []
    for edge in net.getEdges(True):
        function = edge.getFunction()
        for lane in edge.getLanes():
            if function == "walkingarea":
                pavement.append(shapely.Polygon(lane.getShape()).buffer(0.0))
                continue
            line = shapely.LineString(lane.getShape())
            strip = line.buffer(lane.getWidth() / 2 + MARGIN_M, cap_style="flat")
            wheels = function != "crossing" and (lane.allows("passenger") or lane.allows("bicycle"))
            (carriageway if wheels else pavement).append(strip)
    return Ground(shapely.union_all(carriageway), shapely.union_all(pavement))
