"""The rules of all formats: what grey values are, units, spacing, right-handed grids.

The user's spacing wins over that of the file; a spacing that is not known along every axis is asked for, not
guessed; a left-handed grid is read with one index axis reversed, so that every voxel keeps its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

if TYPE_CHECKING:
    from ct_inertia.scan.stored import Stored

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
_UNSET = 4.0  # a slice distance of exactly 1 unit is not believed so many times off the pixel size
_ORTHONORMAL = 1e-4  # of products of directions: headers round cosines to four digits; .3 um over a stapes


def check_grey_values(shape: Sequence[int], dtype: np.dtype[Any], name: str = "") -> None:
    """Refuse what is no volume of real numbers.

    Raises
    ------
    StapeskitError
        Not three-dimensional, or neither integers nor floating point numbers.
    """
    if dtype.kind == "c":
        step = "Export the magnitude"
        raise StapeskitError.of("the volume", "real grey values", "complex numbers", name, step)
    if len(shape) != 3 or min(shape) < 2:
        got = f"an image of {' x '.join(str(n) for n in reversed(shape))}"
        step = "Give the whole stack, or the folder of slices"
        raise StapeskitError.of("the volume", "three-dimensional", got, name, step)
    if dtype.kind not in "uif" or dtype.itemsize > 8:
        wanted, step = "integers or floating point numbers", "Export it as grey values"
        raise StapeskitError.of("the grey values", wanted, str(dtype), name, step)


def mm_per_unit(unit: object) -> float | None:
    """Return the length of a unit in mm, or None when the word names no length (``pixel``)."""
    return _MM.get(unit.strip().lower()) if isinstance(unit, str) else None


def is_printer_resolution(pixel_mm: float) -> bool:
    """Return whether a pixel size is that of a screen or printer rather than of a scanner."""
    return any(abs(pixel_mm * dpi / 25.4 - 1.0) < 1e-4 for dpi in _PRINTER_DPI)


def choose_spacing(stored: Stored, from_user: float | Sequence[float] | None, name: str) -> Array:
    """Choose the voxel spacing (3,), mm: that of the user, otherwise that of the file of this name.

    Raises
    ------
    StapeskitError
        Neither has it.
    """
    stated = np.full(3, np.nan) if stored.spacing_mm is None else np.array(stored.spacing_mm, dtype=float)
    known, unit = stored.known, stored.unit_mm
    if np.isclose(stated[2], unit, rtol=1e-9, atol=0.0) and not unit / _UNSET < stated[0] < unit * _UNSET:
        stated[2] = np.nan
        known = (
            f"slices exactly 1 unit ({unit:g} mm) apart, as programs write where nobody entered a distance"
        )
    if from_user is None:
        if not np.all(stated > 0.0):
            words = "none" if np.all(np.isnan(stated)) else f"{_times(stated)} mm"
            wanted, got = "in the file or given", f"{words}; {known}" if known else words
            step = "Give it in mm with --spacing H or --spacing DX,DY,DZ"
            raise StapeskitError.of("the voxel spacing", wanted, got, name, step)
        return stated
    spacing = np.broadcast_to(np.asarray(from_user, dtype=float), 3).copy()
    with np.errstate(divide="ignore"):
        differ = np.abs(spacing / stated - 1.0) > _NOTED_CHANGE  # never where the file's is NaN
    if np.any(differ):
        stored.note(f"{name} has voxels of {_times(stated)} mm; the given {_times(spacing)} mm were used.")
    return spacing


def _times(values: Array) -> str:
    return " x ".join("?" if np.isnan(value) else f"{value:.6g}" for value in values)


def turn_right_handed(stored: Stored, spacing_mm: Array, name: str) -> int | None:
    """Turn a left-handed grid: of its axes the one that is turned least then begins at its other end.

    Returns that axis x, y or z (0, 1, 2), along which voxels are to be read in reverse, or None.
    """
    origin, direction = (np.array(values, dtype=float) for values in (stored.origin_mm, stored.direction))
    if direction.shape != (3, 3) or not np.linalg.det(direction) < 0.0:
        return None
    axis = int(np.argmin(np.diag(direction)))
    stored.origin_mm = origin + direction[:, axis] * spacing_mm[axis] * (stored.shape[2 - axis] - 1)
    direction[:, axis] *= -1.0
    stored.direction = direction
    stored.note(
        f"The axes of {name} are left-handed: its {'xyz'[axis]} axis was read in reverse, and every "
        f"voxel kept its place."
    )
    return axis


def nearest_rotation(direction: Array, name: str) -> Array:
    """Return the rotation next to a direction matrix (3, 3), which headers round to a few digits.

    Raises
    ------
    StapeskitError
        It is not finite, sheared or left-handed.
    """
    expected, step = "", ""
    if direction.shape != (3, 3) or not np.all(np.isfinite(direction)):
        expected, step = "a finite 3x3 matrix", "Export it again"
    elif np.max(np.abs(direction.T @ direction - np.eye(3))) > _ORTHONORMAL:
        expected, step = "orthonormal (no shear)", "Resample the volume onto a rectangular grid"
    elif np.linalg.det(direction) < 0.0:
        expected, step = "right-handed (determinant +1)", "Turn one axis of the grid"
    if expected:
        got = np.round(direction, 6).tolist()
        raise StapeskitError.of("the direction matrix", expected, got, name, step)
    left, _, right = np.linalg.svd(direction)
    return np.asarray(left @ right)
