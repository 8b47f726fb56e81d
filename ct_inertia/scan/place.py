"""Where the voxels of a scan lie: units, spacing and handedness, by the same rules for every format.

The rules: the user's spacing wins over that of the file; a spacing that is not known along every axis is
asked for, not guessed; a left-handed grid is read with one index axis reversed, so that every voxel keeps its
place; ``--mirror`` then reverses the voxels inside the box of the scan, whose place stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.opened import Opened, ReadOptions
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
_AXES = "xyz"


def mm_per_unit(unit: object) -> float | None:
    """Return the length of a unit in mm, or None when the word names no length (``pixel``)."""
    return _MM.get(unit.strip().lower()) if isinstance(unit, str) else None


def is_printer_resolution(pixel_mm: float) -> bool:
    """Return whether a pixel size is that of a screen or printer rather than of a scanner."""
    return any(abs(pixel_mm * dpi / 25.4 - 1.0) < 1e-4 for dpi in _PRINTER_DPI)


def believed_spacing(spacing: Array, unit_mm: float) -> tuple[Array, str]:
    """Leave out a slice distance of exactly 1 that nobody entered.

    Parameters
    ----------
    spacing : ndarray, (3,)
        Along x, y, z in the unit of the file.
    unit_mm : float
        Length of the unit, mm.

    Returns
    -------
    ndarray, (3,)
        In mm; NaN along z where it is not believed.
    str
        What the file says, for the message; empty where it is believed.
    """
    x, _, z = spacing
    if z == 1.0 and np.isfinite(x) and x > 0.0 and not 1.0 / _UNSET_RATIO <= x <= _UNSET_RATIO:
        text = (
            f"the file says {x * unit_mm:.6g} mm in a slice and slices exactly 1 unit ({unit_mm:g} mm) "
            f"apart, which programs write where nobody entered a distance"
        )
        return np.array([spacing[0], spacing[1], np.nan]) * unit_mm, text
    return spacing * unit_mm, ""


def choose_spacing(
    from_file: Array | None, from_user: float | Sequence[float] | None, name: str, known: str = ""
) -> tuple[Array, list[Notice]]:
    """Choose the voxel spacing (3,), mm: that of the user, otherwise that of the file.

    Parameters
    ----------
    from_file : ndarray, (3,), or None
        NaN along axes where the file does not have it.
    from_user : float, sequence of 3 float, or None
    name : str
        Of the file, for messages.
    known : str
        What the file says of an incomplete spacing.

    Raises
    ------
    StapeskitError
        There is none, or one that is not positive.
    """
    stated = np.full(3, np.nan) if from_file is None else np.asarray(from_file, dtype=float)
    stated, unset = believed_spacing(stated, 1.0)
    known = unset or known
    if from_user is None:
        if not np.all(stated > 0.0):
            known = known if np.any(np.isnan(stated)) else _times(stated)
            wanted, got = "in the file or given", f"none{': ' + known if known else ''}"
            step = "Give it in mm with --spacing H or --spacing DX,DY,DZ"
            raise StapeskitError.of("the voxel spacing", wanted, got, name, step)
        return stated, []
    values = np.asarray(from_user, dtype=float).ravel()
    if values.size not in (1, 3) or not np.all(np.isfinite(values)) or np.any(values <= 0.0):
        wanted = "one or three positive numbers in mm (H or DX,DY,DZ)"
        step = "Give it in mm, for example --spacing 0.018"
        raise StapeskitError.of("--spacing", wanted, values.tolist(), next_step=step)
    spacing = np.broadcast_to(values, 3).copy()
    known_axes = np.isfinite(stated) & (stated != 0.0)
    if not np.any(np.abs(spacing[known_axes] / stated[known_axes] - 1.0) > _NOTED_CHANGE):
        return spacing, []
    along = "" if np.all(known_axes) else " along " + " and ".join(np.array(list(_AXES))[known_axes])
    held, given = _times(stated[known_axes]), _times(spacing)
    text = f"{name} has voxels of {held} mm{along}; the given {given} mm were used."
    return spacing, [Notice("file_read", text)]


def place_scan(opened: Opened, fetch: Fetch, path: Path, options: ReadOptions, carries_place: bool) -> Scan:
    """Return the scan behind a header, on a right-handed grid.

    Parameters
    ----------
    opened : Opened
    fetch : callable
        Reads a box of stored values.
    path : Path
        The file or folder that was given.
    options : ReadOptions
    carries_place : bool
        See `Scan`.

    Raises
    ------
    StapeskitError
        No three-dimensional grey values, no spacing, sheared directions, or ``--mirror`` names no axis.
    """
    name = path.name
    check_grey_values(tuple(opened.shape), opened.dtype, name)
    shape = (int(opened.shape[0]), int(opened.shape[1]), int(opened.shape[2]))
    if options.mirror is not None and options.mirror not in tuple(_AXES):
        raise StapeskitError.of(
            "--mirror", "x, y or z", options.mirror, next_step="Name one of the three axes"
        )
    spacing, notices = choose_spacing(opened.spacing_mm, options.spacing_mm, name, opened.known)
    notices = [*opened.notices, *notices]
    fetch, dtype = rescaled(opened, fetch)
    origin, direction = np.asarray(opened.origin_mm, dtype=float), np.asarray(opened.direction, dtype=float)
    if opened.white_is_zero:
        fetch = _inverted(fetch, dtype)
        notices.append(_white_is_zero(name))
    if direction.shape == (3, 3) and np.linalg.det(direction) < 0.0:
        axis = int(np.argmin(np.diag(direction)))
        fetch = _reversed(fetch, shape, axis)
        origin = origin + direction[:, axis] * spacing[axis] * (shape[2 - axis] - 1)
        direction = direction.copy()
        direction[:, axis] = -direction[:, axis]
        text = (
            f"The axes of {name} are left-handed: its {_AXES[axis]} axis was read in reverse, and every "
            f"voxel kept its place."
        )
        notices.append(Notice("file_read", text))
    if options.mirror is not None:
        fetch = _reversed(fetch, shape, _AXES.index(options.mirror))
    elif not opened.anatomical:
        text = (
            f"Nothing in {name} confirms that its slices are in right-handed order: if they are not, the "
            f"ear is a mirror image. Check a known asymmetry in the report; --mirror x, y or z undoes it."
        )
        notices.append(Notice("handedness_unconfirmed", text))
    return Scan(
        shape=shape,
        dtype=dtype,
        spacing_mm=spacing,
        fetch=fetch,
        origin_mm=origin,
        direction=direction,
        source=path,
        files=opened.files or (path,),
        notices=tuple(notices),
        segment_names=dict(opened.names),
        handedness_confirmed=opened.anatomical,
        carries_place=carries_place,
        nan_as_air=options.nan_as_air,
        inverted=opened.white_is_zero,
        chunk_planes=opened.depth,
    )


def rescaled(opened: Opened, fetch: Fetch) -> tuple[Fetch, np.dtype[Any]]:
    """Apply slope and intercept, of the scan or of every plane; float32 where they change anything."""
    dtype = opened.dtype.newbyteorder("=")
    slope, intercept = np.asarray(opened.slope, dtype=float), np.asarray(opened.intercept, dtype=float)
    if np.all(slope == 1.0) and np.all(intercept == 0.0):
        return fetch, dtype
    slopes, intercepts = (np.broadcast_to(one, opened.shape[0])[:, None, None] for one in (slope, intercept))

    def scaled(box: Box) -> NDArray[np.float32]:
        return np.asarray(fetch(box) * slopes[box[0]] + intercepts[box[0]], dtype=np.float32)

    return scaled, np.dtype(np.float32)


def without_inversion(scan: Scan) -> Scan:
    """Undo the exchange of bright and dark: numbers that name bodies are neither."""
    if not scan.inverted:
        return scan
    kept = tuple(notice for notice in scan.notices if notice != _white_is_zero(scan.name))
    return replace(scan, fetch=_inverted(scan.fetch, scan.dtype), notices=kept, inverted=False)


def _inverted(fetch: Fetch, dtype: np.dtype[Any]) -> Fetch:
    if dtype.kind == "f":
        return lambda box: -fetch(box)
    return lambda box: np.invert(fetch(box))


def _white_is_zero(name: str) -> Notice:
    text = (
        f"{name} says that 0 is white (WhiteIsZero): bright and dark were exchanged, so that bone is "
        f"bright. Grey values count from the other end of their range (255 less the stored one, 65535 less "
        f"it; floats change sign). If bone was bright as stored, correct the tag where the scan was exported."
    )
    return Notice("file_read", text)


def _reversed(fetch: Fetch, shape: tuple[int, int, int], axis: int) -> Fetch:
    """Return a reader of the grid with its x, y or z axis (0, 1, 2) reversed."""
    k = 2 - axis

    def reversed_fetch(box: Box) -> NDArray[Any]:
        asked = range(shape[k])[box[k]]
        if not len(asked):
            return fetch(box)
        first = shape[k] - 1 - asked[-1]
        turned = list(box)
        turned[k] = slice(first, shape[k] - asked[0], asked.step)
        values = fetch((turned[0], turned[1], turned[2]))
        return np.ascontiguousarray(np.flip(values, axis=k))

    return reversed_fetch


def _times(values: Array) -> str:
    return " x ".join(f"{value:.6g}" for value in values)
