"""Demand and signals for the networks inside SUMO's package (`sumo_package_nets`)."""

from __future__ import annotations

import hashlib
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import shapely

from cosim.addons.netbuild import build
from cosim.addons.netbuild.build_from_osm import escaped
from cosim.addons.netbuild.gate_flows import gate_flows, rates_at
from sumo_nets import demand, sumotools
from sumo_nets.density import trips_per_hour
from sumo_nets.footprints import read_footprints, write_footprints
from sumo_nets.sumo_package_nets import NETS, PackageNet, cached_folder

BOUNDARY_M = 120.0
"""A street that ends this near to the boundary of the network continues outside of it."""

REBUILD: dict[str, Any] = {
    "remove-edges.by-vclass": "rail,rail_urban,rail_electric,rail_fast,subway",
    "junctions.join": True,
    "no-turnarounds.except-deadend": True,
    "no-warnings": True,
    "tls.rebuild": True,
    "tls.default-type": "actuated",
    "tls.min-dur": 5,
    "tls.max-dur": 40,
    "tls.join": True,
    "tls.discard-simple": True,
    "tls.ignore-internal-junction-jam": True,
    "sidewalks.guess": True,
    "sidewalks.guess.min-speed": 1,
    "sidewalks.guess.max-speed": 16,
    "default.sidewalk-width": 2.0,
    "crossings.guess": True,
    "check-lane-foes.all": True,
}
"""Options of netconvert. Unchanged, with signals of fixed timing, 15 to 25 of 100 trips teleport. Railways are removed:
they reach far beyond the streets, and traffic enters and leaves where the streets end."""

RECIPE = """# How the files were made; see cosim/addons/netbuild/build_from_sumo_package.py.
name = "{name}"
description = "{description}"
licence = "{licence}"
attribution = "{attribution}"
warm_up_s = 600

[source]
file = "{net}"
sha256 = "{sha256}"

[demand]
seed = {seed}
end_s = 7800
route_choice = 1.5
density_per_km = {density}
hour = {hour}

[demand.vehicles]
at_least_m = {at_least}
from_inside = 0.3
to_inside = 0.3
gate_weight = {{ motorway = 6.0, trunk = 5.0, primary = 3.0, secondary = 2.0, tertiary = 1.2, unclassified = 0.3, residential = 0.2 }}

[demand.gates]
# Vehicles per hour and lane that enter at a gate, by class of its street; per_hour is their sum without the trips above.
per_hour_and_lane = {{ motorway = {motorway}, trunk = {trunk} }}
per_hour = {through}

[demand.car]
per_hour = {car}

[demand.van]
per_hour = {van}

[demand.truck]
per_hour = {truck}

[demand.bicycle]
per_hour = {bicycle}
at_most_m = 4000.0

[demand.pedestrian]
per_hour = {pedestrian}
at_least_m = 100.0
at_most_m = 800.0
"""  # noqa: E501


def folder_of(name: str) -> Path:
    """The folder of a network of SUMO's package; generated on first use, the same on every machine.

    Raises
    ------
    ValueError
        If the installed SUMO lacks the network, or the cache cannot be written.
    """
    net = NETS[name]
    source = sumotools.home() / net.net
    if not source.is_file():
        raise ValueError(f"{name}: the installed SUMO has no {net.net}. Install eclipse-sumo 1.28 from PyPI.")
    if (folder := cached_folder(net, source)).is_dir():
        return folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f"{name}.", dir=folder.parent) as scratch:
            done = Path(scratch) / "done"
            _make(net, source, Path(scratch), done)
            try:
                done.replace(folder)
            except OSError:
                if not folder.is_dir():  # another process may have been faster
                    raise
    except OSError as error:
        raise ValueError(
            f"{name}: the cache {folder.parent} cannot be written ({error.strerror}). Set COSIM_CACHE to a folder."
        ) from None
    return folder


def _make(net: PackageNet, source: Path, work: Path, out: Path) -> None:
    import sumolib

    sumotools.run("netconvert", {"sumo-net-file": source, "output-file": "net.net.xml", **REBUILD}, work)
    read = sumolib.net.readNet(str(work / "net.net.xml"))
    streets = demand.streets_of(read, _boundary_nodes(read), is_one_piece=True)
    figures: dict[str, Any] = {"through": 0}
    figures |= trips_per_hour(streets, net.density)
    figures |= rates_at(net.density.hour)

    def filled() -> str:
        return RECIPE.format(
            name=net.name,
            description=escaped(net.description),
            licence=net.licence,
            attribution=net.attribution,
            net=net.net,
            sha256=hashlib.sha256(source.read_bytes()).hexdigest(),
            seed=net.density.seed,
            density=net.density.per_km,
            hour=net.density.hour,
            **figures,
        )

    flows = gate_flows(read, streets, tomllib.loads(filled())["demand"])
    figures["through"] = round(sum(one.per_hour for one in flows))
    text = filled()
    recipe = tomllib.loads(text)
    build.route(streets, flows, recipe["demand"], work)
    found = read_footprints(sumotools.home() / net.polygons) if net.polygons else []
    named = [(f"b{i}", footprint) for i, footprint in enumerate(found)]
    write_footprints(work / "buildings.poly.xml", named)
    (work / "buses.rou.xml").write_text("<routes/>\n", encoding="utf-8")
    (work / "stops.add.xml").write_text("<additional/>\n", encoding="utf-8")
    build.pack(recipe, text, work, out)


def _boundary_nodes(net: Any) -> frozenset[str]:
    """Nodes near the convex hull at which the network ends."""
    nodes = net.getNodes()
    hull = shapely.MultiPoint([node.getCoord() for node in nodes]).convex_hull.boundary
    found = set()
    for node in nodes:
        neighbours = {other.getID() for other in node.getNeighboringNodes()}
        away_m = hull.distance(shapely.Point(node.getCoord()))
        if len(neighbours) == 1 and away_m < BOUNDARY_M:
            found.add(node.getID())
    return frozenset(found)
