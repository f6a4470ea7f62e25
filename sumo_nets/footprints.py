"""Building footprints: polygons with courtyards and heights, in SUMO's polygon files.

SUMO's `<poly>` has one ring. Ours carry the rest as parameters, which SUMO ignores:
`base_z_m`, `top_z_m`, and one `hole.<n>` per courtyard (a shape like the poly's own). A user's file
(polyconvert with `--all-attributes`) carries OpenStreetMap's tags as parameters instead.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float, Int
from numpy import ndarray
from shapely import Polygon

from sumo_nets import sumotools
from sumo_nets.heights import height_of, stands
from sumo_nets.sumotools import Ring
from sumo_nets.xml import Attributes, is_true, stream

_HEIGHTS = frozenset(("height", "building:height", "building:levels", "top_z_m", "levels", "min_height"))
"""Parameters of a polygon that only something of a height has."""


class Footprint(NamedTuple):
    """One building's outline and vertical extent, in the network's coordinates.

    Rings are closed (the last point repeats the first); the outer one runs counter-clockwise, holes clockwise.
    """

    outer: Float[ndarray, "k 2"]
    holes: list[Float[ndarray, "h 2"]]
    base_z_m: float
    top_z_m: float
    height_from: str = "given"
    """Where the height comes from: "given" as such, or as in `heights.Height`."""

    @property
    def polygon(self) -> Polygon:
        """The footprint as a Shapely polygon."""
        return Polygon(self.outer, self.holes)


class OtherPolygons(NamedTuple):
    """Polygons of one type that are no buildings."""

    n: int
    n_high: int
    """Those with a height or a number of storeys, as buildings have."""


def read_footprints(path: Path | str, net_path: Path | None = None) -> list[Footprint]:
    """The buildings of a SUMO polygon file; see `read_polygons`."""
    return read_polygons(path, net_path)[0]


def read_polygons(
    path: Path | str,
    net_path: Path | None,
) -> tuple[list[Footprint], dict[str, OtherPolygons]]:
    """Buildings of a SUMO polygon file (.poly.xml, gzip'ed or not), in the file's order, and the others by type.

    Polygons count as buildings if their type starts with "building" or they carry a `building` or
    `building:part` parameter, unless these say that it is gone, planned or underground. Heights come from `base_z_m`
    and `top_z_m`, else from OpenStreetMap's tags (`height`, `building:levels`, ...) or the attribute `height`, which
    polyconvert writes, else from the kind and size of the building. Rings that cross themselves are repaired; where
    that yields several pieces, each is a footprint; those without area are left out.
    Longitudes and latitudes (`geo="true"`) are projected as the network of `net_path` is.

    Raises
    ------
    ValueError
        Names the file, the polygon and the cause.
    """
    found: list[tuple[Attributes, Attributes]] = []
    others: dict[str, OtherPolygons] = {}
    poly: Attributes | None = None
    params: Attributes = {}

    def start(name: str, attributes: Attributes) -> None:
        nonlocal poly, params
        if name == "poly":
            poly, params = attributes, {}
        elif name == "param" and poly is not None:
            params[attributes.get("key", "").lower()] = attributes.get("value", "")  # shapefiles have HEIGHT

    def end(name: str) -> None:
        nonlocal poly
        if name == "poly" and poly is not None:
            kind = poly.get("type", "")
            tags = _tags(poly, params)
            if stands(tags):
                found.append((poly, params))
            else:
                n, n_high = others.get(kind, (0, 0))
                is_high = "building" not in tags and not _HEIGHTS.isdisjoint(tags)
                others[kind] = OtherPolygons(n + 1, n_high + is_high)
            poly = None

    stream(path, start, end)
    buildings = [building for building, _ in found]
    where = [f"{path}: polygon {building.get('id', '?')!r}" for building in buildings]
    shapes = [building.get("shape", "") for building in buildings]
    outer = list(map(_ring, shapes, where))
    geo = [k for k, building in enumerate(buildings) if is_true(building.get("geo", ""))]
    if geo:
        projected = _projected([outer[k] for k in geo], net_path, where[geo[0]])
        for k, ring in zip(geo, projected, strict=True):
            outer[k] = ring
    return _footprints(outer, found, where), others


def pieces_of(shape: shapely.Geometry) -> list[Polygon]:
    """The valid polygons of any geometry, oriented, slivers left out."""
    return list(_pieces(np.array([shape]))[0])


def _pieces(shapes: ndarray) -> tuple[ndarray, Int[ndarray, "p"]]:
    """Valid polygons of 1 m² or more of many geometries, and the row of the shape that each belongs to."""
    shapes = shapes.copy()
    torn = ~shapely.is_valid(shapes)
    shapes[torn] = shapely.make_valid(shapes[torn])
    parts, of_shape = shapely.get_parts(shapes, return_index=True)
    parts, of_part = shapely.get_parts(parts, return_index=True)
    is_polygon = shapely.get_type_id(parts) == shapely.GeometryType.POLYGON
    kept = is_polygon & (shapely.area(parts) >= 1.0)
    return shapely.orient_polygons(parts[kept]), of_shape[of_part[kept]]


def footprint_of(polygon: Polygon, base_z_m: float, top_z_m: float) -> Footprint:
    """A footprint from an oriented, valid polygon."""
    (rings,) = _rings_of(np.array([polygon]))
    return Footprint(rings[0], rings[1:], base_z_m, top_z_m)


def _rings_of(polygons: ndarray) -> list[list[Float[ndarray, "k 2"]]]:
    """Of each polygon, the outer ring and those of its holes."""
    rings, of_polygon = shapely.get_rings(polygons, return_index=True)
    points, of_ring = shapely.get_coordinates(rings, return_index=True)
    found: list[list[Float[ndarray, "k 2"]]] = [[] for _ in polygons]
    n_points = np.bincount(of_ring, minlength=len(rings))
    ends = np.cumsum(n_points)
    for row, first, end in zip(of_polygon, ends - n_points, ends, strict=True):
        found[row].append(points[first:end])
    return found


def write_footprints(path: Path, footprints: Iterable[tuple[str, Footprint]]) -> None:
    """Write (id, footprint) pairs as a SUMO polygon file with centimetre coordinates."""
    with path.open("w", encoding="utf-8", newline="\n") as out:
        out.write('<?xml version="1.0" encoding="UTF-8"?>\n<additional>\n')
        for name, (outer, holes, base, top, _) in footprints:
            out.write(
                f'    <poly id="{name}" type="building" color="0.72,0.66,0.58" fill="1" layer="-1"'
                f' shape="{_shape(outer)}">\n'
                f'        <param key="base_z_m" value="{base:.2f}"/>\n'
                f'        <param key="top_z_m" value="{top:.2f}"/>\n'
            )
            for n, hole in enumerate(holes):
                out.write(f'        <param key="hole.{n}" value="{_shape(hole)}"/>\n')
            out.write("    </poly>\n")
        out.write("</additional>\n")


def _shape(ring: Float[ndarray, "k 2"]) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in ring)


def _projected(rings: list[Ring], net_path: Path | None, where: str) -> list[Ring]:
    """Rings of longitudes and latitudes in the coordinates of a network."""
    try:
        if net_path is None:
            raise ValueError("no network is known")
        return sumotools.projected(rings, net_path)
    except ValueError as error:
        raise ValueError(f'{where}: geo="true", but {error}') from None


def _footprints(
    outer: list[Ring],
    found: list[tuple[Attributes, Attributes]],
    where: list[str],
) -> list[Footprint]:
    """Those of all polygons of a file."""
    rings: list[Ring] = []
    of_polygon: list[int] = []
    kept: list[int] = []
    for k, ring in enumerate(outer):
        _, params = found[k]
        inner = [value for key, value in params.items() if key.startswith("hole.")]
        holes = [_ring(shape, where[k]) for shape in inner]
        if len(ring) > 3:
            own = [ring, *(hole for hole in holes if len(hole) > 3)]
            rings += own
            of_polygon += [len(kept)] * len(own)
            kept.append(k)
    if not kept:
        return []
    of_ring = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    lines = shapely.linearrings(np.concatenate(rings), indices=of_ring)
    polygons = shapely.polygons(lines, indices=of_polygon)
    heights = []
    for k, area_m2 in zip(kept, shapely.area(polygons).tolist(), strict=True):
        heights.append(_extent(*found[k], area_m2, where[k]))
    pieces, of_piece = _pieces(polygons)
    rings_of = _rings_of(pieces)
    made = []
    for (ring, *holes), k in zip(rings_of, of_piece.tolist(), strict=True):
        made.append(Footprint(ring, holes, *heights[k]))
    return made


def _tags(poly: Attributes, params: Attributes) -> Attributes:
    """OpenStreetMap's tags of a polygon: its parameters, the kind of building that its type says, and its height."""
    tags = {"height": poly["height"]} if "height" in poly else {}
    kind = poly.get("type", "").lower()
    if kind.startswith("building"):
        tags["building"] = kind.removeprefix("building").lstrip(".") or "yes"
    return tags | params


def _extent(poly: Attributes, params: Attributes, area_m2: float, where: str) -> tuple[float, float, str]:
    """Base and top of a building [m], and where its height comes from."""
    height = height_of(_tags(poly, params), area_m2)
    base = _metres(params.get("base_z_m"), height.base_z_m, where)
    top = _metres(params.get("top_z_m"), height.top_z_m, where)
    if not 0.0 <= base < top:
        raise ValueError(f"{where}: reaches from {base} m to {top} m; a building's top must lie above its base")
    return base, top, "given" if "top_z_m" in params else height.source


def _ring(text: str, where: str) -> Ring:
    pairs = [point.split(",")[:2] for point in text.split()]
    try:
        points = np.array([list(map(float, pair)) for pair in pairs])
    except ValueError:
        raise ValueError(f"{where}: shape {text[:40]!r}... is not a list of x,y pairs") from None
    if points.shape[1:] != (2,) or not np.isfinite(points).all():
        raise ValueError(f"{where}: shape {text[:40]!r}... is not a list of finite x,y pairs")
    if not (points[0] == points[-1]).all():
        points = np.vstack([points, points[:1]])
    return points


def _metres(text: str | None, otherwise: float, where: str) -> float:
    if text is None:
        return otherwise
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise ValueError(f"{where}: {text!r} is not a height in metres")
    return value
