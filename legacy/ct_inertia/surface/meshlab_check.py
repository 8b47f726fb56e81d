"""A second program's view of a surface: pymeshlab's volume, centre, inertia and topology.

The only file that imports pymeshlab (GPL-3, needs the GL libraries); without it nothing else is missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.surface.surface import Surface


@dataclass(frozen=True)
class SecondOpinion:
    """What pymeshlab finds of a surface, against the surface's own moments.

    Attributes
    ----------
    volume_difference : float
        Relative.
    centroid_difference_mm : float
        Distance.
    inertia_difference : float
        Largest difference of the tensor about the centroid, relative to its largest entry.
    genus : int
        Holes through the body.
    two_manifold : bool
        Closed, and no edge or vertex where sheets meet.
    """

    volume_difference: float
    centroid_difference_mm: float
    inertia_difference: float
    genus: int
    two_manifold: bool


def second_opinion(surface: Surface) -> SecondOpinion | None:
    """Measure a surface with pymeshlab; None where pymeshlab or its GL libraries are missing.

    Parameters
    ----------
    surface : Surface
        Closed, outward, mm.
    """
    try:
        import pymeshlab
    except (ImportError, OSError):
        return None
    own = surface.moments()
    # pymeshlab's moments lose digits far from the origin, so it sees the body about its own centroid
    centred: NDArray[np.float64] = surface.vertices_mm - own.centroid_mm
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(centred, surface.faces.astype(np.int32)))
    measures, shape = meshes.get_geometric_measures(), meshes.get_topological_measures()
    if "mesh_volume" not in measures:
        return None
    tensor = np.asarray(measures["inertia_tensor"])
    return SecondOpinion(
        volume_difference=float(measures["mesh_volume"] / own.volume_mm3 - 1.0),
        centroid_difference_mm=float(np.linalg.norm(measures["center_of_mass"])),
        inertia_difference=float(np.abs(tensor - own.inertia_mm5).max() / np.abs(own.inertia_mm5).max()),
        genus=int(shape["genus"]),
        two_manifold=bool(shape["is_mesh_two_manifold"] and shape["boundary_edges"] == 0),
    )
