"""VGStudio volumes: a .vgi header with one or several .vol files, memory-mapped."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import mm_per_unit
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.header_grid import Grid, grid_volume
from legacy.ct_inertia.readers.refusals import header_fault
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

_KINDS = {"unsigned integer": "u", "signed integer": "i", "integer": "i", "float": "f", "double": "f"}
_STORED = {(kind, bits) for kind in "ui" for bits in ("8", "16", "32")} | {("f", "32"), ("f", "64")}
# Most bytes of the text header, which has some kilobytes: a wrong file may be of any size.
_HEADER_BYTES = 1 << 20
Sections = dict[str, dict[str, str]]


def read(path: Path, options: ReadOptions) -> Volume:
    """Read the volume that a .vgi header describes.

    Raises
    ------
    CtInertiaError
        A key is missing, a data file is missing or too short, packed, or no spacing.

    Notes
    -----
    A section ``[file1]`` says how the voxels are stored, which need not be how ``[representation]`` shows
    them. Several files hold the slices one after another. The place and rotation of the volume in the
    scene of VGStudio are not scan coordinates: origin 0, identity.
    """
    sections = _sections(path)
    files = [sections[name] for name in sorted(sections, key=_number) if re.fullmatch(r"file\d*", name)]
    if not files:
        raise header_fault(path, "VGI header", "no section [file1]")
    sizes = [_size(part, sections, path) for part in files]
    uneven = any(size[2] != sizes[0][2] for size in sizes[:-1]) or sizes[-1][2] > sizes[0][2]
    if any(size[:2] != sizes[0][:2] for size in sizes) or uneven:
        raise header_fault(path, "VGI header", f"files of different sizes {sizes}")
    first = files[0]
    unpacked = first.get("fileformat", "raw").lower()
    if unpacked != "raw":
        raise CtInertiaError.of(
            "FileFormat", "raw", unpacked, path.name, "Export the volume as raw, unsigned integer or float"
        )
    grid = Grid(
        (sizes[0][0], sizes[0][1], sum(size[2] for size in sizes)),
        _dtype(first, sections, path),
        tuple((_companion_path(path, part), _header_length(part, path)) for part in files),
        *_spacing(sections),
        slab=sizes[0][2],
        notices=tuple(_notices(sections, path)),
    )
    return grid_volume(grid, path, options)


def companion_files(path: Path) -> list[Path]:
    """Return the files that hold the voxels of a header."""
    sections = _sections(path)
    return [_companion_path(path, part) for name, part in sections.items() if re.fullmatch(r"file\d*", name)]


def _sections(path: Path) -> Sections:
    """Return the sections of the first volume, names and keys in lower case."""
    with path.open("rb") as stream:
        text = stream.read(_HEADER_BYTES).decode("utf-8", "replace")
    sections: Sections = {}
    name = ""
    for line in text.splitlines():
        line = line.strip()
        if line.startswith("{"):
            if line.lower() == "{volume2}":
                break
            continue
        if line.startswith("["):
            name = line.strip("[] ").lower()
            sections.setdefault(name, {})
            continue
        key, equals, value = line.partition("=")
        if equals:
            sections.setdefault(name, {}).setdefault(key.strip().lower(), value.strip())
    if not sections:
        raise header_fault(path, "VGI header", "a text without sections")
    return sections


def _number(name: str) -> int:
    digits = re.sub(r"\D", "", name)
    return int(digits) if digits else 0


def _require(key: str, part: dict[str, str], sections: Sections, path: Path) -> str:
    value = part.get(key, sections.get("representation", {}).get(key))
    if value is None:
        raise header_fault(path, "VGI header", f"no {key}")
    return value


def _size(part: dict[str, str], sections: Sections, path: Path) -> tuple[int, int, int]:
    words = _require("size", part, sections, path).split()
    try:
        x, y, z = (int(word) for word in words)
    except ValueError as fault:
        raise header_fault(path, "VGI header", f"Size = {' '.join(words)}") from fault
    return x, y, z


def _dtype(part: dict[str, str], sections: Sections, path: Path) -> np.dtype:
    kind = _KINDS.get(_require("datatype", part, sections, path).lower())
    bits = _require("bitsperelement", part, sections, path)
    if (kind, bits) not in _STORED:
        raise header_fault(path, "VGI header", f"Datatype = {part.get('datatype')}, BitsPerElement = {bits}")
    order = ">" if part.get("byteorder", "").lower().startswith("big") else "<"
    return np.dtype(f"{order}{kind}{int(bits) // 8}")


def _companion_path(path: Path, part: dict[str, str]) -> Path:
    name = part.get("name") or path.with_suffix(".vol").name
    return path.parent / name.replace("\\", "/").rsplit("/", 1)[-1]


def _header_length(part: dict[str, str], path: Path) -> int:
    text = part.get("skipheader", "0")
    if not text.isdigit():
        raise header_fault(path, "VGI header", f"SkipHeader = {text}")
    return int(text)


def _spacing(sections: Sections) -> tuple[NDArray[np.float64] | None]:
    """Return the voxel size from the resolution and its unit; (None,) when one of them is missing."""
    geometry = sections.get("geometry", {})
    unit = mm_per_unit(geometry.get("unit"))
    try:
        values = np.array([float(word) for word in geometry.get("resolution", "").split()])
        scale = np.array([float(word) for word in geometry.get("scale", "1 1 1").split()])
    except ValueError:
        return (None,)
    if unit is None or values.shape != (3,) or scale.shape != (3,) or np.any(values * scale <= 0.0):
        return (None,)
    return (values * scale * unit,)


def _notices(sections: Sections, path: Path) -> list[Notice]:
    mirrored = sections.get("representation", {}).get("mirror", "0").split()
    if any(word not in ("0", "0.0") for word in mirrored):
        text = (
            f"{path.name} is shown mirrored in VGStudio (mirror = {' '.join(mirrored)}); its voxels were "
            f"read as they are stored. Use {named('mirror')} if the ear is a mirror image."
        )
        return [Notice("mirrored_display", text)]
    return []
