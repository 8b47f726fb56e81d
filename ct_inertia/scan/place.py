"""Where the voxels of a scan lie: units, spacing and handedness, by the same rules for every format.

The rules: the user's spacing wins over that of the file; a spacing that is not known along every axis is
asked for, not guessed; a left-handed grid is read with one index axis reversed, so that every voxel keeps its
place; ``--mirror`` then reverses the voxels inside the box of the scan, whose place stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.header import Header
from ct_inertia.scan.scan import Box, Fetch, Scan, check_grey_values
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_MM = {
    **dict.fromkeys(("m", "meter", "metre", "meters", "metres"), 1e3),
    **dict.fromkeys(("cm", "centimeter", "centimetre", "centimeters"), 10.0),
    **dict.fromkeys(("mm", "millimeter", "millimetre", "millimeters"), 1.0),
    **dict.fromkeys(("um", "µm", "μm", "\\u00b5m", "micron", "microns"), 1e-3),
    **dict.fromkeys(("micrometer", "micrometre", "micrometers"), 1e-3),
    **dict.fromkeys(("nm", "nanometer", "nanometre", "nanometers"), 1e-6),
    **dict.fromkeys(("angstrom", "å"), 1e-7),
    **dict.fromkeys(("inch", "in", "inches", '"'), 25.4),
}

_PRINTER_DPI = (1.0, 72.0, 96.0, 100.0, 150.0, 200.0, 300.0, 400.0, 600.0, 1200.0)
"""Pixels per inch of screens and printers, which programs write where they know none."""

_NOTED_CHANGE = 1e-3  # relative difference of two voxel sizes that is more than rounding
_UNSET_RATIO = 4.0  # a slice distance of exactly 1 is not believed so far from the pixel size
_AXES = ("x", "y", "z")


def mm_per_unit(unit: object) -> float | None:
    """Return the length of a unit in mm, or None when the word names no length (``pixel``)."""
    return _MM.get(unit.strip().lower()) if isinstance(unit, str) else None


def is_printer_resolution(pixel_mm: float) -> bool:
    """Return whether a pixel size is that of a screen or printer rather than of a scanner."""
    return any(abs(pixel_mm * dpi / 25.4 - 1.0) < 1e-4 for dpi in _PRINTER_DPI)


def believed_spacing(spacing: Array, unit_mm: float) -> tuple[Array, str]:
    """Leave out a slice distance of exactly 1 that nobody entered.

    Returns spacing (3,), given in a unit of so many mm, in mm, with NaN along z where it is not believed, and
    what the file says then.
    """
    x, y, z = spacing
    if z == 1.0 and np.isfinite(x) and x > 0.0 and not 1.0 / _UNSET_RATIO <= x <= _UNSET_RATIO:
        text = (
            f"the file says {x * unit_mm:.6g} mm in a slice and slices exactly 1 unit ({unit_mm:g} mm) "
            f"apart, which programs write where nobody entered a distance"
        )
        return np.array([x, y, np.nan]) * unit_mm, text
    return spacing * unit_mm, ""


def _choose_spacing(
    from_file: Array | None, from_user: float | Sequence[float] | None, name: str, known: str = ""
) -> tuple[Array, list[Notice]]:
    """Choose the voxel spacing (3,), mm: that of the user, otherwise that of the file.

    ``known`` is what the file of this name says of an incomplete spacing.

    Raises
    ------
    StapeskitError
        Neither has it.
    """
    stated = np.full(3, np.nan) if from_file is None else np.asarray(from_file, dtype=float)
    stated, unset = believed_spacing(stated, 1.0)
    if from_user is None:
        if not np.all(stated > 0.0):
            known = unset or known if np.any(np.isnan(stated)) else _times(stated)
            wanted, got = "in the file or given", f"none{': ' + known if known else ''}"
            step = "Give it in mm with --spacing H or --spacing DX,DY,DZ"
            raise StapeskitError.of("the voxel spacing", wanted, got, name, step)
        return stated, []
    spacing = np.broadcast_to(np.asarray(from_user, dtype=float), 3).copy()
    with np.errstate(divide="ignore"):
        differ = np.abs(spacing / stated - 1.0) > _NOTED_CHANGE  # never where the file's is NaN
    if not np.any(differ):
        return spacing, []
    text = f"{name} has voxels of {_times(stated)} mm; the given {_times(spacing)} mm were used."
    return spacing, [Notice("file_read", text)]


def place_scan(
    header: Header,
    fetch: Fetch,
    path: Path,
    spacing_mm: float | Sequence[float] | None = None,
    mirror: str | None = None,
    **attributes: Any,
) -> Scan:
    """Return the scan behind a header, on a right-handed grid.

    ``fetch`` reads a box of stored values; ``spacing_mm`` and ``mirror`` are the user's, ``attributes``
    further ones of the scan.

    Raises
    ------
    StapeskitError
        No three-dimensional grey values, no spacing, or sheared directions.
    """
    name = path.name
    check_grey_values(header.shape, header.dtype, name)
    z, y, x = (int(n) for n in header.shape)
    shape = (z, y, x)
    spacing, notices = _choose_spacing(header.spacing_mm, spacing_mm, name, header.known)
    fetch, dtype = _as_grey_values(header, fetch)
    if header.white_is_zero:
        text = (
            f"{name} says that 0 is white (WhiteIsZero): bright and dark were exchanged, so that bone is "
            f"bright. Grey values count from the other end of their range (255 less the stored one, 65535 "
            f"less it; floats change sign). If bone was bright as stored, correct the tag in its program."
        )
        notices.append(Notice("file_read", text))
    origin, direction = np.asarray(header.origin_mm, dtype=float), np.array(header.direction, dtype=float)
    if direction.shape == (3, 3) and np.linalg.det(direction) < 0.0:
        axis = int(np.argmin(np.diag(direction)))
        fetch = _reversed(fetch, shape, axis)
        origin = origin + direction[:, axis] * spacing[axis] * (shape[2 - axis] - 1)
        direction[:, axis] *= -1.0
        text = (
            f"The axes of {name} are left-handed: its {_AXES[axis]} axis was read in reverse, and every "
            f"voxel kept its place."
        )
        notices.append(Notice("file_read", text))
    if mirror is not None:
        fetch = _reversed(fetch, shape, _AXES.index(mirror))
    elif not header.anatomical:
        text = (
            f"Nothing in {name} confirms that its slices are in right-handed order: if they are not, the "
            f"ear is a mirror image. Check a known asymmetry in the report; --mirror x, y or z undoes it."
        )
        notices.append(Notice("handedness_unconfirmed", text))
    return Scan(
        shape,
        dtype,
        spacing,
        fetch,
        origin,
        direction,
        source=path,
        files=tuple(dict.fromkeys((path, *header.files))),
        notices=(*header.notices, *notices),
        segment_names=dict(header.names),
        handedness_confirmed=header.anatomical,
        chunk_planes=header.depth,
        **attributes,
    )


def _as_grey_values(header: Header, fetch: Fetch) -> tuple[Fetch, np.dtype[Any]]:
    """Apply slope and intercept, to float32 where they change anything, and exchange bright and dark."""
    dtype = header.dtype.newbyteorder("=")
    scaled = (header.slope, header.intercept) != (1.0, 0.0)
    if not scaled and not header.white_is_zero:
        return fetch, dtype

    def read(box: Box) -> NDArray[Any]:
        values = fetch(box)
        if scaled:
            values = np.asarray(values * header.slope + header.intercept, dtype=np.float32)
        if header.white_is_zero:
            values = -values if values.dtype.kind == "f" else np.invert(values)
        return values

    return read, np.dtype(np.float32) if scaled else dtype


def _reversed(fetch: Fetch, shape: tuple[int, int, int], axis: int) -> Fetch:
    """Return a reader of the grid with its x, y or z axis (0, 1, 2) reversed."""
    k = 2 - axis

    def reversed_fetch(box: Box) -> NDArray[Any]:
        asked = range(shape[k])[box[k]]
        if not len(asked):
            return fetch(box)
        turned = list(box)
        turned[k] = slice(shape[k] - 1 - asked[-1], shape[k] - asked[0], asked.step)
        return np.ascontiguousarray(np.flip(fetch((turned[0], turned[1], turned[2])), axis=k))

    return reversed_fetch


def _times(values: Array) -> str:
    return " x ".join("?" if np.isnan(value) else f"{value:.6g}" for value in values)
