"""A napari reader of mass.json: labels of the scan and the surfaces of stapes and plate, in scan coordinates.

napari finds it by the manifest napari.yaml (npe2) once this folder is installed: ``pip install
./examples/napari``, then ``napari results/mass.json``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

Layer = tuple[Any, dict[str, Any], str]


def get_reader(path: str | list[str]) -> Callable[[str], list[Layer]] | None:
    """Return the reader of a mass.json, or nothing for other files (npe2, readers)."""
    return read_mass if isinstance(path, str) and Path(path).name.endswith("mass.json") else None


def read_mass(path: str) -> list[Layer]:
    """Return layers: labels and surfaces, all mm in scan coordinates, axes z, y, x as napari has them."""
    import numpy as np

    from legacy.kinematics.registration.scan_surfaces import ScanSurfaces, read_labels
    from legacy.stapeskit.records.measured_mass import measured_mass

    folder = Path(path).parent
    layers: list[Layer] = []
    labels = folder / "labels.nrrd"
    if labels.is_file():
        volume = read_labels(labels)
        turn = np.eye(3)[::-1]
        affine = np.eye(4)
        affine[:3, :3] = turn @ volume.scan_from_index[:, :3] @ turn
        affine[:3, 3] = turn @ volume.scan_from_index[:, 3]
        layers.append((np.asarray(volume.array), {"name": "labels", "affine": affine}, "labels"))
    surfaces = ScanSurfaces.of(measured_mass(path))
    for name in ("stapes", "plate"):
        surface = surfaces.mesh(name)
        if surface is not None:
            layers.append(((surface.vertices_mm[:, ::-1], surface.faces), {"name": name}, "surface"))
    return layers
