"""OpenStreetMap extracts in Protocol Buffers (.osm.pbf), through osmium."""

from __future__ import annotations

from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any

from sumo_nets.osm import Box, Extract, Relation, Way, is_within


def read(path: Path, box: Box | None) -> tuple[Box | None, Extract]:
    """The box of a file, if it has one, and its content, as in `osm.read`.

    A region can be larger than memory, so that it is read several times, and only what is in the box is kept.
    """
    try:
        import osmium
    except ImportError as error:
        raise ValueError(
            "building a network from OpenStreetMap needs osmium, which is not installed. "
            "Install it: make extra NAME=build in a checkout, else pip install 'cosim-perception[build]'."
        ) from error

    file = osmium.io.File(str(path), "pbf")

    def items(kind: Any) -> Iterator[Any]:
        read: Any = osmium.FileProcessor(file, kind)
        return (item for item in read if item.visible)

    try:
        header = osmium.io.Reader(file).header().box()
        low, high = header.bottom_left, header.top_right
        whole = (low.lon, low.lat, high.lon, high.lat) if header.valid() else None
        extract = Extract()
        for node in items(osmium.osm.NODE):
            if box is None or is_within(node.location.lon, node.location.lat, box):
                extract.place[node.id] = (node.location.lon, node.location.lat)
                if tags := dict(node.tags):
                    extract.node_tags[node.id] = tags
        missing: set[int] = set()
        for way in items(osmium.osm.WAY):
            nodes = tuple(node.ref for node in way.nodes)
            outside = [node for node in nodes if node not in extract.place] if box is not None else []
            if box is None or len(outside) < len(nodes):
                missing.update(outside)
                extract.ways[way.id] = Way(way.id, nodes, dict(way.tags))
        kept: dict[str, Container[int]] = {
            "n": extract.place,
            "w": extract.ways,
            "r": (),
        }
        for relation in items(osmium.osm.RELATION):
            members = tuple((member.type, member.ref, member.role) for member in relation.members)
            is_near = any(ref in kept[kind] for kind, ref, _ in members)
            if box is None or is_near:
                extract.relations[relation.id] = Relation(relation.id, members, dict(relation.tags))
        for node in items(osmium.osm.NODE) if missing else ():
            if node.id in missing:
                extract.place[node.id] = (node.location.lon, node.location.lat)
    except (RuntimeError, osmium.InvalidLocationError) as error:
        raise ValueError(f"{path} is not an OpenStreetMap file that osmium can read: {error}") from None
    return whole, extract
