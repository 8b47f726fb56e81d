"""NIfTI and Analyze volumes by nibabel; the sform places the voxels, otherwise the qform.

The format: https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.stored import Stored, Stream, no_data_file, several_values

_LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def open_nifti(path: Path) -> Stored:
    """Open a NIfTI or Analyze volume, attached or detached."""
    import nibabel

    try:
        image: Any = nibabel.load(path)
    except FileNotFoundError as fault:
        raise no_data_file(path.with_suffix(".img")) from fault
    dtype = image.header.get_data_dtype()
    if dtype.names:
        raise several_values("a colour (RGB) image")
    voxels, data = image.dataobj, Path(image.file_map["image"].filename)
    packed = data.suffix.lower() == ".gz"
    stored = Stored(voxels.shape[::-1], dtype, Stream(data, 0, int(voxels.offset), packed, exact=True))
    stored.slope, stored.intercept = float(voxels.slope), float(voxels.inter)
    if len(stored.shape) > 2:  # a picture has no place
        _place(stored, image.header, path.name)
    return stored


def _place(stored: Stored, header: Any, name: str) -> None:
    """Set spacing, origin and direction: sform, else qform, else voxel sizes alone (nifti1.h).

    A notice says where the sform, which counts, and the rest of the header place voxels differently.
    """
    forms = (header.get_sform(True)[0], header.get_qform(True)[0]) if "sform_code" in header else (None, None)
    unit = mm_per_unit(header.get_xyzt_units()[0]) if "xyzt_units" in header else None
    if unit is None:
        text = f"{name} does not say its unit of length: mm was taken, as NIfTI programs do."
        stored.note(text, "length_unit_assumed")
    unit = unit or 1.0
    sform, qform = (None if form is None else _LPS_FROM_RAS @ form for form in forms)
    steps = np.abs(np.asarray(header.get_zooms()[:3], dtype=float))
    affine = np.diag([*steps, 1.0]) if qform is None else qform
    affine = affine if sform is None else sform
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not np.all(np.isfinite(affine)) or np.any(spacing <= 0.0):
        return
    stored.spacing_mm, stored.origin_mm, stored.unit_mm = spacing * unit, affine[:3, 3] * unit, unit
    stored.direction = affine[:3, :3] / spacing
    stored.anatomical = sform is not None or qform is not None
    if sform is None:
        return
    sized = affine @ np.diag([*(steps / spacing), 1.0])
    other, called = (sized, "voxel sizes (pixdim)") if qform is None else (qform, "qform")
    stated = np.linalg.norm(other[:3, :3], axis=0)
    corners = np.array([[*corner, 1.0] for corner in product(*((0, n - 1) for n in stored.shape[:-4:-1]))])
    apart = float(np.linalg.norm((corners @ (affine - other).T)[:, :3], axis=1).max()) * unit
    if apart <= 0.5 * unit * spacing.min():
        return
    first, second = (", ".join(f"{value:.5g}" for value in unit * one) for one in (spacing, stated))
    text = (
        f"{name} states the place of its voxels twice: by the sform ({first} mm a voxel), which was used, "
        f"and by the {called} ({second} mm); a corner lies {apart:.4g} mm apart. Programs that prefer the "
        f"other show other coordinates and sizes. Save it anew from the program that shows it rightly."
    )
    stored.note(text, "header_places_differ")
