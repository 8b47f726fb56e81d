"""Gauss filter, multi-Otsu with three classes, scipy label, scikit-image marching cubes, trimesh."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.peers import common


def main(scan: Path, folder: Path) -> None:
    """Run; the level is its own."""
    from scipy.ndimage import find_objects, label
    from skimage.filters import gaussian, threshold_multiotsu
    from skimage.measure import marching_cubes

    volume, spacing = common.read_stack(scan)
    smooth = gaussian(volume.astype(np.float32), 1.0, preserve_range=True)
    del volume
    level = float(threshold_multiotsu(smooth, 3)[1])
    labels, _ = label(smooth > level)
    boxes = find_objects(labels)
    stapes = common.nearest_component(labels, boxes, spacing)
    box = common.widened(boxes[stapes - 1], labels.shape)
    part = labels[box]
    grey = common.alone(smooth[box], part, stapes, 0.0)
    vertices, faces, _, _ = marching_cubes(grey, level, spacing=(spacing,) * 3)
    start = np.array([s.start for s in box]) * spacing
    common.mesh_and_mass(folder, (vertices + start)[:, ::-1], faces[:, ::-1])
    common.write_labels(folder, part == stapes, box, spacing)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
