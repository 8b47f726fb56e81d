"""Binary STL: scan coordinates, mm."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from legacy.ct_inertia.exports.body import ExportBody
from legacy.ct_inertia.surface.surface import Surface

UNITS = {"length": "mm", "coordinates": "scan"}


def write(body: ExportBody, folder: Path) -> list[str]:
    """Write stapes.stl and plate.stl; return their names."""
    names = []
    for name, surface in (("stapes.stl", body.stapes), ("plate.stl", body.plate)):
        if surface is not None:
            (folder / name).write_bytes(stl_bytes(surface))
            names.append(name)
    return names


def stl_bytes(surface: Surface) -> bytes:
    """Return a surface as binary STL with outward normals."""
    corners = surface.vertices_mm[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("rest", "<u2")])
    rows["normal"] = normals / np.where(size > 0.0, size, 1.0)
    rows["corner"] = corners
    header = b"stapeskit: scan coordinates, mm, normals outward"
    return header.ljust(80) + np.uint32(len(rows)).astype("<u4").tobytes() + rows.tobytes()
