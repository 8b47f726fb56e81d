"""Import pymeshlab where it works: on some machines it has no wheel or misses a graphics library."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

if TYPE_CHECKING:
    from pymeshlab import MeshSet

_LARGEST_HOLE = 1 << 20  # edges


def mesh_set(vertices: Array, faces: NDArray[np.int64], option: str) -> MeshSet:
    """Return a MeshSet that holds one mesh.

    Parameters
    ----------
    vertices : ndarray, (n, 3)
    faces : ndarray of int, (m, 3)
    option : str
        What asks for it, for the message.

    Raises
    ------
    StapeskitError
        pymeshlab cannot be imported here.
    """
    try:
        import pymeshlab
    except (ImportError, OSError) as fault:
        step = "Run pip install pymeshlab (on Debian also apt-get install libgl1 libopengl0)"
        raise StapeskitError.of(option, "used where pymeshlab works", fault, next_step=step) from fault
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces.astype(np.int32)))
    return meshes


def filled(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]] | None:
    """Return a mesh of one piece with its holes filled; None where pymeshlab cannot fill them.

    Raises
    ------
    StapeskitError
        pymeshlab cannot be imported here.
    """
    meshes = mesh_set(vertices, faces, "--close")
    from pymeshlab import PyMeshLabException

    try:
        meshes.meshing_repair_non_manifold_edges()
        meshes.meshing_re_orient_faces_coherently()
        meshes.meshing_close_holes(maxholesize=_LARGEST_HOLE, selfintersection=False)
    except PyMeshLabException:
        return None
    mesh = meshes.current_mesh()
    return mesh.vertex_matrix(), mesh.face_matrix().astype(np.int64)
