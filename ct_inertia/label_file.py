"""Label files: written so that they lie on the scan in 3D Slicer, ITK-SNAP and Fiji."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ct_inertia.bodies import LabelledVolume


def write_labels(path: Path, labels: LabelledVolume) -> None:
    """Write labels as a compressed image (NRRD by its suffix) with spacing, origin and direction."""
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(labels.labels)
    image.SetSpacing([float(v) for v in labels.spacing_mm])
    image.SetOrigin([float(v) for v in labels.origin_mm])
    image.SetDirection([float(v) for v in labels.direction.ravel()])
    sitk.WriteImage(image, str(path), useCompression=True)
