"""Footprints and heights of the buildings in an OpenStreetMap extract."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass

import shapely
from shapely import Polygon

from sumo_nets.footprints import Footprint, footprint_of, pieces_of
from sumo_nets.ground import Ground
from sumo_nets.heights import CLEARANCE_M, Height, height_of, stands
from sumo_nets.osm import Extract, Tags, Way
from sumo_nets.sumotools import Ring

SIMPLIFY_M = 0.15
"""Largest displacement of a wall by simplification [m]."""
PASSAGE_M2 = 25.0
"""A building that covers more carriageway than this bridges it; less is a drawing error and cut off [m²]."""

Solid = tuple[str, shapely.Geometry, Height]

Chains = list[list[int]]
"""Nodes, chain by chain."""
Rings = dict[str, tuple[Chains, Chains, Tags]]


@dataclass(frozen=True, slots=True)
class MappedBuildings:
    """Named footprints, with counts by origin."""

    footprints: list[tuple[str, Footprint]]
    heights: Counter[str]
    """Number of footprints by source of their height."""
    cut: int
    """Footprints that lost a strip to the street."""
    bridging: int
    """Pieces raised over a street that runs below them."""


def rings_of(extract: Extract) -> Rings:
    """Outer and inner rings (node ids) and tags of every building and building part, by name."""
    found: Rings = {}
    for way in extract.ways.values():
        is_closed = way.nodes and way.nodes[0] == way.nodes[-1]
        if is_closed and stands(way.tags):
            ring = [node for node in way.nodes[:-1] if node in extract.place]
            if len(ring) > 2:
                found[f"w{way.id}"] = ([ring], [], way.tags)
    for relation in extract.relations.values():
        if relation.tags.get("type") != "multipolygon" or not stands(relation.tags):
            continue
        chains: dict[bool, Chains] = {True: [], False: []}
        parts = []  # outer ways that are parts of this building, not another copy of it
        for kind, ref, role in relation.members:
            if kind == "w" and ref in extract.ways:
                nodes = [node for node in extract.ways[ref].nodes if node in extract.place]
                if len(nodes) > 1:
                    chains[role != "inner"].append(nodes)
                if role != "inner" and f"w{ref}" in found:
                    way_is_part, relation_is_part = _is_part(extract.ways[ref].tags), _is_part(relation.tags)
                    if way_is_part == relation_is_part:
                        del found[f"w{ref}"]
                    elif way_is_part:
                        parts.append(f"w{ref}")
        outer, inner = _joined(chains[True]), _joined(chains[False])
        if outer:
            found[f"r{relation.id}"] = (outer, inner, relation.tags)
        for part in parts:
            rings, _, tags = found[part]
            found[part] = rings, inner, tags
    return dict(sorted(found.items()))


def build(
    rings: Rings,
    project: Callable[[list[Way]], dict[int, Ring]],
    ground: Ground,
) -> MappedBuildings:
    """Footprints in network coordinates, parts taking the place of the outline they refine.

    `project` turns ways into rings in the network's coordinates; `ground` is kept free of buildings.
    """
    ways: list[Way] = []
    owner: list[tuple[str, bool]] = []
    for name, (outer, inner, _) in rings.items():
        for ring in (*outer, *inner):
            closed = *ring, ring[0]
            ways.append(Way(len(ways) + 1, closed, {"building": "yes"}))
        owner += [(name, True)] * len(outer)
        owner += [(name, False)] * len(inner)
    projected = project(ways)
    shells: dict[tuple[str, bool], list[Polygon]] = defaultdict(list)
    for way, of in zip(ways, owner, strict=True):
        if way.id in projected and len(projected[way.id]) > 3:
            shells[of] += pieces_of(Polygon(projected[way.id]))
    shape = {}
    for name in sorted({name for name, _ in shells}):
        whole = shapely.union_all(shells[name, True])
        shape[name] = whole.difference(shapely.union_all(shells[name, False]))
    tags = {name: rings[name][2] for name in shape}
    return _standing(_refined(shape, tags), ground)


def _is_part(tags: Tags) -> bool:
    """Whether a building part has no outline of a building among its tags."""
    return tags.get("building", "no") == "no"


def _joined(chains: Chains) -> Chains:
    """Chains of nodes joined end to end into rings; an open chain is closed by a straight wall."""
    chains = [list(chain) for chain in chains]
    rings = []
    while chains:
        ring = chains.pop(0)
        while ring[0] != ring[-1]:
            for i, chain in enumerate(chains):
                if ring[-1] in (chain[0], chain[-1]):
                    onward = chain if chain[0] == ring[-1] else chain[::-1]
                    ring += onward[1:]
                    del chains[i]
                    break
            else:
                break
        if ring[0] == ring[-1]:
            ring = ring[:-1]
        if len(ring) > 2:
            rings.append(ring)
    return rings


def _refined(
    shape: dict[str, shapely.Geometry],
    tags: dict[str, Tags],
) -> list[Solid]:
    """Parts are kept as they are; an outline keeps the area that no part covers, and the volume below raised parts."""
    parts = [name for name in shape if _is_part(tags[name])]
    solids = []
    for name in parts:
        height = height_of(tags[name], shape[name].area)
        solids.append((name, shape[name], height))
    tree = shapely.STRtree([solid for _, solid, _ in solids])
    done = list(solids)
    for name, outline in shape.items():
        if name in parts:
            continue
        height = height_of(tags[name], outline.area)
        inside = [solids[i] for i in sorted(tree.query(outline, predicate="intersects"))]
        for _, part, extent in sorted(inside, key=lambda solid: solid[2].base_z_m):
            if extent.base_z_m > height.base_z_m:
                below = Height(height.base_z_m, extent.base_z_m, extent.source)
                done.append((name, outline.intersection(part), below))
            outline = outline.difference(part)
        done.append((name, outline, height))
    return done


def _standing(solids: list[Solid], ground: Ground) -> MappedBuildings:
    street = shapely.union(*ground)
    shapely.prepare(street)
    footprints: list[tuple[str, Footprint]] = []
    heights: Counter[str] = Counter()
    cut = bridging = 0
    used: Counter[str] = Counter()

    def place(of: Solid) -> tuple[str, Height, bytes]:
        name, solid, height = of
        return name, height, solid.wkb

    for name, solid, height in sorted(solids, key=place):
        solid = solid.simplify(SIMPLIFY_M)
        layers = [(solid, height.base_z_m)]
        if height.base_z_m < CLEARANCE_M and street.intersects(solid):
            over = solid.intersection(street)
            layers = [(solid.difference(street), height.base_z_m)]
            if over.intersection(ground.carriageway).area > PASSAGE_M2 and height.top_z_m > CLEARANCE_M:
                layers.append((over, CLEARANCE_M))
                bridging += 1
            cut += 1
        for shape, base in layers:
            for piece in pieces_of(shapely.set_precision(shape, 0.01)):
                footprint = footprint_of(piece, base, height.top_z_m)
                footprints.append((f"{name}.{used[name]}", footprint))
                heights[height.source] += 1
                used[name] += 1
    return MappedBuildings(footprints, heights, cut, bridging)
