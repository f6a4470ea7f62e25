"""The geometry that rays hit: actors as stacks of upright prisms, buildings as footprints with a base and a top."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.base.codes import ObjectClass
from cosim.base.ragged import offsets, owner_of_rows, ranges
from sensors.boxes import Boxes


class Hit(IntEnum):
    """The first object on a ray. Codes of ACTOR and above are actors: row = code - Hit.ACTOR."""

    NOTHING = 0
    GROUND = 1
    BUILDING = 2
    ACTOR = 3


class Shape(IntEnum):
    """Body types of actors: which prisms make up an actor."""

    CAR = 0
    VAN = 1
    TRUCK = 2
    BUS = 3
    MOTORCYCLE = 4
    BICYCLE = 5
    PEDESTRIAN = 6
    ROADSIDE_UNIT = 7
    """A sensor at the roadside. Its body is not modelled, so no ray meets it."""


_CLASS_OF = {
    Shape.CAR: ObjectClass.CAR,
    Shape.VAN: ObjectClass.CAR,
    Shape.TRUCK: ObjectClass.TRUCK,
    Shape.BUS: ObjectClass.TRUCK,
    Shape.MOTORCYCLE: ObjectClass.CYCLIST,
    Shape.BICYCLE: ObjectClass.CYCLIST,
    Shape.PEDESTRIAN: ObjectClass.PEDESTRIAN,
    Shape.ROADSIDE_UNIT: ObjectClass.CAR,  # never detected and never listed
}

LABEL_OF_SHAPE: UInt8[ndarray, "shape"] = np.array([_CLASS_OF[shape] for shape in Shape], np.uint8)
"""`ObjectClass` of each `Shape`."""

_STACKS = tomllib.loads(Path(__file__).with_name("bodies.toml").read_text(encoding="utf-8"))
_STACKED = [(shape, body) for shape in Shape for body in _STACKS[shape.name.lower()]]
_BODIES = [(shape, body["from_m"], body["prisms"]) for shape, body in _STACKED]
_PARTS = np.array([part for *_, stack in _BODIES for part in stack])
_FIRST_PART = np.cumsum([0] + [len(stack) for *_, stack in _BODIES])
"""Row of `_PARTS` at which the prisms of each body begin."""


class Prisms(NamedTuple):
    """Upright rectangular prisms, grouped by the actor they belong to; world frame."""

    ptr: ndarray
    """int64 [n+1]: the prisms of actor row a are ptr[a]..ptr[a+1]."""
    x_m: ndarray
    y_m: ndarray
    cos: ndarray
    sin: ndarray
    """Heading of the actor."""
    half_l_m: ndarray
    half_w_m: ndarray
    bottom_m: ndarray
    top_m: ndarray
    shape: ndarray
    """uint8 [n]: `Shape` of each actor."""
    speed_mps: ndarray
    """float64 [n]: speed of each actor along its heading, by which it moves while a sensor turns."""


def prisms(
    shape: UInt8[ndarray, "n"],
    boxes: Boxes,
    speed_mps: Float[ndarray, "n"] | None = None,
) -> Prisms:
    """The solid body of each actor inside its box.

    Parameters
    ----------
    shape
        `Shape` of each actor.
    boxes
        Box of each actor, world frame.
    speed_mps
        Speed of each actor along its heading. By default no actor moves.

    Raises
    ------
    ValueError
        If a shape code is no `Shape`, or there is not one shape, or not one speed, per box.

    Notes
    -----
    Trucks of 12.5 m or more are tractors with a trailer. Buses of 15 m or more are articulated but do not bend.
    """
    if len(shape) != len(boxes):
        raise ValueError(
            f"{len(shape)} shapes were given for {len(boxes)} boxes. Give one shape and one box per actor."
        )
    if speed_mps is not None and len(speed_mps) != len(boxes):
        raise ValueError(f"{len(speed_mps)} speeds were given for {len(boxes)} boxes. Give one speed per actor.")
    if len(shape) and int(np.max(shape)) >= len(Shape):
        row = int(np.argmax(shape))
        known = ", ".join(f"{s.value} {s.name}" for s in Shape)
        raise ValueError(f"shape[{row}] = {shape[row]} is no actor shape: use one of {known}.")
    body = np.zeros(len(boxes), int)
    for k, (s, least_m, _) in enumerate(_BODIES):
        body[(shape == s) & (boxes.lwh_m[:, 0] >= least_m)] = k
    parts = np.diff(_FIRST_PART)[body]
    actor = owner_of_rows(parts)
    rear, front, width, bottom, top = _PARTS[ranges(_FIRST_PART[body], parts)].T
    length, w, h = boxes.lwh_m[actor].T
    x, y, z = boxes.xyz_m[actor].T
    cos = np.cos(boxes.yaw_rad)[actor]
    sin = np.sin(boxes.yaw_rad)[actor]
    ahead = 0.5 * (rear + front) * length
    return Prisms(
        ptr=offsets(parts),
        x_m=x + cos * ahead,
        y_m=y + sin * ahead,
        cos=cos,
        sin=sin,
        half_l_m=0.5 * (front - rear) * length,
        half_w_m=0.5 * width * w,
        bottom_m=z + (bottom - 0.5) * h,
        top_m=z + (top - 0.5) * h,
        shape=np.asarray(shape, np.uint8),
        speed_mps=np.zeros(len(boxes)) if speed_mps is None else np.asarray(speed_mps, np.float64),
    )


def _no_prisms() -> Prisms:
    nowhere = np.zeros((0, 3))
    boxes = Boxes(nowhere, nowhere, np.zeros(0))
    return prisms(np.zeros(0, np.uint8), boxes)


class Buildings(NamedTuple):
    """Building walls, grouped by building; world frame."""

    ptr: ndarray
    """int64 [b+1]: the walls of building k are ptr[k]..ptr[k+1]."""
    ax_m: ndarray
    ay_m: ndarray
    bx_m: ndarray
    by_m: ndarray
    """A wall runs from a to b with the inside on its left."""
    base_m: ndarray
    top_m: ndarray
    bounds_m: ndarray
    """float64 [b, 4]: x min, y min, x max, y max."""


SMALLEST_M2 = 1e-4
"""Footprints of a smaller area are dropped."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Scene:
    """The static city: buildings as upright prisms on ground that is flat around each sensor."""

    buildings: Buildings
    footprints: ndarray
    """Shapely polygon of each building, valid, outer ring counter-clockwise."""
    triangles_m: Float[ndarray, "t 3 3"] | None = None
    """Other solids, as closed meshes. Embree and Open3D cast them, the columnar engine refuses them."""
    bodies_m: Mapping[int, Float[ndarray, "t 3 3"]] = field(default_factory=dict)
    """Closed meshes that replace the prisms of actors of a `Shape`. A mesh is 1 m long, wide and high around the origin
    and faces along +x; it is stretched to each actor's box. The same engines cast it."""
    trees: Prisms = field(default_factory=_no_prisms)
    """Trees (`sensors.trees`), whose returns have the code of buildings. All engines cast them."""

    @staticmethod
    def empty() -> Scene:
        """Flat ground without buildings."""
        return Scene.from_footprints([], [], [])

    @staticmethod
    def from_footprints(
        rings: Sequence[Sequence[Float[ndarray, "_ 2"]]],
        base_z_m: Float[ndarray, "n"] | Sequence[float],
        top_z_m: Float[ndarray, "n"] | Sequence[float],
    ) -> Scene:
        """A scene with buildings.

        Parameters
        ----------
        rings
            Per building its outer ring and then its holes, each (k, 2) in the world frame, closed or open, in any
            orientation.
        base_z_m, top_z_m
            Heights of the lower and upper end of the walls. A base above the road is a passage.

        Notes
        -----
        Footprints that cross themselves are split into valid parts. Footprints without area are left out.

        Raises
        ------
        ValueError
            If coordinates are not finite, a ring has fewer than three corners, or a top is not above its base.
        """
        base, top = np.asarray(base_z_m, float), np.asarray(top_z_m, float)
        if not len(rings) == len(base) == len(top):
            raise ValueError(f"{len(rings)} footprints, {len(base)} bases, {len(top)} tops: one of each per building.")
        bad = ~(np.isfinite(base) & np.isfinite(top) & (top > base))
        if bad.any():
            k = int(np.argmax(bad))
            raise ValueError(f"building {k}: top = {top[k]} m is not above base = {base[k]} m. Correct its height.")
        raw = []
        for k, building in enumerate(rings):
            loops = [np.asarray(ring, float) for ring in building]
            for loop in loops:
                is_ring = loop.ndim == 2 and loop.shape[1] == 2 and len(loop) >= 3
                if not is_ring or not np.isfinite(loop).all():
                    raise ValueError(
                        f"building {k}: a ring of shape {loop.shape} is no footprint. "
                        "A ring is three or more finite (x, y) corners; a building is a sequence of rings, outer first."
                    )
            raw.append(shapely.Polygon(loops[0], loops[1:]))
        polygons = np.array(raw, dtype=object)
        broken = ~np.asarray(shapely.is_valid(polygons), bool)
        polygons[broken] = shapely.make_valid(polygons[broken])
        parts, owner = shapely.get_parts(polygons, return_index=True)
        parts, index = shapely.get_parts(parts, return_index=True)  # a repair may nest what it splits
        owner = owner[index]
        is_polygon = shapely.get_type_id(parts) == shapely.GeometryType.POLYGON
        solid = is_polygon & (shapely.area(parts) > SMALLEST_M2)
        parts, owner = parts[solid], owner[solid]
        parts = shapely.orient_polygons(parts)
        return Scene(_walls(parts, base[owner], top[owner]), parts)

    def with_mesh(self, vertices_m: Float[ndarray, "v 3"], faces: Int[ndarray, "t 3"]) -> Scene:
        """This scene with one more solid, such as a tree or a bridge. Its returns have the code of buildings.

        Parameters
        ----------
        vertices_m
            Vertices in the world frame [m].
        faces
            Vertices of each triangle, counter-clockwise seen from outside.

        Raises
        ------
        ValueError
            If the mesh is not closed, or a face names a vertex that does not exist.
        """
        own = _closed(vertices_m, faces)
        both = own if self.triangles_m is None else np.concatenate([self.triangles_m, own])
        return replace(self, triangles_m=both)

    def with_body(self, shape: Shape, vertices_m: Float[ndarray, "v 3"], faces: Int[ndarray, "t 3"]) -> Scene:
        """This scene with a mesh as the body of all actors of a shape.

        Parameters
        ----------
        shape
            Shape of the actors.
        vertices_m, faces
            A closed mesh that faces along +x, with +z up; faces as in `with_mesh`.

        Raises
        ------
        ValueError
            If the mesh is not closed or flat, or a face names a vertex that does not exist.
        """
        own = _closed(vertices_m, faces)
        low, high = own.min(axis=(0, 1)), own.max(axis=(0, 1))
        if not (high - low > 0).all():
            raise ValueError("a mesh without length, width or height is no body. Every extent must be above 0.")
        unit = (own - 0.5 * (low + high)) / (high - low)
        return replace(self, bodies_m={**self.bodies_m, int(shape): unit})


def _closed(
    vertices_m: Float[ndarray, "v 3"],
    faces: Int[ndarray, "t 3"],
) -> Float[ndarray, "t 3 3"]:
    """Triangles of a closed mesh; ValueError for any other."""
    vertices, faces = np.asarray(vertices_m, float), np.asarray(faces, int)
    names_vertices = len(faces) and faces.min() >= 0 and faces.max() < len(vertices)
    if not names_vertices or not np.isfinite(vertices).all():
        raise ValueError(
            f"a mesh of {len(vertices)} vertices and {len(faces)} faces: each face names three of the vertices, "
            "from 0 on, and each vertex has three finite coordinates."
        )
    _, same = np.unique(vertices, axis=0, return_inverse=True)
    n_open = _open_edges(same.reshape(-1)[faces])
    if n_open:
        raise ValueError(
            f"a mesh with {n_open} open edges: its inside would be visible. Every edge must belong to two faces "
            "that run along it in opposite directions; close the holes and turn faces that are inside out."
        )
    return vertices[faces]


def _open_edges(faces: Int[ndarray, "t 3"]) -> int:
    """Directed edges without exactly one partner in the opposite direction."""
    first, second = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    n = int(faces.max()) + 1
    there = first * n + second
    back = second * n + first
    key, count = np.unique(there, return_counts=True)
    is_single = count[np.searchsorted(key, there)] == 1
    at = np.minimum(np.searchsorted(key, back), len(key) - 1)
    has_partner = (key[at] == back) & (count[at] == 1)
    return int((~(is_single & has_partner)).sum())


def _walls(polygons: ndarray, base: ndarray, top: ndarray) -> Buildings:
    """Walls of valid, oriented polygons."""
    loop, owner = shapely.get_rings(polygons, return_index=True)
    xy, ring = shapely.get_coordinates(loop, return_index=True)
    begin = np.flatnonzero(ring[1:] == ring[:-1])
    has_length = (xy[begin] != xy[begin + 1]).any(axis=1)
    begin = begin[has_length]
    a, b = xy[begin], xy[begin + 1]
    building = owner[ring[begin]]
    ptr = np.searchsorted(building, np.arange(len(polygons) + 1))
    return Buildings(
        ptr=ptr.astype(np.int64),
        ax_m=np.ascontiguousarray(a[:, 0]),
        ay_m=np.ascontiguousarray(a[:, 1]),
        bx_m=np.ascontiguousarray(b[:, 0]),
        by_m=np.ascontiguousarray(b[:, 1]),
        base_m=np.ascontiguousarray(base),
        top_m=np.ascontiguousarray(top),
        bounds_m=np.ascontiguousarray(shapely.bounds(polygons)),
    )


@lru_cache(maxsize=4)
def roof_triangles(scene: Scene) -> tuple[Float[ndarray, "t 3 2"], ndarray]:
    """Triangles that cover every footprint, for engines that cast meshes.

    Returns
    -------
    x and y of the corners of each triangle, world frame [m], and the row of its building.
    """
    pieces, owner = shapely.get_parts(shapely.constrained_delaunay_triangles(scene.footprints), return_index=True)
    corner = shapely.get_coordinates(shapely.get_exterior_ring(pieces)).reshape(-1, 4, 2)  # the last is the first
    return corner[:, :3], owner
