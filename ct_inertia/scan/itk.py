"""NRRD and MetaImage: geometry by SimpleITK; raw voxels are read where they lie, packed ones unpacked once.

SimpleITK does not say where voxels begin, what the unit of length is and whether the axes are a patient's:
these few fields are looked up in the text of the header.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
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
    wrong_header,
)
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.scan import check_grey_values
from ct_inertia.scan.streams import check_surplus, unpack, unpack_once
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


@dataclass(frozen=True)
class _Voxels:
    """Where the voxels of a header lie.

    Attributes
    ----------
    pieces : list of (Path, int)
        Files, each with the byte of its voxels or of its packed stream; -1: counted from its end.
    packing : str
        ``raw``, ``deflate`` or ``bzip2``.
    skip : int
        Unpacked bytes before the first voxel of a packed stream; -1: counted from its end.
    order : str
        Byte order, ``<`` or ``>``.
    attached : bool
        They are in the file of the header.
    """

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
    info = _Information(path)
    space = _field(text, "space").lower().replace("_", "-")
    if space == "3d-left-handed":
        raise StapeskitError.of(
            "the space", "right-handed", "3D-left-handed", path.name, "Export it in LPS or RAS"
        )
    segments = _segments(info)
    opened = info.opened(path, voxels.order, layers=bool(segments))
    units = re.findall(r'"([^"]*)"', _field(text, "space units") or _field(text, "units"))
    factors = {factor for unit in units if (factor := mm_per_unit(unit)) is not None}
    if len(factors) > 1:
        step = "Save it with one unit, or give --spacing for a copy without units"
        raise StapeskitError.of("the units", "the same along all axes", ", ".join(units), path.name, step)
    factor = factors.pop() if factors else 1.0
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
    info = _Information(path)
    opened = info.opened(path, voxels.order)
    factor = mm_per_unit(_field(text, "DistanceUnits")) or 1.0
    opened.origin_mm = opened.origin_mm * factor
    stated = bool(_field(text, "ElementSpacing") or _field(text, "ElementSize"))
    opened.spacing_mm = opened.spacing_mm * factor if stated and opened.spacing_mm is not None else None
    opened.anatomical = "?" not in (_field(text, "AnatomicalOrientation") or "?")
    return _with_voxels(opened, voxels, path)


class _Information:
    """What SimpleITK reads of a header."""

    def __init__(self, path: Path) -> None:
        import SimpleITK as sitk

        sitk.ProcessObject.SetGlobalWarningDisplay(False)
        reader: Any = sitk.ImageFileReader()
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
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
            wanted, step = "integers or floating point numbers", "Export it as real grey values"
            raise StapeskitError.of("the grey values", wanted, self.kind, path.name, step)
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
    files = [path]
    if named:
        _, _, listed = text.partition(named)
        names = listed_files(path, named, [line.strip() for line in listed.splitlines() if line.strip()])
        files = [_existing(path, name) for name in names]
    pieces = []
    for file in files:
        start = _past_lines(file, 0 if named else end, lines)
        # Of raw voxels bytes are skipped in the file, of packed ones in what is unpacked.
        pieces.append((file, start if packing != "raw" else -1 if skip == -1 else start + skip))
    return _Voxels(pieces, packing, skip, order, not named)


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
    names = listed_files(path, named, listed)
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


def _past_lines(file: Path, start: int, count: int) -> int:
    with file.open("rb") as stream:
        stream.seek(start)
        for _ in range(count):
            if not stream.readline(_HEADER_BYTES):
                break
        return stream.tell()


def _with_voxels(opened: Opened, voxels: _Voxels, path: Path) -> Opened:
    """Say where the voxels lie, or how they are unpacked as a whole."""
    opened.files = tuple(dict.fromkeys([path, *(file for file, _ in voxels.pieces)]))
    if voxels.packing == "raw":
        opened.planes = planes_in(voxels.pieces, opened.shape, opened.dtype, path.name)
        check_surplus(opened, voxels.pieces, voxels.attached)
        return opened
    opened.read = unpack_once(lambda: _unpack(voxels, opened.shape, opened.dtype))
    return opened


def _unpack(voxels: _Voxels, shape: Sequence[int], dtype: np.dtype[Any]) -> NDArray[Any]:
    return unpack(voxels.pieces, voxels.packing, voxels.skip, shape, dtype, voxels.attached)


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

    def labelled() -> NDArray[Any]:
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
    opened.dtype = np.dtype(np.uint16)
    opened.read = unpack_once(labelled)
    opened.files = tuple(dict.fromkeys([path, *(file for file, _ in voxels.pieces)]))
    return opened
