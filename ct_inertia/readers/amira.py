"""Avizo and Amira lattices (.am) of binary grey values, memory-mapped."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import header_fault, mm_per_unit
from ct_inertia.readers.formats import ReadOptions
from ct_inertia.readers.header_grid import Grid, check_dimensions, grid_volume
from ct_inertia.volume.volume import Volume

_TYPES = {"byte": "u1", "short": "i2", "ushort": "u2", "int": "i4", "float": "f4", "double": "f8"}
# Most bytes of the text header: headers have some kilobytes, and a damaged file may have no end of it.
_HEADER_BYTES = 1 << 20


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a uniform lattice with its bounding box.

    Raises
    ------
    CtInertiaError
        Not such a file, text, packed, another lattice, or no spacing.

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
    if "BINARY" not in first.upper() and "RAW" not in first.upper():
        raise CtInertiaError.of(
            "the lattice", "binary", "text (ASCII)", path.name, "Save it as AmiraMesh binary"
        )
    end = re.search(rb"^@1[ \t]*\r?\n", start, re.M)
    if end is None:
        raise header_fault(path, "Amira lattice", "a header without data @1")
    text = start[: end.start()].decode("latin-1")
    size = _sizes(text, path)
    field = re.search(r"Lattice\s*\{\s*(\w+)(\[\d+\])?\s+\w+\s*\}\s*=?\s*@1(\(\w+)?", text)
    if field is None or field[1] not in _TYPES or field[2] not in (None, "[1]"):
        raise CtInertiaError.of(
            "the lattice",
            "one grey value per voxel",
            field[0] if field else "none",
            path.name,
            "Export one channel",
        )
    if field[3]:
        raise CtInertiaError.of(
            "the lattice", "not packed", field[3][1:], path.name, "Save it as AmiraMesh binary"
        )
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
    grid = Grid(size, np.dtype(order + _TYPES[field[1]]), ((path, end.end()),), spacing, origin, known=known)
    return grid_volume(grid, path, options)


def _sizes(text: str, path: Path) -> tuple[int, int, int]:
    definition = re.search(r"define\s+Lattice\s+(\d{1,9})\s+(\d{1,9})\s+(\d{1,9})\b", text)
    if definition is None or re.search(r'CoordType\s+"(?!uniform)', text):
        raise header_fault(path, "Amira lattice", "a lattice that is not a uniform one in three dimensions")
    size = int(definition[1]), int(definition[2]), int(definition[3])
    check_dimensions(size, path.name)
    return size
