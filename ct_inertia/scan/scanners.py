"""Formats of scanners and viewers that no library reads: Scanco ISQ and AIM, VGStudio, Amira and Avizo.

The layouts of ISQ and AIM follow the reader in ITK: https://github.com/KitwareMedical/ITKIOScanco
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.stored import HEADER_BYTES, Stored, Stream, beside, several_values, wrong_file
from stapeskit.faults import StapeskitError


def _layout(**fields: tuple[int, str]) -> np.dtype[Any]:
    """Return a binary header as a type: of each field the byte at which it begins, and its type."""
    offsets, formats = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets})


_ISQ = _layout(magic=(0, "S16"), size=(44, "3<i4"), extent_um=(56, "3<i4"), blocks=(508, "<i4"))
_ISQ_BLOCK = 512  # bytes
_AIM_020 = _layout(
    blocks=(0, "3<i4"), kind=(40, "<i4"), place=(44, "3<i4"), size=(56, "3<i4"), cell=(128, "(3,2)<u2")
)
_AIM_030 = _layout(
    blocks=(16, "3<i8"), kind=(68, "<i4"), place=(72, "3<i8"), size=(96, "3<i8"), cell=(240, "3<i8")
)
"""``blocks``: bytes of the three blocks before the voxels: two headers and the processing log."""
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


def open_isq(path: Path) -> Stored:
    """Open a Scanco ISQ volume.

    Notes
    -----
    An ISQ stores the extent of the whole volume in whole micrometres: the voxel size is rounded to that over
    the number of voxels.
    """
    head = np.frombuffer(_start(path), _ISQ, 1)[0]
    size, blocks = head["size"].tolist(), int(head["blocks"])
    if head["magic"] != b"CTDATA-HEADER_V1" or blocks < 0:
        got = f"a file that begins with {head['magic'][:8]!r}, data at block {blocks}"
        raise wrong_file("ISQ file", got)
    stored = Stored(tuple(reversed(size)), np.dtype("<i2"), Stream(path, (blocks + 1) * _ISQ_BLOCK))
    stored.spacing_mm = head["extent_um"] * 1e-3 / np.array(size)
    return stored


def open_aim(path: Path) -> Stored:
    """Open a Scanco AIM volume of version 020 or 030; its place in the original scan gives the origin.

    Notes
    -----
    The voxel size is in mm as VAX F floats, whose halves are swapped and which are four times the IEEE number
    of the same bits, in version 020, and in whole nanometres in version 030.
    """
    content = _start(path)
    newer = content.startswith(b"AIMDATA_V030")
    layout, begin = (_AIM_030, 16) if newer else (_AIM_020, 0)
    head = np.frombuffer(content, layout, 1)[0]
    first, second, log_bytes = head["blocks"].tolist()
    log = begin + first + second
    known = first == 40 and second >= 204 if newer else (first, second) == (20, 140)
    if not known or not 0 <= log_bytes <= path.stat().st_size - log:
        raise wrong_file("AIM file", f"blocks of {first}, {second} and {log_bytes} bytes")
    kind, cell = int(head["kind"]), head["cell"]
    if kind not in _AIM_TYPES:
        wanted, step = (
            "8-bit, 16-bit, 32-bit or float voxels, not packed",
            "Export it unpacked, as ISQ or MHA",
        )
        raise StapeskitError.of("the AIM data", wanted, f"type {kind:#x}", next_step=step)
    size, stream = head["size"].tolist(), Stream(path, log + log_bytes)
    stored = Stored(tuple(reversed(size)), np.dtype(_AIM_TYPES[kind]), stream)
    if newer:
        stored.spacing_mm = cell * 1e-6
    else:
        stored.spacing_mm = cell[:, ::-1].copy().view("<f4")[:, 0].astype(float) / 4.0
    stored.origin_mm = np.nan_to_num(head["place"] * stored.spacing_mm)
    return stored


def open_vgi(path: Path) -> Stored:
    """Open the volume that a VGStudio header describes.

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
    files = [name for name in sections if re.fullmatch(r"file\d{0,9}", name)]
    part, geometry = sections.get("representation", {}) | sections[files[0]], sections.get("geometry", {})
    if len(files) > 1 or part.get("fileformat", "raw").lower() != "raw":
        got = f"{len(files)} files of format {part.get('fileformat', 'raw')}"
        step = "Export the volume as one raw file, unsigned integer or float"
        raise StapeskitError.of("the voxels", "in one raw file", got, next_step=step)
    order = ">" if part.get("byteorder", "").lower().startswith("big") else "<"
    dtype = np.dtype(f"{order}{_VGI_KINDS[part['datatype'].lower()]}{int(part['bitsperelement']) // 8}")
    data = beside(path, part.get("name") or path.with_suffix(".vol").name)
    size = [int(word) for word in part["size"].split()]
    stream = Stream(data, int(part.get("skipheader", "0")), exact=True)
    stored = Stored(tuple(reversed(size)), dtype, stream)
    unit = mm_per_unit(geometry.get("unit"))
    if unit is not None and "resolution" in geometry:
        steps = (geometry["resolution"], geometry.get("scale", "1 1 1"))
        numbers = [line.replace(",", ".").split() for line in steps]  # Windows may write decimal commas
        stored.spacing_mm = unit * np.prod(np.array(numbers, dtype=float), axis=0)
    mirrored = part.get("mirror", "0")
    if any(float(word.replace(",", ".")) for word in mirrored.split()):
        stored.note(
            f"{path.name} is shown mirrored in VGStudio (mirror = {mirrored}); its voxels were read as they "
            "are stored. Use --mirror if the ear is a mirror image.",
            "handedness_unconfirmed",
        )
    return stored


def _vgi_sections(text: str) -> dict[str, dict[str, str]]:
    """Return the sections of the first volume, names and keys in lower case; of doubles the first counts."""
    volume = re.split(r"^\s*\{volume2\}", text, flags=re.MULTILINE | re.IGNORECASE)[0]
    parts = re.split(r"^\s*\[([^\]\r\n]*)\]", volume, flags=re.MULTILINE)
    sections: dict[str, dict[str, str]] = {}
    for name, body in zip(parts[1::2], parts[2::2], strict=True):
        for key, value in re.findall(r"^[ \t]*(\w+)[ \t]*=[ \t]*([^\r\n]*)", body, re.MULTILINE):
            sections.setdefault(name.strip().lower(), {}).setdefault(key.lower(), value.strip())
    return sections


def open_amira(path: Path) -> Stored:
    """Open an Avizo or Amira lattice of binary voxels with its bounding box.

    Notes
    -----
    The bounding box joins the centres of the outer voxels. ``Units`` gives its unit; without it the spacing
    must be given. The number of a label is the place of its material, from 0.
    """
    head = _start(path)
    first = head.split(b"\n", 1)[0].decode("latin-1").upper()
    end = re.search(rb"^@1[ \t]*\r?\n", head, re.MULTILINE)
    text = head[: end.start() if end else 0].decode("utf-8", "replace")
    lattice = re.search(r"define\s+Lattice\s+(\d{1,9})\s+(\d{1,9})\s+(\d{1,9})\b", text)
    if end is None or lattice is None or re.search(r'CoordType\s+"(?!uniform)', text):
        raise wrong_file("Amira lattice", "a file without a uniform lattice in three dimensions")
    field = re.search(r"Lattice\s*\{\s*(\w+)(\[\d+\])?\s+\w+\s*\}\s*=?\s*@1\b(?:\((\w+))?", text)
    if field is None or field[1] not in _AMIRA_TYPES or field[2] not in (None, "[1]"):
        raise several_values(field[0] if field else "no lattice")
    if field[3] or "ASCII" in first:
        wanted, step = "of binary voxels that are not packed", "Save it as AmiraMesh binary, not compressed"
        raise StapeskitError.of("the lattice", wanted, field[3] or "text", next_step=step)
    size = [int(word) for word in lattice.groups()]
    dtype = np.dtype(("<" if "LITTLE" in first else ">") + _AMIRA_TYPES[field[1]])
    stored = Stored(tuple(reversed(size)), dtype, Stream(path, end.end()))
    materials = re.search(r"\bMaterials\s*\{((?:[^{}]*\{[^{}]*\})*)", text)
    names = re.findall(r'("[^"]*"|[\w.-]+)\s*\{[^{}]*\}', materials[1] if materials else "")
    stored.names = {number: name.strip('"') for number, name in enumerate(names)}
    moved = re.search(r"TransformationMatrix([-+0-9.eE\s]+)", text)
    if moved and not np.array_equal(np.array(moved[1].split(), dtype=float), np.eye(4).ravel()):
        stored.note(
            f"{path.name} is moved by a TransformationMatrix in Avizo or Amira. It was not applied: scan "
            f"coordinates, landmarks and --anterior are those of the lattice. Give its scale by --spacing."
        )
    stored.known = "the lattice has no unit of length"
    box = re.search(r"BoundingBox\s+([-+0-9.eE ]+)", text)
    if box is not None:
        ends = np.array(box[1].split(), dtype=float).reshape(3, 2)
        steps = (ends[:, 1] - ends[:, 0]) / (np.array(size) - 1)
        unit = re.search(r"Coordinates\s+\"([^\"]+)\"", text)
        factor = mm_per_unit(unit[1]) if unit else None
        stored.known += f"; its voxels are {steps[0]:.6g} x {steps[1]:.6g} x {steps[2]:.6g}"
        if factor is not None:
            stored.spacing_mm, stored.origin_mm = steps * factor, ends[:, 0] * factor
    return stored


def _start(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(HEADER_BYTES)
