"""Solids of any form in the city: meshes from files, placed as the config says."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.mobility.fleet import ActorClass
from sensors.scene import Scene, Shape

SUFFIXES = (".glb", ".obj", ".ply", ".stl")

LARGEST_M = 1e5
"""Coordinates beyond are a mistake of units."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MeshParams:
    """One solid that LiDARs see, besides the buildings of the scenario: a `[[meshes]]` section."""

    file: str
    """A closed mesh, .glb, .obj, .ply or .stl, in metres; relative to the config file. z is up; in .glb, y."""
    at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where its origin stands: east, north, up in the world frame [m]."""
    yaw_deg: float = 0.0
    """How far it is turned, counter-clockwise seen from above [deg]."""
    scale: Annotated[float, Gt(0)] = 1.0
    """Metres per unit of the file."""


@dataclass(frozen=True, kw_only=True, slots=True)
class VehicleMeshParams:
    """The body that all vehicles of a class have for LiDARs, instead of prisms: a `[[vehicle_meshes]]` section."""

    file: str
    """A closed mesh, .glb, .obj, .ply or .stl; relative to the config file. Ahead is +x, up is z; in .glb, y. It is
    stretched to each vehicle's length, width and height."""
    vehicle_class: ActorClass = "car"
    """Whose body it is: one section for a class."""


def check_vehicle_meshes(meshes: Sequence[VehicleMeshParams]) -> None:
    """ValueError where a class has two bodies."""
    classes = [mesh.vehicle_class for mesh in meshes]
    for number, name in enumerate(classes):
        if name in classes[:number]:
            raise ValueError(
                f'vehicle_meshes.{number}.vehicle_class = "{name}" has a mesh already. Leave one of the sections out.'
            )


def with_meshes(scene: Scene, meshes: Sequence[MeshParams], vehicle_meshes: Sequence[VehicleMeshParams] = ()) -> Scene:
    """The scene with these solids and bodies; ValueError in one line where a file is no closed mesh."""
    for number, body in enumerate(vehicle_meshes):
        vertices, faces = read(f"vehicle_meshes.{number}.file", Path(body.file))
        try:
            scene = scene.with_body(Shape[body.vehicle_class.upper()], vertices, faces)
        except ValueError as error:
            raise ValueError(f"vehicle_meshes.{number}.file = {body.file}: {error}") from None
    for number, mesh in enumerate(meshes):
        vertices, faces = read(f"meshes.{number}.file", Path(mesh.file))
        cos, sin = np.cos(np.radians(mesh.yaw_deg)), np.sin(np.radians(mesh.yaw_deg))
        placed = mesh.scale * vertices @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + mesh.at_m
        try:
            scene = scene.with_mesh(placed, faces)
        except ValueError as error:
            raise ValueError(f"meshes.{number}.file = {mesh.file}: {error}") from None
    return scene


def read(key: str, path: Path) -> tuple[Float[ndarray, "v 3"], Int[ndarray, "t 3"]]:
    """Vertices, z up, and triangles of a mesh file; `key` of the config is for errors."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{key} = {path}: no such form of mesh. There are {', '.join(SUFFIXES)}.")
    if not path.is_file():
        raise ValueError(f"{key} = {path}: no such file.")
    try:
        import trimesh
    except ImportError:
        raise ValueError(
            f"{key} = {path}: trimesh reads meshes, and it is not installed. "
            "Install it: make extra NAME=mesh in a checkout, else pip install 'cosim-perception[mesh]'."
        ) from None
    try:
        mesh: Any = trimesh.load(path, force="mesh")
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # whatever a damaged file makes of the reader
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{key} = {path}: cannot be read as a mesh: {reason}.") from None
    if not len(faces) or not np.isfinite(vertices).all() or np.abs(vertices).max() > LARGEST_M:
        raise ValueError(f"{key} = {path}: holds no triangles, or coordinates that are no place in a city.")
    if path.suffix.lower() == ".glb":
        vertices = vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    return vertices, faces
