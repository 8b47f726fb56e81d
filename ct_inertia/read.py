"""Open a scan of any supported format as a Volume in scan coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import existing_file
from ct_inertia.volume import Volume, reversed_axis
from kinematics.errors import sentence
from kinematics.notices import Notice

ITK_SUFFIXES = (".nrrd", ".nhdr", ".mha", ".mhd", ".nii", ".nii.gz")
_TIFF = (".tif", ".tiff", ".btf", ".tf8")


def read_volume(
    path: Path | str,
    spacing_mm: float | Sequence[float] | None = None,
    mirror: str | None = None,
    nan_as_air: bool = False,
) -> Volume:
    """Open a scan: TIFF stack, folder of slices, NRRD, MetaImage, NIfTI, Scanco ISQ and AIM, DICOM.

    Parameters
    ----------
    path : Path or str
    spacing_mm : float or sequence of 3 floats, optional
        Voxel spacing x, y, z in mm; needed where the file does not tell it, and overrides the file.
    mirror : str, optional
        ``x``, ``y`` or ``z``: reverse the slices along that array axis. The box of the scan keeps its place
        and its origin; the content is reflected inside it.
    nan_as_air : bool
        Let voxels that are not finite count as air.

    Returns
    -------
    Volume
        Memory-mapped where the file allows; its notices say when nothing confirms the handedness.

    Raises
    ------
    CtInertiaError
        The file is missing, of an unknown kind, damaged, truncated, has no spacing, is not a
        three-dimensional grey-value volume, is constant, or holds voxels that are not finite.
    """
    path = existing_file(Path(path))
    given = None if spacing_mm is None else np.asarray(spacing_mm, dtype=float).ravel().tolist()
    volume = _opened(path, given, mirror)
    volume = replace(volume, nan_as_air=nan_as_air)
    check_values(volume)
    if volume.handedness_confirmed or mirror is not None:
        return volume
    text = (
        f"Nothing in {path.name} confirms that its slices are in right-handed order: if they are not, the "
        f"ear is a mirror image. Check a known asymmetry in the report; --mirror x, y or z undoes it."
    )
    return replace(volume, notices=(*volume.notices, Notice("handedness_unconfirmed", text)))


def _opened(path: Path, spacing: list[float] | None, mirror: str | None) -> Volume:
    if mirror is not None:
        reversed_axis(np.zeros((1, 1, 1)), mirror)
    if path.is_file() and path.name.lower().endswith(ITK_SUFFIXES):
        from ct_inertia.readers.itk import read_itk

        return read_itk(path, spacing, mirror)
    volume = _dispatch(path, spacing)
    return volume if mirror is None else volume.mirrored(mirror)


def _dispatch(path: Path, spacing: list[float] | None) -> Volume:
    if path.is_dir():
        from ct_inertia.readers.dicom import holds_dicom, read_dicom
        from ct_inertia.readers.slices import read_slices

        return read_dicom(path, spacing) if holds_dicom(path) else read_slices(path, spacing)
    name = path.name.lower()
    if name.endswith(_TIFF):
        from ct_inertia.readers.tiff import read_tiff

        return read_tiff(path, spacing)
    from ct_inertia.readers.scanco import SCANCO_SUFFIXES, read_scanco

    if name.split(";")[0].endswith(SCANCO_SUFFIXES):
        return read_scanco(path, spacing)
    raise CtInertiaError(
        sentence(
            "the scan",
            "a TIFF, NRRD, MHA, MHD, NIfTI, ISQ or AIM file, or a folder of slices or DICOM files",
            path.name,
            next_step="Export it in one of these formats",
        )
    )


def check_values(volume: Volume) -> None:
    """Refuse volumes that hold no picture: constant, or with voxels that are not finite.

    Raises
    ------
    CtInertiaError
    """
    array = volume.array
    where = "" if volume.source is None else Path(volume.source).name
    first = array[0, 0, 0]
    sample = array[:: max(1, array.shape[0] // 8), ::8, ::8]
    settled = bool(np.any(sample != first))
    floating = array.dtype.kind == "f"
    if floating and not volume.nan_as_air:
        _check_finite(array, where)
    if not settled and all(np.all(piece == first) for piece in array):
        raise CtInertiaError(
            sentence(
                "the volume",
                "a picture with differing grey values",
                f"{first} in every voxel",
                where,
                next_step="Check that this is the reconstructed volume, and export it again",
            )
        )


def _check_finite(array: NDArray[Any], where: str) -> None:
    bad = sum(int(np.count_nonzero(~np.isfinite(piece))) for piece in array)
    if bad:
        raise CtInertiaError(
            sentence(
                "the grey values",
                "finite",
                f"{bad} voxels of NaN or infinity",
                where,
                "Replace them, or let them count as air with --nan-as-air",
            )
        )
