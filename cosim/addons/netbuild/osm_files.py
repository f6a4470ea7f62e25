"""Reads OpenStreetMap files of any kind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cosim.addons.netbuild import osm_pbf, osm_xml
from cosim.addons.netbuild.streets import PIECE
from sumo_nets.osm import Box, Extract

MOST_INCOMPLETE_P = 0.2
"""A file with a larger share of ways without places is refused."""


def is_pbf(path: Path) -> bool:
    return path.suffix.lower() == ".pbf"


def read(path: Path, box: Box | None = None) -> Extract:
    """Read a .osm.pbf, .osm, .osm.gz, .osm.xml.gz or .osm.bz2 file.

    With `box` (west, south, east, north in degrees), only what has a node in it: ways are kept whole, as an Overpass
    service sends them, and so are relations with a member that is kept.

    The order of the elements means nothing. Of several copies of an element, one with tags counts. Elements that an
    editor has marked as deleted are left out (`osm_xml`).

    Raises
    ------
    ValueError
        Where osmium is needed and not installed, the file is not OpenStreetMap data, or the box holds no street.
    """
    whole, extract = (osm_pbf if is_pbf(path) else osm_xml).read(path, box)
    extract = replace(extract, box=box or whole)
    if not extract.ways:
        where = "" if box is None else " in the box {:g},{:g},{:g},{:g}".format(*box)
        reach = "" if whole is None else " The file reaches over {:g},{:g},{:g},{:g}.".format(*whole)
        raise ValueError(f"{path} has no ways{where}: there is no street to build.{reach if box else ''}")
    extract = _on_one_side(_numbered(extract), path)
    known = extract.place.keys()
    placed = {}
    for number, way in extract.ways.items():
        if not known.isdisjoint(way.nodes):
            placed[number] = way
    n = len(extract.ways) - len(placed)
    if n > MOST_INCOMPLETE_P * len(extract.ways):
        raise ValueError(
            f"{path} has {n:,} ways without the places of their nodes, of {len(extract.ways):,}. Ask Overpass for the "
            "nodes too: out body; >; out skel qt;"
        )
    return replace(extract, ways=placed, n_incomplete=n)


def _on_one_side(extract: Extract, path: Path) -> Extract:
    """Without places beyond the meridian of 180 degrees from the box. A ValueError is raised if there is no box."""
    lons = [lon for lon, _ in extract.place.values()]
    if max(lons, default=0.0) - min(lons, default=0.0) < 180:
        return extract
    west, _, east, _ = extract.box or (0.0,) * 4
    if not 0 < east - west < 180:
        raise ValueError(
            f"{path} reaches over 180 degrees of longitude, where numbers jump to -180. Cut out what is on one side "
            "with --bbox west,south,east,north."
        )
    middle = (west + east) / 2
    place = {}
    for node, (lon, lat) in extract.place.items():
        if abs(lon - middle) < 180:
            place[node] = lon, lat
    return replace(extract, place=place)


def _numbered(extract: Extract) -> Extract:
    """With numbers of ways above 0: editors number new ways below it, and netconvert a street's other direction."""
    if all(way >= 0 for way in extract.ways):
        return extract
    renumbered = [replace(way, id=way.id % PIECE) for way in extract.ways.values()]
    relations = {}
    for number, relation in extract.relations.items():
        members = []
        for kind, ref, role in relation.members:
            members.append((kind, ref % PIECE if kind == "w" else ref, role))
        relations[number] = replace(relation, members=tuple(members))
    return replace(extract, ways={way.id: way for way in renumbered}, relations=relations)
