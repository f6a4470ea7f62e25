"""Network, buildings and demand from any OpenStreetMap file."""

from __future__ import annotations

import gzip
import logging
import re
import shutil
import tempfile
import tomllib
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import sumo_nets
from cosim.addons.netbuild import build, osm_files, overpass
from cosim.addons.netbuild.gate_flows import gate_flows, rates_at
from cosim.addons.netbuild.osm_xml import check_form
from cosim.addons.netbuild.streets import LeftOut, n_clockwise
from cosim.base.durable import sha256
from sumo_nets import demand
from sumo_nets.density import BY_HOUR, SHARES, Density, trips_per_hour
from sumo_nets.osm import Extract
from sumo_nets.xml import Attributes, check_prolog, stream

_HERE = Path(str(sumo_nets.__file__)).parent
_LOG = logging.getLogger("cosim.addons.netbuild.build_from_osm")


SMALLEST_LEFT_M = 50.0
"""Less is not worth a word: streets within junctions become a part of them [m]."""
SLOWER = 1.45
"""Duration of a trip over that of its route at the speed limit.

SUMO drives 1.34 in Braunschweig, 1.45 in Kotka, 1.70 in Bad Hersfeld, and 1.99 in Adlershof, where streets are full.
"""
BICYCLE_MPS = 5.5
"""Speed of bicycles, where the speed limit is not below."""
BUSES_PER_HOUR = 2.0
"""Buses of a line and direction at the busiest hour, as a guess; those of other hours are fewer, like the trips."""
_SAMPLE = 2000.0
"""Trips from which the mean duration of trips is computed."""


class Losses(NamedTuple):
    """What of an extract is not in the city."""

    streets: dict[str, LeftOut]
    """By class."""
    n_incomplete: int
    """Ways without the places of their nodes."""
    side: str = ""
    """A note if most roundabouts are driven as on the other side of the road."""

    @property
    def text(self) -> str:
        """One line; empty if nothing is left out."""
        parts = []
        for kind, of in self.streets.items():
            if of.left_m > SMALLEST_LEFT_M:
                parts.append(f"{kind} {of.text}")
        if self.n_incomplete:
            parts.append(f"{self.n_incomplete:,} ways without places")
        return "; ".join(parts)


def from_osm(
    path: Path,
    out: Path,
    density: Density,
    name: str | None = None,
    left_hand: bool = False,
    box: overpass.Box | None = None,
) -> Losses:
    """Build streets, buildings and demand from an OpenStreetMap file into the folder `out`.

    Parameters
    ----------
    path
        The OpenStreetMap file.
    out
        Folder for the city.
    density
        Amount of traffic.
    name
        Name of the city and its files.
    left_hand
        Whether traffic drives on the left. An extract tells by its roundabouts alone.
    box
        Region (west, south, east, north in degrees) to cut out of a larger extract.

    Returns
    -------
    What is left out.

    Raises
    ------
    ValueError
        If no network can be built from the file; one line names the file and the reason.
    """
    if not path.is_file():
        raise ValueError(f"--osm {path}: no such file. Give an extract: .osm, .osm.gz, .osm.xml.gz or .osm.pbf.")
    if not osm_files.is_pbf(path):
        check_form(path)
        check_prolog(path)
    if name is None:
        name = re.sub(r"[^\w-]+", "-", out.resolve().name).strip("-") or "town"
    elif not re.fullmatch(r"[\w-]+", name):
        raise ValueError(f"--name {name}: files are named after it. Use letters, digits, - and _ only.")
    extract = osm_files.read(path, box)
    about = {
        "name": name,
        "description": f"{name}, from {path.name}",
        "box": "" if box is None else f"\nbox = [{', '.join(map(repr, box))}]",
        "licence": "ODbL-1.0",
        "attribution": "© OpenStreetMap contributors",
        "file": path.name,
        "sha256": sha256(path),
        "left_hand": str(left_hand).lower(),
    }
    template = (_HERE / "common" / "osm_recipe.toml").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory(prefix="sumo_nets.") as folder:
        work = Path(folder)
        recipe = tomllib.loads(_filled(template, about, density, {}))
        try:
            gates, left_out = build.network(recipe, extract, work)
        except ValueError as error:
            raise ValueError(f"--osm {path}: {error}") from None
        _LOG.info("network made")
        try:
            text = _recipe(template, about, density, work / "net.net.xml", gates)
            recipe = tomllib.loads(text)
            build.furnish(recipe, extract, gates, work)
        except demand.NoTraffic as error:
            cause = f"the extract is too small for traffic: {error}. Take a larger one."
            raise ValueError(f"--osm {path}: {cause}") from None
        build.pack(recipe, text, work, out)
    return Losses(left_out, extract.n_incomplete, _other_side(extract, left_hand))


def _other_side(extract: Extract, left_hand: bool) -> str:
    n_left, n = n_clockwise(extract)
    n_other = n - n_left if left_hand else n_left
    if 2 * n_other <= n:
        return ""
    way, side, cure = ("against the clock", "right", "without") if left_hand else ("clockwise", "left", "with")
    return (
        f"note: {n_other} of {n} roundabouts are driven {way}, as where traffic keeps to the {side}. Build the city "
        f"again {cure} --left-hand."
    )


def from_box(
    box: str, out: Path, density: Density, name: str | None = None, left_hand: bool = False, server: str | None = None
) -> Losses:
    """Like `from_osm`, for the box "west,south,east,north" [degrees], fetched from OpenStreetMap's Overpass service.

    The extract is kept in `out`, so that the build can be repeated; see `overpass.fetch`.
    """
    edges = overpass.degrees(box)
    with tempfile.TemporaryDirectory(prefix="sumo_nets.") as folder:
        extract = Path(folder) / "box_{:g}_{:g}_{:g}_{:g}.osm.xml.gz".format(*edges)
        try:
            extract.write_bytes(gzip.compress(overpass.fetch(edges, server), mtime=0))
            losses = from_osm(extract, out, density, name, left_hand)
        except ValueError as error:
            said = str(error).removeprefix("--osm ").replace(str(extract), "what the Overpass service sent")
            raise ValueError(
                f"--bbox {box}: {said.rstrip('. ')}. Or fetch an extract elsewhere (download.geofabrik.de, "
                "www.openstreetmap.org/export) and give it with --osm FILE."
            ) from None
        shutil.copyfile(extract, out / extract.name)
    build.write_checksums(out)
    return losses


def _filled(
    template: str,
    about: dict[str, str],
    density: Density,
    figures: dict[str, float],
) -> str:
    """The recipe of a city: its template with the values filled in."""
    values: dict[str, Any] = {
        **about,
        "density": f"{density.per_km:g}",
        "hour": density.hour,
        "at_least": 300.0,
        "bus": f"{BUSES_PER_HOUR * BY_HOUR[density.hour]:g}",
        **dict.fromkeys((*demand.KINDS, "pedestrian", "through"), 0),
        **rates_at(density.hour),
        **figures,
    }

    def value(match: re.Match[str]) -> str:
        name = match[1]
        return values[name] if name == "box" else escaped(values[name])

    text = re.sub(r"@(\w+)@", value, template)
    return text.replace("\nseed = 1\n", f"\nseed = {density.seed}\n")


def escaped(value: object) -> str:
    """Text that cannot end a TOML string."""
    return re.sub(r'["\\]|[\x00-\x1f\x7f]', "_", str(value))


def _recipe(
    template: str,
    about: dict[str, str],
    density: Density,
    net_path: Path,
    gates: frozenset[str],
) -> str:
    """The recipe with the trips per hour for the wanted density, and through traffic."""
    import sumolib

    net = sumolib.net.readNet(str(net_path))
    streets = demand.streets_of(net, gates)
    figures: dict[str, float] = trips_per_hour(streets, density)
    sample = {kind: _SAMPLE * share for kind, share in SHARES.items()}
    sample["pedestrian"] = 1.0
    wanted = tomllib.loads(_filled(template, about, density, figures | sample))["demand"]
    build.route(streets, [], wanted | {"end_s": 3600}, net_path.parent)
    if free_s := _free_times_s(net, net_path.with_name("demand.rou.xml")):
        figures = trips_per_hour(streets, density, SLOWER * sum(free_s) / len(free_s))
    flows = gate_flows(net, streets, tomllib.loads(_filled(template, about, density, figures))["demand"])
    figures["through"] = float(round(sum(one.per_hour for one in flows)))
    return _filled(template, about, density, figures)


def _free_times_s(net: Any, path: Path) -> list[float]:
    """How long each vehicle of a file of routes would take at the speed limit, or at that of bicycles [s].

    Vehicles that start or stop at a kerb drive half of that street. `net` is a sumolib network.
    """
    found: list[float] = []
    vehicle: Attributes = {}

    def start(name: str, attributes: Attributes) -> None:
        nonlocal vehicle
        if name == "vehicle":
            vehicle = attributes
        elif name == "route":
            most_mps = BICYCLE_MPS if vehicle["type"] == "bicycle" else inf
            edges = [net.getEdge(edge) for edge in attributes["edges"].split()]
            times_s = [edge.getLength() / min(edge.getSpeed(), most_mps) for edge in edges]
            if "random" in vehicle["departPos"]:
                times_s[0] /= 2
            if "arrivalPos" in vehicle:
                times_s[-1] /= 2
            found.append(sum(times_s))

    stream(path, start)
    return found
