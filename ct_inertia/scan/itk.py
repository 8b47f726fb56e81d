"""NRRD and MetaImage: geometry by SimpleITK; voxels are read where they lie, or unpacked once.

SimpleITK does not say where voxels begin, what the unit of length is and whether the axes are a patient's:
these few fields are looked up in the text of the header.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.raw import unpacked
from ct_inertia.scan.stored import (
    HEADER_BYTES,
    Stored,
    Stream,
    beside,
    several_values,
    unpack_once,
    wrong_file,
)
from stapeskit.faults import StapeskitError

_Segment = tuple[int, int, str]
"""Layer, value in that layer and name of a segment of 3D Slicer."""

_KIND = re.compile(r"(?:vector of )?(\d+)-bit (unsigned integer|signed integer|float)")
_KINDS = {"unsigned integer": "u", "signed integer": "i", "float": "f"}
_NRRD_PACKED = {"raw": False, **dict.fromkeys(("gzip", "gz", "bzip2", "bz2"), True)}
_PATIENT = re.compile(r"(ras|las|lps|\w+-(anterior|posterior)-\w+|\w+-\w+-(superior|inferior))(-time)?")
_FIELD = re.compile(r"^([^:=#\r\n]+?)[ \t]*[:=](?!=)[ \t]*([^\r\n]*?)\r?$", re.MULTILINE)


def open_nrrd(path: Path) -> Stored:
    """Open an NRRD volume or segmentation; of layers that overlap the segments are numbered anew.

    The format: https://teem.sourceforge.net/nrrd/format.html
    """
    fields, end = _fields(path, rb"\r?\n\r?\n", "NRRD volume", b"NRRD000")
    space = fields.get("space", "").lower().replace("_", "-")
    if space == "3d-left-handed":
        step = "Export it in LPS or RAS"
        raise StapeskitError.of("the space", "right-handed", "3D-left-handed", next_step=step)
    encoding = fields.get("encoding", "").lower()
    if encoding not in _NRRD_PACKED or _whole(fields, "lineskip"):
        wanted, got = f"one of {', '.join(_NRRD_PACKED)} without a line skip", encoding or "none"
        raise StapeskitError.of("the encoding", wanted, got, next_step="Export it as raw or gzip")
    units = re.findall(r'"([^"]*)"', fields.get("spaceunits") or fields.get("units", ""))
    factors = {factor for unit in units if (factor := mm_per_unit(unit)) is not None}
    if len(factors) > 1:
        step = "Save it with one unit, or give --spacing for a copy without units"
        raise StapeskitError.of("the units", "the same along all axes", ", ".join(units), next_step=step)
    file, start = _data_file(path, fields.get("datafile", ""), end)
    stream = Stream(file, start, _whole(fields, "byteskip"), _NRRD_PACKED[encoding], exact=True)
    # NaN says that nobody knows.
    stated = re.search(r"\d", fields.get("spacings", "") + fields.get("spacedirections", "")) is not None
    big = fields.get("endian", "").lower() == "big"
    stored, layers, segments = _geometry(path, factors.pop() if factors else 1.0, stated, big)
    stored.voxels, stored.anatomical = stream, _PATIENT.fullmatch(space) is not None
    if layers == 1:
        stored.names = {value: name for _, value, name in segments}
    else:
        _flatten(stored, stream, layers, segments, path)
    return stored


def open_metaimage(path: Path) -> Stored:
    """Open a MetaImage volume whose voxels are in the file or in a second one.

    The format: https://itk.org/Wiki/ITK/MetaIO/Documentation
    """
    fields, end = _fields(path, rb"^ElementDataFile[ \t]*=[^\n]*\n?", "MetaImage volume")
    if fields.get("binarydata", "").lower() == "false":
        raise StapeskitError.of(
            "the voxels", "binary", "numbers as text", next_step="Export it as binary data"
        )
    big, packed = (
        any(fields.get(name, "").lower() in ("true", "1") for name in names)
        for names in (("elementbyteordermsb", "binarydatabyteordermsb"), ("compresseddata",))
    )
    factor = mm_per_unit(fields.get("distanceunits")) or 1.0
    stated = "elementspacing" in fields or "elementsize" in fields
    stored, components, _ = _geometry(path, factor, stated, big)
    if components > 1:
        raise several_values(f"{components} values (a colour or vector image)")
    stored.anatomical = "?" not in fields.get("anatomicalorientation", "?")
    named = fields.get("elementdatafile", "")
    file, start = _data_file(path, "" if named.upper() == "LOCAL" else named, end)
    skip = 0 if file == path else _whole(fields, "headersize")
    stored.voxels = Stream(file, start + max(skip, 0), min(skip, 0), packed, exact=True)
    return stored


def _fields(path: Path, end: bytes, kind: str, begin: bytes = b"") -> tuple[dict[str, str], int]:
    """Return the fields of a text header, their names in lower case without spaces, and where it ends.

    It ends with the first match of ``end``; a detached NRRD header may do without.
    """
    with path.open("rb") as stream:
        start = stream.read(HEADER_BYTES)
    found = re.search(end, start, re.MULTILINE)
    if not start.startswith(begin) or (found is None and path.suffix.lower() != ".nhdr"):
        raise wrong_file(kind, "a file that does not begin as one")
    stop = found.end() if found else len(start)
    fields: dict[str, str] = {}
    for name, value in _FIELD.findall(start[:stop].decode("utf-8", "replace")):
        fields.setdefault(name.lower().replace(" ", ""), value.strip())
    return {name: value for name, value in fields.items() if value}, stop


def _whole(fields: dict[str, str], name: str) -> int:
    """Return a field that is a whole number of at least -1, 0 where it is missing."""
    value = fields.get(name, "0")
    if not re.fullmatch(r"-1|\d{1,15}", value):
        raise wrong_file("header", f"{name} {value}")
    return int(value)


def _data_file(path: Path, named: str, end: int) -> tuple[Path, int]:
    """Return the file of the voxels, and the byte at which they begin there."""
    if named.upper().startswith("LIST") or "%" in named:
        raise StapeskitError.of("the voxels", "in one data file", named, next_step="Save it as one file")
    return (beside(path, named), 0) if named else (path, end)


def _geometry(path: Path, mm: float, stated: bool, big: bool) -> tuple[Stored, int, list[_Segment]]:
    """Return what SimpleITK reads of a header, the number of values in a voxel, and named segments.

    ``mm`` is the unit of length; a spacing that is not ``stated`` is SimpleITK's own.
    """
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    reader: Any = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    named = sitk.GetPixelIDValueAsString(reader.GetPixelID())
    kind = _KIND.fullmatch(named)
    if kind is None:
        wanted, step = "integers or floating point numbers", "Export it as real grey values"
        raise StapeskitError.of("the grey values", wanted, named, next_step=step)
    size = reader.GetSize()
    stored = Stored(
        tuple(reversed(size)),
        np.dtype(f"{'>' if big else '<'}{_KINDS[kind[2]]}{int(kind[1]) // 8}"),
        spacing_mm=np.abs(np.array(reader.GetSpacing())[:3]) * mm if stated else None,
        unit_mm=mm,
        origin_mm=np.array(reader.GetOrigin())[:3] * mm,
        direction=np.array(reader.GetDirection()).reshape(len(size), -1)[:3, :3],
    )
    keys, segments = {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys()}, []
    for number in range(len(keys)):
        value, layer, name = (
            keys.get(f"Segment{number}_{word}", "") for word in ("LabelValue", "Layer", "Name")
        )
        if value.isdigit():
            segments.append((int(layer or 0), int(value), name or f"segment {number + 1}"))
    return stored, int(reader.GetNumberOfComponents()), segments


def _flatten(stored: Stored, stream: Stream, layers: int, segments: Sequence[_Segment], path: Path) -> None:
    """Number the segments of a layered segmentation 1, 2, ... in the order of the file."""
    if not segments:
        raise several_values(f"{layers} values (no segmentation of 3D Slicer)")
    shape, dtype = (*stored.shape, layers), stored.dtype

    def labels() -> NDArray[Any]:
        values = unpacked(stream, shape, dtype, path)
        numbers = np.zeros(shape[:3], dtype=np.uint16)
        masks = [values[..., layer] == value for layer, value, _ in segments]
        for k in sorted(range(len(masks)), key=lambda k: -np.count_nonzero(masks[k])):
            numbers[masks[k]] = k + 1
        return numbers

    stored.names = {number: name for number, (_, _, name) in enumerate(segments, start=1)}
    listed = ", ".join(f"{number} {name}" for number, name in stored.names.items())
    stored.note(
        f"The segments of {path.name} lie in several layers; they were numbered {listed}. Where two overlap "
        f"the smaller one counts."
    )
    stored.dtype, stored.voxels, stored.files = np.dtype(np.uint16), unpack_once(labels), (stream.file,)
