"""Avizo and Amira lattices (.am) of grey values or labels, memory-mapped where they are not packed.

Packings as in Fiji's reader: https://github.com/fiji/VIB-lib (AmiraMeshDecoder).
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import mm_per_unit
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.header_grid import Grid, check_dimensions, grid_volume
from legacy.ct_inertia.readers.refusals import header_fault, several_values
from legacy.ct_inertia.volume.volume import Volume

_PACKINGS = {None: "raw", "HxByteRLE": "HxByteRLE", "HxZip": "zlib"}
_TYPES = {"byte": "u1", "short": "i2", "ushort": "u2", "int": "i4", "float": "f4", "double": "f8"}
# A bracket and the name before it, of a bounded length: a damaged header may be one long word.
_BRACKET = re.compile(r'("[^"]{0,200}"|[\w.-]{1,200})?\s{0,20}([{}])')
# Most bytes of the text header: headers have some kilobytes, and a damaged file may have no end of it.
_HEADER_BYTES = 1 << 20


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a uniform lattice with its bounding box.

    Raises
    ------
    CtInertiaError
        Not such a file, packed in another way, another lattice, or no spacing.

    Notes
    -----
    The bounding box joins the centres of the outer voxels. Its unit is given by ``Units``; where it does
    not, the spacing must be given.
    """
    with path.open("rb") as stream:
        start = stream.read(_HEADER_BYTES)
    first = start.split(b"\n", 1)[0].decode("latin-1")
    if "AmiraMesh" not in first and "Avizo" not in first:
        raise header_fault(path, "Amira lattice", "a file that does not begin as one")
    end = re.search(rb"^@1[ \t]*\r?\n", start, re.M)
    if end is None:
        raise header_fault(path, "Amira lattice", "a header without data @1")
    text = _decode(start[: end.start()])
    size = _sizes(text, path)
    field = re.search(r"Lattice\s*\{\s*(\w+)(\[\d+\])?\s+\w+\s*\}\s*=?\s*@1\b(?:\((\w+))?", text)
    if field is None or field[1] not in _TYPES or field[2] not in (None, "[1]"):
        raise several_values(path, field[0] if field else "no lattice")
    packing = _PACKINGS.get(field[3])
    if packing is None:
        known = ", ".join(name for name in _PACKINGS if name)
        raise CtInertiaError.of(
            "the lattice", f"not packed, or by {known}", field[3], path.name, "Save it as AmiraMesh binary"
        )
    if "ASCII" in first.upper():
        packing = "text"
    order = "<" if "LITTLE" in first.upper() else ">"
    box = re.search(r"BoundingBox\s+([-+0-9.eE ]+)", text)
    unit = re.search(r"Coordinates\s+\"([^\"]+)\"", text)
    factor = mm_per_unit(unit[1]) if unit else None
    spacing, origin, known = None, np.zeros(3), "the lattice has no unit of length"
    if box and len(box[1].split()) == 6:
        try:
            ends = np.array([float(word) for word in box[1].split()]).reshape(3, 2)
        except ValueError as fault:
            raise header_fault(path, "Amira lattice", f"BoundingBox {box[1].strip()}") from fault
        steps = (ends[:, 1] - ends[:, 0]) / (np.array(size) - 1)
        if factor is not None and np.all(np.isfinite(steps)) and np.all(steps > 0.0):
            spacing, origin = steps * factor, ends[:, 0] * factor
        elif factor is None:
            known += f"; its voxels are {steps[0]:.6g} x {steps[1]:.6g} x {steps[2]:.6g}"
    dtype = np.dtype(order + _TYPES[field[1]])
    grid = Grid(size, dtype, ((path, end.end()),), spacing, origin, packing=packing, known=known)
    return replace(grid_volume(grid, path, options), segment_names=_materials(text))


def _decode(header: bytes) -> str:
    try:
        return header.decode("utf-8")
    except UnicodeDecodeError:
        return header.decode("latin-1")


def _materials(text: str) -> dict[int, str]:
    """Return the names of labels: the number of a label is the place of its material, from 0."""
    begin = re.search(r"\bMaterials\s*\{", text)
    names: list[str] = []
    depth = 1
    for mark in re.finditer(_BRACKET, text[begin.end() :] if begin else ""):
        if mark[2] == "{" and depth == 1:
            names.append((mark[1] or "").strip('"'))
        depth += 1 if mark[2] == "{" else -1
        if depth == 0:
            break
    return dict(enumerate(names))


def _sizes(text: str, path: Path) -> tuple[int, int, int]:
    definition = re.search(r"define\s+Lattice\s+(\d{1,9})\s+(\d{1,9})\s+(\d{1,9})\b", text)
    if definition is None or re.search(r'CoordType\s+"(?!uniform)', text):
        raise header_fault(path, "Amira lattice", "a lattice that is not a uniform one in three dimensions")
    size = int(definition[1]), int(definition[2]), int(definition[3])
    check_dimensions(size, path.name)
    return size
