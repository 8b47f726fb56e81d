"""NRRD, MetaImage and NIfTI volumes through SimpleITK, with direction and origin (LPS)."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import check_size, not_readable, settle_spacing
from ct_inertia.volume import Volume, unmirrored_frame
from kinematics.errors import sentence

_BYTES = {
    "8-bit": np.uint8,
    "16-bit": np.uint16,
    "32-bit": np.uint32,
    "64-bit": np.uint64,
}


def read_itk(path: Path, spacing_mm: Sequence[float] | None = None, mirror: str | None = None) -> Volume:
    """Read a volume whose header tells spacing, origin and direction.

    ``mirror`` reverses the slices along one axis; on a left-handed grid that makes it right-handed.

    Raises
    ------
    CtInertiaError
        Not readable, truncated, not three-dimensional, several values per voxel, complex, no spacing, or
        a left-handed direction matrix without ``mirror``.
    """
    import SimpleITK as sitk

    try:
        reader = sitk.ImageFileReader()
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
    except RuntimeError as fault:
        raise not_readable(path, "volume", fault) from fault
    _check_kind(reader, path)
    header = _header(path)
    spacing, notices = settle_spacing(_spacing(reader, header, path), spacing_mm, path.name)
    origin, direction = np.zeros(3), np.eye(3)
    if reader.GetDimension() == 3:
        origin = np.array(reader.GetOrigin())
        direction = np.array(reader.GetDirection()).reshape(3, 3)
    if mirror is not None and np.linalg.det(direction) < 0.0:
        size = np.array(reader.GetSize()[:3])
        origin, direction = unmirrored_frame(origin, direction, size, spacing, mirror)
        mirror = None
    array = _array(reader, path, header)
    volume = Volume(array, spacing, origin, direction, _anatomical(path, header), path, notices=notices)
    return volume if mirror is None else volume.mirrored(mirror)


def _check_kind(reader: Any, path: Path) -> None:
    import SimpleITK as sitk

    size = list(reader.GetSize())
    while len(size) > 3 and size[-1] == 1:
        size.pop()
    kind = sitk.GetPixelIDValueAsString(reader.GetPixelID())
    if len(size) != 3 or min(size) < 2:
        shape = " x ".join(map(str, reader.GetSize()))
        raise CtInertiaError(
            sentence(
                "the volume",
                "three-dimensional",
                f"an image of shape {shape}",
                path.name,
                next_step="Give the whole stack",
            )
        )
    if "complex" in kind:
        raise CtInertiaError(
            sentence("the volume", "real grey values", "complex numbers", path.name, "Export the magnitude")
        )
    if reader.GetNumberOfComponents() > 1:
        raise CtInertiaError(
            sentence(
                "the volume",
                "one grey value per voxel",
                f"{reader.GetNumberOfComponents()} (a colour or vector image)",
                path.name,
                "Export one channel",
            )
        )


def _array(reader: Any, path: Path, header: str) -> NDArray[Any]:
    import SimpleITK as sitk

    kind = sitk.GetPixelIDValueAsString(reader.GetPixelID())
    dtype = next((np.dtype(t) for word, t in _BYTES.items() if word in kind), np.dtype(np.uint8))
    data, packed = _stored(path, header)
    shape = tuple(reversed(reader.GetSize()))
    check_size(shape, dtype, sum(p.stat().st_size for p in data), packed, path.name)
    if path.suffix.lower() == ".gz":
        _check_gzip(path, int(np.prod(shape, dtype=np.int64)) * dtype.itemsize)
    try:
        array = sitk.GetArrayFromImage(reader.Execute())
    except RuntimeError as fault:
        raise not_readable(path, "volume", fault) from fault
    return np.asarray(array).reshape([n for n in array.shape if n > 1] if array.ndim > 3 else array.shape)


def _header(path: Path) -> str:
    """Return the beginning of a text header; empty for binary headers."""
    with path.open("rb") as stream:
        start = stream.read(1 << 14)
    if path.suffix.lower() in (".nrrd", ".nhdr"):
        return start.split(b"\n\n")[0].decode("latin-1")
    if path.suffix.lower() in (".mha", ".mhd"):
        end = re.search(rb"ElementDataFile[^\n]*", start)
        return start[: end.end() if end else len(start)].decode("latin-1")
    return ""


def _stored(path: Path, header: str) -> tuple[list[Path], bool]:
    """Return the files that hold the voxels and whether they are compressed."""
    packed = path.suffix.lower() == ".gz"
    if re.search(r"^CompressedData\s*=\s*true", header, re.I | re.M) or re.search(
        r"^encoding:\s*(gz|bz|zstd)", header, re.I | re.M
    ):
        packed = True
    named = re.search(r"^(?:ElementDataFile\s*=|data file:|datafile:)\s*(.+?)\s*$", header, re.I | re.M)
    if named and named[1].upper() not in ("LOCAL", "LIST") and "%" not in named[1]:
        data = path.parent / named[1]
        if not data.is_file():
            raise CtInertiaError(
                sentence(
                    "the header",
                    "beside its data file",
                    f"no {named[1]}",
                    path.name,
                    "Copy both files together",
                )
            )
        return [data], packed
    if named and named[1].upper() != "LOCAL":
        return [p for p in path.parent.iterdir() if p.is_file()], True
    return [path], packed


def _spacing(reader: Any, header: str, path: Path) -> NDArray[np.float64] | None:
    spacing = np.array(reader.GetSpacing()[:3])
    suffix = path.suffix.lower()
    if suffix in (".mha", ".mhd") and not re.search(r"^Element(Spacing|Size)\s*=", header, re.M):
        return None
    if suffix in (".nrrd", ".nhdr") and not re.search(r"^(spacings|space directions):", header, re.M):
        return None
    return spacing


def _anatomical(path: Path, header: str) -> bool:
    """Say whether the header ties its axes to the patient."""
    suffix = path.suffix.lower()
    if suffix in (".nrrd", ".nhdr"):
        found = re.search(r"^space:\s*(.+?)\s*$", header, re.M)
        return bool(found and re.match(r"(left|right|LPS|RAS|LAS)", found[1]))
    if suffix in (".mha", ".mhd"):
        found = re.search(r"^AnatomicalOrientation\s*=\s*(\S+)", header, re.M)
        return bool(found and "?" not in found[1])
    if suffix in (".nii", ".gz"):
        return max(_nifti_field(path, 252, "<i2"), _nifti_field(path, 254, "<i2")) > 0
    return False


def _nifti_field(path: Path, offset: int, dtype: str) -> int:
    with path.open("rb") as stream:
        start = stream.read(1 << 12)
    if path.suffix.lower() == ".gz":
        start = zlib.decompressobj(31).decompress(start)
    kind = np.dtype(dtype)
    if start[:4] == (348).to_bytes(4, "big"):
        kind = kind.newbyteorder(">")
    return int(np.frombuffer(start, kind, 1, offset)[0])


def _check_gzip(path: Path, voxel_bytes: int) -> None:
    """Compare the length that gzip notes at the end of the file with what the header needs."""
    with path.open("rb") as stream:
        stream.seek(-4, 2)
        noted = int.from_bytes(stream.read(4), "little")
    surplus = (noted - voxel_bytes) % (1 << 32)
    if surplus > 1 << 20:
        raise CtInertiaError(
            sentence(
                "the compressed volume",
                f"complete ({voxel_bytes} bytes of voxels)",
                "a file that ends early",
                path.name,
                "Copy or export it again",
            )
        )
