"""The surfaces that ct2mass leaves beside mass.json, and signed distances from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.polydata import arrays_of, polydata
from stapeskit.records.mass_record import MassRecord

BODIES = ("stapes", "plate")


@dataclass(frozen=True)
class Surface:
    """A closed triangle surface in scan coordinates: vertices (n, 3), mm, and outward faces (m, 3)."""

    name: str
    vertices_mm: Array
    faces: NDArray[np.int64]

    @cached_property
    def edge_mm(self) -> float:
        """Median length of an edge, mm: about one voxel on a surface from a scan."""
        corners = self.vertices_mm[self.faces[: 20 * (len(self.faces) // 20) or None]]
        return float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))

    @cached_property
    def _distance(self) -> Any:
        from vtkmodules.vtkFiltersCore import vtkImplicitPolyDataDistance

        distance = vtkImplicitPolyDataDistance()
        distance.SetInput(polydata(self.vertices_mm, self.faces))
        return distance

    def signed(self, points_mm: Array) -> tuple[Array, Array]:
        """Return the distances (n,), mm, outside positive, and their gradients (n, 3), of points (n, 3)."""
        away = np.empty(len(points_mm))
        gradient = np.empty((len(points_mm), 3))
        for row, point in enumerate(np.asarray(points_mm, dtype=float).tolist()):
            away[row] = self._distance.EvaluateFunction(point)
            self._distance.EvaluateGradient(point, gradient[row])
        length = np.linalg.norm(gradient, axis=1)
        return away, gradient / np.where(length > 0.0, length, 1.0)[:, None]


def surfaces_of(mass: MassRecord) -> dict[str, Surface]:
    """Return the surfaces of a mass by name, from memory or from the folder of its file.

    Raises
    ------
    StapeskitError
        A file of a surface is there and holds none.
    """
    if mass.file is None:
        return {name: Surface(name, *mesh) for name, mesh in mass.meshes.items() if name in BODIES}
    paths = {name: mass.file.parent / f"{name}.ply" for name in BODIES}
    return {name: _read(path, name) for name, path in paths.items() if path.is_file()}


def _read(path: Path, name: str) -> Surface:
    from vtkmodules.vtkCommonCore import vtkObject
    from vtkmodules.vtkIOPLY import vtkPLYReader

    vtkObject.GlobalWarningDisplayOff()
    reader = vtkPLYReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput()
    if data.GetNumberOfPolys() == 0 or data.GetPolys().IsHomogeneous() != 3:
        step = "Run ct2mass anew, or remove the file"
        raise StapeskitError.of(
            f"the surface {path.name}", "made of triangles", "none", path.parent.name, step
        )
    return Surface(name, *arrays_of(data))
