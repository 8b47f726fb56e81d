"""NRRD and MetaImage: geometry by SimpleITK; raw voxels are read where they lie, packed ones unpacked once.

SimpleITK does not say where voxels begin, what the unit of length is and whether the axes are a patient's:
these few fields are looked up in the text of the header. It reads a packed stream that ends too early without
an error, so that streams are unpacked here.
"""

from __future__ import annotations

import bz2
import gzip
import re
import zlib
from collections.abc import Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.header import (
    HEADER_BYTES,
    Header,
    beside,
    several_values,
    unpack_once,
    wrong_header,
    wrong_size,
)
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.scan import Box, check_grey_values
from stapeskit.faults import StapeskitError

_Segment = tuple[int, int, str]
"""Layer, value in that layer and name of a segment of 3D Slicer."""

_KINDS = {"unsigned integer": "u", "signed integer": "i", "float": "f"}
_NRRD_PACKED = {"raw": False, **dict.fromkeys(("gzip", "gz", "bzip2", "bz2"), True)}
_PATIENT = re.compile(r"(ras|las|lps|\w+-(anterior|posterior)-\w+|\w+-\w+-(superior|inferior))(-time)?")
_FIELD = re.compile(r"^([^:=#\r\n]+?)[ \t]*[:=](?!=)[ \t]*([^\r\n]*?)\r?$", re.MULTILINE)


def open_nrrd(path: Path) -> Header:
    """Open an NRRD volume or segmentation; of layers that overlap the segments are numbered anew.

    The format: https://teem.sourceforge.net/nrrd/format.html

    Raises
    ------
    StapeskitError
        A damaged header, a missing or too short data file, or several values in a voxel.
    """
    fields, end = _fields(path, rb"\r?\n\r?\n", "NRRD volume", b"NRRD000")
    space = fields.get("space", "").lower().replace("_", "-")
    if space == "3d-left-handed":
        step = "Export it in LPS or RAS"
        raise StapeskitError.of("the space", "right-handed", "3D-left-handed", path.name, step)
    encoding = fields.get("encoding", "").lower()
    if encoding not in _NRRD_PACKED or _whole(fields, "lineskip", path):
        wanted, got = f"one of {', '.join(_NRRD_PACKED)} without a line skip", encoding or "none"
        raise StapeskitError.of("the encoding", wanted, got, path.name, "Export it as raw or gzip")
    units = re.findall(r'"([^"]*)"', fields.get("spaceunits") or fields.get("units", ""))
    factors = {factor for unit in units if (factor := mm_per_unit(unit)) is not None}
    if len(factors) > 1:
        step = "Save it with one unit, or give --spacing for a copy without units"
        raise StapeskitError.of("the units", "the same along all axes", ", ".join(units), path.name, step)
    stated = "spacings" in fields or "spacedirections" in fields
    big = fields.get("endian", "").lower() == "big"
    header, layers, segments = _geometry(path, factors.pop() if factors else 1.0, stated, big)
    header.anatomical = _PATIENT.fullmatch(space) is not None
    named = fields.get("datafile", "")
    file, start = (_data_file(path, named), 0) if named else (path, end)
    packed, skip = _NRRD_PACKED[encoding], _whole(fields, "byteskip", path)
    if layers == 1:
        header.names = {value: name for _, value, name in segments}
        return _with_voxels(header, path, file, start, skip, packed)
    if not segments or not packed:
        raise several_values(path, f"{layers} values (no packed segmentation of 3D Slicer)")
    layered = replace(header, shape=(*header.shape, layers))
    return _flattened(header, _with_voxels(layered, path, file, start, skip, packed), segments, path)


def open_metaimage(path: Path) -> Header:
    """Open a MetaImage volume whose voxels are in the file or in a second one.

    The format: https://itk.org/Wiki/ITK/MetaIO/Documentation

    Raises
    ------
    StapeskitError
        A damaged header, a missing or too short data file, or several values in a voxel.
    """
    fields, end = _fields(path, rb"^ElementDataFile[ \t]*=[^\n]*\n?", "MetaImage volume")
    if fields.get("binarydata", "").lower() == "false":
        step = "Export it as binary data"
        raise StapeskitError.of("the voxels", "binary", "numbers as text", path.name, step)
    big, packed = (
        any(fields.get(name, "").lower() in ("true", "1") for name in names)
        for names in (("elementbyteordermsb", "binarydatabyteordermsb"), ("compresseddata",))
    )
    factor = mm_per_unit(fields.get("distanceunits")) or 1.0
    stated = "elementspacing" in fields or "elementsize" in fields
    header, components, _ = _geometry(path, factor, stated, big)
    if components > 1:
        raise several_values(path, f"{components} values (a colour or vector image)")
    header.anatomical = "?" not in fields.get("anatomicalorientation", "?")
    named = fields.get("elementdatafile", "")
    if named.upper() in ("LOCAL", ""):
        return _with_voxels(header, path, path, end, 0, packed)
    start = _whole(fields, "headersize", path)
    return _with_voxels(header, path, _data_file(path, named), start, 0, packed)


def _fields(path: Path, end: bytes, kind: str, begin: bytes = b"") -> tuple[dict[str, str], int]:
    """Return the fields of a text header, their names in lower case without spaces, and where it ends.

    It ends with the first match of ``end``; a detached NRRD header may do without.
    """
    with path.open("rb") as stream:
        start = stream.read(HEADER_BYTES)
    found = re.search(end, start, re.MULTILINE)
    if not start.startswith(begin) or (found is None and path.suffix.lower() != ".nhdr"):
        raise wrong_header(path, kind, "a file that does not begin as one")
    stop = found.end() if found else len(start)
    fields: dict[str, str] = {}
    for name, value in _FIELD.findall(start[:stop].decode("utf-8", "replace")):
        fields.setdefault(name.lower().replace(" ", ""), value.strip())
    return {name: value for name, value in fields.items() if value}, stop


def _whole(fields: dict[str, str], name: str, path: Path) -> int:
    """Return a field that is a whole number of at least -1, 0 where it is missing."""
    value = fields.get(name, "0")
    if not re.fullmatch(r"-1|\d{1,15}", value):
        raise wrong_header(path, "header", f"{name} {value}")
    return int(value)


def _data_file(path: Path, named: str) -> Path:
    if named.upper().startswith("LIST") or "%" in named:
        step = "Save it as one file"
        raise StapeskitError.of("the voxels", "in one data file", named, path.name, step)
    return beside(path, named)


def _geometry(path: Path, mm: float, stated: bool, big: bool) -> tuple[Header, int, list[_Segment]]:
    """Return what SimpleITK reads of a header, the number of values in a voxel, and Slicer's segments.

    ``mm`` is the unit of length; a spacing that is not ``stated`` is SimpleITK's own.
    """
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    reader: Any = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    size = [int(n) for n in reader.GetSize()]
    count = len(size)
    while len(size) > 3 and size[-1] == 1:
        size.pop()
    named = sitk.GetPixelIDValueAsString(reader.GetPixelID()).removeprefix("vector of ")
    kind = re.fullmatch(r"(\d+)-bit (.*)", named)
    if kind is None or kind[2] not in _KINDS:
        wanted, step = "integers or floating point numbers", "Export it as real grey values"
        raise StapeskitError.of("the grey values", wanted, named, path.name, step)
    dtype = np.dtype(f"{'>' if big else '<'}{_KINDS[kind[2]]}{int(kind[1]) // 8}")
    if len(size) > 3 and min(size[:3]) > 1:
        raise several_values(path, f"{' x '.join(map(str, size[3:]))} values (a vector or time image)")
    check_grey_values(size[::-1], dtype, path.name)
    header = Header(
        tuple(reversed(size)),
        dtype,
        spacing_mm=np.abs(np.array(reader.GetSpacing())[:3]) * mm if stated else None,
        origin_mm=np.array(reader.GetOrigin())[:3] * mm,
        direction=np.array(reader.GetDirection()).reshape(count, count)[:3, :3],
    )
    keys = {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys()}
    return header, int(reader.GetNumberOfComponents()), _segments(keys)


def _with_voxels(header: Header, path: Path, file: Path, start: int, skip: int, packed: bool) -> Header:
    """Say where the voxels lie, or how they are unpacked; -1 counts them from the end."""
    if packed:
        header.files = (file,)
        exact = file != path  # another one holds nothing behind the voxels
        header.read = unpack_once(lambda: unpacked(file, start, skip, header.shape, header.dtype, exact))
    else:
        header.set_planes(file, -1 if -1 in (start, skip) else start + skip, path, exact=True)
    return header


def unpacked(
    file: Path, start: int, skip: int, shape: Sequence[int], dtype: np.dtype[Any], exact: bool
) -> NDArray[Any]:
    """Return the voxels of a stream that begins at a byte of a file, and is read to the check sum at its end.

    ``skip`` are unpacked bytes before the first voxel; -1: the voxels are the last ones.
    """
    try:
        with file.open("rb") as stream:
            stream.seek(start)
            content = stream.read()
        packing: Any = {b"\x1f\x8b": gzip, b"BZ": bz2}.get(content[:2], zlib)
        content = packing.decompress(content)
    except (EOFError, zlib.error, OSError) as fault:
        raise wrong_header(file, "packed stream", "a damaged or truncated one") from fault
    needed, held = prod(shape) * dtype.itemsize, len(content) - max(skip, 0)
    if held < needed or (exact and skip >= 0 and held > needed):
        raise wrong_size(shape, needed, held, file)
    begin = len(content) - needed if skip == -1 else skip
    return np.frombuffer(content, dtype, prod(shape), begin).reshape(shape)


def _segments(keys: dict[str, str]) -> list[_Segment]:
    segments = []
    for number in range(len(keys)):
        value, layer = (keys.get(f"Segment{number}_{key}", "") for key in ("LabelValue", "Layer"))
        if value.isdigit():
            name = keys.get(f"Segment{number}_Name", f"segment {number + 1}")
            segments.append((int(layer) if layer.isdigit() else 0, int(value), name))
    return segments


def _flattened(header: Header, layered: Header, segments: list[_Segment], path: Path) -> Header:
    """Number the segments of a layered segmentation 1, 2, ... in the order of the file."""

    def read(box: Box) -> NDArray[Any]:
        stored = layered.read(box) if layered.read else np.empty(0)
        labels = np.zeros(stored.shape[:3], dtype=np.uint16)
        for number, (layer, value, _) in enumerate(segments, start=1):
            labels[stored[..., layer] == value] = number
        return labels

    header.names = {number: name for number, (_, _, name) in enumerate(segments, start=1)}
    listed = ", ".join(f"{number} {name}" for number, name in header.names.items())
    header.note(
        f"The segments of {path.name} lie in several layers; they were numbered {listed}. Where two overlap "
        f"the later one counts."
    )
    header.dtype, header.read, header.files = np.dtype(np.uint16), read, layered.files
    return header
