"""Triangle surfaces as VTK holds them and back, without pyvista: its import takes longer than a page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stapeskit.arrays import Array

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkPolyData


def polydata(vertices: ArrayLike, faces: ArrayLike) -> vtkPolyData:
    """Return a surface of vertices (n, 3) and triangles (m, 3)."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    points, cells, surface = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(vertices, dtype=float), deep=True))
    numbered = np.insert(np.asarray(faces, dtype=np.int64), 0, 3, axis=1)
    cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(numbered.ravel(), deep=True))
    surface.SetPoints(points)
    surface.SetPolys(cells)
    return surface


def arrays_of(surface: vtkPolyData) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices (n, 3) and triangles (m, 3) of a surface that has no other faces."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    faces = np.array(vtk_to_numpy(surface.GetPolys().GetConnectivityArray()), dtype=np.int64)
    return np.array(vtk_to_numpy(surface.GetPoints().GetData()), dtype=float), faces.reshape(-1, 3)
