"""OpenStreetMap extracts: the streets, buildings, stops and bus lines that a network is made of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

Tags = dict[str, str]


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

    place: dict[int, tuple[float, float]] = field(default_factory=dict)
    """(longitude, latitude) of every node [degrees]."""
    node_tags: dict[int, Tags] = field(default_factory=dict)
    ways: dict[int, Way] = field(default_factory=dict)
    relations: dict[int, Relation] = field(default_factory=dict)
    box: tuple[float, float, float, float] | None = None
    """West, south, east, north of what was asked for, if the file says so [degrees]; ways may reach beyond."""


def read(path: Path) -> Extract:
    """Read a .osm.pbf, .osm, .osm.gz, .osm.xml.gz or .osm.bz2 file.

    Raises
    ------
    ValueError
        Where osmium is not installed, or the file is not OpenStreetMap data.
    """
    try:
        import osmium
    except ImportError as error:
        raise ValueError("building a network from OpenStreetMap needs osmium: pip install 'cosim[build]'") from error
    try:
        box = osmium.io.Reader(str(path)).header().box()
        low, high = box.bottom_left, box.top_right
        extract = Extract(box=(low.lon, low.lat, high.lon, high.lat) if box.valid() else None)
        for item in osmium.FileProcessor(str(path)):
            if isinstance(item, osmium.osm.Changeset):
                continue
            tags = {tag.k: tag.v for tag in item.tags}
            if isinstance(item, osmium.osm.Node):
                extract.place[item.id] = (item.location.lon, item.location.lat)
                if tags:
                    extract.node_tags[item.id] = tags
            elif isinstance(item, osmium.osm.Way):
                extract.ways[item.id] = Way(item.id, tuple(node.ref for node in item.nodes), tags)
            elif isinstance(item, osmium.osm.Relation):
                members = tuple((member.type, member.ref, member.role) for member in item.members)
                extract.relations[item.id] = Relation(item.id, members, tags)
    except (RuntimeError, osmium.InvalidLocationError) as error:
        raise ValueError(f"{path} is not an OpenStreetMap file that osmium can read: {error}") from None
    if not extract.ways:
        raise ValueError(f"{path} has no ways: there is no street to build")
    return extract


def pieces(way: Way, place: Mapping[int, tuple[float, float]]) -> list[tuple[int, ...]]:
    """The runs of a way's nodes that lie inside the extract, at least two nodes each."""
    runs: list[tuple[int, ...]] = []
    run: list[int] = []
    for node in (*way.nodes, None):
        if node is not None and node in place:
            run.append(node)
            continue
        if len(run) > 1:
            runs.append(tuple(run))
        run = []
    return runs


def write(
    path: Path,
    place: Mapping[int, tuple[float, float]],
    node_tags: Mapping[int, Tags],
    ways: Iterable[Way],
    relations: Iterable[Relation] = (),
    nodes: Iterable[int] = (),
) -> None:
    """Write OpenStreetMap XML with the given nodes and those that the ways use, sorted by id."""
    ways = sorted(ways, key=lambda way: way.id)
    used = sorted({*nodes, *(node for way in ways for node in way.nodes)})
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
    lines = children + [f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in sorted(tags.items())]
    if not lines:
        out.write(f"  {head}/>\n")
        return
    out.write(f"  {head}>\n" + "".join(f"    {line}\n" for line in lines) + f"  </{name}>\n")
