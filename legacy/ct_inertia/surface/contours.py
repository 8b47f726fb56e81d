"""Triangles where a field crosses a level: by a compiled kernel, else by VTK's flying edges, which agree."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.native import checked, compiled, shape_of
from legacy.stapeskit.arrays import Array

Indices = NDArray[np.int64]


def contoured(field: NDArray[np.float32], level: float) -> tuple[Array, Indices]:
    """Return points (n, 3; index x, y, z) and faces (m, 3) where a field [z, y, x] crosses a level.

    Notes
    -----
    Marching cubes with linear interpolation along the edges; a value at the level counts as above it.
    """
    values = np.ascontiguousarray(field, dtype=np.float32)
    kernels = compiled()
    if kernels is None:
        return _by_vtk(values, level)
    points, faces = ctypes.c_void_p(), ctypes.c_void_p()
    n_points, n_faces = ctypes.c_int64(), ctypes.c_int64()
    results = [ctypes.addressof(part) for part in (points, n_points, faces, n_faces)]
    checked(kernels.contoured(values.ctypes.data, shape_of(values), level, *results))
    return (
        _copy_and_free(kernels, points, n_points.value, np.dtype(np.float64)),
        _copy_and_free(kernels, faces, n_faces.value, np.dtype(np.int64)),
    )


def _copy_and_free(kernels: Any, memory: ctypes.c_void_p, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return a copy of rows of three in the memory of a kernel, and free it."""
    out = np.empty((count, 3), dtype=dtype)
    if memory.value:
        ctypes.memmove(out.ctypes.data, memory.value, out.nbytes)
        kernels.released(memory)
    return out


def _by_vtk(values: NDArray[np.float32], level: float) -> tuple[Array, Indices]:
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    image = vtkImageData()
    image.SetDimensions(*values.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(), deep=False))
    edges = vtkFlyingEdges3D()
    edges.SetInputData(image)
    edges.SetValue(0, float(level))
    edges.ComputeNormalsOff()
    edges.ComputeGradientsOff()
    edges.ComputeScalarsOff()
    edges.Update()
    result = edges.GetOutput()
    if result.GetNumberOfPolys() == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    points = vtk_to_numpy(result.GetPoints().GetData()).astype(float)
    return points, vtk_to_numpy(result.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
