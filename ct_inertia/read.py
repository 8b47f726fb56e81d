"""Open a scan of any supported format as a Volume in scan coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import existing_file
from ct_inertia.readers.dicom import holds_dicom, is_dicom
from ct_inertia.readers.raw import RAW_SUFFIXES, RawLayout, companion, layout_missing
from ct_inertia.readers.tiff_pages import WHITE_IS_ZERO
from ct_inertia.volume.blocks import turned
from ct_inertia.volume.volume import Volume, reversed_axis
from stapeskit.faults import Fault
from stapeskit.warnings import Notice

ITK_SUFFIXES = (".nrrd", ".nhdr", ".mha", ".mhd", ".nii", ".nii.gz")
FORMATS = (
    "TIFF, NRRD, MHA, MHD, NIfTI, DICOM, ISQ, AIM, VGI, AM, raw voxels, a folder of slices or DICOM files, "
    "OME-Zarr"
)
_READERS = (
    ((".tif", ".tiff", ".btf", ".tf8", ".tf2"), "tiff", "read_tiff"),
    ((".nrrd", ".nhdr"), "nrrd", "read_nrrd"),
    ((".mha", ".mhd"), "metaimage", "read_metaimage"),
    ((".nii", ".nii.gz", ".hdr"), "nifti", "read_nifti"),
    ((".isq", ".rsq", ".rad"), "isq", "read_isq"),
    ((".aim",), "aim", "read_aim"),
    ((".vgi",), "vgi", "read_vgi"),
    ((".am",), "amira", "read_amira"),
    ((".dcm", ".dicom", ".ima"), "dicom", "read_dicom_file"),
)
# Their headers tell directions, which may be left-handed: they take the mirror themselves.
_TURNABLE = ("nrrd", "metaimage", "nifti")


def read_volume(
    path: Path | str,
    spacing_mm: float | Sequence[float] | None = None,
    mirror: str | None = None,
    nan_as_air: bool = False,
    raw: RawLayout | None = None,
) -> Volume:
    """Open a scan of any format that `FORMATS` lists.

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
    raw : RawLayout, optional
        How raw voxels lie in a file without a header.

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
    given = None if spacing_mm is None else np.asarray(spacing_mm, dtype=float).ravel().tolist()
    if raw is None and path.is_file() and path.name.lower().endswith(RAW_SUFFIXES):
        path = companion(path) or path
    volume = _opened(path, given, mirror, raw)
    volume = replace(volume, nan_as_air=nan_as_air)
    check_values(volume)
    if volume.handedness_confirmed or mirror is not None:
        return volume
    text = (
        f"Nothing in {path.name} confirms that its slices are in right-handed order: if they are not, the "
        f"ear is a mirror image. Check a known asymmetry in the report; --mirror x, y or z undoes it."
    )
    return replace(volume, notices=(*volume.notices, Notice("handedness_unconfirmed", text)))


def read_labels(
    path: Path | str, spacing_mm: float | Sequence[float] | None = None, mirror: str | None = None
) -> Volume:
    """Open a label volume of any format and hold its voxels in memory.

    Raises
    ------
    CtInertiaError
        As `read_volume`.
    """
    volume = read_volume(path, spacing_mm, mirror)
    kept = tuple(notice for notice in volume.notices if notice.code != WHITE_IS_ZERO)
    # Numbers that name bodies are no matter of bright and dark.
    array = volume.array if len(kept) == len(volume.notices) else turned(volume.array)
    return replace(volume, array=np.asarray(array), notices=kept)


def _opened(path: Path, spacing: list[float] | None, mirror: str | None, raw: RawLayout | None) -> Volume:
    if mirror is not None:
        reversed_axis(np.zeros((1, 1, 1)), mirror)
    module, name = _reader(path, raw is not None)
    read = getattr(import_module(f"ct_inertia.readers.{module}"), name)
    if raw is not None:
        volume = read(path, raw, spacing)
    elif module in _TURNABLE:
        return cast(Volume, read(path, spacing, mirror))
    else:
        volume = read(path, spacing)
    return cast(Volume, volume if mirror is None else volume.mirrored(mirror))


def _reader(path: Path, raw: bool) -> tuple[str, str]:
    """Return the module and the function that read a file or folder."""
    if raw and path.is_file():
        return "raw", "read_raw"
    if path.is_dir():
        return _folder_reader(path)
    # VMS adds a version number to the names of Scanco files: SCAN.ISQ;1
    name = path.name.lower().split(";")[0]
    for suffixes, module, function in _READERS:
        if name.endswith(suffixes):
            return module, function
    if name.endswith(RAW_SUFFIXES):
        raise layout_missing(path)
    if is_dicom(path):
        return "dicom", "read_dicom_file"
    raise CtInertiaError(
        Fault(
            "the scan",
            f"a volume of a known format ({FORMATS})",
            path.name,
            next_step="Export it in one of these formats, or as raw voxels with --shape and --dtype",
        )
    )


def _folder_reader(path: Path) -> tuple[str, str]:
    if any((path / name).is_file() for name in (".zattrs", ".zgroup", ".zarray", "zarr.json")):
        return "ome_zarr", "read_ome_zarr"
    return ("dicom", "read_dicom") if holds_dicom(path) else ("slices", "read_slices")


def check_values(volume: Volume) -> None:
    """Refuse volumes that hold no picture: constant, or with voxels that are not finite.

    Raises
    ------
    CtInertiaError
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
        raise CtInertiaError(
            Fault(
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
            Fault(
                "the grey values",
                "finite",
                f"{bad} voxels of NaN or infinity",
                where,
                "Replace them, or let them count as air with --nan-as-air",
            )
        )
