"""NRRD volumes and segmentations (.nrrd, .nhdr, .seg.nrrd), memory-mapped where they are not packed.

The format: https://teem.sourceforge.net/nrrd/format.html
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import beside, mm_per_unit, named_files
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.header_grid import Grid, grid_array, grid_volume
from legacy.ct_inertia.readers.refusals import (
    header_fault,
    no_grey_values,
    not_three_dimensional,
    several_values,
)
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

# Most bytes of the text header, and of a line skipped before data: a damaged file may have no end of them.
_HEADER_BYTES = 1 << 20
_TYPES = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(("longlong", "long long", "long long int", "signed long long", "int64", "int64_t"), "i8"),
    **dict.fromkeys(("ulonglong", "unsigned long long", "uint64", "uint64_t"), "u8"),
    "float": "f4",
    "double": "f8",
}
_PACKINGS = {
    "raw": "raw",
    **dict.fromkeys(("gzip", "gz"), "gzip"),
    **dict.fromkeys(("bzip2", "bz2"), "bzip2"),
    **dict.fromkeys(("ascii", "text", "txt"), "text"),
    "hex": "hex",
}
# Bytes are skipped in what is unpacked, not in the file (NRRD, section 5, byte skip).
_SKIPPED_UNPACKED = ("gzip", "bzip2")
_SPATIAL = ("domain", "space", "???", "none")


def read(path: Path, options: ReadOptions) -> Volume:
    """Read an NRRD volume; of a layered segmentation one label volume with its segments numbered.

    Raises
    ------
    CtInertiaError
        Not readable, truncated, not three-dimensional, several values per voxel, no spacing, or a
        left-handed direction matrix without ``mirror``.
    """
    fields, keys, start = _header(path)
    axes = _axes(fields, path)
    sizes = _sizes(fields, path)
    grid = _grid(path, fields, axes, sizes, start, options.follow)
    layers = [k for k in range(len(sizes)) if k not in axes and sizes[k] > 1]
    segments = _segments(keys, path)
    if not layers:
        names = {value: name for _, value, name in segments}
        return replace(grid_volume(grid, path, options), segment_names=names)
    if layers != [0] or not segments:
        count = int(np.prod([sizes[k] for k in layers]))
        raise several_values(path, f"{count} (a colour, vector or time image)")
    labels, notice = _flatten(grid_array(grid, path), segments)
    volume = grid_volume(grid, path, options, labels)
    names = {number: name for number, (_, _, name) in enumerate(segments, start=1)}
    return replace(volume, notices=(*volume.notices, notice), segment_names=names)


def companion_files(path: Path) -> list[Path]:
    """Return the files that hold the voxels of a header."""
    fields, _, start = _header(path)
    return [file for file, _ in _files(path, fields, start, "raw", True)]


def _header(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """Return the fields, the key/value pairs and the offset of the data."""
    with path.open("rb") as stream:
        start = stream.read(_HEADER_BYTES)
    if not start.startswith(b"NRRD000"):
        raise header_fault(path, "NRRD volume", "a file that does not begin as one")
    end = re.search(rb"\r?\n\r?\n", start)
    if end is None and path.suffix.lower() != ".nhdr":
        raise header_fault(path, "NRRD volume", "a header without an end")
    text = start[: end.start() if end else len(start)].decode("utf-8", "replace")
    fields: dict[str, str] = {}
    keys: dict[str, str] = {}
    lines = text.splitlines()[1:]
    for number, line in enumerate(lines):
        if line.startswith("#"):
            continue
        key, pair, value = line.partition(":=")
        if pair:
            keys[key.strip()] = value.strip()
            continue
        name, colon, value = line.partition(":")
        if colon:
            name = name.strip().lower()
            fields["data file" if name == "datafile" else name] = value.strip()
            if fields.get("data file", "").upper().startswith("LIST") and name in ("data file", "datafile"):
                fields["list"] = "\n".join(x.strip() for x in lines[number + 1 :] if x.strip())
                break
    return fields, keys, end.end() if end else len(start)


def _sizes(fields: dict[str, str], path: Path) -> list[int]:
    sizes = _parse_numbers(fields, "sizes", path)
    if not all(abs(n) < 1e15 and n == int(n) for n in sizes):
        raise header_fault(path, "NRRD volume", f"sizes {fields['sizes']}")
    return [int(n) for n in sizes]


def _parse_numbers(fields: dict[str, str], name: str, path: Path) -> list[float]:
    try:
        return [float(word) for word in fields[name].split()]
    except (KeyError, ValueError) as fault:
        raise header_fault(path, "NRRD volume", f"a header without usable {name}") from fault


def _axes(fields: dict[str, str], path: Path) -> list[int]:
    """Return which axes are those of space."""
    count = len(_parse_numbers(fields, "sizes", path))
    if "space directions" in fields:
        parts = re.findall(r"none|\([^)]*\)", fields["space directions"].lower())
        if len(parts) == count:
            return [k for k, part in enumerate(parts) if part != "none"]
    kinds = fields.get("kinds", "").lower().split()
    if len(kinds) == count and count > 3:
        return [k for k, kind in enumerate(kinds) if kind in _SPATIAL][:3]
    sizes = _parse_numbers(fields, "sizes", path)
    if count > 3:
        long_axes = [k for k in range(count) if sizes[k] > 1]
        return long_axes if len(long_axes) <= 3 else list(range(3))
    return list(range(count))


def _grid(
    path: Path, fields: dict[str, str], axes: list[int], sizes: list[int], start: int, follow: bool
) -> Grid:
    kind = fields.get("type", "").lower()
    if kind not in _TYPES:
        raise no_grey_values(path, f"type {kind or 'missing'}")
    packing = _PACKINGS.get(fields.get("encoding", "").lower())
    if packing is None:
        raise CtInertiaError.of(
            "the encoding",
            f"one of {', '.join(_PACKINGS)}",
            fields.get("encoding", "none"),
            path.name,
            next_step="Export it as raw or gzip",
        )
    if len(axes) != 3 or min(sizes) < 1 or min(sizes[k] for k in axes) < 2:
        raise not_three_dimensional(path.name, sizes)
    order = ">" if fields.get("endian", "little").lower() == "big" else "<"
    spacing, direction, origin, anatomical = _place(path, fields, axes, sizes)
    extra = int(np.prod([n for k, n in enumerate(sizes) if k not in axes], dtype=np.int64))
    return Grid(
        (sizes[axes[0]], sizes[axes[1]], sizes[axes[2]]),
        np.dtype(order + _TYPES[kind]),
        tuple(_files(path, fields, start, packing, follow)),
        spacing,
        origin,
        direction,
        packing,
        anatomical,
        layers=extra,
        skip=max(0, _integer(fields, path, "byte skip", "byteskip")) if packing in _SKIPPED_UNPACKED else 0,
    )


def _place(
    path: Path, fields: dict[str, str], axes: list[int], sizes: list[int]
) -> tuple[Array | None, Array, Array, bool]:
    """Return spacing, direction, origin, and whether the space is the patient's."""
    space = fields.get("space", "").lower().replace("_", "-")
    signs, anatomical = _signs(space, path)
    units = re.findall(r'"([^"]*)"', fields.get("space units", fields.get("units", "")))
    factors = [mm_per_unit(unit) for unit in units]
    known = [f for f in factors if f is not None]
    scale = known[0] if known and min(known) == max(known) else 1.0
    if "space directions" in fields:
        vectors = [_vector(part, path) for part in re.findall(r"\([^)]*\)", fields["space directions"])]
        if len(vectors) != 3:
            raise header_fault(path, "NRRD volume", f"{len(vectors)} space directions")
        matrix = np.array(vectors).T * signs[:, None] * scale
        spacing = np.linalg.norm(matrix, axis=0)
        if np.any(spacing <= 0.0) or not np.all(np.isfinite(spacing)):
            return None, np.eye(3), np.zeros(3), anatomical
        origin = np.zeros(3)
        if "space origin" in fields:
            origin = _vector(fields["space origin"], path) * signs * scale
        return spacing, matrix / spacing, origin, anatomical
    if "spacings" not in fields:
        return None, np.eye(3), np.zeros(3), anatomical
    told_spacings = _parse_numbers(fields, "spacings", path)
    if len(told_spacings) != len(sizes):
        raise header_fault(path, "NRRD volume", f"{len(told_spacings)} spacings for {len(sizes)} axes")
    values = np.array(told_spacings)[axes]
    factor = np.array([f if f is not None else 1.0 for f in factors])
    steps = np.abs(values) * (factor[axes] if factor.size == len(sizes) else scale)
    if not np.all(np.isfinite(steps)) or np.any(steps <= 0.0):
        return None, np.eye(3), np.zeros(3), anatomical
    return steps, np.eye(3), np.zeros(3), anatomical


def _signs(space: str, path: Path) -> tuple[Array, bool]:
    """Return what turns the axes of the file's space into LPS."""
    space = space.removesuffix("-time")
    names = {"ras": "right-anterior-superior", "las": "left-anterior-superior"}
    names["lps"] = "left-posterior-superior"
    words = names.get(space, space).split("-")
    signs = {
        "left": 1.0,
        "right": -1.0,
        "posterior": 1.0,
        "anterior": -1.0,
        "superior": 1.0,
        "inferior": -1.0,
    }
    if len(words) == 3 and all(word in signs for word in words):
        return np.array([signs[word] for word in words]), True
    if space == "3d-left-handed":
        raise CtInertiaError.of(
            "the space", "right-handed", "3D-left-handed", path.name, "Export it in LPS or RAS"
        )
    return np.ones(3), False


def _vector(text: str, path: Path) -> Array:
    try:
        values = np.array([float(word) for word in text.strip("() ").split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,):
        raise header_fault(path, "NRRD volume", f"the vector {text}")
    return values


def _files(
    path: Path, fields: dict[str, str], start: int, packing: str, follow: bool
) -> list[tuple[Path, int]]:
    """Return the data files, each with the offset of its first voxel (or of its packed stream)."""
    skip = 0 if packing in _SKIPPED_UNPACKED else _integer(fields, path, "byte skip", "byteskip")
    lines = _integer(fields, path, "line skip", "lineskip")
    named = fields.get("data file")
    if not named:
        return [(path, -1 if skip == -1 else start + max(skip, 0))]
    most = max(_sizes(fields, path), default=0)
    names = named_files(named, fields.get("list", "").splitlines(), most, path, "NRRD volume")
    files = []
    for name in names:
        file = beside(path, name, follow)
        past = 0
        if lines and file.is_file():
            with file.open("rb") as stream:
                for _ in range(lines):
                    if not stream.readline(_HEADER_BYTES):
                        break
                past = stream.tell()
        files.append((file, -1 if skip == -1 else past + skip))
    return files


def _integer(fields: dict[str, str], path: Path, *names: str) -> int:
    text = next((fields[name] for name in names if fields.get(name)), "0")
    if not re.fullmatch(r"-1|\d{1,15}", text):
        raise header_fault(path, "NRRD volume", f"{names[0]} {text}")
    return int(text)


def _segments(keys: dict[str, str], path: Path) -> list[tuple[int, int, str]]:
    """Return layer, value in that layer and name of each segment of a Slicer segmentation."""
    segments = []
    for number in range(1000):
        value = keys.get(f"Segment{number}_LabelValue")
        if value is None:
            break
        layer = keys.get(f"Segment{number}_Layer", "0")
        if not all(re.fullmatch(r"\s*\d{1,9}\s*", word) for word in (value, layer)):
            raise header_fault(path, "NRRD volume", f"segment {number} with value {value}, layer {layer}")
        segments.append((int(layer), int(value), keys.get(f"Segment{number}_Name", f"segment {number + 1}")))
    return segments


def _flatten(layered: NDArray[Any], segments: list[tuple[int, int, str]]) -> tuple[NDArray[Any], Notice]:
    """Number the segments of a layered segmentation 1, 2, ... in the order of the file."""
    labels = np.zeros(layered.shape[:3], dtype=np.uint8 if len(segments) < 256 else np.uint16)
    for number, (layer, value, _) in enumerate(segments, start=1):
        labels[layered[..., layer] == value] = number
    listed = ", ".join(f"{number} {name}" for number, (_, _, name) in enumerate(segments, start=1))
    text = (
        f"The segmentation has {layered.shape[3]} layers; its segments were numbered {listed}. Where two "
        f"overlap the later one counts."
    )
    return labels, Notice("segments_numbered", text)
