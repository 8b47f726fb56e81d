"""Open a scan of any supported format as a Volume in scan coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import existing_file
from legacy.ct_inertia.readers.formats import ReadOptions, format_of
from legacy.ct_inertia.readers.raw_layout import RawLayout
from legacy.ct_inertia.readers.tiff_pages import WHITE_IS_ZERO
from legacy.ct_inertia.volume.lazy_arrays import invert_grey_values
from legacy.ct_inertia.volume.volume import Volume, check_axis
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice


def read_volume(
    path: Path | str,
    spacing_mm: float | Sequence[float] | None = None,
    mirror: str | None = None,
    nan_as_air: bool = False,
    raw: RawLayout | None = None,
    follow: bool = False,
) -> Volume:
    """Open a scan of any format in the table `ct_inertia.readers.formats.FORMATS`.

    Parameters
    ----------
    path : Path or str
    spacing_mm : float or sequence of 3 floats, optional
        Voxel spacing x, y, z in mm; needed where the file has none; replaces that of the file.
    mirror : str, optional
        ``x``, ``y`` or ``z``: reverse the slices along that array axis. The box of the scan keeps its place
        and its origin; the content is reflected inside it.
    nan_as_air : bool
        Let voxels that are not finite count as air.
    raw : RawLayout, optional
        How raw voxels lie in a file without a header.
    follow : bool
        Data files that a header names may lie outside its folder.

    Returns
    -------
    Volume
        Memory-mapped where the file allows, read block by block where its voxels are scattered or packed
        in pieces, and unpacked in memory only where it is packed as a whole. Its
        notices say when nothing confirms the handedness.

    Raises
    ------
    CtInertiaError
        The file is missing, of an unknown kind, damaged, truncated, has no spacing, is not a
        three-dimensional grey-value volume, is constant, or holds voxels that are not finite.
    """
    path = existing_file(Path(path))
    path = path if path.name else path.resolve()  # messages name the folder "." too
    given = None if spacing_mm is None else np.asarray(spacing_mm, dtype=float).ravel().tolist()
    if mirror is not None:
        check_axis(mirror)
    volume = format_of(path, raw).read(path, ReadOptions(given, mirror, raw, follow))
    volume = replace(volume, nan_as_air=nan_as_air)
    check_values(volume)
    if volume.handedness_confirmed or mirror is not None:
        return volume
    name = (volume.source or path).name
    text = (
        f"Nothing in {name} confirms that its slices are in right-handed order: if they are not, the "
        f"ear is a mirror image. Check a known asymmetry in the report; {named('mirror')} x, y or z "
        "undoes it."
    )
    return replace(volume, notices=(*volume.notices, Notice("handedness_unconfirmed", text)))


def read_labels(
    path: Path | str,
    spacing_mm: float | Sequence[float] | None = None,
    mirror: str | None = None,
    follow: bool = False,
) -> Volume:
    """Open a label volume of any format and hold its voxels in memory.

    The spacing of its own file counts; ``spacing_mm``, that of the scan, is used where it has none.

    Raises
    ------
    CtInertiaError
        As `read_volume`.
    """
    try:
        volume = read_volume(path, None, mirror, follow=follow)
    except CtInertiaError:
        if spacing_mm is None:
            raise
        volume = read_volume(path, spacing_mm, mirror, follow=follow)
    kept = tuple(notice for notice in volume.notices if notice.code != WHITE_IS_ZERO)
    # Numbers that name bodies are no matter of bright and dark.
    array = volume.array if len(kept) == len(volume.notices) else invert_grey_values(volume.array)
    return replace(volume, array=np.asarray(array), notices=kept)


def check_values(volume: Volume) -> None:
    """Refuse volumes that hold no picture: constant, or with voxels that are not finite.

    Raises
    ------
    CtInertiaError
        All voxels are equal, or some are NaN or infinite and do not count as air.
    """
    array = volume.array
    where = "" if volume.source is None else Path(volume.source).name
    first = array[0, 0, 0]
    # A row and a plane settle nearly every volume; packed ones are spared unpacking more.
    z, y = array.shape[0] // 2, array.shape[1] // 2
    settled = bool(np.any(array[z, y] != first)) or bool(np.any(array[z] != first))
    floating = array.dtype.kind == "f"
    if floating and not volume.nan_as_air:
        _check_finite(array, where)
    if not settled and all(np.all(piece == first) for piece in array):
        raise CtInertiaError.of(
            "the volume",
            "a picture with differing grey values",
            f"{first} in every voxel",
            where,
            next_step="Check that this is the reconstructed volume, and export it again",
        )


def _check_finite(array: NDArray[Any], where: str) -> None:
    bad = sum(int(np.count_nonzero(~np.isfinite(piece))) for piece in array)
    if bad:
        raise CtInertiaError.of(
            "the grey values",
            "finite",
            f"{bad} voxels of NaN or infinity",
            where,
            "Replace them, or let them count as air with {nan_as_air}",
        )
