"""Level given, VTK flying edges on the whole scan, pieces of the mesh, trimesh: its fastest way."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.peers import common


def main(scan: Path, folder: Path, level: float) -> None:
    """Run."""
    from scipy.ndimage import label
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    volume, spacing = common.read_stack(scan)
    points, faces = common.flying_edges(volume, spacing, level + 0.25)
    ends = (faces[:, :2].ravel(), faces[:, 1:].ravel())
    links = coo_array((np.ones(len(ends[0]), dtype=np.int8), ends), shape=(len(points),) * 2)
    count, piece = connected_components(links, directed=False)
    owner = piece[faces[:, 0]]
    corners = points[faces]
    six = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    volumes = np.abs(np.bincount(owner, six, minlength=count)) / 6.0
    stapes = common.nearest_in_volume(volumes / spacing**3, spacing)
    used = np.flatnonzero(piece == stapes)
    renumbered = np.zeros(len(points), dtype=np.int64)
    renumbered[used] = np.arange(len(used))
    points = points[used]
    common.mesh_and_mass(folder, points, renumbered[faces[owner == stapes]])
    low = np.floor(points.min(axis=0) / spacing).astype(int)[::-1]
    high = np.ceil(points.max(axis=0) / spacing).astype(int)[::-1]
    part = [slice(int(a), int(b) + 1) for a, b in zip(low, high, strict=True)]
    box = common.widened(part, volume.shape)
    labels, _ = label(volume[box] > level)
    number = 1 + common.nearest_in_volume(np.bincount(labels.ravel())[1:], spacing)
    common.write_labels(folder, labels == number, box, spacing)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]))
