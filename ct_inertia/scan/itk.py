"""NRRD and MetaImage: geometry by SimpleITK; raw voxels are read where they lie, packed ones unpacked once.

SimpleITK does not say where voxels begin, what the unit of length is and whether the axes are a patient's:
these few fields are looked up in the text of the header.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.opened import (
    HEADER_BYTES,
    Opened,
    ReadOptions,
    beside,
    check_surplus,
    no_data_file,
    planes_in,
    several_values,
    wrong_header,
)
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.scan import check_grey_values
from ct_inertia.scan.streams import unpack, unpack_once
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_MOST_FILES = 100_000  # of a list in a header: ten times the slices of any scan
_DATA_FILE = "(?:data ?file|ElementDataFile)"
_PICTURES = (".tif", ".tiff", ".png", ".jpg", ".jpeg", ".bmp")
_LETTERS = {"unsigned integer": "u", "signed integer": "i", "float": "f"}
_NRRD_PACKED = {"raw": False, **dict.fromkeys(("gzip", "gz", "bzip2", "bz2"), True)}
_PATIENT = re.compile(r"(ras|las|lps|\w+-(anterior|posterior)-\w+|\w+-\w+-(superior|inferior))(-time)?")
_FIELD = re.compile(r"^([^:=#\r\n]+?)[ \t]*(:=|[:=])[ \t]*([^\r\n]*?)\r?$", re.MULTILINE)


@dataclass(frozen=True)
class _Header:
    """A text header.

    Attributes
    ----------
    path : Path
    text : str
    fields : dict of str to str
        Names in lower case without spaces.
    keys : dict of str to str
        Of other programs (``name:=value``).
    end : int
        Byte behind it.
    """

    path: Path
    text: str
    fields: dict[str, str]
    keys: dict[str, str]
    end: int

    @classmethod
    def read(cls, path: Path, end: bytes, kind: str, begin: bytes = b"") -> Self:
        """Read a header up to the first match of ``end``; a detached NRRD header may do without."""
        with path.open("rb") as stream:
            start = stream.read(HEADER_BYTES)
        found = re.search(end, start, re.MULTILINE)
        if not start.startswith(begin) or (found is None and path.suffix.lower() != ".nhdr"):
            raise wrong_header(path, kind, "a file that does not begin as one")
        stop = found.end() if found else len(start)
        fields: dict[str, str] = {}
        keys: dict[str, str] = {}
        for name, sign, value in _FIELD.findall(start[:stop].decode("utf-8", "replace")):
            if sign == ":=":
                keys[name] = value.strip()
            else:
                fields.setdefault(name.lower().replace(" ", ""), value.strip())
        return cls(path, start.decode("utf-8", "replace"), fields, keys, stop)

    def get(self, *names: str) -> str:
        """Return the first of these fields that is there; empty without."""
        return next((value for name in names if (value := self.fields.get(name))), "")

    def true(self, *names: str) -> bool:
        """Return whether a field says true."""
        return self.get(*names).lower() in ("true", "1")

    def whole(self, name: str) -> int:
        """Return a field that is a whole number of at least -1, 0 where it is missing."""
        value = self.get(name) or "0"
        if not re.fullmatch(r"-1|\d{1,15}", value):
            raise wrong_header(self.path, "header", f"{name} {value}")
        return int(value)

    def data_files(self, name: str) -> list[Path]:
        """Return the data files of a field: one, the lines behind ``LIST``, or ``pattern first last [step]``.

        Raises
        ------
        StapeskitError
            An empty list, a pattern without whole numbers, more files than a scan can have, or a missing one.
        """
        named = self.get(name)
        names = [named]
        if named.upper().startswith("LIST"):
            behind = re.split(rf"^{_DATA_FILE}[ \t]*[:=].*$", self.text, maxsplit=1, flags=re.M | re.I)[-1]
            names = [line.strip() for line in behind.splitlines() if line.strip()]
        elif "%" in named:
            parts = re.fullmatch(
                r"([^%]*%0?\d{0,2}d[^%\s]*)\s+(\d{1,7})\s+(\d{1,7})(?:\s+([1-9]\d{0,6}))?(?:\s+\d+)?", named
            )
            numbers = range(int(parts[2]), int(parts[3]) + 1, int(parts[4] or 1)) if parts else range(0)
            names = [parts[1] % number for number in numbers[: _MOST_FILES + 1]] if parts else []
        if not 0 < len(names) <= _MOST_FILES:
            raise wrong_header(self.path, "header", f"the data files {named}")
        files = [beside(self.path, one) for one in names]
        missing = [file for file in files if not file.is_file()]
        if missing:
            raise no_data_file(missing[0], self.path.name)
        return files


@dataclass(frozen=True)
class _Voxels:
    """Where the voxels of a header lie.

    Attributes
    ----------
    pieces : list of (Path, int)
        Files, each with the byte of its voxels or of its packed stream; -1: counted from its end.
    packed : bool
    skip : int
        Unpacked bytes before the first voxel of a packed stream; -1: counted from its end.
    order : str
        Byte order, ``<`` or ``>``.
    attached : bool
        They are in the file of the header.
    """

    pieces: list[tuple[Path, int]]
    packed: bool
    skip: int
    order: str
    attached: bool

    def unpack(self, shape: Sequence[int], dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return the voxels of packed files."""
        return unpack(self.pieces, self.skip, shape, dtype, self.attached)


def open_nrrd(path: Path, _: ReadOptions) -> Opened:
    """Open an NRRD volume or segmentation; of layers that overlap the segments are numbered anew.

    The format: https://teem.sourceforge.net/nrrd/format.html

    Raises
    ------
    StapeskitError
        A damaged header, a missing or too short data file, or several values in a voxel.
    """
    header = _Header.read(path, rb"\r?\n\r?\n", "NRRD volume", b"NRRD000")
    voxels = _nrrd_voxels(header)
    space = header.get("space").lower().replace("_", "-")
    if space == "3d-left-handed":
        step = "Export it in LPS or RAS"
        raise StapeskitError.of("the space", "right-handed", "3D-left-handed", path.name, step)
    segments = _segments(header.keys)
    opened, components = _grid(path, voxels, layers=bool(segments))
    units = re.findall(r'"([^"]*)"', header.get("spaceunits", "units"))
    factors = {factor for unit in units if (factor := mm_per_unit(unit)) is not None}
    if len(factors) > 1:
        step = "Save it with one unit, or give --spacing for a copy without units"
        raise StapeskitError.of("the units", "the same along all axes", ", ".join(units), path.name, step)
    _scale(opened, factors.pop() if factors else 1.0, header.get("spacings", "spacedirections"))
    opened.anatomical = _PATIENT.fullmatch(space) is not None
    if components == 1:
        opened.names = {value: name for _, value, name in segments}
        return _with_voxels(opened, voxels)
    return _flattened(opened, voxels, segments, components, path)


def open_metaimage(path: Path, _: ReadOptions) -> Opened:
    """Open a MetaImage volume whose voxels are in the file, in a second file or in a list of slabs.

    The format: https://itk.org/Wiki/ITK/MetaIO/Documentation

    Raises
    ------
    StapeskitError
        A damaged header, a missing or too short data file, or several values in a voxel.
    """
    header = _Header.read(path, rb"^ElementDataFile[ \t]*=[^\n]*\n?", "MetaImage volume")
    voxels = _metaimage_voxels(header)
    opened = _grid(path, voxels)[0]
    factor = mm_per_unit(header.get("distanceunits")) or 1.0
    _scale(opened, factor, header.get("elementspacing", "elementsize"))
    opened.anatomical = "?" not in (header.get("anatomicalorientation") or "?")
    return _with_voxels(opened, voxels)


def _grid(path: Path, voxels: _Voxels, layers: bool = False) -> tuple[Opened, int]:
    """Return what SimpleITK reads of a header, and the values in a voxel: ``layers`` allows several."""
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    reader: Any = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    components = int(reader.GetNumberOfComponents())
    size = [int(n) for n in reader.GetSize()]
    count = len(size)
    while len(size) > 3 and size[-1] == 1:
        size.pop()
    if components > 1 and not layers:
        raise several_values(path, f"{components} values (a colour or vector image)")
    named = sitk.GetPixelIDValueAsString(reader.GetPixelID()).removeprefix("vector of ")
    kind = re.fullmatch(r"(\d+)-bit (.*)", named)
    if kind is None or kind[2] not in _LETTERS:
        wanted, step = "integers or floating point numbers", "Export it as real grey values"
        raise StapeskitError.of("the grey values", wanted, named, path.name, step)
    dtype = np.dtype(f"{voxels.order}{_LETTERS[kind[2]]}{int(kind[1]) // 8}")
    if len(size) > 3 and min(size[:3]) > 1:
        raise several_values(path, f"{' x '.join(map(str, size[3:]))} values (a vector or time image)")
    check_grey_values(tuple(reversed(size)), dtype, path.name)
    opened = Opened(
        tuple(reversed(size)),
        dtype,
        spacing_mm=np.abs(np.array(reader.GetSpacing())[:3]),
        origin_mm=np.array(reader.GetOrigin())[:3],
        direction=np.array(reader.GetDirection()).reshape(count, count)[:3, :3],
    )
    return opened, components


def _scale(opened: Opened, factor: float, stated: str) -> None:
    """Turn lengths of the file into mm; a spacing that the header does not state is SimpleITK's own."""
    opened.origin_mm = opened.origin_mm * factor
    spacing = opened.spacing_mm
    good = stated and spacing is not None and np.all(np.isfinite(spacing)) and np.all(spacing > 0.0)
    opened.spacing_mm = spacing * factor if good and spacing is not None else None


def _nrrd_voxels(header: _Header) -> _Voxels:
    encoding = header.get("encoding").lower()
    if encoding not in _NRRD_PACKED:
        wanted, step = f"one of {', '.join(_NRRD_PACKED)}", "Export it as raw or gzip"
        raise StapeskitError.of("the encoding", wanted, encoding or "none", header.path.name, step)
    packed, skip = _NRRD_PACKED[encoding], header.whole("byteskip")
    name = "datafile" if header.get("datafile") else ""
    pieces = []
    for file in header.data_files(name) if name else [header.path]:
        start = _past_lines(file, 0 if name else header.end, header.whole("lineskip"))
        # Of raw voxels bytes are skipped in the file, of packed ones in what is unpacked.
        pieces.append((file, start if packed else -1 if skip == -1 else start + skip))
    order = ">" if header.get("endian").lower() == "big" else "<"
    return _Voxels(pieces, packed, skip, order, not name)


def _metaimage_voxels(header: _Header) -> _Voxels:
    path, packed = header.path, header.true("compresseddata")
    if header.get("binarydata").lower() == "false":
        step = "Export it as binary data"
        raise StapeskitError.of("the voxels", "binary", "numbers as text", path.name, step)
    order = ">" if header.true("elementbyteordermsb", "binarydatabyteordermsb") else "<"
    if header.get("elementdatafile").upper() in ("LOCAL", ""):
        return _Voxels([(path, header.end)], packed, 0, order, True)
    files = header.data_files("elementdatafile")
    pictures = [file.name for file in files if file.suffix.lower() in _PICTURES]
    if pictures:
        step = "Give the folder of slices itself, with --spacing"
        raise StapeskitError.of("the data files", "raw voxels", pictures[0], path.name, step)
    skip = header.whole("headersize")
    return _Voxels([(file, skip) for file in files], packed, 0, order, False)


def _past_lines(file: Path, start: int, count: int) -> int:
    with file.open("rb") as stream:
        stream.seek(start)
        for _ in range(count):
            if not stream.readline(HEADER_BYTES):
                break
        return stream.tell()


def _with_voxels(opened: Opened, voxels: _Voxels) -> Opened:
    """Say where the voxels lie, or how they are unpacked as a whole."""
    name = voxels.pieces[0][0].name
    opened.files = tuple(dict.fromkeys(file for file, _ in voxels.pieces))
    if voxels.packed:
        opened.read = unpack_once(lambda: voxels.unpack(opened.shape, opened.dtype))
        return opened
    opened.planes = planes_in(voxels.pieces, opened.shape, opened.dtype, name)
    check_surplus(opened, voxels.pieces, voxels.attached)
    return opened


def _segments(keys: dict[str, str]) -> list[tuple[int, int, str]]:
    """Return layer, value in that layer and name of each segment of a Slicer segmentation."""
    segments = []
    for number in range(1000):
        value = keys.get(f"Segment{number}_LabelValue")
        if not value:
            break
        layer = keys.get(f"Segment{number}_Layer", "0")
        if value.isdigit() and layer.isdigit():
            name = keys.get(f"Segment{number}_Name", f"segment {number + 1}")
            segments.append((int(layer), int(value), name))
    return segments


def _flattened(
    opened: Opened, voxels: _Voxels, segments: list[tuple[int, int, str]], layers: int, path: Path
) -> Opened:
    """Number the segments of a layered segmentation 1, 2, ... in the order of the file."""
    if any(layer >= layers for layer, _, _ in segments):
        raise wrong_header(path, "segmentation", f"a segment in a layer beyond its {layers} layers")
    shape, stored = tuple(opened.shape), opened.dtype

    def labelled() -> NDArray[Any]:
        layered = voxels.unpack((*shape, layers), stored)
        labels = np.zeros(shape, dtype=np.uint16)
        for number, (layer, value, _) in enumerate(segments, start=1):
            labels[layered[..., layer] == value] = number
        return labels

    opened.names = {number: name for number, (_, _, name) in enumerate(segments, start=1)}
    listed = ", ".join(f"{number} {name}" for number, name in opened.names.items())
    text = (
        f"The segmentation has {layers} layers; its segments were numbered {listed}. Where two overlap the "
        f"later one counts."
    )
    opened.notices.append(Notice("file_read", text))
    opened.dtype = np.dtype(np.uint16)
    opened.read = unpack_once(labelled)
    opened.files = tuple(dict.fromkeys(file for file, _ in voxels.pieces))
    return opened
