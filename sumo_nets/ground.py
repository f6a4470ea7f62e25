"""The ground that traffic needs: carriageways and pavements of a network, and how high they lie."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely

from sumo_nets.footprints import Footprint
from sumo_nets.network import lanes

MARGIN_M = 0.1
"""Margin added to the width of lanes [m]."""


class Ground(NamedTuple):
    """Areas in network coordinates on which no building may stand."""

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


def standing_on(footprints: list[Footprint], net_path: Path) -> list[Footprint]:
    """Buildings raised, base and top, to the height of the street that is nearest to their middle."""
    shapes = [lane.line_m for lane in lanes(net_path)]
    if not footprints or not any(shape[:, 2].any() for shape in shapes):
        return footprints
    begin, end = (np.concatenate([shape[cut] for shape in shapes]) for cut in (slice(None, -1), slice(1, None)))
    middle = np.array([footprint.outer[:-1].mean(axis=0) for footprint in footprints])
    nearest = shapely.STRtree(shapely.linestrings(np.stack([begin[:, :2], end[:, :2]], axis=1))).nearest(
        shapely.points(middle)
    )
    begin, along = begin[nearest], (end - begin)[nearest]
    towards = ((middle - begin[:, :2]) * along[:, :2]).sum(axis=1)
    t = np.clip(towards / np.maximum((along[:, :2] ** 2).sum(axis=1), 1e-12), 0.0, 1.0)
    z_m = (begin[:, 2] + t * along[:, 2]).tolist()
    return [f._replace(base_z_m=f.base_z_m + z, top_z_m=f.top_z_m + z) for f, z in zip(footprints, z_m, strict=True)]
