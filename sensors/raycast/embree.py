"""Embree (Intel's ray tracing kernels, through embreex) over the same prisms as triangle meshes.

Slower than the columnar caster and independent of it: a reference for it, and the caster of arbitrary meshes.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from sensors.raycast import mesh

INSTALL = "make extra NAME=embree in a checkout, else pip install 'cosim-perception[embree]'"


def tracer_of(triangles: ndarray) -> mesh.Tracer:
    """Embree, ready for rays.

    Parameters
    ----------
    triangles
        Corners (t, 3, 3) in single precision, in the frame of the rays. The tracer numbers triangles by their row.

    Raises
    ------
    ValueError
        If Embree cannot be loaded.
    """
    try:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh
    except (ImportError, OSError) as missing:  # there are no wheels for Linux on ARM
        raise ValueError(
            f'lidar.engine = "embree" needs embreex, which cannot be loaded here ({missing}): {INSTALL}. '
            'lidar.engine = "open3d" casts the same rays.'
        ) from None
    solid = rtcore_scene.EmbreeScene()
    TriangleMesh(solid, np.ascontiguousarray(triangles))

    def trace(start, direction):
        found = solid.run(start, direction, output=True)
        return found["tfar"], found["primID"]

    return trace
