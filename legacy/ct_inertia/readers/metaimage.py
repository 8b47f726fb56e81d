"""MetaImage volumes (.mha, .mhd), memory-mapped where they are not packed.

The format: https://itk.org/Wiki/ITK/MetaIO/Documentation
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import beside, mm_per_unit, named_files
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.header_grid import Grid, check_dimensions, grid_volume
from legacy.ct_inertia.readers.refusals import header_fault, no_grey_values, several_values
from legacy.ct_inertia.volume.volume import Volume

_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a MetaImage volume whose voxels are in the file, in a second file or in a list of slices.

    Raises
    ------
    CtInertiaError
        Not readable, truncated, not three-dimensional, several values per voxel, no spacing, or a
        left-handed direction matrix without ``mirror``.

    Notes
    -----
    A data file named like a picture (.tif, .png) is refused: its folder of slices can be read.
    """
    fields, start, rest = _header(path)
    sizes = _values(fields, ("DimSize",), path)
    channels_told = fields.get("ElementNumberOfChannels", "1") or "1"
    if not all(abs(v) < 1e15 and v == int(v) for v in sizes) or not re.fullmatch(r"\d{1,9}", channels_told):
        got = f"DimSize = {fields['DimSize']}, ElementNumberOfChannels = {channels_told}"
        raise header_fault(path, "MetaImage volume", got)
    size = [int(v) for v in sizes]
    while len(size) > 3 and size[-1] == 1:
        size.pop()
    check_dimensions(size, path.name)
    if int(channels_told) > 1:
        raise several_values(path, f"{channels_told} (a colour or vector image)")
    return grid_volume(_grid(path, fields, size, start, rest, options.follow), path, options)


def companion_files(path: Path) -> list[Path]:
    """Return the files that hold the voxels of a header."""
    fields, start, rest = _header(path)
    return [file for file, _ in _files(path, fields, start, rest, True)]


def _header(path: Path) -> tuple[dict[str, str], int, list[str]]:
    """Return the fields, the offset behind the last of them, and the lines that follow it."""
    with path.open("rb") as stream:
        start = stream.read(1 << 16)
    end = re.search(rb"^ElementDataFile[ \t]*=[^\n]*\n?", start, re.M)
    if end is None:
        raise header_fault(path, "MetaImage volume", "a header without ElementDataFile")
    fields = {}
    for line in start[: end.end()].decode("utf-8", "replace").splitlines():
        name, equals, value = line.partition("=")
        if equals:
            fields[name.strip()] = value.strip()
    rest = []
    if fields["ElementDataFile"].upper().startswith("LIST"):
        rest = [x.strip() for x in start[end.end() :].decode("utf-8", "replace").splitlines() if x.strip()]
    return fields, end.end(), rest


def _values(fields: dict[str, str], names: Sequence[str], path: Path) -> list[float]:
    for name in names:
        if name in fields:
            try:
                return [float(word) for word in fields[name].split()]
            except ValueError as fault:
                raise header_fault(path, "MetaImage volume", f"{name} = {fields[name]}") from fault
    if names[0] == "DimSize":
        raise header_fault(path, "MetaImage volume", "a header without DimSize")
    return []


def _true(fields: dict[str, str], *names: str) -> bool:
    return any(fields.get(name, "").lower() in ("true", "1") for name in names)


def _grid(
    path: Path, fields: dict[str, str], size: list[int], start: int, rest: list[str], follow: bool
) -> Grid:
    kind = fields.get("ElementType", "")
    if kind not in _TYPES:
        raise no_grey_values(path, f"ElementType {kind or 'missing'}")
    order = ">" if _true(fields, "BinaryDataByteOrderMSB", "ElementByteOrderMSB") else "<"
    unit = mm_per_unit(fields.get("DistanceUnits", "mm")) or 1.0
    steps = np.abs(_values(fields, ("ElementSpacing", "ElementSize"), path)) * unit
    spacing = steps[:3] if steps.size >= 3 and np.all(steps[:3] > 0.0) else None
    offset = np.array((_values(fields, ("Offset", "Position", "Origin"), path) + [0.0] * 3)[:3]) * unit
    matrix = _values(fields, ("TransformMatrix", "Rotation", "Orientation"), path)
    direction = np.eye(3)
    if len(matrix) == 9:
        # Row k of the file is the direction of axis k.
        direction = np.array(matrix).reshape(3, 3).T
        direction = direction / np.maximum(np.linalg.norm(direction, axis=0), 1e-12)
    orientation = fields.get("AnatomicalOrientation", "?")
    packing = "zlib" if _true(fields, "CompressedData") else "raw"
    if fields.get("BinaryData", "True").lower() == "false":
        packing = "text"
    return Grid(
        (size[0], size[1], size[2]),
        np.dtype(order + _TYPES[kind]),
        tuple(_files(path, fields, start, rest, follow)),
        spacing,
        offset,
        direction,
        packing,
        "?" not in orientation,
    )


def _files(
    path: Path, fields: dict[str, str], start: int, rest: list[str], follow: bool
) -> list[tuple[Path, int]]:
    named = fields["ElementDataFile"]
    head = _values(fields, ("HeaderSize",), path)
    skip = int(head[0]) if head and abs(head[0]) < 1e15 else 0
    if named.upper() in ("LOCAL", ""):
        return [(path, start)]
    most = max((n for n in _values(fields, ("DimSize",), path) if abs(n) < 1e15), default=0)
    names = named_files(named, rest, most, path, "MetaImage volume")
    pictures = [
        name for name in names if Path(name).suffix.lower() in (".tif", ".tiff", ".png", ".jpg", ".bmp")
    ]
    if pictures:
        step = "Give the folder of slices itself, with {spacing}"
        raise CtInertiaError.of("the data files", "raw voxels", pictures[0], path.name, step)
    return [(beside(path, name, follow), skip) for name in names]
