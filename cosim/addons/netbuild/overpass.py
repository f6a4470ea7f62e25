"""OpenStreetMap data of a bounding box from an Overpass service, through SUMO's osmGet.py."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from math import cos, radians
from pathlib import Path

from sumo_nets import sumotools
from sumo_nets.osm import Box

MOST_KM2 = 1000.0
"""Largest box that is fetched."""
TIME_LIMIT_S = 900.0
"""Time limit [s]; a service takes up to 240 s for an answer, and osmGet.py knows three of them."""
RETRY_S = 3
"""Delay between attempts where a service is busy [s]."""

_KM_PER_DEGREE = 111.2


def degrees(text: str) -> Box:
    """The box that "west,south,east,north" says; ValueError where it is none, or too large."""
    try:
        west, south, east, north = (float(value) for value in text.split(","))
    except ValueError:
        raise ValueError(f"--bbox {text}: four numbers are wanted: west,south,east,north in degrees.") from None
    if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):
        raise ValueError(f"--bbox {text}: west < east and south < north in degrees are wanted: west,south,east,north.")
    width = (east - west) * cos(radians((south + north) / 2))
    km2 = width * (north - south) * _KM_PER_DEGREE**2
    if km2 > MOST_KM2:
        raise ValueError(
            f"--bbox {text}: {km2:,.0f} km², and at most {MOST_KM2:,.0f} km² are fetched at once. Is the order "
            "west,south,east,north? Choose a smaller box, or give the extract of a region with --osm FILE."
        )
    return west, south, east, north


def fetch(box: Box, server: str | None = None) -> bytes:
    """OpenStreetMap XML of a box, which names the box as files of openstreetmap.org do.

    `server` is the address of another Overpass service than the public ones: http://host/api/interpreter.

    Raises
    ------
    ValueError
        One line: why there is none.
    """
    with tempfile.TemporaryDirectory(prefix="sumo_nets.") as folder:
        tool = sumotools.home() / "tools" / "osmGet.py"
        corners = ",".join(map(repr, box))
        words = [sys.executable, str(tool), f"--bbox={corners}", "-p", "map", "-d", folder]
        words += ["--retry-delay", str(RETRY_S), *(["--url", server] if server else [])]
        try:
            done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=TIME_LIMIT_S)
        except subprocess.TimeoutExpired:
            raise ValueError(f"the Overpass service gave no answer within {TIME_LIMIT_S:g} s") from None
        found = sorted(Path(folder).glob("map*.osm.xml"))
        if done.returncode != 0 or not found:
            said = (done.stderr.strip() or done.stdout.strip() or "it brought nothing").splitlines()[-1]
            raise ValueError(f"OpenStreetMap's Overpass service cannot be reached, or is busy ({_plain(said)})")
        return _bounded(found[0].read_bytes(), box)


def _plain(said: str) -> str:
    """The last line of a traceback without the names of Python's exceptions."""
    return re.sub(r"<urlopen error (.*)>", r"\1", said.partition(": ")[2] or said)


def _bounded(xml: bytes, box: Box) -> bytes:
    """A response with its bounding box, and without osmGet.py's comment on time and machine.

    A service that stopped early says so in an otherwise complete response (`<remark>`): refused.
    """
    if remark := re.search(rb"<remark>\s*(.*?)\s*</remark>", xml, re.DOTALL):
        said = " ".join(remark[1].decode(errors="replace").split())
        raise ValueError(f"the Overpass service gave up ({said}); choose a smaller box, or try again later")
    west, south, east, north = box
    bounds = f'\n  <bounds minlat="{south!r}" minlon="{west!r}" maxlat="{north!r}" maxlon="{east!r}"/>'.encode()
    xml = re.sub(rb"<!-- generated on .*?-->\s*", b"", xml, count=1, flags=re.DOTALL)
    return re.sub(rb"<osm\b[^>]*>", lambda match: match[0] + bounds, xml, count=1)
