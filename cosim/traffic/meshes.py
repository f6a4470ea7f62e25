"""Solids of any shape in the city: meshes from files, placed by the config."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.traffic.fleet import ActorClass
from sensors.scene import Scene, Shape

SUFFIXES = (".glb", ".obj", ".ply", ".stl")

LARGEST_M = 1e5
"""Larger coordinates are taken for a mistake of units."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MeshParams:
    """A `[[meshes]]` section: one solid that LiDARs see in addition to the scenario's buildings."""

    file: str
    """Path of a closed mesh (.glb, .obj, .ply or .stl) in metres, relative to the config file. z points up; in .glb
    files, y does."""
    at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of its origin in the world frame: east, north, up [m]."""
    yaw_deg: float = 0.0
    """Rotation about the vertical axis, counter-clockwise seen from above [deg]."""
    scale: Annotated[float, Gt(0)] = 1.0
    """Metres per unit of the file."""


@dataclass(frozen=True, kw_only=True, slots=True)
class VehicleMeshParams:
    """A `[[vehicle_meshes]]` section: the shape that LiDARs see of all vehicles of a class, instead of prisms."""

    file: str
    """Path of a closed mesh (.glb, .obj, .ply or .stl), relative to the config file. +x points ahead and z up; in .glb
    files, y points up. The mesh is scaled to each vehicle's length, width and height."""
    vehicle_class: ActorClass = "car"
    """Class of the vehicles that have this shape. A class may have one section only."""


def check_vehicle_meshes(meshes: Sequence[VehicleMeshParams]) -> None:
    """Raise a ValueError if a class has two meshes."""
    classes = [mesh.vehicle_class for mesh in meshes]
    for number, name in enumerate(classes):
        if name in classes[:number]:
            raise ValueError(
                f'vehicle_meshes.{number}.vehicle_class = "{name}" has a mesh already. Leave one of the sections out.'
            )


def with_meshes(scene: Scene, meshes: Sequence[MeshParams], vehicle_meshes: Sequence[VehicleMeshParams] = ()) -> Scene:
    """Add meshes to a scene. A file without a closed mesh raises a ValueError of one line."""
    for number, body in enumerate(vehicle_meshes):
        vertices, faces = read(f"vehicle_meshes.{number}.file", Path(body.file))
        try:
            scene = scene.with_body(Shape[body.vehicle_class.upper()], vertices, faces)
        except ValueError as error:
            raise ValueError(f"vehicle_meshes.{number}.file = {body.file}: {error}") from None
    for number, mesh in enumerate(meshes):
        vertices, faces = read(f"meshes.{number}.file", Path(mesh.file))
        cos = np.cos(np.radians(mesh.yaw_deg))
        sin = np.sin(np.radians(mesh.yaw_deg))
        turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        placed = mesh.scale * vertices @ turn + mesh.at_m
        try:
            scene = scene.with_mesh(placed, faces)
        except ValueError as error:
            raise ValueError(f"meshes.{number}.file = {mesh.file}: {error}") from None
    return scene


def read(
    key: str,
    path: Path,
) -> tuple[Float[ndarray, "v 3"], Int[ndarray, "t 3"]]:
    """Read a mesh file.

    Parameters
    ----------
    key
        Key of the config that names the file, for error messages.

    Returns
    -------
    Vertices with z up, in the units of the file, and the triangles as rows of vertices.

    Raises
    ------
    ValueError
        The file cannot be read as a mesh. The message is one line.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{key} = {path}: no such form of mesh. Supported are {', '.join(SUFFIXES)}.")
    if not path.is_file():
        raise ValueError(f"{key} = {path}: no such file.")
    try:
        import trimesh
    except ImportError:
        raise ValueError(
            f"{key} = {path}: reading meshes needs trimesh, which is not installed. "
            "Install it: make extra NAME=mesh in a checkout, else pip install 'cosim-perception[mesh]'."
        ) from None
    try:
        mesh: Any = trimesh.load(path, force="mesh")
        vertices = np.asarray(mesh.vertices, float)
        faces = np.asarray(mesh.faces, np.int64)
    except Exception as error:  # a damaged file can raise any exception in the reader
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{key} = {path}: cannot be read as a mesh: {reason}.") from None
    is_placed = (np.abs(vertices) <= LARGEST_M).all()
    if not len(faces) or not is_placed:
        raise ValueError(f"{key} = {path}: has no triangles, or coordinates that are not finite or beyond 100 km.")
    if path.suffix.lower() == ".glb":
        vertices = vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    return vertices, faces
