"""NIfTI and Analyze volumes by nibabel; the sform places the voxels, otherwise the qform.

The format: https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ct_inertia.scan.header import Header, no_data_file, several_values, unpack_once
from ct_inertia.scan.itk import unpacked
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.scan import check_grey_values
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def open_nifti(path: Path) -> Header:
    """Open a NIfTI or Analyze volume.

    Raises
    ------
    StapeskitError
        A damaged header, a missing or too short data file, or several values in a voxel.
    """
    import nibabel

    try:
        image: Any = nibabel.load(path)
    except FileNotFoundError as fault:
        raise no_data_file(path.with_suffix(".img"), path) from fault
    voxels = image.dataobj
    shape = [int(n) for n in voxels.shape]
    while len(shape) > 3 and shape[-1] == 1:
        shape.pop()
    if len(shape) > 3 and min(shape[:3]) > 1:
        raise several_values(path, f"{int(np.prod(shape[3:]))} values (a vector or time image)")
    stored = image.header.get_data_dtype()
    if stored.names:
        raise several_values(path, "a colour (RGB) image")
    check_grey_values(shape[::-1], stored, path.name)
    data = Path(image.file_map["image"].filename)
    header = Header(tuple(reversed(shape)), stored, files=(data,))
    header.slope, header.intercept = float(voxels.slope), float(voxels.inter)
    _place(header, image.header, path.name)
    if data.suffix.lower() == ".gz":
        # nibabel stops before the check sum of the stream
        header.read = unpack_once(
            lambda: unpacked(data, 0, int(voxels.offset), header.shape, stored, exact=False)
        )
    else:
        header.set_planes(data, int(voxels.offset), path, exact=True)
    return header


def _place(header: Header, stated: Any, name: str) -> None:
    """Set spacing, origin and direction: sform, else qform, else voxel sizes alone (nifti1.h)."""
    forms = (stated.get_sform(True)[0], stated.get_qform(True)[0]) if "sform_code" in stated else (None, None)
    unit = mm_per_unit(stated.get_xyzt_units()[0]) if "xyzt_units" in stated else None
    if unit is None:
        unit = 1.0
        text = f"{name} does not say its unit of length: mm was taken, as NIfTI programs do."
        header.notices.append(Notice("length_unit_assumed", text))
    sform, qform = (None if form is None else _LPS_FROM_RAS @ form for form in forms)
    steps = np.abs(np.asarray(stated.get_zooms()[:3], dtype=float))
    affine = next((form for form in (sform, qform) if form is not None), np.diag([*steps, 1.0]))
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not np.all(np.isfinite(affine)) or np.any(spacing <= 0.0):
        return
    header.spacing_mm, header.origin_mm = spacing * unit, affine[:3, 3] * unit
    header.direction = affine[:3, :3] / spacing
    header.anatomical = sform is not None or qform is not None
    if sform is not None and qform is not None:
        _note_difference(header, affine, qform, "qform", unit, name)
    elif sform is not None:
        sized = affine.copy()
        sized[:3, :3] *= steps / spacing
        _note_difference(header, affine, sized, "voxel sizes (pixdim)", unit, name)


def _note_difference(
    header: Header, affine: Array, other: Array, called: str, unit: float, name: str
) -> None:
    """Add a notice where the sform, which counts, and the rest of the header place voxels differently."""
    steps, stated = (np.linalg.norm(one[:3, :3], axis=0) for one in (affine, other))
    corners = np.array([[*corner, 1.0] for corner in product(*((0, n - 1) for n in header.shape[::-1]))])
    apart = float(np.linalg.norm((corners @ (affine - other).T)[:, :3], axis=1).max()) * unit
    if apart <= 0.5 * unit * steps.min() and np.max(np.abs(stated / steps - 1.0)) <= 1e-3:
        return
    first, second = (", ".join(f"{value:.5g}" for value in unit * one) for one in (steps, stated))
    text = (
        f"{name} states the place of its voxels twice: by the sform ({first} mm a voxel), which was used, "
        f"and by the {called} ({second} mm); a corner lies {apart:.4g} mm apart. Programs that prefer the "
        f"other show other coordinates and sizes. Save it anew from the program that shows it rightly."
    )
    header.notices.append(Notice("header_places_differ", text))
