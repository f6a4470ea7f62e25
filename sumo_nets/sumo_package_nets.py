"""Networks of real cities inside SUMO's package; demand is generated on first use, into the user's cache."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from sumo_nets.density import Density


@dataclass(frozen=True, slots=True)
class PackageNet:
    """A network in SUMO's package, with the facts that are listed before it is generated."""

    name: str
    description: str
    net: str
    """Path of the network under SUMO_HOME."""
    polygons: str | None
    density: Density
    km2: float
    """Of the generated network, so that it can be listed before it is generated; tests compare."""
    vehicles_per_hour: float
    pedestrians_per_hour: float
    licence: str = "ODbL-1.0"
    attribution: str = "© OpenStreetMap contributors; network by the authors of Eclipse SUMO"


NETS = {
    net.name: net
    for net in (
        PackageNet(
            "adlershof",
            "Berlin-Adlershof and Köpenick: 1.9 x 1.7 km of city streets and suburbs",
            "tools/game/DRT/osm.net.xml",
            None,
            Density(per_km=2.5),
            3.33,
            2378,
            952,
        ),
        PackageNet(
            "braunschweig",
            "Braunschweig, ring road and university quarter: 1.6 x 1.1 km",
            "tools/game/bs3d/bs.net.xml",
            None,
            Density(per_km=2.5),
            1.73,
            1364,
            546,
        ),
        PackageNet(
            "koenigs-wusterhausen",
            "Motorways A 10 and A 13 and the town of Königs Wusterhausen: 2.5 x 3.2 km",
            "tools/game/A10KW/osm.net.xml",
            "tools/game/A10KW/osm.poly.xml",
            Density(per_km=8.0),
            7.89,
            5062,
            1449,
        ),
    )
}
"""The networks by name. SUMO's authors made them from OpenStreetMap, which is therefore attributed too."""

_SOURCES = (
    "../cosim/addons/netbuild/build.py",
    "../cosim/addons/netbuild/build_from_sumo_package.py",
    "../cosim/addons/netbuild/gate_flows.py",
    "demand.py",
    "density.py",
    "common/vtypes.add.xml",
)
"""Files on which the generated folders depend."""


def cache() -> Path:
    """Where generated files are kept: $COSIM_CACHE, else the user's cache folder."""
    if given := os.environ.get("COSIM_CACHE"):
        return Path(given)
    if os.name == "nt":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home()))
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "cosim"


def made(name: str) -> Path | None:
    """The generated folder of a network, or None before its first use."""
    from sumo_nets import sumotools

    if find_spec("sumo") is None:
        return None
    source = sumotools.home() / NETS[name].net
    folder = cached_folder(NETS[name], source) if source.is_file() else None
    return folder if folder is not None and folder.is_dir() else None


def cached_folder(net: PackageNet, source: Path) -> Path:
    """Where it is kept; the name contains a hash of the files on which its content depends."""
    here = Path(__file__).parent
    sources = (Path(__file__), *(here / name for name in _SOURCES))
    files = [path for path in (source, *sources) if path.is_file()]
    about = net.name + "".join(map(_checksum, files))
    digest = hashlib.sha256(about.encode()).hexdigest()
    return cache() / "nets" / f"{net.name}-{digest[:12]}"


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
