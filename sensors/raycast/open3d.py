"""Open3D's RaycastingScene over the same prisms as triangle meshes: an optional third engine.

Open3D uses Embree inside, with tensors of rays; it runs with one thread here, so that a comparison is per core.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from sensors.raycast import mesh

INSTALL = (
    "make extra NAME=open3d in a checkout, else pip install 'cosim-perception[open3d]'; "
    "on Linux it also needs the system library libusb-1.0 (apt install libusb-1.0-0)"
)


def tracer_of(triangles: ndarray) -> mesh.Tracer:
    """Open3D, ready for rays.

    Parameters
    ----------
    triangles
        Corners (t, 3, 3) in single precision, in the frame of the rays. The tracer numbers triangles by their row.

    Raises
    ------
    ValueError
        If Open3D cannot be loaded.
    """
    try:
        import open3d  # 1-3 s, and 400 MB on disk: loaded only where the config names it
    except (ImportError, OSError) as missing:
        raise ValueError(
            f'lidar.engine = "open3d" needs Open3D, which cannot be loaded here ({missing}): {INSTALL}.'
        ) from None
    corner, face = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    solid = open3d.t.geometry.RaycastingScene(nthreads=1)
    tensor = open3d.core.Tensor.from_numpy
    solid.add_triangles(tensor(corner), tensor(face.reshape(-1, 3).astype(np.uint32)))

    def trace(start, direction):
        found = solid.cast_rays(tensor(np.concatenate([start, direction], axis=1)), nthreads=1)
        return found["t_hit"].numpy(), found["primitive_ids"].numpy().astype(np.int32)  # 2^32 - 1 becomes -1

    return trace
