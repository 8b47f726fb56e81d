"""Formats of scanners and viewers that no library reads: Scanco ISQ and AIM, VGStudio, Amira and Avizo.

A header that is cut or makes no sense raises whatever it does; `open_scan` makes one sentence of it. The
layouts of ISQ and AIM follow the reader in ITK: https://github.com/KitwareMedical/ITKIOScanco
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ct_inertia.scan.header import HEADER_BYTES, Header, beside, several_values, wrong_header
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.scan import check_grey_values
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

_BLOCK = 512  # bytes of a block of an ISQ header
_AIM_TYPES = {
    0x00010001: "<i1",
    0x00160001: "<u1",
    0x000D0001: "<u1",
    0x00020002: "<i2",
    0x00170002: "<u2",
    0x00030004: "<i4",
    0x001A0004: "<f4",
}
_VGI_KINDS = {"unsigned integer": "u", "signed integer": "i", "integer": "i", "float": "f", "double": "f"}
_AMIRA_TYPES = {"byte": "u1", "short": "i2", "ushort": "u2", "int": "i4", "float": "f4", "double": "f8"}
_BRACKET = re.compile(r'("[^"]{0,200}"|[\w.-]{1,200})?\s{0,20}([{}])')


def open_isq(path: Path) -> Header:
    """Open a Scanco ISQ volume.

    Raises
    ------
    StapeskitError
        Not such a file, or truncated.

    Notes
    -----
    An ISQ stores the extent of the whole volume in whole micrometres: the voxel size is rounded to that over
    the number of voxels.
    """
    head = _start(path)
    size = struct.unpack_from("<3i", head, 44)
    extent = np.array(struct.unpack_from("<3i", head, 56), dtype=float) * 1e-3
    (blocks,) = struct.unpack_from("<i", head, 508)
    if not head.startswith(b"CTDATA-HEADER_V1") or blocks < 0:
        raise wrong_header(path, "ISQ file", f"a file that begins with {head[:8]!r}, data at block {blocks}")
    header = _raw(path, size, "<i2", (blocks + 1) * _BLOCK)
    header.spacing_mm = extent / np.array(size)
    return header


def open_aim(path: Path) -> Header:
    """Open a Scanco AIM volume of version 020 or 030; its place in the original scan gives the origin.

    Raises
    ------
    StapeskitError
        Not such a file, truncated, packed, or of a data type that is no grey value.

    Notes
    -----
    The voxel size is in mm as VAX F floats, whose halves are swapped, in version 020 and in whole nanometres
    in version 030.
    """
    head = _start(path)
    newer = head.startswith(b"AIMDATA_V030")
    begin, word, at_kind = (16, "q", 12) if newer else (0, "i", 20)
    pre, image, log_bytes = struct.unpack_from(f"<3{word}", head, begin)
    known = (pre, image >= 204) == (40, True) if newer else (pre, image) == (20, 140)
    at = begin + pre
    log, data = at + image, at + image + log_bytes
    if not known or not log <= data <= path.stat().st_size:
        raise wrong_header(path, "AIM file", f"blocks of {pre}, {image} and {log_bytes} bytes")
    kind, *values = struct.unpack_from(f"<i6{word}", head, at + at_kind)
    place = at + at_kind + 4 + 21 * struct.calcsize(f"<{word}")
    if newer:
        cell = np.array(struct.unpack_from("<3q", head, place), dtype=float) * 1e-6
    else:
        halves = np.frombuffer(head, "<u2", 6, place).reshape(
            3, 2
        )  # four times the IEEE number of the same bits
        cell = halves[:, ::-1].copy().view("<f4")[:, 0].astype(float) / 4.0
    if kind not in _AIM_TYPES:
        wanted = "8-bit, 16-bit, 32-bit or float voxels, not packed"
        step = "Export it unpacked, or as ISQ or MHA"
        raise StapeskitError.of("the AIM data", wanted, f"type {kind:#x}", path.name, step)
    header = _raw(path, values[3:], _AIM_TYPES[kind], data)
    header.spacing_mm, header.origin_mm = cell, np.nan_to_num(np.array(values[:3], dtype=float) * cell)
    _note_aim_density(header, head[log:data].decode("latin-1"), path.name)
    return header


def _note_aim_density(header: Header, log: str, name: str) -> None:
    """Report the line from grey value to density in the processing log, as points for a calibration file."""
    entries = {
        key.strip(): value.strip() for key, _, value in (line.partition("  ") for line in log.splitlines())
    }
    try:
        words = [entries[key] for key in ("Mu_Scaling", "Density: slope", "Density: intercept")]
        scaling, slope, intercept = (float(word) for word in words)
    except (KeyError, ValueError):
        return
    if not (scaling > 0.0 and slope > 0.0 and np.isfinite(slope * scaling + intercept)):
        return
    header.note(
        f"{name} has the line density = {slope:.6g} * grey value / {scaling:.6g} + {intercept:.6g} "
        f"{entries.get('Density: unit') or 'mg HA/ccm'}. For a density of every voxel write "
        f"points_mg_ha_cm3 = [[0, {intercept:.6g}], [{2.0 * scaling:.0f}, {2.0 * slope + intercept:.6g}]] "
        f"into the file of --calibration."
    )


def open_vgi(path: Path) -> Header:
    """Open the volume that a VGStudio header describes.

    Raises
    ------
    StapeskitError
        A key is missing, the voxels are packed or in several files, or the file is missing or too short.

    Notes
    -----
    The section ``[file1]`` says how the voxels are stored, which need not be how ``[representation]`` shows
    them. The place and rotation of the volume in the scene of VGStudio are not scan coordinates: origin 0,
    identity.
    """
    head = _start(path)
    try:
        sections = _vgi_sections(head.decode("utf-8"))
    except UnicodeDecodeError:  # of Windows, where the unit may be µm
        sections = _vgi_sections(head.decode("latin-1"))
    stored = [name for name in sections if re.fullmatch(r"file\d{0,9}", name)]
    part = sections.get("representation", {}) | sections[stored[0]]
    if len(stored) > 1 or part.get("fileformat", "raw").lower() != "raw":
        got = f"{len(stored)} files of format {part.get('fileformat', 'raw')}"
        step = "Export the volume as one raw file, unsigned integer or float"
        raise StapeskitError.of("the voxels", "in one raw file", got, path.name, step)
    named = part.get("name") or path.with_suffix(".vol").name
    order = ">" if part.get("byteorder", "").lower().startswith("big") else "<"
    kind = f"{order}{_VGI_KINDS[part['datatype'].lower()]}{int(part['bitsperelement']) // 8}"
    size = [int(word) for word in part["size"].split()]
    header = _raw(path, size, kind, int(part.get("skipheader", "0")), beside(path, named))
    geometry = sections.get("geometry", {})
    unit = mm_per_unit(geometry.get("unit"))
    if unit is not None and "resolution" in geometry:
        steps = (geometry["resolution"].split(), geometry.get("scale", "1 1 1").split())
        header.spacing_mm = unit * np.prod(np.array(steps, dtype=float), axis=0)
    mirrored = sections.get("representation", {}).get("mirror", "0")
    if any(float(word) for word in mirrored.split()):
        text = (
            f"{path.name} is shown mirrored in VGStudio (mirror = {mirrored}); its voxels were read as they "
            "are stored. Use --mirror if the ear is a mirror image."
        )
        header.notices.append(Notice("handedness_unconfirmed", text))
    return header


def _vgi_sections(text: str) -> dict[str, dict[str, str]]:
    """Return the sections of the first volume, names and keys in lower case; of doubles the first counts."""
    volume = re.split(r"^\s*\{volume2\}", text, flags=re.MULTILINE | re.IGNORECASE)[0]
    parts = re.split(r"^\s*\[([^\]\r\n]*)\]", volume, flags=re.MULTILINE)
    sections: dict[str, dict[str, str]] = {}
    for name, body in zip(parts[1::2], parts[2::2], strict=True):
        for key, value in re.findall(r"^[ \t]*(\w+)[ \t]*=[ \t]*([^\r\n]*)", body, re.MULTILINE):
            sections.setdefault(name.strip().lower(), {}).setdefault(key.lower(), value.strip())
    return sections


def open_amira(path: Path) -> Header:
    """Open an Avizo or Amira lattice of binary voxels with its bounding box.

    Raises
    ------
    StapeskitError
        Not such a file, text or packed voxels, or another lattice than a uniform one.

    Notes
    -----
    The bounding box joins the centres of the outer voxels. ``Units`` gives its unit; without it the spacing
    must be given.
    """
    head = _start(path)
    first = head.split(b"\n", 1)[0].decode("latin-1")
    end = re.search(rb"^@1[ \t]*\r?\n", head, re.MULTILINE)
    if not ("AmiraMesh" in first or "Avizo" in first) or end is None:
        raise wrong_header(path, "Amira lattice", "a file that does not begin as one")
    text = head[: end.start()].decode("utf-8", "replace")
    lattice = re.search(r"define\s+Lattice\s+(\d{1,9})\s+(\d{1,9})\s+(\d{1,9})\b", text)
    if lattice is None or re.search(r'CoordType\s+"(?!uniform)', text):
        raise wrong_header(path, "Amira lattice", "a lattice that is not a uniform one in three dimensions")
    field = re.search(r"Lattice\s*\{\s*(\w+)(\[\d+\])?\s+\w+\s*\}\s*=?\s*@1\b(?:\((\w+))?", text)
    if field is None or field[1] not in _AMIRA_TYPES or field[2] not in (None, "[1]"):
        raise several_values(path, field[0] if field else "no lattice")
    if field[3] or "ASCII" in first.upper():
        got, step = field[3] or "text", "Save it as AmiraMesh binary, without compression"
        raise StapeskitError.of("the lattice", "of binary voxels that are not packed", got, path.name, step)
    order = "<" if "LITTLE" in first.upper() else ">"
    size = [int(word) for word in lattice.groups()]
    header = _raw(path, size, order + _AMIRA_TYPES[field[1]], end.end())
    header.names = _materials(text)
    moved = re.search(r"TransformationMatrix([-+0-9.eE\s]+)", text)
    if moved and not np.array_equal(np.array(moved[1].split(), dtype=float), np.eye(4).ravel()):
        header.note(
            f"{path.name} is moved by a TransformationMatrix in Avizo or Amira. It was not applied: scan "
            f"coordinates, landmarks and --anterior are those of the lattice. Give its scale by --spacing."
        )
    header.known = "the lattice has no unit of length"
    box = re.search(r"BoundingBox\s+([-+0-9.eE ]+)", text)
    if box is None:
        return header
    unit = re.search(r"Coordinates\s+\"([^\"]+)\"", text)
    factor = mm_per_unit(unit[1]) if unit else None
    ends = np.array([float(word) for word in box[1].split()]).reshape(3, 2)
    steps = (ends[:, 1] - ends[:, 0]) / (np.array(size) - 1)
    if factor is None:
        header.known += f"; its voxels are {steps[0]:.6g} x {steps[1]:.6g} x {steps[2]:.6g}"
    else:
        header.spacing_mm, header.origin_mm = steps * factor, ends[:, 0] * factor
    return header


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


def _start(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(HEADER_BYTES)


def _raw(path: Path, size: Sequence[int], kind: str, start: int, file: Path | None = None) -> Header:
    """Return a volume of x, y, z voxels behind a header in the same file, or in another one."""
    header = Header(tuple(reversed(size)), np.dtype(kind))
    check_grey_values(header.shape, header.dtype, path.name)
    header.set_planes(file or path, start, path, exact=file is not None)
    return header
