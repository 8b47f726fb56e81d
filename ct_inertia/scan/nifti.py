"""NIfTI and Analyze volumes by nibabel; the sform places the voxels, otherwise the qform.

The format: https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ct_inertia.scan.opened import (
    Opened,
    ReadOptions,
    check_surplus,
    no_data_file,
    planes_in,
    several_values,
)
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.scan import check_grey_values
from ct_inertia.scan.streams import unpack_once
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def open_file(path: Path, _: ReadOptions) -> Opened:
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
        raise no_data_file(path.with_suffix(".img"), path.name) from fault
    header, voxels = image.header, image.dataobj
    shape = [int(n) for n in voxels.shape]
    while len(shape) > 3 and shape[-1] == 1:
        shape.pop()
    if len(shape) > 3 and min(shape[:3]) > 1:
        raise several_values(path, f"{int(np.prod(shape[3:]))} values (a vector or time image)")
    stored = header.get_data_dtype()
    if stored.names:
        raise several_values(path, "a colour (RGB) image")
    check_grey_values(tuple(reversed(shape)), stored, path.name)
    data = Path(image.file_map["image"].filename)
    opened = Opened(tuple(reversed(shape)), stored, files=(data,))
    opened.slope, opened.intercept = float(voxels.slope), float(voxels.inter)
    _place_nifti(opened, header, path.name)
    if data.suffix.lower() == ".gz":
        opened.read = unpack_once(lambda: voxels.get_unscaled().reshape(shape, order="F").T)
        return opened
    pieces = [(data, int(voxels.offset))]
    opened.planes = planes_in(pieces, opened.shape, stored, data.name)
    check_surplus(opened, pieces, attached=data == path)
    return opened


def _place_nifti(opened: Opened, header: Any, name: str) -> None:
    """Set spacing, origin and direction: sform, else qform, else voxel sizes alone (nifti1.h)."""
    sform, qform = (
        (header.get_sform(True)[0], header.get_qform(True)[0]) if "sform_code" in header else (None, None)
    )
    unit = mm_per_unit(header.get_xyzt_units()[0]) if "xyzt_units" in header else None
    if unit is None:
        unit = 1.0
        text = f"{name} does not say its unit of length: mm was taken, as NIfTI programs do."
        opened.notices.append(Notice("length_unit_assumed", text))
    steps = np.abs(np.asarray(header.get_zooms()[:3], dtype=float))
    bare = np.diag([*steps, 1.0])
    affine = sform if sform is not None else qform
    affine = bare if affine is None else _LPS_FROM_RAS @ affine
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not np.all(np.isfinite(affine)) or np.any(spacing <= 0.0):
        return
    opened.spacing_mm, opened.origin_mm = spacing * unit, affine[:3, 3] * unit
    opened.direction = affine[:3, :3] / spacing
    opened.anatomical = sform is not None or qform is not None
    if sform is None:
        return
    if qform is None:
        other = np.column_stack([affine[:, :3] / np.append(spacing, 1.0)[:3] * steps, affine[:, 3]])
    else:
        other = _LPS_FROM_RAS @ qform
    called = "voxel sizes (pixdim)" if qform is None else "qform"
    opened.notices += _difference(affine, other, called, opened.shape, unit, name)


def _difference(
    affine: Array, other: Array, called: str, shape: Sequence[int], unit: float, name: str
) -> list[Notice]:
    """Return a notice where the sform, which counts, and the rest of the header place voxels differently."""
    steps, stated = (np.linalg.norm(one[:3, :3], axis=0) for one in (affine, other))
    corners = np.array([[*corner, 1.0] for corner in product(*((0, n - 1) for n in reversed(shape)))])
    apart = float(np.linalg.norm((corners @ (affine - other).T)[:, :3], axis=1).max()) * unit
    if apart <= 0.5 * unit * steps.min() and np.max(np.abs(stated / steps - 1.0)) <= 1e-3:
        return []
    first, second = (", ".join(f"{value:.5g}" for value in unit * one) for one in (steps, stated))
    text = (
        f"{name} states the place of its voxels twice: by the sform ({first} mm a voxel), which was used, "
        f"and by the {called} ({second} mm); a corner lies {apart:.4g} mm apart. Programs that prefer the "
        f"other show other coordinates and sizes. Save it anew from the program that shows it rightly."
    )
    return [Notice("header_places_differ", text)]
