"""OpenStreetMap extracts in XML, as the planet's servers, Overpass and JOSM write them.

Overpass writes elements in any order, members of relations a second time without tags (`out skel`), and geometries
inside ways and relations (`out geom`). JOSM keeps deleted elements in the file (`action="delete"`).
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from sumo_nets.osm import Box, Extract, Relation, Tags, Way, is_within
from sumo_nets.xml import Attributes, chunks, stream

_KINDS = {"node": "n", "way": "w", "relation": "r"}
_FIRST_OWN = 10**15
"""Numbers of nodes that a file gives by their places only begin here; OpenStreetMap's own have 11 digits."""


def read(path: Path, box: Box | None) -> tuple[Box | None, Extract]:
    """The box of a file, if it has one, and its content, as in `osm.read`."""
    check_form(path)
    reader = _Reader()
    try:
        stream(path, reader.start, reader.end, reader.text.append)
    except ValueError as error:
        cause = str(error).removeprefix(f"{path}, ").removeprefix(f"{path}: ")
        raise ValueError(f"{path} is not an OpenStreetMap file that can be read: {cause}") from None
    return reader.box, reader.extract if box is None else _cropped(reader.extract, box)


def check_form(path: Path) -> None:
    """Refuse JSON and web pages, which Overpass sends too, in one line."""
    head = next(chunks(path), b"")[:2000].lstrip(b"\xef\xbb\xbf \t\r\n")
    if head[:1] in (b"{", b"["):
        raise ValueError(f"{path} is JSON. Ask Overpass for XML, [out:xml];, or give a .osm.pbf.")
    if head[:14].lower().startswith((b"<!doctype html", b"<html")):
        raise ValueError(f"{path} is a web page, not an OpenStreetMap file: the download has failed. Fetch it again.")


class _Reader:
    """Collects the elements of a file."""

    def __init__(self) -> None:
        self.extract = Extract()
        self.box: Box | None = None
        self.text: list[str] = []
        self._version: Counter[tuple[str, int]] = Counter()
        self._own: dict[tuple[float, float], int] = {}
        self._depth = 0
        self._head: Attributes = {}
        self._tags: Tags = {}
        self._nodes: list[int] = []
        self._members: list[tuple[str, int, str]] = []
        self._member_nodes: list[int] = []

    def start(self, name: str, attributes: Attributes) -> None:
        self._depth += 1
        if self._depth == 1 and name != "osm":
            raise ValueError(f"it starts with <{name}>, a map starts with <osm>")
        if self._depth == 2:
            self._head, self._tags, self._nodes, self._members = attributes, {}, [], []
            self.text.clear()
            if name == "action":
                raise ValueError("it lists changes (<action>), and is no map. Ask Overpass without [adiff] or [diff]")
            if name == "bounds":
                self._bound(attributes)
        elif name == "tag":
            self._tags[attributes["k"]] = attributes["v"]
        elif name == "nd":
            nodes = self._nodes if self._depth == 3 else self._member_nodes
            nodes.append(self._node(attributes))
        elif name == "member":
            kind = _KINDS.get(attributes["type"], "")
            self._members.append((kind, int(attributes["ref"]), attributes.get("role", "")))
            self._member_nodes = []

    def end(self, name: str) -> None:
        self._depth -= 1
        if self._depth == 2 and name == "member" and self._member_nodes:
            kind, ref, _ = self._members[-1]
            if kind == "w":
                self.extract.ways.setdefault(ref, Way(ref, tuple(self._member_nodes), {}))
        elif self._depth == 1 and name == "remark":
            said = " ".join("".join(self.text).split())
            raise ValueError(f"Overpass gave up before its end ({said}). Fetch it again, or a smaller region")
        elif self._depth == 1 and name in _KINDS:
            self._keep(name)

    def _keep(self, kind: str) -> None:
        """Put an element into the extract, or merge it with a copy of itself."""
        number = int(self._head["id"])
        version = int(self._head.get("version", 0))
        extract = self.extract
        if version < self._version[kind, number]:
            return
        self._version[kind, number] = version
        if self._head.get("action") == "delete" or self._head.get("visible") == "false":
            if kind == "node":
                extract.place.pop(number, None)
                extract.node_tags.pop(number, None)
            else:
                _of(extract, kind).pop(number, None)
            self._version[kind, number] = version + 1  # a copy of it does not bring it back
        elif kind == "node":
            if "lat" in self._head:
                extract.place[number] = _place(self._head)
            if self._tags:
                extract.node_tags[number] = self._tags
        elif kind == "way":
            way = extract.ways.get(number, Way(number, (), {}))
            nodes = tuple(self._nodes) or way.nodes
            extract.ways[number] = Way(number, nodes, self._tags or way.tags)
        else:
            relation = extract.relations.get(number, Relation(number, (), {}))
            members = tuple(self._members) or relation.members
            extract.relations[number] = Relation(number, members, self._tags or relation.tags)

    def _node(self, attributes: Attributes) -> int:
        """Number of a node of a way, whose place may be given with it."""
        if "lat" not in attributes:
            return int(attributes["ref"])
        place = _place(attributes)
        own = self._own.setdefault(place, _FIRST_OWN + len(self._own))
        number = int(attributes["ref"]) if "ref" in attributes else own
        self.extract.place.setdefault(number, place)
        return number

    def _bound(self, attributes: Attributes) -> None:
        """Widen the box: JOSM writes one for every region that was downloaded."""
        west, south, east, north = (float(attributes[key]) for key in ("minlon", "minlat", "maxlon", "maxlat"))
        w, s, e, n = self.box or (west, south, east, north)
        low = min(w, west), min(s, south)
        high = max(e, east), max(n, north)
        self.box = *low, *high


def _of(extract: Extract, kind: str) -> dict:
    return extract.ways if kind == "way" else extract.relations


def _place(attributes: Attributes) -> tuple[float, float]:
    """Longitude and latitude, to OpenStreetMap's seven digits."""
    lon, lat = (round(float(attributes[key]), 7) for key in ("lon", "lat"))
    if not (-180 <= lon <= 180 and -90 <= lat <= 90):
        raise ValueError(f"a node is at lat = {attributes['lat']}, lon = {attributes['lon']}, which is not on Earth")
    return lon, lat


def _cropped(extract: Extract, box: Box) -> Extract:
    """What has a node in the box: ways whole, and relations with a member that is kept."""
    inside = {node for node, place in extract.place.items() if is_within(*place, box)}
    ways = {}
    used = set(inside)
    for number, way in extract.ways.items():
        if not inside.isdisjoint(way.nodes):
            ways[number] = way
            used |= set(way.nodes)
    kept = {"n": inside, "w": ways.keys()}
    relations = {}
    for number, relation in extract.relations.items():
        members = [ref in kept.get(kind, ()) for kind, ref, _ in relation.members]
        if any(members):
            relations[number] = relation
    place = {node: where for node, where in extract.place.items() if node in used}
    tags = {node: tags for node, tags in extract.node_tags.items() if node in inside}
    return Extract(place, tags, ways, relations)
