"""OpenStreetMap extracts: the streets, buildings, stops and bus lines that a network is made of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from xml.sax.saxutils import quoteattr

Tags = dict[str, str]
Box = tuple[float, float, float, float]
"""West, south, east, north [degrees]."""
Point = tuple[float, float]
Places = Mapping[int, Point]
"""(longitude, latitude) of nodes by id [degrees]."""


@dataclass(frozen=True, slots=True)
class Way:
    """A chain of nodes with its tags."""

    id: int
    nodes: tuple[int, ...]
    tags: Tags


@dataclass(frozen=True, slots=True)
class Relation:
    """Members as (type, id, role), type one of "n", "w", "r"."""

    id: int
    members: tuple[tuple[str, int, str], ...]
    tags: Tags


@dataclass(frozen=True, slots=True)
class Extract:
    """An OpenStreetMap extract in memory; ways may name nodes that were cut off at its edge."""

    place: dict[int, Point] = field(default_factory=dict)
    """(longitude, latitude) of every node [degrees]."""
    node_tags: dict[int, Tags] = field(default_factory=dict)
    ways: dict[int, Way] = field(default_factory=dict)
    relations: dict[int, Relation] = field(default_factory=dict)
    box: Box | None = None
    """What was asked for, if the file says so; ways may reach beyond."""
    n_incomplete: int = 0
    """Ways that are left out because the file has the place of none of their nodes."""


def is_within(lon: float, lat: float, box: Box) -> bool:
    west, south, east, north = box
    return west <= lon <= east and south <= lat <= north


def pieces(way: Way, place: Places) -> list[tuple[int, ...]]:
    """The runs of a way's nodes that lie inside the extract, at least two nodes each."""
    runs = [tuple(run) for is_inside, run in groupby(way.nodes, place.__contains__) if is_inside]
    return [run for run in runs if len(run) > 1]


def write(
    path: Path,
    place: Places,
    node_tags: Mapping[int, Tags],
    ways: Iterable[Way],
    relations: Iterable[Relation] = (),
) -> None:
    """Write OpenStreetMap XML with the given ways and relations and the nodes of the ways, sorted by id."""
    ways = sorted(ways, key=lambda way: way.id)
    used = sorted({node for way in ways for node in way.nodes})
    with path.open("w", encoding="utf-8") as out:
        out.write('<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6">\n')
        for node in used:
            lon, lat = place[node]
            head = f'<node id="{node}" version="1" lat="{lat:.7f}" lon="{lon:.7f}"'
            _element(out, head, "node", node_tags.get(node, {}), [])
        for way in ways:
            refs = [f'<nd ref="{node}"/>' for node in way.nodes]
            _element(out, f'<way id="{way.id}" version="1"', "way", way.tags, refs)
        kinds = {"n": "node", "w": "way", "r": "relation"}
        for relation in sorted(relations, key=lambda relation: relation.id):
            refs = [
                f'<member type="{kinds[kind]}" ref="{ref}" role={quoteattr(role)}/>'
                for kind, ref, role in relation.members
            ]
            _element(out, f'<relation id="{relation.id}" version="1"', "relation", relation.tags, refs)
        out.write("</osm>\n")


def _element(out, head: str, name: str, tags: Tags, children: list[str]) -> None:
    for key, value in sorted(tags.items()):
        children.append(f"<tag k={quoteattr(key)} v={quoteattr(value)}/>")
    lines = "".join(f"    {line}\n" for line in children)
    if not lines:
        out.write(f"  {head}/>\n")
        return
    out.write(f"  {head}>\n{lines}  </{name}>\n")
