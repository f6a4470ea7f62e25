"""Real networks that come inside SUMO's own package: given demand on first use, into the user's cache."""

from __future__ import annotations

import hashlib
import os
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import shapely

from sumo_nets import build, demand, sumotools, town
from sumo_nets.footprints import read_footprints, write_footprints

RIM_M = 120.0
"""A street that ends this near to the rim of the network goes on outside."""


@dataclass(frozen=True, slots=True)
class WheelNet:
    """A network in SUMO's package, and what is known of it."""

    name: str
    description: str
    net: str
    """Path of the network under SUMO_HOME."""
    polygons: str | None
    density: town.Density
    km2: float
    """What it is when it is made, so that it can be listed before; tests hold it to that."""
    vehicles_per_hour: float
    pedestrians_per_hour: float
    licence: str = "ODbL-1.0"
    attribution: str = "© OpenStreetMap contributors; network by the authors of Eclipse SUMO"


NETS = {
    net.name: net
    for net in (
        WheelNet(
            "adlershof", "Berlin-Adlershof and Köpenick: 1.9 x 1.7 km of city streets and suburbs",
            "tools/game/DRT/osm.net.xml", None, town.Density(per_km=2.5), 3.33, 2378, 952,
        ),
        WheelNet(
            "braunschweig", "Braunschweig, ring road and university quarter: 1.6 x 1.1 km",
            "tools/game/bs3d/bs.net.xml", None, town.Density(per_km=2.5), 1.73, 1364, 546,
        ),
        WheelNet(
            "koenigs-wusterhausen", "Motorways A 10 and A 13 and the town of Königs Wusterhausen: 2.5 x 3.2 km",
            "tools/game/A10KW/osm.net.xml", "tools/game/A10KW/osm.poly.xml", town.Density(per_km=8.0), 7.89, 3624, 1449,
        ),
    )
}  # fmt: skip
"""The networks by name. Made from OpenStreetMap by SUMO's authors, so that OpenStreetMap is to be named too."""

REBUILD: dict[str, Any] = {
    "remove-edges.by-vclass": "rail,rail_urban,rail_electric,rail_fast,subway",
    "junctions.join": True, "no-turnarounds.except-deadend": True, "no-warnings": True,
    "tls.rebuild": True, "tls.default-type": "actuated", "tls.min-dur": 5, "tls.max-dur": 40, "tls.join": True,
    "tls.discard-simple": True, "tls.ignore-internal-junction-jam": True,
    "sidewalks.guess": True, "sidewalks.guess.min-speed": 1, "sidewalks.guess.max-speed": 16,
    "default.sidewalk-width": 2.0, "crossings.guess": True, "check-lane-foes.all": True,
}  # fmt: skip
"""What netconvert is asked to mend: as they come, with signals of fixed timing, 15 to 25 of 100 trips teleport.
Railways go: they would reach far beyond the streets, and where the streets end is where traffic comes and goes."""

RECIPE = """# How the files were made; sumo_nets/wheel.py follows it.
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


def cache() -> Path:
    """Where generated files are kept: $COSIM_CACHE, else the user's cache folder."""
    if given := os.environ.get("COSIM_CACHE"):
        return Path(given)
    if os.name == "nt":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home()))
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "cosim"


def folder_of(name: str) -> Path:
    """The folder of a network of the wheel; made on first use, the same on every machine.

    Raises
    ------
    ValueError
        Where the installed SUMO lacks the network, or the cache cannot be written.
    """
    net = NETS[name]
    source = sumotools.home() / net.net
    if not source.is_file():
        raise ValueError(f"{name}: the installed SUMO has no {net.net}. Install eclipse-sumo 1.28 from PyPI.")
    if (folder := _place(net, source)).is_dir():
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


def made(name: str) -> Path | None:
    """The folder of a network of the wheel, if it has been made."""
    source = sumotools.home() / NETS[name].net
    folder = _place(NETS[name], source) if source.is_file() else None
    return folder if folder is not None and folder.is_dir() else None


def _place(net: WheelNet, source: Path) -> Path:
    """Where it is kept; the name changes with whatever its making depends on."""
    makers = (build.__file__, demand.__file__, town.__file__, __file__, build.VEHICLE_TYPES)
    about = net.name + "".join(_checksum(Path(path)) for path in (source, *makers))
    return cache() / "nets" / f"{net.name}-{hashlib.sha256(about.encode()).hexdigest()[:12]}"


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _make(net: WheelNet, source: Path, work: Path, out: Path) -> None:
    import sumolib

    sumotools.run("netconvert", {"sumo-net-file": source, "output-file": "net.net.xml", **REBUILD}, work)
    read = sumolib.net.readNet(str(work / "net.net.xml"))
    streets = demand.streets_of(read, _rim(read))
    figures: dict[str, Any] = town.scaled(streets, net.density)
    text = RECIPE.format(
        name=net.name, description=town.escaped(net.description), licence=net.licence, attribution=net.attribution,
        net=net.net, sha256=_checksum(source), seed=net.density.seed, density=net.density.per_km, hour=net.density.hour,
        **figures,
    )  # fmt: skip
    recipe = tomllib.loads(text)
    wanted = recipe["demand"]
    trips = demand.walks(streets, wanted["pedestrian"], wanted["seed"], wanted["end_s"]) if _walkable(streets) else []
    for kind in demand.KINDS:
        trips += demand.vehicle_trips(streets, kind, wanted["vehicles"] | wanted[kind], wanted["seed"], wanted["end_s"])
    build.route(trips, wanted, work)
    found = read_footprints(sumotools.home() / net.polygons) if net.polygons else []
    write_footprints(work / "buildings.poly.xml", ((f"b{i}", footprint) for i, footprint in enumerate(found)))
    (work / "buses.rou.xml").write_text("<routes/>\n", encoding="utf-8")
    (work / "stops.add.xml").write_text("<additional/>\n", encoding="utf-8")
    build.pack(recipe, text, work, out)


def _rim(net: Any) -> frozenset[str]:
    """Nodes near the rim at which the network ends."""
    nodes = net.getNodes()
    hull = shapely.MultiPoint([node.getCoord() for node in nodes]).convex_hull.boundary
    return frozenset(
        node.getID()
        for node in nodes
        if len({n.getID() for n in node.getNeighboringNodes()}) == 1
        and hull.distance(shapely.Point(node.getCoord())) < RIM_M
    )


def _walkable(streets: list[demand.Street]) -> bool:
    return any(street.walkable for street in streets)
