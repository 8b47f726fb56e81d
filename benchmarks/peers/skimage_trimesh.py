"""Level given, scipy label, scikit-image marching cubes, trimesh."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.peers import common


def main(scan: Path, folder: Path, level: float) -> None:
    """Run."""
    from scipy.ndimage import find_objects, label
    from skimage.measure import marching_cubes

    volume, spacing = common.read_stack(scan)
    labels, _ = label(volume > level)
    boxes = find_objects(labels)
    stapes = common.nearest_component(labels, boxes, spacing)
    box = common.widened(boxes[stapes - 1], labels.shape)
    part = labels[box]
    grey = common.alone(volume[box].astype(np.float32), part, stapes, 0.0)
    vertices, faces, _, _ = marching_cubes(grey, level + 0.25, spacing=(spacing,) * 3)
    start = np.array([s.start for s in box]) * spacing
    common.mesh_and_mass(folder, (vertices + start)[:, ::-1], faces[:, ::-1])
    common.write_labels(folder, part == stapes, box, spacing)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))
