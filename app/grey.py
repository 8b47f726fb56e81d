"""Grey values for the picture: eight bits, of a part of the scan or of the whole at coarse steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.drawing import MOST_VOXELS, Drawing, ras_affine, ras_view
from ct_inertia.options import MassOptions
from ct_inertia.scan.open_scan import open_scan
from ct_inertia.scan.scan import Box, Scan
from stapeskit.arrays import Array

_COARSE_VOXELS = MOST_VOXELS // 3  # of the first look, which is there before anything is measured
_PERCENT = (1.0, 99.8)  # of the grey values, shown black and white


def opened(options: MassOptions) -> Scan | None:
    """Open the scan of a study; None where it is a mesh or labels alone.

    Raises
    ------
    StapeskitError
        The scan cannot be read.
    """
    if options.file is None or options.is_mesh:
        return None
    return open_scan(options.file, options.spacing_mm, options.mirror, options.nan_as_air, options.raw)


def first_look(scan: Scan) -> tuple[NDArray[np.uint8], Array]:
    """Return the whole scan at coarse steps as grey values [s, a, r] and the affine (4, 4) to RAS mm."""
    step = max(1, int(np.ceil((np.prod(scan.size) / _COARSE_VOXELS) ** (1.0 / 3.0))))
    part = scan.part((slice(step // 2, None, step),) * 3)
    return _eight_bits(part), ras_affine(part.scan_from_index, part.shape)


def beneath(scan: Scan, drawing: Drawing) -> NDArray[np.uint8]:
    """Return the grey values [s, a, r] on the voxels of a drawing's picture."""
    corner = drawing.scan_from_index @ [*(part.start for part in drawing.box[::-1]), 1.0]
    first = np.rint(scan.index_points(corner[:3])).astype(int)[::-1]
    k = drawing.step
    size = [(part.stop - part.start) // k for part in drawing.box]
    box = tuple(
        slice(int(a) + k // 2, int(a) + k // 2 + (n - 1) * k + 1, k) for a, n in zip(first, size, strict=True)
    )
    return _eight_bits(scan.part((box[0], box[1], box[2])))


def _eight_bits(scan: Scan, box: Box | None = None) -> NDArray[np.uint8]:
    """Read some planes at a time, so that no copy in floating point numbers is ever whole."""
    grey = np.empty(scan.shape, dtype=np.uint8)
    coarse = scan.read((slice(None, None, 4),) * 3).astype(np.float32)
    dark, bright = np.percentile(coarse, _PERCENT)
    factor = 255.0 / max(float(bright - dark), 1e-30)
    for first, slab in scan.slabs(8, box):
        shown = (slab.astype(np.float32) - np.float32(dark)) * np.float32(factor)
        grey[first : first + len(slab)] = np.clip(shown, 0.0, 255.0)
    return np.ascontiguousarray(ras_view(grey, scan.scan_from_index)).astype(np.uint8, copy=False)


def write_nifti(path: Path, array: NDArray[np.uint8], affine: Array) -> Path:
    """Write a picture [s, a, r] as NIfTI, which NiiVue reads, and return its path."""
    import nibabel as nib

    image = nib.Nifti1Image(array.T, affine)
    image.header.set_xyzt_units("mm")
    nib.save(image, path)
    return path
