"""Level given, SimpleITK threshold, connected components and label statistics; mesh by scikit-image."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.peers import common


def main(scan: Path, folder: Path, level: float) -> None:
    """Run."""
    import SimpleITK as sitk
    import trimesh
    from skimage.measure import marching_cubes

    volume, spacing = common.read_stack(scan)
    image = sitk.GetImageFromArray(volume)
    image.SetSpacing((spacing,) * 3)
    mask = sitk.BinaryThreshold(image, level, float(np.iinfo(volume.dtype).max), 1, 0)
    labels = sitk.ConnectedComponent(mask)
    statistics = sitk.LabelShapeStatisticsImageFilter()
    statistics.ComputePerimeterOff()
    statistics.Execute(labels)
    numbers = statistics.GetLabels()
    sizes = [statistics.GetNumberOfPixels(number) for number in numbers]
    stapes = int(numbers[common.nearest_in_volume(sizes, spacing)])
    x, y, z, nx, ny, nz = statistics.GetBoundingBox(stapes)
    box = common.widened((slice(z, z + nz), slice(y, y + ny), slice(x, x + nx)), volume.shape)
    part = sitk.GetArrayViewFromImage(labels)[box]
    axes = np.array(statistics.GetPrincipalAxes(stapes)).reshape(3, 3)
    volume_mm3 = statistics.GetPhysicalSize(stapes)
    second = axes.T @ np.diag(statistics.GetPrincipalMoments(stapes)) @ axes * volume_mm3
    inertia = np.trace(second) * np.eye(3) - second
    common.write_mass(folder, volume_mm3, statistics.GetCentroid(stapes), inertia)
    grey = common.alone(volume[box].astype(np.float32), part, stapes, 0.0)
    vertices, faces, _, _ = marching_cubes(grey, level + 0.25, spacing=(spacing,) * 3)
    start = np.array([s.start for s in box]) * spacing
    mesh = trimesh.Trimesh((vertices + start)[:, ::-1], faces[:, ::-1], process=False)
    if mesh.volume < 0.0:
        mesh.invert()
    mesh.export(folder / "stapes.ply")
    common.write_labels(folder, part == stapes, box, spacing)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))
