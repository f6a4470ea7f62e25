"""Point clouds in the formats that other tools read, as bytes; the caller writes the files."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int32
from numpy import ndarray

from sensors.lidar import Sweeps

Cloud = tuple[Float[ndarray, "k 3"], Int32[ndarray, "k"]]
"""Points in the sensor frame (x forward, y left, z up) [m], and what returned there, as a `Hit` code."""


def cloud_of(sweeps: Sweeps, o: int) -> Cloud:
    """The returns of one observer, column by column, each from the lowest beam up."""
    return sweeps.xyz(o), sweeps.hit[o][sweeps.has_return(o)]


def npy(cloud: Cloud) -> bytes:
    """NumPy: float32 (k, 3)."""
    file = io.BytesIO()
    np.save(file, cloud[0].astype("<f4"))
    return file.getvalue()


def kitti(cloud: Cloud) -> bytes:
    """KITTI's velodyne files: float32 x, y, z, reflectance; there is no reflectance here, hence 0."""
    xyz, _ = cloud
    rows = np.column_stack([xyz, np.zeros(len(xyz))])
    return rows.astype("<f4").tobytes()


def ply(cloud: Cloud) -> bytes:
    """Polygon file format, binary; `hit` beside the coordinates."""
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(cloud[0])}",
        *(f"property float {axis}" for axis in "xyz"),
        "property int hit",
        "end_header",
        "",
    ]
    return "\n".join(head).encode() + _records(cloud).tobytes()


def pcd(cloud: Cloud) -> bytes:
    """Point cloud library's format 0.7, binary; `hit` beside the coordinates."""
    return _pcd_head(cloud, "binary") + _records(cloud).tobytes()


def pcd_ascii(cloud: Cloud) -> bytes:
    """Point cloud library's format 0.7, as text."""
    file = io.BytesIO()
    np.savetxt(file, np.column_stack(cloud), fmt=["%.4f", "%.4f", "%.4f", "%d"])
    return _pcd_head(cloud, "ascii") + file.getvalue()


def _pcd_head(cloud: Cloud, data: str) -> bytes:
    n = len(cloud[0])
    head = [
        "VERSION 0.7",
        "FIELDS x y z hit",
        "SIZE 4 4 4 4",
        "TYPE F F F I",
        "COUNT 1 1 1 1",
        f"WIDTH {n}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {n}",
        f"DATA {data}",
        "",
    ]
    return "\n".join(head).encode()


def _records(cloud: Cloud) -> ndarray:
    xyz, hit = cloud
    rows = np.empty(len(xyz), [("xyz", "<f4", 3), ("hit", "<i4")])
    rows["xyz"], rows["hit"] = xyz, hit
    return rows


FORMATS: dict[str, Callable[[Cloud], bytes]] = {
    ".npy": npy,
    ".bin": kitti,
    ".ply": ply,
    ".pcd": pcd,
    ".pcd.txt": pcd_ascii,
}
"""Encoders by file name suffix."""
