"""Grey values for the picture: eight bits, of the part of the scan around the stapes, or of all of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.drawing import MOST_VOXELS, Drawing, ras_affine, ras_view
from ct_inertia.scan.scan import Scan
from stapeskit.arrays import Array

_COARSE_VOXELS = MOST_VOXELS // 3  # of the first look, which is there before anything is measured
_PERCENT = (1.0, 99.8)  # of the grey values, shown black and white


def grey_values(scan: Scan, drawing: Drawing | None = None) -> tuple[NDArray[np.uint8], Array]:
    """Return grey values [s, a, r] and their affine (4, 4) from an index r, a, s to RAS mm.

    They lie on the voxels of a drawing's picture; without one they are the whole scan at coarse steps.
    """
    if drawing is None:
        step = max(1, int(np.ceil((np.prod(scan.size) / _COARSE_VOXELS) ** (1.0 / 3.0))))
        first, size = np.zeros(3, dtype=int), np.array(scan.shape) // step
    else:
        step, size = drawing.step, np.array(drawing.shape)
        corner = drawing.scan_from_index @ [*(part.start for part in drawing.box[::-1]), 1.0]
        first = np.rint(scan.index_points(corner[:3])).astype(int)[::-1]
    middle = first + step // 2
    box = [slice(int(a), int(a) + (int(n) - 1) * step + 1, step) for a, n in zip(middle, size, strict=True)]
    part = scan.part((box[0], box[1], box[2]))
    affine = ras_affine(part.scan_from_index, part.shape) if drawing is None else drawing.affine
    return ras_view(_eight_bits(part), part.scan_from_index).astype(np.uint8, copy=False), affine


def _eight_bits(scan: Scan) -> NDArray[np.uint8]:
    """Read some planes at a time, so that no copy in floating point numbers is ever whole."""
    grey = np.empty(scan.shape, dtype=np.uint8)
    coarse = scan.read((slice(None, None, 4),) * 3).astype(np.float32)
    dark, bright = np.percentile(coarse, _PERCENT)
    factor = 255.0 / max(float(bright - dark), 1e-30)
    for first, slab in scan.slabs(8):
        shown = (slab.astype(np.float32) - np.float32(dark)) * np.float32(factor)
        grey[first : first + len(slab)] = np.clip(shown, 0.0, 255.0)
    return grey


def write_nifti(path: Path, array: NDArray[np.generic], affine: Array) -> Path:
    """Write a picture [s, a, r] as NIfTI, which NiiVue reads, and return its path."""
    import nibabel as nib

    image = nib.Nifti1Image(array.T, affine)
    image.header.set_xyzt_units("mm")
    nib.save(image, path)
    return path
