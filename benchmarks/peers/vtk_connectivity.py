"""Level given, threshold, VTK connectivity, VTK flying edges on the box of the stapes, trimesh."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.peers import common


def main(scan: Path, folder: Path, level: float) -> None:
    """Run."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkImagingMorphological import vtkImageConnectivityFilter

    volume, spacing = common.read_stack(scan)
    mask = (volume > level).view(np.uint8)
    connectivity = vtkImageConnectivityFilter()
    connectivity.SetInputData(common.image(mask, spacing))
    connectivity.SetScalarRange(1, 1)
    connectivity.SetSizeRange(int(0.3 / spacing**3), int(1e12))
    connectivity.SetExtractionModeToAllRegions()
    connectivity.SetLabelModeToSizeRank()
    connectivity.SetLabelScalarTypeToUnsignedChar()
    connectivity.GenerateRegionExtentsOn()
    connectivity.Update()
    sizes = vtk_to_numpy(connectivity.GetExtractedRegionSizes())
    number = common.nearest_in_volume(sizes, spacing)
    stapes = int(vtk_to_numpy(connectivity.GetExtractedRegionLabels())[number])
    extent = vtk_to_numpy(connectivity.GetExtractedRegionExtents())[number]
    part = [slice(int(extent[2 * k]), int(extent[2 * k + 1]) + 1) for k in (2, 1, 0)]
    box = common.widened(part, volume.shape)
    labels = vtk_to_numpy(connectivity.GetOutput().GetPointData().GetScalars()).reshape(volume.shape)[box]
    grey = common.alone(volume[box].astype(np.float32), labels, stapes, 0.0)
    points, faces = common.flying_edges(grey, spacing, level + 0.25)
    start = np.array([s.start for s in reversed(box)]) * spacing
    common.mesh_and_mass(folder, points + start, faces)
    common.write_labels(folder, labels == stapes, box, spacing)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))
