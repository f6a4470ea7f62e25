"""SUMO's command-line tools, run in a given folder."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sumo_nets.osm import Extract, Places, Point, Way, write
from sumo_nets.xml import Attributes, Enough, stream

Ring = Float[ndarray, "k 2"]
"""Corners of a polygon; the last one is the first."""


def home() -> Path:
    """SUMO_HOME of the installed package.

    Raises
    ------
    ValueError
        In one line: SUMO's tools are not installed.
    """
    try:
        import sumo
    except ImportError as error:
        raise ValueError(
            "building cities, and the cities of SUMO's package, need eclipse-sumo, which is not installed. "
            "Install it: make extra NAME=build in a checkout, else pip install 'cosim-perception[build]'."
        ) from error

    return Path(sumo.SUMO_HOME)


def run(tool: str, options: dict[str, Any], folder: Path) -> str:
    """Run a tool in `folder`; returns its standard error.

    Raises
    ------
    ValueError
        If the tool fails; with its message.
    """
    words = [str(home() / "bin" / tool)]
    for key, value in options.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        words += [f"--{key}", text]
    environment = {**os.environ, "SUMO_HOME": str(home())}
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        errors = [line.removeprefix("Error: ") for line in done.stderr.splitlines() if line.startswith("Error: ")]
        reason = " ".join(errors) or " ".join(done.stderr.split())[-2000:]
        raise ValueError(f"{tool} failed: {reason}")
    return done.stderr


def without_header(path: Path) -> str:
    """A tool's XML without the comment that names the time and the machine."""
    return re.sub(r"<!-- generated on .*?-->\s*", "", path.read_text(encoding="utf-8"), count=1, flags=re.DOTALL)


def projected(rings: list[Ring], net_path: Path) -> list[Ring]:
    """Rings of longitudes and latitudes in the coordinates of a network, by polyconvert.

    Raises
    ------
    ValueError
        If the network has no projection.
    """
    polygons = ""
    for k, ring in enumerate(rings):
        shape = " ".join(f"{x!r},{y!r}" for x, y in ring.tolist())
        polygons += f'<poly id="{k}" type="building" geo="true" shape="{shape}"/>'

    def location(name: str, attributes: Attributes) -> None:
        if name == "location":
            if attributes.get("projParameter", "!") in ("!", "-"):
                raise ValueError(f"{net_path} has no projection. Give its polygons in metres.")
            raise Enough

    stream(net_path, location)
    with tempfile.TemporaryDirectory(prefix="sumo_nets.") as folder:
        given, flat = Path(folder) / "geo.xml", Path(folder) / "flat.xml"
        given.write_text(f"<additional>{polygons}</additional>", encoding="utf-8")
        options = {"net-file": net_path.name, "xml-files": given, "output-file": flat, "precision": 4}
        run("polyconvert", options, net_path.parent)
        found = _rings(flat)
    return [found[k] for k in range(len(rings))]


def _rings(path: Path) -> dict[int, Ring]:
    """The polygons that polyconvert wrote, by id."""
    found: dict[int, Ring] = {}

    def start(name: str, attributes: Attributes) -> None:
        if name == "poly":
            found[int(attributes["id"])] = _points(attributes["shape"])

    stream(path, start)
    return found


def _points(shape: str) -> Ring:
    return np.array([point.split(",") for point in shape.split()], float)


class Projector:
    """Longitudes and latitudes in the coordinates of a network, by polyconvert."""

    def __init__(self, extract: Extract, net_path: Path) -> None:
        self._extract = extract
        self._net_path = net_path

    def ways(self, ways: list[Way], more: Places | None = None) -> dict[int, Ring]:
        """Closed ways as rings, by id, with `more` nodes; polyconvert leaves out what has no area."""
        folder = self._net_path.parent
        source, target = folder / "project.osm.xml", folder / "project.poly.xml"
        write(source, {**self._extract.place, **(more or {})}, {}, ways)
        options = {
            "net-file": self._net_path.name,
            "osm-files": source.name,
            "type-file": home() / "data" / "typemap" / "osmPolyconvert.typ.xml",
            "output-file": target.name,
        }
        run("polyconvert", options, folder)
        return _rings(target)

    def nodes(self, nodes: list[int]) -> dict[int, Point]:
        """Nodes as points: each is the first corner of a small triangle."""
        corners: dict[int, Point] = {}
        ways = []
        for i, node in enumerate(nodes):
            lon, lat = self._extract.place[node]
            east, north = -2 * i - 1, -2 * i - 2
            corners[east] = (lon + 1e-4, lat)
            corners[north] = (lon, lat + 1e-4)
            ways.append(Way(i + 1, (node, east, north, node), {"building": "yes"}))
        rings = self.ways(ways, corners)
        found: dict[int, Point] = {}
        for i, node in enumerate(nodes):
            x, y = rings[i + 1][0, :2].tolist()
            found[node] = (x, y)
        return found
