"""NRRD and MetaImage by SimpleITK, NIfTI by nibabel: their geometry; raw voxels are read where they lie.

SimpleITK does not say where voxels begin, what the unit of length is and whether the axes are a patient's:
these few fields are looked up in the text of the header.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.opened import (
    Opened,
    ReadOptions,
    beside,
    listed_files,
    no_data_file,
    planes_in,
    several_values,
    too_short,
    wrong_header,
)
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.scan import Box, check_grey_values
from ct_inertia.scan.streams import unpacked
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_HEADER_BYTES = 1 << 20  # most bytes of a text header, which has some kilobytes
_PICTURES = (".tif", ".tiff", ".png", ".jpg", ".jpeg", ".bmp")
_KINDS = {
    "8-bit unsigned integer": "u1",
    "8-bit signed integer": "i1",
    "16-bit unsigned integer": "u2",
    "16-bit signed integer": "i2",
    "32-bit unsigned integer": "u4",
    "32-bit signed integer": "i4",
    "64-bit unsigned integer": "u8",
    "64-bit signed integer": "i8",
    "32-bit float": "f4",
    "64-bit float": "f8",
}
_NRRD_PACKINGS = {
    "raw": "raw",
    **dict.fromkeys(("gzip", "gz"), "deflate"),
    **dict.fromkeys(("bzip2", "bz2"), "bzip2"),
}
_PATIENT = re.compile(r"(ras|las|lps|\w+-(anterior|posterior)-\w+|\w+-\w+-(superior|inferior))(-time)?")
_LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True)
class _Voxels:
    """Where the voxels of a header lie: files with the byte (-1: counted from the end), packing, bytes to "
    "skip."""

    pieces: list[tuple[Path, int]]
    packing: str
    skip: int
    order: str
    attached: bool


def open_nrrd(path: Path, _: ReadOptions) -> Opened:
    """Open an NRRD volume or segmentation; of layers that overlap the segments are numbered anew.

    The format: https://teem.sourceforge.net/nrrd/format.html

    Raises
    ------
    StapeskitError
        A damaged header, a missing or too short data file, or several values in a voxel.
    """
    text, end = _header(path, rb"\r?\n\r?\n", "NRRD volume", rb"NRRD000", path.suffix.lower() == ".nhdr")
    voxels = _nrrd_voxels(path, text, end)
    info = _Information(path, "NRRD volume")
    space = _field(text, "space").lower().replace("_", "-")
    if space == "3d-left-handed":
        raise StapeskitError.of(
            "the space", "right-handed", "3D-left-handed", path.name, "Export it in LPS or RAS"
        )
    segments = _segments(info)
    opened = info.opened(path, voxels.order, layers=bool(segments))
    units = re.findall(r'"([^"]*)"', _field(text, "space units") or _field(text, "units"))
    factors = {factor for unit in units if (factor := mm_per_unit(unit)) is not None}
    factor = factors.pop() if len(factors) == 1 else 1.0
    opened.origin_mm = opened.origin_mm * factor
    stated = bool(_field(text, "spacings") or _field(text, "space directions"))
    opened.spacing_mm = opened.spacing_mm * factor if stated and opened.spacing_mm is not None else None
    opened.anatomical = _PATIENT.fullmatch(space) is not None
    if info.components == 1:
        opened.names = {value: name for _, value, name in segments}
        return _with_voxels(opened, voxels, path)
    return _flattened(opened, voxels, segments, info.components, path)


def open_metaimage(path: Path, _: ReadOptions) -> Opened:
    """Open a MetaImage volume whose voxels are in the file, in a second file or in a list of slabs.

    The format: https://itk.org/Wiki/ITK/MetaIO/Documentation

    Raises
    ------
    StapeskitError
        A damaged header, a missing or too short data file, or several values in a voxel.
    """
    end_of_header = rb"^ElementDataFile[ \t]*=[^\n]*\n?"
    text, end = _header(path, end_of_header, "MetaImage volume")
    voxels = _metaimage_voxels(path, text, end)
    info = _Information(path, "MetaImage volume")
    opened = info.opened(path, voxels.order)
    factor = mm_per_unit(_field(text, "DistanceUnits")) or 1.0
    opened.origin_mm = opened.origin_mm * factor
    stated = bool(_field(text, "ElementSpacing") or _field(text, "ElementSize"))
    opened.spacing_mm = opened.spacing_mm * factor if stated and opened.spacing_mm is not None else None
    opened.anatomical = "?" not in (_field(text, "AnatomicalOrientation") or "?")
    return _with_voxels(opened, voxels, path)


class _Information:
    """What SimpleITK reads of a header."""

    def __init__(self, path: Path, kind: str) -> None:
        import SimpleITK as sitk

        sitk.ProcessObject.SetGlobalWarningDisplay(False)
        reader: Any = sitk.ImageFileReader()
        reader.SetFileName(str(path))
        try:
            reader.ReadImageInformation()
        except RuntimeError as fault:
            raise wrong_header(path, kind, "one that SimpleITK cannot read") from fault
        self.kind = sitk.GetPixelIDValueAsString(reader.GetPixelID()).removeprefix("vector of ")
        self.components = int(reader.GetNumberOfComponents())
        self.size = [int(n) for n in reader.GetSize()]
        self.keys = {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys()}
        count = len(self.size)
        self.spacing = np.array(reader.GetSpacing())[:3]
        self.origin = np.array(reader.GetOrigin())[:3]
        self.direction = np.array(reader.GetDirection()).reshape(count, count)[:3, :3]

    def opened(self, path: Path, order: str, layers: bool = False) -> Opened:
        """Return the grid; ``layers`` lets a voxel have several values."""
        size = list(self.size)
        while len(size) > 3 and size[-1] == 1:
            size.pop()
        if self.components > 1 and not layers:
            raise several_values(path, f"{self.components} values (a colour or vector image)")
        if self.kind not in _KINDS:
            raise StapeskitError.of(
                "the grey values",
                "integers or floating point numbers",
                self.kind,
                path.name,
                "Export it as real grey values",
            )
        dtype = np.dtype(order + _KINDS[self.kind])
        if len(size) > 3 and min(size[:3]) > 1:
            raise several_values(path, f"{' x '.join(map(str, size[3:]))} values (a vector or time image)")
        check_grey_values(tuple(reversed(size)), dtype, path.name)
        spacing = np.abs(self.spacing)
        good = np.all(np.isfinite(spacing)) and np.all(spacing > 0.0)
        return Opened(
            tuple(reversed(size)),
            dtype,
            spacing_mm=spacing if good else None,
            origin_mm=self.origin,
            direction=self.direction,
        )


def _header(path: Path, end: bytes, kind: str, begin: bytes = b"", endless: bool = False) -> tuple[str, int]:
    """Return the text of a header and the offset of what follows it."""
    with path.open("rb") as stream:
        start = stream.read(_HEADER_BYTES)
    found = re.search(end, start, re.MULTILINE)
    if not re.match(begin, start) or (found is None and not endless):
        raise wrong_header(path, kind, "a file that does not begin as one")
    stop = found.end() if found else len(start)
    return start[:stop].decode("utf-8", "replace"), stop


def _field(text: str, name: str) -> str:
    """Return the value of a field of a text header; empty where it is missing."""
    found = re.search(
        rf"^{name.replace(' ', ' ?')}[ \t]*[:=][ \t]*([^=\r\n][^\r\n]*)?\r?$", text, re.M | re.I
    )
    return (found[1] or "").strip() if found else ""


def _whole(text: str, name: str, path: Path) -> int:
    """Return a field that is a whole number of at least -1, 0 where it is missing."""
    value = _field(text, name) or "0"
    if not re.fullmatch(r"-1|\d{1,15}", value):
        raise wrong_header(path, "header", f"{name} {value}")
    return int(value)


def _nrrd_voxels(path: Path, text: str, end: int) -> _Voxels:
    encoding = _field(text, "encoding").lower()
    packing = _NRRD_PACKINGS.get(encoding)
    if packing is None:
        wanted = f"one of {', '.join(_NRRD_PACKINGS)}"
        raise StapeskitError.of(
            "the encoding", wanted, encoding or "none", path.name, "Export it as raw or gzip"
        )
    skip, lines = _whole(text, "byte skip", path), _whole(text, "line skip", path)
    order = ">" if _field(text, "endian").lower() == "big" else "<"
    named = _field(text, "data file")
    if not named:
        return _Voxels([(path, -1 if packing == "raw" and skip == -1 else end)], packing, skip, order, True)
    listed = text.splitlines()
    at = next(k for k, line in enumerate(listed) if re.match(r"data ?file\s*:", line, re.I))
    names = listed_files(path, named, [line.strip() for line in listed[at + 1 :] if line.strip()], 1 << 20)
    pieces = []
    for name in names:
        file = _existing(path, name)
        past = _past_lines(file, lines) if lines else 0
        pieces.append((file, skip if skip == -1 else past + skip) if packing == "raw" else (file, past))
    return _Voxels(pieces, packing, skip, order, False)


def _metaimage_voxels(path: Path, text: str, end: int) -> _Voxels:
    def true(name: str) -> bool:
        return _field(text, name).lower() in ("true", "1")

    packing = "deflate" if true("CompressedData") else "raw"
    if _field(text, "BinaryData").lower() == "false":
        step = "Export it as binary data"
        raise StapeskitError.of("the voxels", "binary", "numbers as text", path.name, step)
    order = ">" if true("ElementByteOrderMSB") or true("BinaryDataByteOrderMSB") else "<"
    named, skip = _field(text, "ElementDataFile"), _whole(text, "HeaderSize", path)
    if named.upper() in ("LOCAL", ""):
        return _Voxels([(path, end)], packing, 0, order, True)
    with path.open("rb") as stream:
        behind = stream.read(_HEADER_BYTES)[end:].decode("utf-8", "replace")
    listed = [line.strip() for line in behind.splitlines() if line.strip()]
    names = listed_files(path, named, listed, 1 << 20)
    pictures = [name for name in names if Path(name).suffix.lower() in _PICTURES]
    if pictures:
        step = "Give the folder of slices itself, with --spacing"
        raise StapeskitError.of("the data files", "raw voxels", pictures[0], path.name, step)
    return _Voxels([(_existing(path, name), skip) for name in names], packing, 0, order, False)


def _existing(path: Path, name: str) -> Path:
    file = beside(path, name)
    if not file.is_file():
        raise no_data_file(file, path.name)
    return file


def _past_lines(file: Path, count: int) -> int:
    with file.open("rb") as stream:
        for _ in range(count):
            if not stream.readline(_HEADER_BYTES):
                break
        return stream.tell()


def _with_voxels(opened: Opened, voxels: _Voxels, path: Path) -> Opened:
    """Say where the voxels lie, or how they are unpacked as a whole."""
    opened.files = tuple(dict.fromkeys([path, *(file for file, _ in voxels.pieces)]))
    if voxels.packing == "raw":
        opened.planes = planes_in(voxels.pieces, opened.shape, opened.dtype, path.name)
        _check_surplus(opened, voxels)
        return opened
    opened.depth = opened.shape[0]
    opened.read = _unpacked_once(lambda: _unpack(voxels, opened.shape, opened.dtype))
    return opened


def _check_surplus(opened: Opened, voxels: _Voxels) -> None:
    """Refuse a separate data file that is longer than its voxels: a header of its own may come before "
    "them."""
    if voxels.attached or any(start == -1 for _, start in voxels.pieces):
        return
    share = int(np.prod(opened.shape, dtype=np.int64)) * opened.dtype.itemsize
    stored = sum(file.stat().st_size - start for file, start in voxels.pieces)
    if stored > share:
        raise _surplus(share, stored, voxels.pieces[0][0].name)


def _surplus(needed: int, stored: int, name: str) -> StapeskitError:
    return StapeskitError.of(
        "the data file",
        f"as long as its header says ({needed} bytes)",
        f"{stored} bytes",
        name,
        "If it begins with a header of its own, let the voxels be counted from its end: byte skip: -1 in "
        "NRRD, HeaderSize = -1 in MetaImage",
    )


def _unpack(voxels: _Voxels, shape: Sequence[int], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return all voxels of packed files."""
    out = np.empty(tuple(shape), dtype)
    parts = np.array_split(out.reshape(-1), len(voxels.pieces))
    for part, (file, start) in zip(parts, voxels.pieces, strict=True):
        filled, more = unpacked(voxels.packing, file, start, voxels.skip, part)
        if filled < part.nbytes:
            raise too_short(shape, part.nbytes, filled, file.name)
        if more and not voxels.attached and voxels.skip != -1:
            raise _surplus(part.nbytes, filled + more, file.name)
    return out


def _unpacked_once(unpack: Callable[[], NDArray[Any]]) -> Callable[[Box], NDArray[Any]]:
    """Return a reader of an array that is unpacked when it is first asked for."""
    held: list[NDArray[Any]] = []

    def read(box: Box) -> NDArray[Any]:
        if not held:
            held.append(unpack())
        values = held[0][box]
        return values.astype(values.dtype.newbyteorder("="), copy=False)

    return read


def _segments(info: _Information) -> list[tuple[int, int, str]]:
    """Return layer, value in that layer and name of each segment of a Slicer segmentation."""
    segments = []
    for number in range(1000):
        value = info.keys.get(f"Segment{number}_LabelValue", "").strip()
        if not value:
            break
        layer = info.keys.get(f"Segment{number}_Layer", "0").strip()
        if value.isdigit() and layer.isdigit():
            name = info.keys.get(f"Segment{number}_Name", f"segment {number + 1}")
            segments.append((int(layer), int(value), name))
    return segments


def _flattened(
    opened: Opened, voxels: _Voxels, segments: list[tuple[int, int, str]], layers: int, path: Path
) -> Opened:
    """Number the segments of a layered segmentation 1, 2, ... in the order of the file."""

    def unpack() -> NDArray[Any]:
        layered = _unpack(voxels, (*opened_shape, layers), stored)
        labels = np.zeros(opened_shape, dtype=np.uint16)
        for number, (layer, value, _) in enumerate(segments, start=1):
            labels[layered[..., layer] == value] = number
        return labels

    if any(layer >= layers for layer, _, _ in segments):
        raise wrong_header(path, "segmentation", f"a segment in a layer beyond its {layers} layers")
    opened_shape, stored = tuple(opened.shape), opened.dtype
    listed = ", ".join(f"{number} {name}" for number, (_, _, name) in enumerate(segments, start=1))
    text = (
        f"The segmentation has {layers} layers; its segments were numbered {listed}. Where two overlap the "
        f"later one counts."
    )
    opened.notices.append(Notice("segments_numbered", text))
    opened.names = {number: name for number, (_, _, name) in enumerate(segments, start=1)}
    opened.dtype, opened.depth = np.dtype(np.uint16), opened.shape[0]
    opened.read = _unpacked_once(unpack)
    opened.files = tuple(dict.fromkeys([path, *(file for file, _ in voxels.pieces)]))
    return opened


def open_nifti(path: Path, _: ReadOptions) -> Opened:
    """Open a NIfTI or Analyze volume; the sform places its voxels, otherwise the qform.

    The format: https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h

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
    except Exception as fault:
        raise wrong_header(path, "NIfTI volume", "one that nibabel cannot read") from fault
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
    opened = Opened(tuple(reversed(shape)), stored)
    opened.slope, opened.intercept = float(voxels.slope), float(voxels.inter)
    _place_nifti(opened, header, path.name)
    data = Path(image.file_map["image"].filename)
    opened.files = tuple(dict.fromkeys([path, data]))
    if data.suffix.lower() != ".gz":
        opened.planes = planes_in([(data, int(voxels.offset))], opened.shape, stored, data.name)
        return opened
    packed = _Voxels([(data, 0)], "deflate", int(voxels.offset), "<", True)
    opened.depth = opened.shape[0]
    opened.read = _unpacked_once(lambda: _unpack(packed, opened.shape, stored))
    return opened


def _place_nifti(opened: Opened, header: Any, name: str) -> None:
    """Set spacing, origin and direction by the rules of nifti1.h: sform, else qform, else voxel sizes "
    "alone."""
    sform, qform = (
        (header.get_sform(True)[0], header.get_qform(True)[0]) if "sform_code" in header else (None, None)
    )
    unit = mm_per_unit(header.get_xyzt_units()[0]) if "xyzt_units" in header else None
    if unit is None:
        unit = 1.0
        text = f"{name} does not say its unit of length: mm was taken, as NIfTI programs do."
        opened.notices.append(Notice("length_unit_missing", text))
    steps = np.abs(np.asarray(header.get_zooms()[:3], dtype=float))
    bare = np.diag([*steps, 1.0])
    affine = sform if sform is not None else qform
    affine = bare if affine is None else np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not np.all(np.isfinite(affine)) or np.any(spacing <= 0.0):
        return
    opened.spacing_mm, opened.origin_mm = spacing * unit, affine[:3, 3] * unit
    opened.direction = affine[:3, :3] / spacing
    opened.anatomical = sform is not None or qform is not None
    if sform is None:
        return
    other, called = bare, "voxel sizes (pixdim)"
    if qform is not None:
        other, called = np.diag([-1.0, -1.0, 1.0, 1.0]) @ qform, "qform"
    else:
        other = np.column_stack([affine[:, :3] / np.append(spacing, 1.0)[:3] * steps, affine[:, 3]])
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
